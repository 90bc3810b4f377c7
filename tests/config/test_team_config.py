"""[team] of a config: who starts where is in one file, and every contradiction to it is said."""

from __future__ import annotations

import numpy as np
import pytest

from swarmtrack.agents.main import main
from swarmtrack.config.drone import load_config
from swarmtrack.config.trajectories import write_trajectories
from swarmtrack.errors import ConfigError
from swarmtrack.geometry import rotation
from swarmtrack.motion.sway import sway
from swarmtrack.runtime.filed import SOMEWHERE_M, agreed_motions, filed_announcements

CAMERA = """
[camera]
source = "http://127.0.0.1:9/"
intrinsics = { fx = 600.0, fy = 600.0, cx = 320.0, cy = 256.0, width = 640, height = 512 }
"""
TEAM = """
[team]
announce = false
[team.drones]
1 = { position_m = [0.0, 0.0, -0.1], position_sigma_m = 0.3 }
2 = { position_m = [5.0, 1.0, -0.1], yaw_deg = 180.0, position_sigma_m = 0.5 }
7 = {}
"""


@pytest.fixture
def load(tmp_path):
    """The config of a drone beside a team's file."""

    def load(drone, team=TEAM, name="drone.toml"):
        (tmp_path / "team.toml").write_text(team + CAMERA)
        (tmp_path / name).write_text(f'extends = "team.toml"\n{drone}\n')
        return load_config(tmp_path / name)

    return load


def test_a_drone_starts_where_the_file_says_and_knows_where_the_others_do(load):
    config = load("drone.id = 2")
    assert config.drone.start.position_m == (5.0, 1.0, -0.1)
    assert (config.drone.start.yaw_deg, config.drone.start.stated_sigma_m) == (180.0, 0.5)
    other, nowhere = filed_announcements(config, 12.0)
    assert (other.drone_id, other.t, list(other.position)) == (1, 12.0, [0.0, 0.0, -0.1])
    assert other.position_cov[1, 1] == pytest.approx(0.09)
    assert (nowhere.drone_id, nowhere.position_cov[0, 0]) == (7, SOMEWHERE_M**2)
    seen_by_seven = filed_announcements(load("drone.id = 7"), 0.0)
    assert [one.drone_id for one in seen_by_seven] == [1, 2]
    assert rotation.to_euler(seen_by_seven[1].world_from_body)[2] == pytest.approx(3.14159, abs=1e-4)


def test_a_local_frame_begins_where_the_file_says(load):
    link = '[autopilot]\nlink = "udpin:0.0.0.0:14540"'
    start = load(f'drone.id = 2\ndrone.start = {{ from = "local" }}\n{link}').drone.start
    assert (start.source, start.offset_m) == ("local", (5.0, 1.0, -0.1))


def test_a_start_of_its_own_may_be_better_than_the_file(load):
    own = load("drone.id = 2\ndrone.start = { position_m = [5.2, 1.1, -0.1], position_sigma_m = 0.05 }")
    assert own.drone.start.position_m == (5.2, 1.1, -0.1)


CODES = TEAM.replace(
    "[team.drones]", "code = { begins = [2026-05-01T10:00:00Z, 2026-05-01T10:01:00Z] }\n[team.drones]"
)
PLAN = TEAM.replace(
    "[team.drones]", 'plan = { file = "plan.csv", begins = 2026-05-01T10:00:00Z }\n[team.drones]'
)
SWITCHED = TEAM.replace("[team.drones]", "code = { switch = { channel = 8 } }\n[team.drones]")
UTC_S = 1777629600.0  # 2026-05-01T10:00:00Z


def test_the_codes_of_all_and_of_this_drone_itself_are_those_of_the_whole_team_at_their_times(load):
    motions = agreed_motions(load("drone.id = 2", CODES), 100.0 - UTC_S)
    assert [(one.drone_id, one.t[0], one.planned) for one in motions] == [
        (drone_id, begin, False) for begin in (100.0, 160.0) for drone_id in (1, 2, 7)
    ]
    seven = motions[2]
    k = 60
    assert seven.displacement[k] == pytest.approx(sway(7, (1, 2, 7), seven.t[k] - 100.0)[0])


