"""Files of trajectories: what is written is read again, and what is wrong is said with its line."""

from __future__ import annotations

import json

import numpy as np
import pytest

from swarmtrack.agents.main import main
from swarmtrack.config.trajectories import read_trajectories, write_trajectories
from swarmtrack.errors import ConfigError
from swarmtrack.motion.priors import SWAY_LASTS_S
from swarmtrack.motion.sway import sway

HEADER = "id,t_s,north_m,east_m,down_m\n"


def test_what_is_written_is_read_again(tmp_path):
    path = tmp_path / "plan.csv"
    write_trajectories(path, [(2, 0.0, 1.0, -2.0, -5.0), (7, 0.0, 0.0, 0.0, 0.0), (2, 2.0, 3.0, -2.0, -5.0),
                              (7, 1.0, 0.0, 0.0, -1.0)])  # fmt: skip
    found = read_trajectories(path)
    assert list(found) == [2, 7]
    # Linear between samples, at rest outside.
    assert found[2].at(np.array([-1.0, 1.0, 9.0])) == pytest.approx(
        np.array([[1.0, -2.0, -5.0], [2.0, -2.0, -5.0], [3.0, -2.0, -5.0]])
    )


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("id,t_s,north_m,east_m\n", "1: column down_m: missing, expected id,t_s,north_m,east_m,down_m in line 1"),
        ("", "1: column id: missing"),
        (HEADER, "1: no samples, expected a line"),
        (HEADER + "1,0,0,0,0\n", "1: id: drone 1 has one sample, expected two or more"),
        (HEADER + "1,0,0,0,0\n1,0,0,0,0\n", "3: t_s: 0 of drone 1, expected more than 0"),
        (HEADER + "0,0,0,0,0\n", "2: id: 0, expected a drone's ID, 1 to 65535"),
        (HEADER + "1.5,0,0,0,0\n", "2: id: 1.5, expected a drone's ID"),
        (HEADER + "1,soon,0,0,0\n", "2: t_s: soon, expected seconds"),
        (HEADER + "1,0,nan,0,0\n", "2: north_m: nan, expected metres"),
        (HEADER + "1,0,0,1e9,0\n", "2: east_m: 1e9, expected metres, 100000 at most"),
        (HEADER + "1,0,0,0\n", "2: down_m: nothing, expected metres"),
        (HEADER + '1,0,0,0,"0\n', "expected CSV in UTF-8"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_line(tmp_path, text, complaint):
    path = tmp_path / "plan.csv"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        read_trajectories(path)
    assert str(error.value).startswith(f"{path}:")
    assert complaint in str(error.value)


def test_a_file_that_is_missing_is_said(tmp_path):
    with pytest.raises(ConfigError, match=r"gone\.csv:1: cannot be read"):
        read_trajectories(tmp_path / "gone.csv")


def test_the_mission_of_a_sway_is_the_code_as_csv_and_as_set_points(tmp_path, capsys):
    table, points = tmp_path / "sway.csv", tmp_path / "sway.json"
    team = (4, 9, 2)
    words = ["mission", "sway", *map(str, team), "--begins", "2026-05-01T10:00:03Z", "--out"]
    assert main([*words, str(table)]) == 0
    assert "begins = [2026-05-01T10:00:10Z]" in capsys.readouterr().out
    assert main([*words, str(points)]) == 0
    document = json.loads(points.read_text())
    assert document["begins_utc"] == "2026-05-01T10:00:10+00:00"
    t = np.arange(0.0, SWAY_LASTS_S, 0.05)
    for drone_id, found in read_trajectories(table).items():
        flown = np.array([sway(drone_id, team, one) for one in t])
        assert found.at(t) == pytest.approx(flown[:, 0], abs=2e-4)
        told = document["drones"][str(drone_id)]
        assert [one["z"] for one in told] == pytest.approx([*flown[:, 0, 2], 0.0], abs=1e-5)
        assert [one["vz"] for one in told] == pytest.approx([*flown[:, 1, 2], 0.0], abs=1e-5)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["1", "2", "1", "--out", "a.csv"], "ID: found 1, expected each of 1 to 65535 once"),
        (["1", "2", "--out", "a.waypoints"], "found .waypoints, expected .csv or .json"),
        (["1", "2", "--out", "nowhere/a.csv"], "expected a file that can be written"),
    ],
)
def test_a_mission_that_cannot_be_written_is_refused(tmp_path, monkeypatch, capsys, words, complaint):
    monkeypatch.chdir(tmp_path)
    assert main(["mission", "sway", *words]) == 2
    assert complaint in capsys.readouterr().err
