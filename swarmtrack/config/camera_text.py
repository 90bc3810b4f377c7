"""The text of a calibration file as a table: YAML (also OpenCV's), JSON, OpenCV's XML, ROS' ost.txt, and the report of
`rs-enumerate-devices -c`.

The files come from anywhere, so each way to read them is bounded: in bytes, in depth, and in entries once aliases are
followed; XML with a document type is refused, because entities are only of use to an attacker here.
"""

from __future__ import annotations

import json
import re
import xml.parsers.expat
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from swarmtrack.config.camera_tables import AGAIN
from swarmtrack.errors import CalibrationError
from swarmtrack.plain_text import plain

MAX_CAMERA_FILE_BYTES = 1024 * 1024  # a calibration is a page
MOST_ENTRIES = 200_000
DEEPEST = 32  # levels
LONGEST_WHOLE_NUMBER = 100  # characters: Python takes time by their square, and shows none of thousands

Table = dict[str, Any]


class OpencvMatrix(dict[str, Any]):
    """A mapping with rows, cols and data that OpenCV wrote."""


class _NotUnderstood(Exception):
    """What is wrong with the text, and in which line, where that is known."""

    def __init__(self, problem: str, line: int | None = None) -> None:
        super().__init__(problem)
        self.line = line


def read_table(path: Path) -> Table:
    """A calibration file's first document, as a mapping. Raises CalibrationError."""
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_CAMERA_FILE_BYTES + 1)
        text = raw.decode().removeprefix("\ufeff")
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path, or bytes that are no UTF-8
        reason = getattr(error, "strerror", None) or "not text"
        raise CalibrationError(f"{path}: cannot be read ({reason}), expected a YAML file") from None
    if len(raw) > MAX_CAMERA_FILE_BYTES:
        raise CalibrationError(
            f"{path}: larger than {MAX_CAMERA_FILE_BYTES // 1024} KiB, expected a calibration in YAML: {AGAIN}"
        )
    form, read = _reader(text)
    try:
        table = read(text)
    except _NotUnderstood as error:
        place = "" if error.line is None else f":{error.line}"
        raise CalibrationError(
            f"{path}{place}: {plain(str(error), 200)}, expected valid {form}: {AGAIN}"
        ) from None
    if not isinstance(table, dict) or not table:
        raise CalibrationError(f"{path}: no keys in it, expected a calibration in {form}: {AGAIN}")
    return table


def _reader(text: str) -> tuple[str, Any]:
    """The name of the text's form, and its reader."""
    start = text.lstrip()
    if start.startswith("<"):
        return "XML", _xml
    if start.startswith("{"):
        return "JSON", _json
    if re.search(r"^camera matrix\s*$", text, re.MULTILINE) and re.search(r"^\[image\]", text, re.MULTILINE):
        return "ost.txt", _ost
    # Not \s, which would try each of many blank lines as the beginning of all that follow.
    if re.search(r'^[ \t]*Intrinsics? of "', text, re.MULTILINE):
        return "rs-enumerate-devices' report", _realsense
    return "YAML", _yaml


# --- YAML -------------------------------------------------------------------------------------------------------------

# libyaml's reads a page in a millisecond; that in Python, where libyaml is missing, takes a second for each 30 KB.
_BASE: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_BASE):  # type: ignore[misc]
    """YAML with OpenCV's matrices, which come out as `OpencvMatrix`."""


def _opencv_matrix(loader: _Loader, node: yaml.Node) -> OpencvMatrix:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(None, None, "an opencv-matrix without rows, cols and data")
    return OpencvMatrix((str(key), value) for key, value in loader.construct_mapping(node, deep=True).items())


def _whole_number(loader: _Loader, node: yaml.ScalarNode) -> int:
    if len(node.value) > LONGEST_WHOLE_NUMBER:
        raise _refused(f"a number of {len(node.value)} characters", node.start_mark)
    return int(loader.construct_yaml_int(node))


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)
_Loader.add_constructor("tag:yaml.org,2002:int", _whole_number)


def _yaml(text: str) -> Any:
    """The first document."""
    # OpenCV, and OpenVINS after it, begin with `%YAML:1.0`, which is not YAML.
    text = re.sub(r"\A%YAML:1\.0\s*\n", "", text)
    try:
        _check_size(text)
        return next(yaml.load_all(text, _Loader), None)
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError, TypeError, AttributeError) as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or "cannot be understood"
        raise _NotUnderstood(problem, mark.line + 1 if mark else None) from None


