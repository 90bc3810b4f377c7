"""Pages, help texts and messages read as a native engineer writes: without some turns that make a reader go back.

Code, quoted output and addresses are left out. docs/glossary.md lists what is written instead.
"""

import ast
import re

import pytest

from support.places import ROOT

PAGES = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
WAITS = {
    "docs/decisions/0007-keys.md",
    "docs/decisions/0011-trackers.md",
    "docs/decisions/0012-the-door.md",
    "docs/decisions/0013-places-for-the-autopilot.md",
    "docs/decisions/0016-the-autopilots-time.md",
    "docs/decisions/0018-the-heading.md",
    "docs/decisions/0019-flown-and-told.md",
    "docs/decisions/0020-a-real-autopilots-manners.md",
    "docs/decisions/0021-measured-noise.md",
    "docs/decisions/0022-a-world-from-outside.md",
    "docs/decisions/0025-silent-teams.md",
    "docs/decisions/0026-metres.md",
    "docs/decisions/0027-a-third-verdict.md",
    "docs/decisions/0028-look-alikes.md",
    "docs/decisions/0029-fewer-larger-steps.md",
    "docs/decisions/0030-seconds-of-looks.md",
    "docs/decisions/0031-cameras-are-charts.md",
    "docs/decisions/0032-ghosts-by-parallax.md",
    "docs/decisions/0033-linked-and-not-heard.md",
    "docs/decisions/0034-a-wide-lens.md",
    "docs/decisions/0035-places-that-leap.md",
    "docs/decisions/0036-hidden-is-not-gone.md",
    "docs/decisions/0037-no-head-for-the-span.md",
    "docs/decisions/0039-two-stages.md",
    "docs/decisions/0040-spans-by-the-second-stage.md",
    "docs/decisions/0041-the-guard.md",
    "docs/decisions/0042-one-headline.md",
    "docs/decisions/README.md",
}
"""Pages that still have such turns."""

MACHINE = (
    r"(?:drones?|followers?|leaders?|teammates?|observers?|strangers?|agents?|guards?|autopilots?|cameras?|trackers?"
    r"|tracks?|detectors?|models?|process|processes|programs?|commands?|simulators?|radios?|messages?|it|they)"
)
REFUSED = {
    "a headless relative": r"(?:(?<=[.:;|] )|^)(?:- |\* )?\**Who(?:m|se)? (?![^.?]*\?)",
    "a headless relative after a preposition": (
        r"\b(?:[Oo]f|[Bb]y|[Ff]or|to|from|with|than|at|after|on|and|but|because|while|around) who(?:m)?\b"
    ),
    "a person's pronoun": r"\b(?:[Ww]ho(?:m|se)?ever|[Nn]obody|[Ss]omebody|[Ee]verybody)\b",
    "'anew' for 'again'": r"\banew\b",
    "'beside' for 'next to' or 'and'": r"\b[Bb]eside\b",
    "a machine that talks": r"\b(?:[Tt]ell|[Tt]ells|[Tt]old|[Tt]elling)\b",
    "a machine with a mind": (
        rf"\b{MACHINE}(?: (?:that|which|itself))?(?: (?:is|are|was|were|has|have|may|must|never|also))?"
        r" (?:says?|said|knows?|knew|doubts?|doubted|believes?|believed|thinks?|hears?|heard|speaks?|spoke)\b"
    ),
    "'the own' for 'its own'": r"\b[Tt]he own\b",
    "'surest' for 'highest confidence'": r"\bsurest\b",
}


PRINTED = [
    *sorted((ROOT / "agents").glob("*.py")),
    *(
        file
        for room in (
            "autopilot", "calibration", "camera_sources", "cameras", "client", "config", "detection", "diagnosis",
            "doctor", "formation", "lab/score", "lab/swarm", "monitor", "recording", "replay", "runtime", "security",
            "setup", "training", "transport", "wire",
        )
        for file in sorted((ROOT / "swarmtrack" / room).rglob("*.py"))
    ),
]  # fmt: skip
"""Modules whose strings with a space in them are taken for messages."""
OF_ONE_BENCHMARK = re.compile(r"^=== swarmtrack bench .*?(?=^===|\Z)", re.MULTILINE | re.DOTALL)
"""Its help, whose arguments are its own module's."""


def prose(text):
    """The page's sentences, one string per paragraph, list item or row: without code, quoted output and addresses."""
    text = re.sub(r"^ *```.*?^ *```$", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    # The table of words that are not used names them.
    text = re.sub(r"^## Words that we do not use$.*?(?=^## )", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"`[^`]*`", "`", text)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    text = re.sub(r"\bautopilot\.tell\b|\btell(?= = )", "", text)
    text = re.sub(r"[\w/-]+\.md\b", "[]", text)
    parts = re.split(r"\n\s*\n|\n(?=\s*(?:[*-]|\d+\.|\||#)\s?)", text)
    return [" ".join(part.split()) for part in parts if part.strip()]


def refused(text):
    return [
        f"{what}: …{part[max(0, m.start() - 30) : m.end() + 30]}…"
        for part in prose(text)
        for what, pattern in REFUSED.items()
        for m in re.finditer(pattern, part)
    ]


def messages(source):
    """The strings of a module that hold a space, docstrings aside, with … for what is filled in."""
    tree = ast.parse(source)
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}

    def found(node):
        if id(node) in docstrings:
            return
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "…" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        else:
            for child in ast.iter_child_nodes(node):
                yield from found(child)

    return [text for text in found(tree) if " " in text.strip()]


def name(page):
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", [page for page in PAGES if name(page) not in WAITS], ids=name)
def test_a_page_is_free_of_them(page):
    assert refused(page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("module", PRINTED, ids=name)
def test_what_programs_print_is_free_of_them(module):
    found = [refused(text) for text in messages(module.read_text(encoding="utf-8"))]
    assert [turns for turns in found if turns] == []


def test_help_is_free_of_them():
    text = (ROOT / "tests" / "golden" / "help.txt").read_text(encoding="utf-8")
    assert refused(OF_ONE_BENCHMARK.sub("", text)) == []


@pytest.mark.parametrize("page", sorted(WAITS))
def test_a_page_that_waits_has_some_and_leaves_the_list_when_it_has_none(page):
    assert refused((ROOT / page).read_text(encoding="utf-8")) != []


@pytest.mark.parametrize(
    "sentence",
    [
        "Who holds stands still and still keeps clear, and goes on by itself.",
        "It keeps clear of nobody whom its cameras do not see.",
        "This page is for whoever stands beside it with a finger on the switch.",
        "Nothing is sent any more, until you engage it anew.",
        "A camera keeps clear of whom it sees, and of who comes straight on.",
        "A drone that says how it moves is known by that.",
        "The agent knows such a rhythm from loss.",
        "All a drone must tell the others is its ID.",
        "It brakes softly, because who brakes hard tilts its camera away.",
        "| what is wrong | right later | surest wrong name |",
        "The own position jumps.",
    ],
)
def test_what_pages_once_said_is_refused(sentence):
    assert refused(sentence) != []


@pytest.mark.parametrize(
    "sentence",
    [
        "A holding drone hovers and still avoids others. It resumes by itself.",
        "Who may look?",
        "The pilot who holds the transmitter knows the mode.",
        "The agent logs `nobody is heard beside drone 3`.",
        "See [the page about it](telling.md).",
    ],
)
def test_plain_sentences_quotations_and_addresses_are_not(sentence):
    assert refused(sentence) == []
