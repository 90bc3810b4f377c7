"""[formation] in a config: what is refused at load, with file and line; and what `--check` shows."""

import re
from xml.etree import ElementTree

import pytest

from swarmtrack.agents.main import main
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.errors import ConfigError
from swarmtrack.runtime.agent import make_formation_pilot
from swarmtrack.runtime.assembly import assemble

TEAM = """\
[team]
airframe_span_m = 0.5
share = "velocity"

[formation]
leader = 1
height_m = 5.0
limits = { speed_m_s = 2.0, yaw_rate_deg_s = 30.0 }

[formation.slots]
2 = [-4.0, 3.0, -1.0]
3 = [-4.0, -3.0, 1.0]
"""
DRONE = """\
extends = "team.toml"

[drone]
id = {id}
start = {{ position_m = [0.0, {id}.0, 0.0], position_sigma_m = 0.3 }}

[camera]
source = "v4l2:///dev/video0"
intrinsics = {{ fx = 430.0, fy = 430.0, cx = 319.5, cy = 239.5, width = 640, height = 480 }}

[autopilot]
link = "udpin:127.0.0.1:14540"

[network]
insecure = true
"""


@pytest.fixture
def team(tmp_path):
    """Writes the configs of a team; `old` of the team's file is `new`."""

    def write(old="", new="", ids=(1, 2, 3)):
        assert old in TEAM
        (tmp_path / "team.toml").write_text(TEAM.replace(old, new))
        files = [tmp_path / f"drone-{n}.toml" for n in ids]
        for n, file in zip(ids, files, strict=True):
            file.write_text(DRONE.format(id=n))
        return files

    return write


def check(capsys, *words):
    code = main(["config", "check", *map(str, words)])
    out = capsys.readouterr()
    return code, out.out, out.err


def test_a_follower_has_its_parameters_and_the_leader_has_none(team):
    leader, second, third = map(load_config, team())
    assert leader.formation.parameters(1) is None
    mine = second.formation.parameters(2)
    assert (mine.leader, mine.references, mine.down) == (1, (1,), -6.0)
    assert (mine.limits.speed, mine.limits.yaw_rate) == (2.0, pytest.approx(0.5236, abs=1e-4))
    assert third.formation.parameters(3).wanted(1) == (4.0, 3.0, -1.0)


def test_without_a_leader_there_is_no_formation(team):
    [config] = map(load_config, team(TEAM[TEAM.index("[formation]") :], "", ids=[2]))
    assert config.formation.plan() is None
    assert config.formation.parameters(2) is None


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("airframe_span_m = 0.5", "", "team.airframe_span_m: found none"),
        ("leader = 1\n", "", "formation: limits without leader"),
        ("leader = 1", "leader = 2", "formation: found a slot of the leader 2"),
        ("2 = [-4.0, 3.0, -1.0]", "4 = [-4.0, 3.0, -1.0]", "team.toml:10: formation.slots: no slot of drone 2"),
        ("3 = [-4.0, -3.0, 1.0]", "3 = [-4.0, 2.0, -0.5]", "team.toml:12: formation.slots.3: 1.1 m from the slot"),
        ("3 = [-4.0, -3.0, 1.0]", "3 = [-400.0, -3.0, 1.0]", "slots.3: 400 m from the leader, expected 60"),
        ("3 = [-4.0", "x = [-4.0", 'found the key "x", expected drone IDs'),
        ("speed_m_s = 2.0", "speed_m_s = 20.0", "formation.limits.speed_m_s: 20.0, expected less than or equal to 5"),
        ("speed_m_s", "sped_m_s", 'formation.limits.sped_m_s: unknown key, did you mean "speed_m_s"?'),
        ("height_m = 5.0", "references = { 2 = [2] }", "references.2: found [2], expected other drones"),
        ("height_m = 5.0", "references = { 7 = [1] }", "references.7: no follower, expected one of 2, 3"),
        ("height_m = 5.0", "references = { 2 = [3], 3 = [2] }", "drone 2 does not depend on the leader 1"),
    ],
)  # fmt: skip
def test_what_cannot_be_flown_is_refused_with_file_and_line(team, old, new, said):
    [file] = team(old, new, ids=[2])
    with pytest.raises(ConfigError) as refused:
        load_config(file)
    assert said in str(refused.value)
    assert re.search(r"team\.toml:\d+: ", str(refused.value))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "2 = [-4.0, 3.0, -1.0]",
            "2 = [-2.0, 2.0, -3.0]",
            "formation.slots.2: drone 1 is 47° below the camera's axis",
        ),
        ('share = "velocity"', "", "formation.leader: the detector's boxes give a range to 13%"),
    ],
)
def test_what_this_drones_camera_and_detector_cannot_do_is_refused(team, capsys, old, new, said):
    [file] = team(old, new, ids=[2])
    code, _, err = check(capsys, file)
    assert code == 2
    assert said in err


def test_ranging_radios_make_up_for_a_detector(team, capsys):
    [file] = team('share = "velocity"\n\n[formation]', "[formation]\nranging = true", ids=[2])
    assert check(capsys, file)[0] == 0


