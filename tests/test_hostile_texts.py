"""Configs, scenarios and calibrations from elsewhere: whatever they hold, a sentence comes of it, and soon."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from support.calibrations import CALIBRATIONS
from support.mutants import MUTANTS, mutants
from support.patience import soon, soon_and_small
from support.places import ROOT
from swarmtrack.config.camera_files import load_calibration
from swarmtrack.config.camera_text import DEEPEST, MOST_ENTRIES
from swarmtrack.config.drone import load_config
from swarmtrack.config.toml.layers import MAX_SEARCHED, MOST_FILES, MOST_PARTS, key_lines
from swarmtrack.errors import CalibrationError, ConfigError, SwarmtrackError
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.plain_text import hide_logins

CALIBRATION = (ROOT / "configs" / "usb-camera.yaml").read_text(encoding="utf-8")
CONFIG = """\
[drone]
id = 1
start = { position_m = [0.0, 0.0, -1.5], yaw_deg = 90.0, position_sigma_m = 0.1 }

[camera]
source = "detections://127.0.0.1:9/1"
intrinsics = { fx = 600.0, fy = 600.0, cx = 320.0, cy = 256.0, width = 640, height = 512 }
distortion = { model = "radtan", coefficients = [-0.2, 0.05, 0.0, 0.0] }
body_from_camera = { rpy_deg = [0, 0, 0], position_m = [0.1, 0, 0] }

[autopilot]
link = "none"
heading_sigma_deg = { ground = 3, flight = 1.5 }

[team]
origin = { lat_deg = 47.1, lon_deg = 8.2, alt_m = 400.0 }