def test_a_plan_lies_beside_the_file_that_names_it_and_counts_from_its_beginning(load, tmp_path):
    write_trajectories(tmp_path / "plan.csv", [(d, t, t, 0.0, -5.0) for d in (1, 2) for t in (0.0, 3.0)])
    (way,) = agreed_motions(load("drone.id = 2", PLAN), 100.0 - UTC_S)
    assert (way.drone_id, way.planned, list(way.t)) == (1, True, [100.0, 103.0])
    assert way.displacement == pytest.approx(np.array([[0.0, 0.0, -5.0], [3.0, 0.0, -5.0]]))


def test_a_plan_with_a_drone_that_is_not_of_the_team_is_refused(load, tmp_path):
    write_trajectories(tmp_path / "plan.csv", [(4, t, 0.0, 0.0, 0.0) for t in (0.0, 3.0)])
    with pytest.raises(ConfigError, match=r"team\.plan\.file: .*plan\.csv has drone 4, expected those of"):
        agreed_motions(load("drone.id = 2", PLAN), 0.0)


@pytest.mark.parametrize(
    ("drone", "team", "complaint"),
    [
        ("drone.id = 3", TEAM, "drone.toml:2: drone.id: 3, expected one of [team.drones]: 1, 2, 7"),
        (
            "drone.id = 2\ndrone.start = { position_m = [0.0, 0.0, -0.1] }",
            TEAM,
            "drone.start.position_m: [0.0, 0.0, -0.1], expected [team.drones] of drone 2: [5.0, 1.0, -0.1]",
        ),
        ("drone.id = 1", TEAM + "1 = {}\n", "team.toml:8: Cannot overwrite a value, expected valid TOML"),
        ("drone.id = 1", TEAM + "0 = {}\n", 'found the key "0", expected drone IDs'),
        ("drone.id = 1", TEAM + "8 = { yaw = 3.0 }\n", "team.drones.8.yaw: unknown key"),
        ("drone.id = 1", TEAM + "8 = 3\n", "team.toml:8: team.drones.8: 3, expected a table"),
        (
            "drone.id = 1",
            TEAM + "8 = { position_m = [0.0, 0.0, 0.0] }\n",
            "position_m without position_sigma_m, expected both",
        ),
        ("drone.id = 1", CODES.replace("10:00:00Z", "10:00:00"), "expected UTC with its Z"),
        ("drone.id = 1", "team.code.begins = [2026-05-01T10:00:00Z]\n", "code without drones, expected"),
        (
            "drone.id = 1",
            CODES.replace("[2026-05-01T10:00:00Z, 2026-05-01T10:01:00Z]", "[]"),
            "team.code: neither begins nor switch, expected begins = [UTC, …] or switch = { channel = 8 }",
        ),
        (
            "drone.id = 1\nautopilot.link = 'udpin:0.0.0.0:14540'",
            SWITCHED.replace("8", "19"),
            "team.toml:4: team.code.switch.channel: 19, expected",
        ),
        (
            "drone.id = 1",
            SWITCHED,
            'autopilot.link: "none", expected a MAVLink link, which reports the channel of team.code.switch',
        ),
        ("drone.id = 1", "team.announce = false\n", "announce = false without drones, expected"),
    ],
)
def test_what_cannot_be_is_said_with_its_place(load, drone, team, complaint):
    with pytest.raises(ConfigError) as error:
        load(drone, team)
    assert complaint in str(error.value)


def test_a_file_that_is_missing_is_said(tmp_path):
    (tmp_path / "drone.toml").write_text(f'extends = "team.toml"\ndrone.id = 1\n{CAMERA}')
    with pytest.raises(ConfigError, match="extends: no file"):
        load_config(tmp_path / "drone.toml")


def test_the_check_shows_who_is_where_and_finds_teams_that_differ(load, tmp_path, capsys):
    load("drone.id = 1", name="one.toml")
    (tmp_path / "other.toml").write_text(TEAM.replace("5.0, 1.0", "6.0, 1.0") + CAMERA)
    (tmp_path / "two.toml").write_text('extends = "other.toml"\ndrone.id = 2\n[team.origin]\n'
                                       "lat_deg = 47.0\nlon_deg = 8.0\nalt_m = 400.0\n")  # fmt: skip
    assert main(["config", "check", str(tmp_path / "one.toml")]) == 0
    shown = capsys.readouterr().out
    assert "teammates  2 at [5.0, 1.0, -0.1] ±0.5 m, 7 somewhere" in shown
    assert "silent     nothing is sent to the team, nothing requested" in shown
    assert main(["config", "check", *(str(tmp_path / name) for name in ("one.toml", "two.toml"))]) == 2
    said = capsys.readouterr().err
    assert "team.drones: [1 at" in said
    assert "team.origin: " in said
