"""What `mkdocs build` does beyond docs/ (mkdocs.yml): three pages from above it, a navigation, links that leave."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
ABOVE = {"README.md": "project.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s#]*)(#[^)\s]*)?\)")


def on_config(config: Any) -> Any:
    """The navigation has the headings of docs/README.md, and below each the pages of its table."""
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    config.nav = [{"Overview": "README.md"}, {"The project": "project.md"}]
    for section in re.split(r"^## ", index, flags=re.MULTILINE)[1:]:
        heading, _, table = section.partition("\n")
        config.nav.append({heading: re.findall(r"^\| \[.*?\]\((.*?\.md)\)", table, re.MULTILINE)})
    config.nav.append({"Take part": ["contributing.md", "changelog.md"]})
    return config


def on_files(files: Any, config: Any) -> Any:
    """The pages that stand above docs/."""
    for source, name in ABOVE.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Links to pages of the site, as seen from this one; others go to the repository, where there is an address of it,
    or are their text alone."""
    here = page.file.src_uri
    folder = "" if here in ABOVE.values() else posixpath.join("docs", posixpath.dirname(here))

    def led(link: re.Match[str]) -> str:
        mark, text, path, anchor = link[1], link[2], link[3], link[4] or ""
        if not path or "://" in path:
            return link[0]
        there = posixpath.normpath(posixpath.join(folder, path))
        inside = ABOVE.get(there) or there.removeprefix("docs/")
        if files.get_file_from_path(inside) is not None and (there in ABOVE or there.startswith("docs/")):
            target = posixpath.relpath(inside, posixpath.dirname(here) or ".")
            return f"{mark}[{text}]({target}{anchor})"
        if not (ROOT / there).exists():
            return link[0]
        return f"[{text}]({config.repo_url.rstrip('/')}/blob/main/{there})" if config.repo_url else text

    return LINK.sub(led, markdown)