def _check_size(text: str) -> None:
    """Raise YAMLError for a document that is far larger than its text once its aliases are followed, or too deep.

    Ten lines of aliases to aliases are a document of 10^10 entries, harmless until somebody merges or prints it.
    """
    sizes: dict[str, int] = {}  # entries behind each anchor
    open_nodes: list[tuple[str | None, int]] = [(None, 0)]
    for event in yaml.parse(text, _Loader):
        anchor, size = getattr(event, "anchor", None), 1
        match event:
            case yaml.DocumentEndEvent():
                return  # what follows is not read
            case yaml.AliasEvent():
                size = sizes.get(anchor or "", MOST_ENTRIES + 1)  # not there yet: it holds itself
                anchor = None
            case yaml.CollectionStartEvent():
                open_nodes.append((anchor, 1))
                if len(open_nodes) > DEEPEST:
                    raise _refused(f"nested more than {DEEPEST} deep", event.start_mark)
                continue
            case yaml.CollectionEndEvent():
                anchor, size = open_nodes.pop()
            case yaml.ScalarEvent():
                pass
            case _:
                continue
        if anchor is not None:
            sizes[anchor] = size
        around, so_far = open_nodes[-1]
        open_nodes[-1] = (around, so_far + size)
        if so_far + size > MOST_ENTRIES:
            raise _refused(f"more than {MOST_ENTRIES} entries, aliases followed", event.start_mark)


def _refused(problem: str, mark: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


# --- JSON -------------------------------------------------------------------------------------------------------------


def _json(text: str) -> Any:
    try:
        table = json.loads(text)
    except RecursionError:
        raise _NotUnderstood(f"nested more than {DEEPEST} deep") from None
    except ValueError as error:
        # A flow mapping of YAML begins with a brace too.
        try:
            return _yaml(text)
        except _NotUnderstood:
            raise _NotUnderstood(str(error)) from None
    _check_depth(table)
    return table


def _check_depth(value: Any, depth: int = 0) -> None:
    if depth > DEEPEST:
        raise _NotUnderstood(f"nested more than {DEEPEST} deep")
    for each in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_depth(each, depth + 1)


# --- OpenCV's XML -----------------------------------------------------------------------------------------------------


class _BoundedElements(ElementTree.TreeBuilder):
    """Elements, but not too deep."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def start(self, tag: Any, attrs: Any, /) -> Any:
        self._depth += 1
        if self._depth > DEEPEST:
            raise _NotUnderstood(f"nested more than {DEEPEST} deep")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)


def _xml(text: str) -> Table:
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise _NotUnderstood("a document type, which no calibration has")
    try:
        # The text is in memory, and so in no encoding that its declaration may name.
        text = re.sub(r"\A\s*<\?xml[^>]*\?>", "", text)
        root = ElementTree.fromstring(text, ElementTree.XMLParser(target=_BoundedElements()))
    except ElementTree.ParseError as error:
        raise _NotUnderstood(
            xml.parsers.expat.ErrorString(error.code) or "cannot be understood", error.position[0]
        ) from None
    except ValueError as error:
        raise _NotUnderstood(str(error)) from None
    table = _of_element(root)
    if not isinstance(table, dict):
        raise _NotUnderstood("no keys in it")
    return table


def _of_element(element: ElementTree.Element) -> Any:
    """A mapping, a list where all children are called `_`, a word, or a list of words."""
    if len(element) == 0:
        words = (element.text or "").split()
        return words[0] if len(words) == 1 else words
    if all(child.tag == "_" for child in element):
        return [_of_element(child) for child in element]
    table = {str(child.tag): _of_element(child) for child in element}
    return OpencvMatrix(table) if element.get("type_id") == "opencv-matrix" else table


# --- plain text -------------------------------------------------------------------------------------------------------


def _ost(text: str) -> Table:
    """ROS' ost.txt: `[image]` with width and height, then a section per camera with blocks of numbers."""
    table: Table = {}
    section: Table = {}
    block: list[str] | None = None
    for line in (line.strip() for line in text.splitlines()):
        if not line or line.startswith("#"):
            continue
        if found := re.fullmatch(r"\[([^\]]{1,64})\]", line):
            section = table.setdefault(found[1], {})
            block = None
        elif re.match(r"[-+.\d]", line):
            if block is None:
                raise _NotUnderstood(f"numbers without a title: {line[:40]}")
            block += line.split()
        else:
            block = section.setdefault(line.replace(" ", "_"), [])
    return {"ost": table}


def _realsense(text: str) -> Table:
    """The report's intrinsics by stream and size: `Color 640x480`."""
    table: Table = {}
    section: Table | None = None
    for line in map(str.strip, text.splitlines()):
        key, colon, value = line.partition(":")
        if found := re.match(r'Intrinsics? of "([^"]{1,64})" */ *(\d{1,6})x(\d{1,6})', line):
            section = {}
            table[f"{found[1]} {found[2]}x{found[3]}"] = section
        elif not line:
            section = None
        elif section is not None and colon:
            key = key.strip().lower()
            section[key] = value.split() if key == "coeffs" else value.strip()
    return {"realsense": table}


def shown(keys: Mapping[Any, Any], most: int = 6) -> str:
    """The first keys of a table, for an error."""
    return ", ".join(plain(str(key), 40) for key in list(keys)[:most])
