"""A roster that is copied to an agent in flight: what is taken, and what is not."""

import os
import shutil
from pathlib import Path

import pytest

from support.network_of_keys import CLOCK, Team, now
from swarmtrack.security.roster_watch import RosterWatch


@pytest.fixture
def team(tmp_path: Path) -> Team:
    return Team(tmp_path / "ca", "1", "2", "3")


@pytest.fixture
def watch(team: Team) -> RosterWatch:
    credentials = team.credentials("1")
    return RosterWatch(credentials.ca.parent, credentials, CLOCK)


def folder(team: Team) -> Path:
    return team.folder / "drone-1"


def test_nothing_new_is_no_news(team: Team, watch: RosterWatch) -> None:
    assert watch.news() is None
    os.utime(folder(team) / "roster.toml", ns=(1, 1))
    assert watch.news() is None


def test_a_newer_roster_is_taken_once(team: Team, watch: RosterWatch) -> None:
    team.authority.revoke("drone-3")
    found = watch.news()
    assert found is not None
    assert found.roster.drones.keys() == {1, 2}
    assert watch.news() is None


def test_a_renewed_certificate_is_taken(team: Team, watch: RosterWatch) -> None:
    before = team.credentials("1").expires
    team.authority.renew(["drone-1"], now(), days=30)
    found = watch.news()
    assert found is not None
    assert found.expires != before


def test_half_a_roster_is_not_taken_and_the_whole_one_is_later(
    team: Team, watch: RosterWatch, caplog: pytest.LogCaptureFixture
) -> None:
    old = (folder(team) / "roster.sig").read_bytes()
    team.authority.revoke("drone-3")
    new = (folder(team) / "roster.sig").read_bytes()
    (folder(team) / "roster.sig").write_bytes(old)
    assert watch.news() is None
    assert "is not what this team's CA signed" in caplog.text
    assert watch.news() is None
    assert caplog.text.count("rejected") == 1  # said once
    (folder(team) / "roster.sig").write_bytes(new + b"\n")
    assert watch.news() is not None


def test_files_that_are_away_for_a_moment_are_no_end(team: Team, watch: RosterWatch) -> None:
    kept = (folder(team) / "roster.toml").read_bytes()
    (folder(team) / "roster.toml").unlink()
    assert watch.news() is None
    (folder(team) / "roster.toml").write_bytes(kept)
    assert watch.news() is None


def test_an_older_roster_brings_nobody_back(
    team: Team, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copytree(folder(team), tmp_path / "old")
    team.authority.revoke("drone-3")
    credentials = team.credentials("1")
    watch = RosterWatch(folder(team), credentials, CLOCK)
    for file in ("roster.toml", "roster.sig"):
        shutil.copy(tmp_path / "old" / file, folder(team) / file)
        os.utime(folder(team) / file)
    assert watch.news() is None
    assert "an old roster is rejected" in caplog.text


def test_another_team_s_roster_is_not_taken(
    team: Team, watch: RosterWatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = Team(tmp_path / "other", "1")
    for file in ("roster.toml", "roster.sig"):
        shutil.copy(other.folder / "drone-1" / file, folder(team) / file)
    assert watch.news() is None
    assert "rejected" in caplog.text
