"""The docs as a site: as published where its theme is installed (`pip install '.[docs]'`), else in a plain one."""

import re
import runpy
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from support.patience import PATIENCE
from support.places import DOCS, ROOT

SITE = ROOT / "docs" / "site.py"


@pytest.fixture
def site(tmp_path) -> Path:
    pytest.importorskip("mkdocstrings_handlers.python", reason="needs mkdocs and mkdocstrings[python]")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    if find_spec("material") is None:
        command += ["--theme", "mkdocs"]
    built = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=2 * PATIENCE, check=False
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return tmp_path


def test_it_is_built_without_a_warning_and_holds_what_docstrings_say(site):
    reference = (site / "api" / "index.html").read_text(encoding="utf-8")
    for words in ("swarmtrack.client.Swarm", "swarmtrack.messages.Scan", "swarmtrack.tracking.base.Filter"):
        assert f'id="{words}"' in reference
    assert "Carry the belief on by dt" in reference
    project = (site / "project" / "index.html").read_text(encoding="utf-8")
    assert 'href="../tutorial/"' in project
    assert (site / "examples" / "nearest_neighbour.py").is_file()
    assert not (site / "site.py").exists()


def test_all_pages_of_the_index_are_in_its_navigation():
    pytest.importorskip("mkdocs", reason="needs mkdocs")

    class Config:
        nav = None

    nav = runpy.run_path(str(SITE))["on_config"](Config()).nav
    pages = {
        page for entry in nav for listed in entry.values() if isinstance(listed, list) for page in listed
    }
    index = (DOCS / "README.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| \[.*\]\((.*\.md)\)", index, re.MULTILINE)) <= pages


def test_the_modules_of_the_reference_are_there():
    named = re.findall(r"^::: swarmtrack\.(.*)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert {"client", "messages", "tracking"} <= set(named)
    for module in named:
        path = ROOT / "swarmtrack" / module.replace(".", "/")
        assert path.with_suffix(".py").is_file() or (path / "__init__.py").is_file(), module
