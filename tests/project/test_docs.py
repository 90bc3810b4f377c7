"""The commands, links and configs in README and docs: what a reader copies must work.

Commands stand in ```sh blocks. All of them must parse; those that are quick and harmless are run, page by page in a
folder that holds the examples of configs/. A comment above a block, `<!-- not run: WHY -->`, spares it; below
`<!-- run: WHY -->` all of them are run, however long they take.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from support.patience import PATIENCE
from support.places import ROOT
from swarmtrack.agents import bench, main, vehicle
from swarmtrack.config.drone import load_config, load_team_config
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.swarm.world_file import load_world

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PROGRAMS = ("swarmtrack", "swarmtrack-agent")
BEFORE = ("sudo", "nohup", "exec", "nice", "-u", "-n")  # with the options of sudo and nice that take a word
# Of these all actions are over in a moment and touch nothing but the folder they are told.
QUICK = ("config", "keys", "calibrate board")
QUICK_FLAGS = {"--check", "--list", "--version", "--help", "-h"}


class Command(NamedTuple):
    """One line of a ```sh block: its words, without what a shell makes of the rest."""

    page: Path
    line: int
    words: list[str]
    mark: str
    """What the comment above its block says."""

    @property
    def spared(self) -> bool:
        return self.mark.startswith("not run")

    @property
    def flown(self) -> bool:
        return self.mark.startswith("run: ")

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}: {' '.join(self.words)}"


def commands(page: Path) -> list[Command]:
    """Those of our own programs in the page's ```sh blocks."""
    found = []
    text = page.read_text(encoding="utf-8")
    for block in re.finditer(
        r"(?:<!-- (?P<mark>[^\n]*?) -->\n *)?```(?:sh|bash)\n(?P<body>.*?)```", text, re.DOTALL
    ):
        first = text[: block.start("body")].count("\n") + 1
        body = re.sub(r"\\\n", " \0", block["body"])  # a line that goes on, still counted as a line
        number = first
        for line in body.split("\n"):
            words = own_words(line.replace("\0", ""))
            if words:
                found.append(Command(page, number, words, block["mark"] or ""))
            number += 1 + line.count("\0")
    return found


def own_words(line: str) -> list[str]:
    """The words of our program in a shell's line, or none: without sudo, variables, pipes and redirections."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars="|&;<>")
    lexer.whitespace_split = True
    words: list[str] = []
    for word in lexer:
        if set(word) <= set("|&;<>"):
            break
        words.append(word)
    while words and (words[0] in BEFORE or re.match(r"\w+=", words[0])):
        words = words[2:] if words[0] in ("-u", "-n") else words[1:]
    if not words or Path(words[0]).name not in PROGRAMS:
        return []
    return [Path(words[0]).name, *words[1:]]