def test_check_shows_who_is_where_and_draws_it(team, capsys, tmp_path):
    files = team()
    code, out, err = check(capsys, *files, "--drawing", tmp_path / "formation.svg")
    assert code == 0, err
    assert "formation  leads drones 2, 3: flown by its pilot, never by its agent" in out
    assert "formation  follows drone 1, finds its slot by drone 1" in out
    assert (
        "2  -4.0 m north, +3.0 m east, 6.0 m high; looks at drone 1 5.1 m away, at 39% of the half view"
        in out
    )
    grid = out[out.index("from above") :].splitlines()
    assert grid[1].strip() == "[1]"
    assert next(line for line in grid[2:] if line.strip()).split() == ["3", "2"]
    drawing = ElementTree.parse(tmp_path / "formation.svg").getroot()
    words = "".join(drawing.itertext())
    assert all(word in words for word in ("from above", "1: 5.0 m", "2: 6.0 m", "3: 4.0 m"))


def test_with_several_cameras_a_reference_may_be_in_any_of_them(team, capsys, tmp_path):
    """The only camera looks down, and a second looks ahead."""
    [file] = team(ids=[2])
    camera = re.search(r"\[camera\]\n(.*?)\n\n", file.read_text(), re.DOTALL)[1]
    down = f"[[camera]]\n{camera}\nbody_from_camera = {{ rpy_deg = [0, -60, 0], position_m = [0, 0, 0] }}\n\n"
    ahead = f"[[camera]]\n{camera}\n\n".replace("video0", "video2")
    before = f"[camera]\n{camera}\n\n"
    assert before in file.read_text()
    text = file.read_text()
    file.write_text(text.replace(before, down))
    code, _, err = check(capsys, file)
    assert code == 2
    assert "drone 1 is 49° above the camera's axis" in err
    file.write_text(text.replace(before, down + ahead))
    code, out, err = check(capsys, file, "--drawing", tmp_path / "formation.svg")
    assert code == 0, err
    assert "looks at drone 1 5.1 m away, at 39% of the half view of camera 2" in out
    drawing = (tmp_path / "formation.svg").read_text()
    assert drawing.count("#dbeafe") == 2
    assert "80% of each view of drone 2" in drawing


def test_a_drawing_of_no_formation_is_an_error_in_words(team, capsys, tmp_path):
    files = team(TEAM[TEAM.index("[formation]") :], "", ids=[2])
    code, _, err = check(capsys, *files, "--drawing", tmp_path / "formation.svg")
    assert code == 2
    assert "formation.leader: found none, expected a formation to draw" in err


def test_nobody_is_flown_unless_it_is_enabled_and_the_leader_never(team, capsys):
    files = team()
    assert [load_config(file).flies_in_formation for file in files] == [False, False, False]
    assert "not enabled: its agent only watches" in check(capsys, *files)[1]
    files = team("leader = 1", "leader = 1\nenabled = true")
    assert [load_config(file).flies_in_formation for file in files] == [False, True, True]
    assert "enabled: its agent flies it while its pilot has it in GUIDED" in check(capsys, *files)[1]
    flown = [make_formation_pilot(assemble(load_config(file), SystemClock()), None) for file in files]
    assert [pilot is not None for pilot in flown] == [False, True, True]


CONSENTS = [
    ('consent = "mode and switch"', "expected switch = { channel = 7 }"),
    ("switch = { channel = 7 }", 'expected consent = "mode and switch"'),
    ('consent = "mode and switch"\nswitch = { channel = 77 }', "channel"),
    ('consent = "yes"', "consent"),
]


@pytest.mark.parametrize(("lines", "said"), CONSENTS)
def test_a_second_condition_is_a_switch_that_is_named(team, lines, said):
    file = team()[1]
    file.write_text(file.read_text() + f"\n[formation]\n{lines}\n")
    with pytest.raises(ConfigError, match=re.escape(said)):
        load_config(file)


def test_with_a_switch_the_mode_alone_engages_nobody(team):
    file = team()[1]
    lines = 'enabled = true\nconsent = "mode and switch"\nswitch = { channel = 7 }'
    file.write_text(file.read_text() + f"\n[formation]\n{lines}\n")
    engagement = assemble(load_config(file), SystemClock()).engagement
    assert engagement.asks_for_switch


@pytest.mark.parametrize("link", ["none", "tlog:flight.tlog"])
def test_a_drone_that_cannot_be_flown_cannot_be_enabled(team, link):
    [file] = team("leader = 1", "leader = 1\nenabled = true", ids=[2])
    file.write_text(file.read_text().replace("udpin:127.0.0.1:14540", link))
    with pytest.raises(ConfigError, match=r"autopilot\.link: .*, expected a MAVLink link"):
        load_config(file)


def test_drones_of_two_formations_contradict_each_other(team, capsys):
    files = team()
    files[1].write_text(files[1].read_text() + "\n[formation]\nheight_m = 7.0\n")
    code, _, err = check(capsys, *files)
    assert code == 2
    assert "formation.slots" in err
