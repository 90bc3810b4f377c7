"""`swarmtrack config`, as its user runs it."""

import json
import os
import pty
import re
import select
import subprocess
import sys
import time
import tomllib

import pytest

from support.patience import PATIENCE
from support.places import ROOT
from swarmtrack.agents.main import main
from swarmtrack.config.drone import load_config
from swarmtrack.lab.scenarios.files import ScenarioFile
from swarmtrack.lab.scenarios.reference import scenario_reference
from swarmtrack.setup.answers import WIRINGS
from swarmtrack.setup.example import SHOWN_VALUES, example
from swarmtrack.setup.reference import json_schema, reference, referred, tables

CONFIGS = ROOT / "configs"
CALIBRATION = CONFIGS / "usb-camera.yaml"


@pytest.fixture
def config(tmp_path, monkeypatch, capsys):
    """Runs a command in a folder of its own, with nobody at the keyboard: (exit code, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", open(os.devnull))

    def config(*words):
        try:
            code = main(["config", *map(str, words)])
        except SystemExit as end:
            code = end.code
        out = capsys.readouterr()
        return code, out.out, out.err

    return config


# ── new ──────────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("wiring", WIRINGS)
def test_what_it_writes_is_a_config_for_every_kind_of_autopilot(config, tmp_path, wiring):
    code, out, err = config("new", "--id", 4, "--autopilot", wiring, "--start", 1, 2, -0.5, -90)
    assert code == 0, err
    assert "drone-4.toml: ok" in out
    made = load_config(tmp_path / "drone-4.toml")
    assert (made.drone.id, made.autopilot.link) == (4, WIRINGS[wiring].link)
    assert (made.drone.start.position_m, made.drone.start.yaw_deg) == ((1.0, 2.0, -0.5), -90.0)
    assert made.network.team == "swarm"


def test_the_example_is_a_config_that_stands(config, tmp_path):
    code, out, err = config("new", "--example")
    assert (code, err) == (0, "")
    assert "swarmtrack config check example.toml" in out
    assert config("check", "example.toml")[0] == 0
    code, _, err = config("new", "--example")
    assert (code, "example.toml: already exists" in err) == (2, True)
    code, _, err = config("new", "--example", "--id", "3", "--force")
    assert (code, "--id: given with --example" in err) == (2, True)


def commented() -> list[tuple[str, str]]:
    """(section, line) of each key of the example that is a comment."""
    found, section = [], ""
    for line in example().splitlines():
        section = line[1:-1] if line.startswith("[") else section
        if section and re.match(r"#\w+ = ", line):
            found.append((section, line))
    return found


def test_the_example_lacks_no_key_of_the_schema():
    schema = json_schema()
    written = {(section, line[1:].split(" = ")[0]) for section, line in commented()}
    other_trackers = {
        "exact_width",
        "end_doubles",
        "one_to_one",
        "prune_below",
        "merge_distance",
        "components_per_label",
    }
    for section, entry in schema["properties"].items():
        if section == "extends":
            continue
        keys = set(schema["$defs"][referred(entry)]["properties"])
        missing = keys - {key for name, key in written if name == section} - other_trackers
        assert missing <= {"id", "start", "source", "intrinsics"}, section


# Those that only go together with others, or that look at a file.
NOT_ALONE = {
    "calibration", "calibration_camera", "plan", "code", "drones", "scale", "mean", "channel_order", "keys",
    "signing_key", "names", "announce", "peers", "leader", "slots", "references", "switch",
}  # fmt: skip


def test_each_line_of_the_example_is_one_that_a_config_may_have(tmp_path):
    text, file = example(), tmp_path / "example.toml"
    file.write_text(text)
    before = load_config(file).model_dump()
    no_default = []
    for section, line in commented():
        file.write_text(text.replace(f"\n{line}\n", f"\n{line[1:]}\n", 1))
        key = line[1:].split(" = ")[0]
        tomllib.loads(file.read_text())
        if key in NOT_ALONE:
            continue
        after = load_config(file).model_dump()
        # Those of a tracker and of identity are kept as they are written, and read with the same defaults.
        if (
            section not in ("tracker", "identity")
            and f"{section}.{key}" not in SHOWN_VALUES
            and after != before
        ):
            no_default.append((section, line))
    assert not no_default


@pytest.mark.parametrize(
    ("link", "warned"),
    [("udpin:0.0.0.0:14540", True), ("udpin:192.168.144.10:14540", True), ("udpin:127.0.0.1:14540", False)],
)
def test_a_door_that_is_open_to_others_than_the_autopilot_is_warned_of(config, tmp_path, link, warned):
    written = drone(tmp_path, 1, 1, f'[autopilot]\nlink = "{link}"\n')
    code, out, _ = config("check", written)
    assert code == 0
    assert (f"warning: {link} accepts MAVLink from any host that reaches it" in out) == warned


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ("[camera.body_from_camera]\nrpy_deg = [0, 1.5708, 0]\n", "looks like radians: write degrees"),
        (
            "[camera.body_from_camera]\nposition_m = [10, 0, 0]\n",
            "the camera is 10.0 m from the drone's centre",
        ),
        ('[detector]\nproviders = ["qnn", "cpu"]\n', "qnn was the first choice, but the network runs on cpu"),
        (
            '[recording]\ndir = "/dev/null/flights"\n',
            "recording.dir cannot be written: /dev/null: is not a folder",
        ),
    ],
    ids=["radians", "centimetres", "provider", "no folder"],
)
def test_what_doctor_would_say_of_a_config_alone_is_warned_of(config, tmp_path, extra, said):
    written = drone(tmp_path, 1, 1, extra)
    code, out, _ = config("check", written)
    assert code == 0
    assert re.search(f"^warning: .*{re.escape(said)}", out, re.MULTILINE)
    assert said not in config("check", drone(tmp_path, 2, 2))[1]


def test_a_guessed_lens_has_the_angle_that_was_told_and_says_that_it_is_a_guess(config, tmp_path):
    code, out, _ = config("new", "--id", 1, "--size", "800x600", "--fov", "90")
    lens = load_config(tmp_path / "drone-1.toml").camera
    assert code == 0
    assert (lens.intrinsics.fx, lens.intrinsics.width, lens.intrinsics.height) == (400.0, 800, 600)
    assert "width=800&height=600" in lens.source
    assert "swarmtrack calibrate" in out
    assert "# A guess" in (tmp_path / "drone-1.toml").read_text()


def test_a_calibration_lies_beside_the_config_that_names_it(config, tmp_path):
    (tmp_path / "cam.yaml").write_bytes(CALIBRATION.read_bytes())
    code, out, err = config("new", "--id", 1, "--calibration", "cam.yaml")
    assert code == 0, err
    assert 'calibration = "cam.yaml"' in (tmp_path / "drone-1.toml").read_text()
    assert "guess" not in out
    code, out, err = config("new", "--id", 2, "--calibration", CALIBRATION, "--out", "a/b")
    assert code == 0, err
    assert 'calibration = "usb-camera.yaml"' in (tmp_path / "a" / "b" / "drone-2.toml").read_text()
    assert (tmp_path / "a" / "b" / "usb-camera.yaml").read_bytes() == CALIBRATION.read_bytes()
    (tmp_path / "cam.yaml").write_text((tmp_path / "cam.yaml").read_text() + "# another\n")
    (tmp_path / "a" / "b" / "cam.yaml").write_bytes(CALIBRATION.read_bytes())
    code, _, err = config("new", "--id", 3, "--calibration", "cam.yaml", "--out", "a/b")
    assert code == 2
    assert "a/b/cam.yaml: already exists and another one" in err


def test_a_second_drone_joins_the_team_that_is_there(config, tmp_path):
    assert (
        config(
            "new", "--id", 1, "--team", "red", "--insecure", "--peer", "1=10.0.0.11", "--peer", "2=10.0.0.12"
        )[0]
        == 0
    )
    team = (tmp_path / "team.toml").read_text()
    code, out, _ = config("new", "--id", 2, "--start", 0, 3, 0, 180)
    assert code == 0
    assert "team.toml is as it was" in out
    assert (tmp_path / "team.toml").read_text() == team
    network = load_config(tmp_path / "drone-2.toml").network
    assert (network.team, network.peers, network.insecure) == (
        "red",
        {"1": "10.0.0.11", "2": "10.0.0.12"},
        True,
    )
    code, out, err = config("check", "drone-1.toml", "drone-2.toml")
    assert (code, err) == (0, "")
    assert "drones 1, 2 agree" in out


def test_a_team_in_a_grid_is_written_at_once(config, tmp_path):
    words = ("--ids", "11-14,20", "--grid", 3, "--fov", 78, "--start", 10, 0, 0, 90, "--autopilot", "px4-usb")
    code, out, err = config("new", *words, "--team", "red", "--out", "team")
    assert code == 0, err
    files = [tmp_path / "team" / f"drone-{number}.toml" for number in (11, 12, 13, 14, 20)]
    assert sorted((tmp_path / "team").iterdir()) == [*files, tmp_path / "team" / "team.toml"]
    starts = [load_config(file).drone.start for file in files]
    # They look east: the right of the first is south of it, and behind it is west.
    assert [start.position_m[:2] for start in starts] == [(10, 0), (7, 0), (4, 0), (10, -3), (7, -3)]
    assert {start.yaw_deg for start in starts} == {90.0}
    assert out.count("lens       640 x 480 px") == 1
    assert "drones 11, 12, 13, 14, 20 agree" in config("check", *files)[1]


def test_a_drones_camera_and_autopilot_are_those_of_its_newest_sibling(config, tmp_path):
    assert config("new", "--id", 1, "--fov", 78, "--autopilot", "ardupilot-uart")[0] == 0
    first = tmp_path / "drone-1.toml"
    text = first.read_text().replace(
        "body_from_camera = { rpy_deg = [0.0, 0.0", "body_from_camera = { rpy_deg = [0.0, 20.0"
    )
    first.write_text(text)
    code, out, _ = config("new", "--id", 2, "--start", 0, 3, 0, 0)
    assert code == 0
    assert "camera, lens and autopilot as in drone-1.toml: --camera" in out
    assert "the lens is guessed: 78°;" in out
    second = (tmp_path / "drone-2.toml").read_text()
    cut = text.index("[camera]")
    assert second[second.index("[camera]") :] == text[cut:].replace("drone-1", "drone-2")

    (tmp_path / "cam.yaml").write_bytes(CALIBRATION.read_bytes())
    assert config("new", "--id", 3, "--calibration", "cam.yaml", "--autopilot", "none")[0] == 0
    code, out, _ = config("new", "--id", 4, "--start", 0, 9, 0, 0, "--out", tmp_path)
    assert (code, "guessed" in out) == (0, False)
    assert 'calibration = "cam.yaml"' in (tmp_path / "drone-4.toml").read_text()
    assert load_config(tmp_path / "drone-4.toml").camera.body_from_camera.rpy_deg[1] == 20.0
    code, out, _ = config("new", "--id", 5, "--fov", 60)
    assert "camera" not in re.search("^.* as in drone-4.toml|$", out, re.MULTILINE)[0]
    assert load_config(tmp_path / "drone-5.toml").camera.guessed_angle_deg == pytest.approx(60.0, abs=0.01)


def test_a_lens_in_numbers_is_taken_as_it_is_and_a_broken_or_simulated_sibling_is_not(config, tmp_path):
    lens = "{ fx = 600.0, fy = 601.0, cx = 320.0, cy = 256.0, width = 640, height = 512 }"
    bent = '{ model = "radtan", coefficients = [-0.28, 0.07, 0.0, 0.0] }'
    (tmp_path / "drone-1.toml").write_text(
        f'drone.id = 1\n[camera]\nsource = "rtsp://10.0.0.2/"\nintrinsics = {lens}\ndistortion = {bent}\n'
    )
    (tmp_path / "drone-7.toml").write_text("broken")
    (tmp_path / "drone-8.toml").write_text('drone.id = 8\ncamera.source = "sim://hover-triangle"\n')
    assert config("new", "--id", 2, "--autopilot", "none")[0] == 0
    ours, theirs = (load_config(tmp_path / f"drone-{number}.toml").camera for number in (2, 1))
    assert (ours.source, ours.intrinsics, ours.distortion) == (
        theirs.source,
        theirs.intrinsics,
        theirs.distortion,
    )
    assert ours.guessed_angle_deg is None


def test_a_guess_that_nobody_asked_for_is_said(config):
    assert "the lens is guessed: 70° (no --fov given)" in config("new", "--id", 1)[1]
    assert "(no --fov given)" not in config("new", "--id", 1, "--fov", 70, "--force")[1]


def test_guesses_of_one_team_that_differ_are_warned_of(config):
    assert config("new", "--ids", "1-2", "--grid", 3, "--fov", 78)[0] == 0
    both = ("drone-1.toml", "drone-2.toml")
    assert "guessed lenses differ" not in config("check", *both)[1]
    assert config("new", "--id", 3, "--start", 0, 9, 0, 0, "--fov", 70)[0] == 0
    code, out, _ = config("check", *both, "drone-3.toml")
    assert code == 0
    assert "warning: the guessed lenses differ: 78° of drone 1, 2; 70° of drone 3;" in out
    assert "drones 1, 2, 3 agree" in out


def test_nothing_is_overwritten_unless_told(config, tmp_path):
    assert config("new", "--id", 1)[0] == 0
    before = (tmp_path / "drone-1.toml").read_text()
    code, _, err = config("new", "--id", 1, "--autopilot", "none")
    assert code == 2
    assert "drone-1.toml: already exists, expected another --id, --out or --force" in err
    code, _, err = config("new", "--id", 2, "--team", "blue")
    assert code == 2
    assert "--team: blue, expected swarm as in team.toml" in err
    code, _, err = config("new", "--id", 2, "--peer", "1=10.0.0.1")
    assert code == 2
    assert "--peer: team.toml already exists" in err
    assert (tmp_path / "drone-1.toml").read_text() == before
    assert config("new", "--id", 1, "--team", "blue", "--autopilot", "none", "--force")[0] == 0
    assert load_config(tmp_path / "drone-1.toml").network.team == "blue"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "--id: missing"),
        (["--id", "0"], "expected a whole number, 1 … 65535"),
        (["--id", "1", "--calibration", "no.yaml"], "no.yaml"),
        (["--id", "1", "--camera", "usbb://x"], "usbb"),
        (["--id", "1", "--autopilot", "px5"], "px4-uart"),
        (["--id", "1", "--start", "here"], "expected NORTH EAST DOWN YAW, gps or local"),
        (["--id", "1", "--start", "0", "0", "0", "nan"], "expected NORTH EAST DOWN YAW"),
        (["--id", "1", "--start", "gps"], "without an origin of the team frame"),
        (["--id", "1", "--team", "a/b"], "expected letters, digits"),
        (["--id", "1", "--fov", "200"], "expected degrees"),
        (["--id", "1", "--size", "640"], "expected WIDTHxHEIGHT"),
        (["--id", "1", "--peer", "10.0.0.1"], "expected ID=HOST"),
        (["--id", "1", "--peer", "1=10.0.0.1"], "insecure"),
        (["--id", "1", "--keys", "keys"], "keys"),
        (["--id", "1", "--origin", "91", "0", "0", "--start", "gps"], "lat_deg"),
        (["--id", "1", "--out", "/proc/nothing"], "--out"),
        (["--ids", "1-3"], "--grid: missing, expected the distance"),
        (["--ids", "1-3", "--grid", "0"], "--grid: found 0, expected metres"),
        (["--ids", "1-3", "--grid", "3", "--id", "4"], "--ids: given with --id"),
        (["--ids", "3-1", "--grid", "3"], "--ids: found 3-1, expected FIRST-LAST"),
        (["--ids", "1-3,2", "--grid", "3"], "each once"),
        (["--ids", "1-60000", "--grid", "3"], "100 drones at most"),
        (["--id", "1", "--grid", "3"], "--grid: given without --ids"),
        (["--ids", "1-3", "--grid", "3", "--start", "local"], "--grid: given with --start local"),
    ],
)
def test_what_would_not_work_is_said_and_leaves_nothing_behind(config, tmp_path, words, said):
    code, _, err = config("new", *words)
    assert code == 2
    assert re.search(said, err), err
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


def test_a_start_by_gps_has_its_origin_in_the_team(config, tmp_path):
    code, _, err = config("new", "--id", 1, "--start", "gps", "--origin", 47.4, 8.5, 488)
    assert code == 0, err
    made = load_config(tmp_path / "drone-1.toml")
    assert (made.drone.start.source, made.team.origin.lat_deg) == ("gps", 47.4)


def test_keys_are_those_of_the_drone(config, tmp_path):
    assert main(["keys", "init", str(tmp_path / "keys"), "--team", "swarm"]) == 0
    assert main(["keys", "issue", str(tmp_path / "keys"), "1", "2"]) == 0
    code, _, err = config(
        "new", "--id", 2, "--keys", "keys/drone-{id}", "--peer", "1=10.0.0.1", "--peer", "2=10.0.0.2"
    )
    assert code == 0, err
    assert load_config(tmp_path / "drone-2.toml").network.keys_of(2) == tmp_path / "keys" / "drone-2"


def test_whatever_the_camera_is_called_it_stays_one_string(config, tmp_path):
    source = 'v4l2:///dev/video"0\n[x]\\'
    assert config("new", "--id", 1, "--camera", source)[0] == 0
    assert load_config(tmp_path / "drone-1.toml").camera.source == source


def test_half_a_character_in_an_answer_is_said(config, tmp_path):
    words = ("--id", 1, "--camera", "sim://hover-triangle", "--autopilot", "sim")
    code, _, err = config("new", *words, "--team", "r\udce9d")
    assert code == 2
    assert r"team r\udce9', expected text" in err
    assert not list(tmp_path.iterdir())


def test_a_simulated_camera_needs_no_lens(config, tmp_path):
    code, _, err = config("new", "--id", 1, "--camera", "sim://hover-triangle", "--autopilot", "sim")
    assert code == 0, err
    assert load_config(tmp_path / "drone-1.toml").autopilot.link == "sim"


class Terminal:
    """A person at a terminal: reads what is asked, types."""

    def __init__(self, folder, *words):
        self._ours, theirs = pty.openpty()
        self.said = ""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "swarmtrack.agents.main", "config", "new", *words],
            stdin=theirs, stdout=theirs, stderr=theirs, cwd=folder,
            env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "utf-8:strict"},
        )  # fmt: skip
        os.close(theirs)

    def until(self, words):
        deadline = time.monotonic() + PATIENCE
        while words not in self.said:
            assert time.monotonic() < deadline, self.said
            if select.select([self._ours], [], [], 0.1)[0]:
                try:
                    self.said += os.read(self._ours, 4096).decode(errors="replace")
                except OSError:  # the other end has gone
                    break
        assert words in self.said, self.said
        self.said = self.said.partition(words)[2]

    def answer(self, question, text):
        self.until(question)
        os.write(self._ours, text.encode(errors="surrogateescape") + b"\n")


def test_on_a_terminal_it_asks_and_asks_again(tmp_path):
    person = Terminal(tmp_path)
    person.answer("ID of the drone", "seven")
    person.until("found seven, expected a whole number")
    person.answer("ID of the drone", "7")
    person.answer("name of the team [swarm]", "r\udce9d")
    person.until("not in this terminal's encoding")
    person.answer("name of the team [swarm]", "red")
    person.answer("camera", "")
    person.answer("calibration file", "nothing.yaml")
    person.until("nothing.yaml")
    person.until("nothing.yaml")
    person.answer("calibration file", "")
    person.answer("size of the images [640x480]", "1280x720")
    person.answer("angle", "90")
    person.answer("autopilot", "telepathy")
    person.until("unknown scheme 'telepathy'")
    person.answer("autopilot", "ardupilot-udp")
    person.answer("start", "0 1 0 90")
    person.until("next: swarmtrack doctor")
    assert person.process.wait(PATIENCE) == 0
    made = load_config(tmp_path / "drone-7.toml")
    assert (made.network.team, made.autopilot.link) == ("red", "udpin:127.0.0.1:14550")
    assert (made.camera.intrinsics.width, made.camera.intrinsics.fx) == (1280, 640.0)
    assert made.drone.start.position_m == (0.0, 1.0, 0.0)


def test_who_walks_away_from_the_keyboard_leaves_nothing(tmp_path):
    person = Terminal(tmp_path)
    person.answer("ID of the drone", "\x04")  # Ctrl-D
    assert person.process.wait(PATIENCE) == 2
    assert list(tmp_path.iterdir()) == []


# ── check ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def drone(tmp_path, number, drone_id, extra="", start="position_m = [0.0, 0.0, 0.0]"):
    path = tmp_path / f"{number}.toml"
    path.write_text(
        f"drone.id = {drone_id}\ndrone.start = {{ {start} }}\n"
        'camera.source = "v4l2:///dev/video0"\n'
        "camera.intrinsics = { fx = 600.0, fy = 600.0, cx = 320.0, cy = 256.0, width = 640, height = 512 }\n"
        + extra,
        encoding="utf-8",
    )
    return path


@pytest.mark.parametrize(
    ("first", "second", "said"),
    [
        ({"drone_id": 1}, {"drone_id": 1}, "1: drone.id: 1, which another of these files is too"),
        (
            {},
            {"extra": 'network.team = "red"'},
            '5: network.team: "red", expected "swarm" as in drone 1',
        ),
        (
            {},
            {"start": "yaw_deg = 90.0"},
            "2: drone.start.position_m: [0.0, 0.0, 0.0], where drone 1 starts too",
        ),
        ({}, {"extra": 'network.transport = "memory"'}, '5: network.transport: "memory" stays within'),
        (
            {"extra": 'network.peers = { 1 = "127.0.0.1:7601", 2 = "127.0.0.1:7602" }'},
            {"extra": 'network.peers = { 1 = "127.0.0.1:7601", 2 = "127.0.0.1:7603" }'},
            "5: network.peers: {",
        ),
        (
            {"extra": 'network.topology = "routers"\nnetwork.routers = ["127.0.0.1"]'},
            {},
            '1: network.topology: "mesh", expected "routers" as in drone 1',
        ),
        (
            {"extra": "team.origin = { lat_deg = 1.0, lon_deg = 2.0, alt_m = 3.0 }"},
            {"extra": "team.origin = { lat_deg = 1.0, lon_deg = 2.0, alt_m = 4.0 }"},
            "5: team.origin: ",
        ),
    ],
)
def test_files_that_are_right_alone_may_be_wrong_together(config, tmp_path, first, second, said):
    a = drone(tmp_path, "a", **{"drone_id": 1, **first})
    b = drone(tmp_path, "b", **{"drone_id": 2, "start": "position_m = [0.0, 3.0, 0.0]", **second})
    code, out, err = config("check", a, b)
    assert code == 2
    assert f"{b}:{said}" in err
    assert f"{a}: ok" in out
    assert f"{b}: ok" in out  # alone, it is
    assert "agree" not in out


def test_one_with_keys_and_one_without_do_not_link(config, tmp_path):
    for team in ("one", "two"):
        main(["keys", "init", str(tmp_path / team), "--team", "swarm"])
        main(["keys", "issue", str(tmp_path / team), "1", "2", "3"])
    at = "position_m = [{}.0, 3.0, 0.0]".format
    a = drone(tmp_path, "a", 1, 'network.keys = "one/drone-{id}"')
    b = drone(tmp_path, "b", 2, 'network.keys = "two/drone-{id}"', at(1))
    c = drone(tmp_path, "c", 3, "", at(2))
    code, _, err = config("check", a, b, c)
    assert code == 2
    assert f'{b}:5: network.keys: "{tmp_path}/two/drone-2" is of another CA than the keys of drone 1' in err
    assert "c.toml:1: network.keys: none, expected keys as drone 1 has" in err


def test_of_several_files_each_mistake_is_named(config, tmp_path):
    good = drone(tmp_path, "good", 1)
    bad = drone(tmp_path, "bad", 2, "network.teem = 3")
    code, out, err = config("check", bad, good, tmp_path / "none.toml")
    assert code == 2
    assert 'bad.toml:5: network.teem: unknown key, did you mean "team"?' in err
    assert "none.toml:1: cannot be read" in err
    assert f"{good}: ok" in out


def test_mistakes_in_tables_and_in_addresses_are_named_in_one_go(config, tmp_path):
    written = drone(tmp_path, "bad", 1, '[autopilot]\nlink = "seriell:/dev/ttyAMA0"\nimu_rate = 200\n')
    text = written.read_text().replace("drone.start = {", "drone.start = { yaw = 3.0,")
    written.write_text(text.replace("v4l2:", "v4l:"))
    code, _, err = config("check", written)
    assert code == 2
    for mistake in ("2: drone.start.yaw", "3: camera.source", "6: autopilot.link", "7: autopilot.imu_rate"):
        assert f"{written}:{mistake}: " in err
    assert len(err.splitlines()) == 4
    # Where all tables are right, the parts are not made one after the other either.
    written.write_text(
        written.read_text().replace("yaw =", "yaw_deg =").replace("imu_rate =", "imu_rate_hz =")
    )
    code, _, err = config("check", written)
    assert (code, len(err.splitlines())) == (2, 2)


# ── schema and reference ─────────────────────────────────────────────────────────────────────────────────────────────


def test_the_schema_in_the_repository_is_what_the_models_say():
    kept = json.loads((ROOT / "docs" / "config.schema.json").read_text(encoding="utf-8"))
    assert kept == json_schema(), "run: swarmtrack config schema --out docs/config.schema.json"


def test_the_page_in_the_repository_is_what_the_models_say():
    kept = (ROOT / "docs" / "config.md").read_text(encoding="utf-8")
    assert kept == reference(), "run: swarmtrack config reference --out docs/config.md"


def test_the_page_of_scenarios_is_what_the_models_say_and_lacks_nothing():
    kept = (ROOT / "docs" / "scenarios.md").read_text(encoding="utf-8")
    assert kept == scenario_reference(), "run: swarmtrack config reference --scenario --out docs/scenarios.md"
    rows = re.findall(r"^\| `(.+?)` \| (.*?) \| (.*?) \| (.*) \|$", kept, re.MULTILINE)
    assert len(rows) > 80
    assert [key for key, kind, _, meaning in rows if not (kind and meaning)] == []
    assert {
        key for key in ScenarioFile.model_fields if f"[{key}]" not in kept and f"| `{key}`" not in kept
    } == set()


def test_both_are_written_where_told(config, tmp_path):
    assert config("schema", "--out", "a.json") == (0, "", "")
    assert json.loads((tmp_path / "a.json").read_text()) == json_schema()
    assert config("reference", "--scenario", "--out", "a.md")[0] == 0
    assert (tmp_path / "a.md").read_text() == scenario_reference()
    assert config("reference", "--out", "a.md")[0] == 0
    assert (tmp_path / "a.md").read_text() == reference()
    assert json.loads(config("schema")[1]) == json_schema()
    code, _, err = config("schema", "--out", "nowhere/a.json")
    assert code == 2
    assert "--out: nowhere/a.json" in err


def test_every_key_has_a_meaning_and_every_table_a_place():
    page = reference()
    rows = re.findall(r"^\| `(.+?)` \| (.*?) \| (.*?) \| (.*) \|$", page, re.MULTILINE)
    assert len(rows) > 100
    assert [key for key, _, _, meaning in rows if not meaning] == []
    assert [key for key, kind, _, _ in rows if not kind] == []
    for section, _ in tables():
        assert f"## [{section}]" in page
    assert ("id", "whole number ≥ 1, ≤ 65535", "required", "1 … 65535, unique in the team") in rows


def test_the_schema_knows_every_key_of_the_examples():
    schema = json_schema()
    for path in CONFIGS.glob("*.toml"):
        for section, value in tomllib.loads(path.read_text(encoding="utf-8")).items():
            reference = schema["properties"][section]
            if "$ref" in reference:
                assert set(value) <= set(schema["$defs"][reference["$ref"].split("/")[-1]]["properties"])


def test_the_schema_requires_nothing_that_an_extended_file_may_hold():
    schema = json_schema()
    assert "required" not in schema
    assert not any("required" in schema["$defs"][name] for name in ("CameraSection", "Vehicle"))
    assert schema["$defs"]["Intrinsics"]["required"] == ["fx", "fy", "cx", "cy", "width", "height"]