def parse(words: list[str]) -> str:
    """What the program's own parser has against a command line; empty if nothing."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint), contextlib.redirect_stdout(io.StringIO()):
            if words[0] == "swarmtrack":
                main.parse(words[1:])
            else:
                vehicle.parser().parse_args(words[1:])
    except SystemExit as end:
        return complaint.getvalue() if end.code else ""
    return ""


ALL = [command for page in PAGES for command in commands(page)]
WITH_COMMANDS = [page for page in PAGES if commands(page)]


def test_the_search_finds_commands():
    assert len(ALL) >= 5
    assert ["swarmtrack", "keys", "init", "keys", "--team", "red"] in [command.words for command in ALL]


@pytest.mark.parametrize("command", ALL, ids=str)
def test_every_command_is_one(command):
    assert parse(command.words) == ""


def test_a_command_that_is_none_is_found():
    assert "there is no command fly" in parse(["swarmtrack", "fly"])
    assert "unrecognized arguments: --bogus" in parse(["swarmtrack", "config", "check", "a.toml", "--bogus"])
    assert "--config" in parse(["swarmtrack-agent"])
    assert own_words("sudo -u pilot A=1 .venv/bin/swarmtrack sim | tee log  # three drones") == [
        "swarmtrack",
        "sim",
    ]
    assert own_words("# swarmtrack sim") == own_words("scp swarmtrack host:") == []


def is_quick(words: list[str]) -> bool:
    """Whether it can be run here: over in a moment, and on files that the page itself makes or configs/ holds."""
    if any(word.startswith(("/etc/", "/var/", "/opt/")) for word in words):
        return False
    if QUICK_FLAGS & set(words):
        return True
    return words[0] == "swarmtrack" and " ".join(words[1:3]).startswith(QUICK)


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_quick_ones_of_a_page_run_one_after_another(page, tmp_path):
    quick = [c for c in commands(page) if is_quick(c.words) and not c.spared]
    if not quick:
        pytest.skip("none that is quick")
    for example in (ROOT / "configs").glob("*.*"):
        shutil.copy(example, tmp_path)
    shutil.copy(ROOT / "configs" / "usb-camera.yaml", tmp_path / "cam1.yaml")
    for command in quick:
        result = run(command, tmp_path)
        assert result.returncode == 0, f"{command}\n{result.stdout}{result.stderr}"


def run(command: Command, folder: Path) -> subprocess.CompletedProcess[str]:
    module = "main" if command.words[0] == "swarmtrack" else "vehicle"
    return subprocess.run(
        [sys.executable, "-m", f"swarmtrack.agents.{module}", *command.words[1:]],
        cwd=folder,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "HOME": str(folder)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


@pytest.mark.long("three drones fly with pictures, for 8 s; in the default run, tests/replay replays a swarm")
def test_a_flight_is_recorded_and_replayed_as_the_docs_say(tmp_path):
    pytest.importorskip("zenoh", reason="Zenoh has no wheel here")
    fly, *look = (command for command in ALL if command.flown and command.page.name == "recording.md")
    # Shorter than a reader's flight, which shows no more.
    flown = run(fly._replace(words=[*fly.words, "--seconds", "8"]), tmp_path)
    info, replayed, what_if = (run(command, tmp_path) for command in look)
    verdict = flown.returncode  # on a busy machine the swarm may fail, and its replay with it
    assert verdict in (0, 1, 3), flown.stderr
    assert info.returncode == 0, info.stderr
    assert "drone 3 of team" in info.stdout
    assert replayed.returncode == verdict, replayed.stderr
    assert replayed.stdout.count("bit for bit as recorded") == 3
    assert "the verdict is the recorded one" in replayed.stdout
    assert what_if.returncode in (0, 1, 3), what_if.stderr
    assert "against it: " in what_if.stdout
    assert (tmp_path / "diff.png").stat().st_size > 10_000


# ── commands within sentences ────────────────────────────────────────────────────────────────────────────────────────


def mentions() -> list[tuple[Path, str]]:
    """Commands in `code` of prose and tables."""
    found = []
    for page in PAGES:
        prose = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        spans = [" ".join(span.split()) for span in re.findall(r"(?<!`)`([^`]+)`(?!`)", prose)]
        found += [(page, span) for span in spans if span.split()[:1] and span.split()[0] in PROGRAMS]
    return found


def test_commands_within_sentences_exist_and_so_do_their_flags():
    wrong = []
    for page, span in mentions():
        words = span.replace("[", " ").replace("]", " ").split()
        if len(words) < 2:
            continue
        usage = help_of(words)
        if usage is None:
            wrong.append(f"{page.relative_to(ROOT)}: {span}: no such command")
            continue
        wrong += [
            f"{page.relative_to(ROOT)}: {span}: no {flag}"
            for flag in re.findall(r"(?<![\w-])--[a-z][\w-]*", span)
            if flag not in usage
        ]
    assert len(mentions()) > 30
    assert wrong == []


def help_of(words: list[str]) -> str | None:
    """The help of a command and of its action; None where there is no such command."""
    if words[0] == "swarmtrack-agent":
        return vehicle.parser().format_help()
    if words[1].startswith("-"):
        return "--version --help"
    if words[1] not in main.COMMANDS:
        return None
    texts = []
    for ask in ([words[1], "--help"], [words[1], words[2] if len(words) > 2 else "", "--help"]):
        text = io.StringIO()
        with (
            contextlib.suppress(SystemExit),
            contextlib.redirect_stdout(text),
            contextlib.redirect_stderr(text),
        ):
            main.parse(ask)
        texts.append(text.getvalue())
    return "".join(texts)


def test_the_first_drone_is_set_up_as_the_readme_says():
    readme, bringup = (
        page.read_text(encoding="utf-8") for page in (ROOT / "README.md", ROOT / "docs" / "bringup.md")
    )
    setup = re.search(r"<!-- run -->\n```sh\n(.*?)\S+swarmtrack sim\n```", readme, re.DOTALL)[1]
    assert setup.count("\n") == 3
    assert f"```sh\n{setup}" in bringup


# ── links and configs ────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "page", [*PAGES, ROOT / "CHANGELOG.md"], ids=lambda page: str(page.relative_to(ROOT))
)
def test_every_link_leads_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        path, _, anchor = target.partition("#")
        if "://" in target:
            continue
        there = page.parent / path if path else page
        assert there.exists(), f"{target}: no such file"
        if anchor and there.suffix == ".md":
            headings = re.findall(r"^#+ (.*)$", there.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in slugs, f"{target}: no such heading"


@pytest.mark.parametrize("folder", ["docs", "docs/decisions"])
def test_the_index_of_a_folder_lists_its_pages(folder):
    index = ROOT / folder / "README.md"
    listed = re.findall(r"\]\(([^)#:]+\.md)\)", index.read_text(encoding="utf-8"))
    pages = {page.name for page in PAGES if page.parent == index.parent} - {"README.md"}
    assert pages - set(listed) == set()
    assert len(listed) == len(set(listed))


def test_the_docs_have_four_doors_and_the_decisions_are_behind_one_link():
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (.*)$", index, re.MULTILINE) == ["First day", "Fly", "Understand", "Reference"]
    assert re.findall(r"decisions/[^)]*", index) == ["decisions/README.md"]


def test_the_page_of_benchmarks_names_every_one():
    page = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    assert [name for name in bench.BENCHMARKS if f"`swarmtrack bench {name}" not in page] == []


@pytest.mark.parametrize(
    ("page", "text"),
    [
        (page, text)
        for page in PAGES[1:]  # of the README: test_readme.py
        for text in re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    ],
    ids=lambda value: str(value.relative_to(ROOT)) if isinstance(value, Path) else None,
)
def test_every_piece_of_a_config_fits_a_config(tmp_path, page, text):
    """A piece lacks what it does not speak of: a drone and a camera are put beneath it."""
    if "[world]" in text:
        (tmp_path / "world.toml").write_text(text, encoding="utf-8")
        assert load_world(tmp_path / "world.toml").scenario.members, page
        return
    if text.startswith("about"):
        (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
        assert load_scenario(tmp_path / "mine.toml").members, page
        return
    shutil.copy(ROOT / "configs" / "usb-camera.yaml", tmp_path / "cam1.yaml")
    (tmp_path / "base.toml").write_text(
        'drone.id = 1\n[camera]\nsource = "v4l2:///dev/video0"\n'
        + (
            ""
            if "calibration =" in text
            else 'calibration = "cam1.yaml"\n'
            if "intrinsics" not in text
            else ""
        ),
        encoding="utf-8",
    )
    piece = tmp_path / "piece.toml"
    piece.write_text("" if "extends" in text else 'extends = "base.toml"\n', encoding="utf-8")
    with piece.open("a", encoding="utf-8") as file:
        file.write(text.replace('extends = "team.toml"', 'extends = "base.toml"'))
    load_config(piece)
    load_team_config(piece)


def test_every_cap_on_time_and_memory_has_the_test_that_holds_it():
    page = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
    table = page.partition("## Resource limits")[2].partition("\n## ")[0]
    rows = [row for row in table.splitlines() if row.startswith("| ") and "`" in row]
    assert len(rows) > 10
    for row in rows:
        (name,) = re.findall(r"`(test_\w+\.py)` \|$", row)
        assert list((ROOT / "tests").rglob(name)), row