[tracker]
name = "mbm"
p_detection = 0.9
"""
SCENARIOS = ("crossing", "silent", "lossy-radio", "faults")  # such as load in a moment


# --- TOML -------------------------------------------------------------------------------------------------------------


def test_a_config_that_extends_the_same_files_again_and_again_is_refused(tmp_path):
    for depth in range(24):
        below = "" if depth == 23 else f'extends = ["{depth + 1}.toml", "{depth + 1}.toml"]\n'
        (tmp_path / f"{depth}.toml").write_text(below, encoding="utf-8")
    with pytest.raises(ConfigError, match=f"extends: more than {MOST_FILES} files in all"):
        load_config(tmp_path / "0.toml")


def test_a_long_chain_is_refused_too(tmp_path):
    for depth in range(1200):
        (tmp_path / f"{depth}.toml").write_text(f'extends = "{depth + 1}.toml"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=f"more than {MOST_FILES} files"):
        load_config(tmp_path / "0.toml")


@pytest.mark.parametrize(
    "text",
    [
        ".".join(["a"] * 60_000) + " = 1\n",
        "[" + ".".join(["a"] * 60_000) + "]\n",
        "[[" + " . ".join(['"a"'] * 20_000) + "]]\n",
        "x = { " + ".".join(["a"] * 60_000) + " = 1 }\n",
    ],
    ids=["key", "table", "array of tables", "inline"],
)
def test_a_key_of_thousands_of_parts_is_not_parsed(tmp_path, text):
    path = tmp_path / "drone.toml"
    path.write_text("drone.id = 1\n" + text, encoding="utf-8")
    with pytest.raises(ConfigError, match=rf"drone\.toml:2: a key of more than {MOST_PARTS} parts"):
        load_config(path)


def test_dots_that_are_no_key_are_no_matter(tmp_path):
    path = tmp_path / "drone.toml"
    path.write_text(CONFIG + f"# {'. ' * 500}\n# {'1.5, ' * 500}\n", encoding="utf-8")
    assert load_config(path).drone.id == 1


def test_the_line_of_an_error_is_not_looked_for_without_end():
    statement = "x{} = [\n" + "1,\n" * 198 + "]\n"
    text = "".join(statement.format(k) for k in range(200))
    found = key_lines(text)
    assert found["x0",] == 1
    assert 0 < len(found) < 200
    assert sum(len(statement) ** 2 / 8 for _ in found) < 4 * MAX_SEARCHED


@pytest.mark.parametrize("entry", ["drone.id", "network.peers", "tracker.p_detection"])
def test_a_number_that_python_does_not_show_is_refused(tmp_path, entry):
    path = tmp_path / "drone.toml"
    path.write_text(f"{entry} = [1, 0x{'f' * 8000}]\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"drone\.toml:1: a whole number of more than 10000 bits"):
        load_config(path)


@pytest.mark.parametrize("metres", ["1e308", "-1.1e7", "inf"])
def test_a_place_that_no_message_can_hold_is_refused(tmp_path, metres):
    path = tmp_path / "drone.toml"
    path.write_text(CONFIG.replace("-1.5]", f"{metres}]"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"drone\.toml:3: drone\.start\.position_m\[2\]"):
        load_config(path)


def test_a_range_that_is_upside_down_is_refused(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(
        "[formation]\ndrones = 2\nring = { radius_m = 2.0 }\nsway = { amplitude_m = [1, 1, 1], period_s = [5, 1] }\n",
        encoding="utf-8",
    )
    with pytest.raises(ConfigError, match=r"period_s: \[5.0, 1.0\], expected \[shortest, longest\]"):
        load_scenario(path)


# --- YAML -------------------------------------------------------------------------------------------------------------

LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{here}: &{here} [{', '.join([f'*{before}'] * 9)}]\n"
    for before, here in zip("abcdefghi", "bcdefghij", strict=True)
)
MERGES = "a: &a {x: 1, y: 2}\n" + "".join(
    f"{here}: &{here} {{<<: [{', '.join([f'*{before}'] * 10)}]}}\n"
    for before, here in zip("abcdefghi", "bcdefghij", strict=True)
)


@pytest.mark.parametrize("key", ["intrinsics", "K", "image_width", "distortion_model", "cam0"])
@pytest.mark.parametrize("bomb", [LAUGHS, MERGES], ids=["aliases", "merge keys"])
def test_a_page_of_aliases_to_aliases_is_not_followed(tmp_path, bomb, key):
    path = tmp_path / "camera.yaml"
    path.write_text(f"{bomb}{key}: *j\n", encoding="utf-8")
    with pytest.raises(CalibrationError, match=f"more than {MOST_ENTRIES} entries, aliases followed"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("intrinsics: " + "[" * 500_000, f"nested more than {DEEPEST} deep"),
        ("intrinsics: " + "{a: " * 100_000, f"nested more than {DEEPEST} deep"),
        ("intrinsics: &a [*a]\n", "more than"),
        ("intrinsics: [" + "1, " * 300_000 + "1]\n", "more than"),
        ("image_width: 0x" + "f" * 8000, ":1: a number of 8002 characters"),
        ("image_width: 1" + ":1" * 300_000, ":1: a number of 600001 characters"),
        (f"? 0x{'f' * 8000}\n: 1\n", ":1: a number of 8002 characters"),
    ],
    ids=["lists", "mappings", "itself", "long", "large number", "sexagesimal", "large key"],
)
def test_what_is_too_deep_or_too_long_is_said(tmp_path, text, said):
    path = tmp_path / "camera.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationError, match=said):
        load_calibration(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"a": ' + "[" * 300_000, f"nested more than {DEEPEST} deep"),
        ('{"a": ' + "[" * 500 + "]" * 500 + "}", f"nested more than {DEEPEST} deep"),
        ("<a>" * 100_000, f"nested more than {DEEPEST} deep"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "a document type"),
        ("<a>&nothing;</a>", "undefined entity"),
        ("<a/>", "no keys in it"),
        (
            "[image]\nwidth\n640\nheight\n480\n[a]\ncamera matrix\n" + "1 " * 400_000,
            "400000 numbers, expected 9",
        ),
        ('Intrinsic of "' + "a" * 500_000, "expected"),
    ],
    ids=["JSON", "closed JSON", "XML", "entities", "undefined", "empty", "ost.txt", "report"],
)
def test_what_other_forms_may_hold_is_bounded_too(tmp_path, text, said):
    path = tmp_path / "camera.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationError, match=said) as refused:
        load_calibration(path)
    assert len(str(refused.value)) < 600


@pytest.mark.parametrize(
    "text",
    [
        "\n" * 500_000 + CALIBRATION,
        f'Intrinsic of "Color" / 640x480\nWidth: a{" " * 500_000}b\n',
        "camera matrix" + " " * 500_000 + "b\n" + CALIBRATION,
    ],
    ids=["blank lines", "spaces in a report", "spaces in ost.txt"],
)
def test_a_megabyte_of_white_space_is_soon_read(tmp_path, text):
    path = tmp_path / "camera.txt"
    path.write_text(text, encoding="utf-8")
    with soon(), contextlib.suppress(CalibrationError):
        load_calibration(path)


def test_honest_aliases_are_followed(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(
        "image_width: &w 640\nimage_height: 480\nother: *w\n"
        "camera_matrix: {rows: 3, cols: 3, data: [600, 0, 320, 0, 600, 240, 0, 0, 1]}\n",
        encoding="utf-8",
    )
    assert load_calibration(path).camera.width == 640


# --- mutants ----------------------------------------------------------------------------------------------------------

COUNTS = pytest.mark.parametrize(
    "count",
    [200, pytest.param(MUTANTS, marks=pytest.mark.long("thousands of mutants, not 200"))],
    ids=["short", "long"],
)


def survive(path: Path, good: str, count: int, read) -> None:
    """Each mutant of a good text is read, or refused with a sentence that can be shown, soon and in little memory."""
    refused = []
    for mutant in mutants(good.encode(), count, seed=9, text=True):
        path.write_bytes(mutant)
        try:
            with soon_and_small():
                read(path)
        except SwarmtrackError as error:
            refused.append(str(error))
    assert 0 < len(refused) < count
    assert all(said.replace("\n", "").isprintable() for said in refused)


@COUNTS
def test_any_mutation_of_a_config_is_read_or_refused(tmp_path, count):
    survive(tmp_path / "drone.toml", CONFIG, count, load_config)


@COUNTS
def test_any_mutation_of_a_calibration_is_read_or_refused(tmp_path, count):
    survive(tmp_path / "camera.yaml", CALIBRATION, count, load_calibration)


@COUNTS
@pytest.mark.parametrize("name", CALIBRATIONS)
def test_any_mutation_of_any_calibration_is_read_or_refused(tmp_path, count, name):
    good = CALIBRATIONS[name]
    survive(
        tmp_path / "camera", good.text, max(count // 5, 40), lambda path: load_calibration(path, good.camera)
    )


@COUNTS
@pytest.mark.parametrize("name", SCENARIOS)
def test_any_mutation_of_a_scenario_is_read_or_refused(tmp_path, count, name):
    good = (ROOT / "configs" / "scenarios" / f"{name}.toml").read_text(encoding="utf-8")
    survive(tmp_path / "scene.toml", good, max(count // len(SCENARIOS), 50), load_scenario)


@pytest.mark.parametrize("text", ["!/" * 8000 + "=", "/a" * 8000 + "=", "x@" * 8000 + "?="])
def test_a_login_is_looked_for_in_a_long_text_without_delay(text):
    with soon(0.2):
        hide_logins(text)
