"""`swarmtrack keys`: what it makes, what it refuses, and what an agent refuses of what it made."""

from __future__ import annotations

import logging
import shutil
import subprocess
import sys
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest

from support.network_of_keys import CLOCK, now
from support.places import ROOT
from swarmtrack.agents.main import main
from swarmtrack.errors import KeysError
from swarmtrack.security.authority import create_authority, open_authority
from swarmtrack.security.keyfiles import read_certificate
from swarmtrack.security.loading import load_credentials
from swarmtrack.security.roster import Roster, read_roster

Keys = Callable[..., tuple[int, str, str]]


@pytest.fixture
def keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Keys:
    """Runs `swarmtrack keys ACTION DIR …`: exit code, what it printed, and its complaint."""

    def run(action: str, *arguments: str) -> tuple[int, str, str]:
        code = main(["keys", action, str(tmp_path / "ca"), *arguments])
        out, err = capsys.readouterr()
        return code, out, err

    return run


def load(folder: Path, name: str) -> object:
    return load_credentials(folder, name, CLOCK.utc())


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


# --- what is made -----------------------------------------------------------------------


def test_a_team_is_set_up_in_two_commands(keys: Keys, tmp_path: Path) -> None:
    assert keys("init", "--team", "red")[0] == 0
    code, said, _ = keys("issue", "1", "2", "monitor", "router-a")
    assert code == 0
    assert f"{tmp_path / 'ca' / 'drone-2'}: copy this folder to drone-2, and to no other machine" in said
    one, two = (load_credentials(tmp_path / "ca" / f"drone-{i}", f"drone-{i}", CLOCK.utc()) for i in (1, 2))
    assert one.roster == two.roster
    assert one.roster.team == "red"
    assert one.roster.names == ("drone-1", "drone-2", "monitor", "router-a")
    assert one.sign is not None
    signature = one.sign(b"words")
    assert two.verify(1, b"words", signature)
    assert not two.verify(1, b"other words", signature)
    assert not two.verify(2, b"words", signature)
    assert not two.verify(9, b"words", signature)
    assert not two.verify(1, b"words", b"")


def test_private_keys_are_for_their_owner_only_and_the_folder_holds_no_other(
    keys: Keys, tmp_path: Path
) -> None:
    keys("init")
    keys("issue", "3", "monitor")
    drone = tmp_path / "ca" / "drone-3"
    assert {path.name: mode(path) for path in drone.iterdir()} == {
        "ca.pem": 0o644,
        "drone-3.pem": 0o644,
        "drone-3.key": 0o600,
        "drone-3.sign.key": 0o600,
        "roster.toml": 0o644,
        "roster.sig": 0o644,
    }
    assert mode(drone) == 0o700
    assert mode(tmp_path / "ca" / "ca.key") == 0o600
    assert not (tmp_path / "ca" / "monitor" / "monitor.sign.key").exists()  # it announces nothing


def test_out_puts_the_folders_elsewhere(keys: Keys, tmp_path: Path) -> None:
    keys("init")
    assert keys("issue", "3", "--out", str(tmp_path / "stick"))[0] == 0
    load(tmp_path / "stick" / "drone-3", "drone-3")
    assert not (tmp_path / "ca" / "drone-3").exists()


def test_list_tells_who_until_when_and_by_which_fingerprint(keys: Keys, tmp_path: Path) -> None:
    keys("init", "--team", "red")
    keys("issue", "7", "monitor", "--days", "30")
    _, said, _ = keys("list")
    (entry, _) = open_authority(tmp_path / "ca").issued()
    assert entry.signing_key is not None
    lines = said.splitlines()
    assert lines[0].startswith("team red, roster number 1, CA until ")
    for words in (
        "drone-7",
        f"{entry.expires:%Y-%m-%d %H:%M}Z",
        entry.fingerprint[:20],
        entry.signing_key.hex()[:20],
    ):
        assert words in lines[2]
    assert lines[3].startswith("monitor")
    assert timedelta(days=29) < entry.expires - now() <= timedelta(days=30)


def test_a_newcomer_renews_the_roster_of_all_and_it_is_said_who_needs_it(keys: Keys, tmp_path: Path) -> None:
    keys("init")
    keys("issue", "1", "2")
    carried_away = tmp_path / "on-drone-1"
    shutil.copytree(tmp_path / "ca" / "drone-1", carried_away)
    _, said, _ = keys("issue", "3")
    assert "into the keys of drone-1, drone-2 and restart" in said
    at_hand = load_credentials(tmp_path / "ca" / "drone-1", "drone-1", CLOCK.utc())
    away = load_credentials(carried_away, "drone-1", CLOCK.utc())
    assert (at_hand.roster.number, away.roster.number) == (2, 1)
    assert 3 in at_hand.roster.drones
    assert 3 not in away.roster.drones


def test_renewal_keeps_the_keys_and_needs_none_of_them(keys: Keys, tmp_path: Path) -> None:
    keys("init")
    keys("issue", "3", "--days", "2")
    drone = tmp_path / "on-drone-3"
    shutil.move(tmp_path / "ca" / "drone-3", drone)
    code, said, _ = keys("issue", "3", "--renew")
    assert code == 0
    renewed = tmp_path / "ca" / "drone-3" / "drone-3.pem"
    assert f"{renewed}: copy it to drone-3" in said
    assert [path.name for path in renewed.parent.iterdir()] == ["drone-3.pem"]
    shutil.copy(renewed, drone)
    credentials = load_credentials(drone, "drone-3", CLOCK.utc())
    assert credentials.expires - now() > timedelta(days=80)
    assert credentials.roster.number == 1  # nobody else needs to know


def test_whoever_is_revoked_is_in_no_roster_any_more(keys: Keys, tmp_path: Path) -> None:
    keys("init")
    keys("issue", "1", "2", "3")
    code, said, _ = keys("revoke", "2")
    assert code == 0
    assert "Without it they still accept drone-2" in said
    assert load_credentials(tmp_path / "ca" / "drone-1", "drone-1", CLOCK.utc()).roster.drones.keys() == {
        1,
        3,
    }
    assert "drone-2" not in keys("list")[1]


# --- what is refused --------------------------------------------------------------------


def test_no_key_is_overwritten_without_force(keys: Keys, tmp_path: Path) -> None:
    keys("init")
    keys("issue", "3")
    ca, drone = (tmp_path / "ca" / "ca.key").read_bytes(), tmp_path / "ca" / "drone-3" / "drone-3.key"
    old = drone.read_bytes()
    code, _, complaint = keys("init")
    assert code == 2
    assert "would lock the whole team out" in complaint
    code, _, complaint = keys("issue", "4", "3")  # all or none
    assert code == 2
    assert "drone-3 has keys already. --renew" in complaint
    assert not (tmp_path / "ca" / "drone-4").exists()
    assert ((tmp_path / "ca" / "ca.key").read_bytes(), drone.read_bytes()) == (ca, old)

    assert keys("issue", "3", "--force")[0] == 0
    assert drone.read_bytes() != old
    load(drone.parent, "drone-3")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["issue", "0"], "found '0', expected a drone's ID 1 … 65535"),
        (["issue", "65536"], "found '65536'"),
        (["issue", "../1"], "found '../1'"),
        (["issue", "router"], "router-NAME"),
        (["issue", "monitor-"], "found 'monitor-'"),
        (["issue"], "no name given"),
        (["issue", "9", "--renew"], "drone-9 has no certificate, expected one of drone-1"),
        (["issue", "1", "--renew", "--out", "x"], "--out with --renew"),
        (["revoke", "9"], "drone-9 is not in the roster"),
    ],
)
def test_wrong_usage_is_a_sentence_and_code_2(keys: Keys, arguments: list[str], says: str) -> None:
    keys("init")
    keys("issue", "1")
    code, _, complaint = keys(*arguments)
    assert code == 2
    assert says in complaint


def test_a_folder_that_is_no_ca_is_named(keys: Keys) -> None:
    code, _, complaint = keys("issue", "1")
    assert code == 2
    assert "holds no ca.key, expected the folder of `swarmtrack keys init`" in complaint


# --- what an agent refuses --------------------------------------------------------------


@pytest.fixture
def ca(tmp_path: Path) -> Path:
    authority = create_authority(tmp_path / "ca", "red", now())
    authority.issue(["drone-1", "drone-2"], now())
    return tmp_path / "ca"


def break_mode(ca: Path) -> None:
    (ca / "drone-1" / "drone-1.sign.key").chmod(0o640)


def take_anothers(ca: Path) -> None:
    shutil.rmtree(ca / "drone-1")
    (ca / "drone-2").rename(ca / "drone-1")


def take_anothers_certificate(ca: Path) -> None:
    shutil.copy(ca / "drone-2" / "drone-2.pem", ca / "drone-1" / "drone-1.pem")


def take_anothers_key(ca: Path) -> None:
    shutil.copy(ca / "drone-2" / "drone-2.key", ca / "drone-1" / "drone-1.key")


def take_an_old_signing_key(ca: Path) -> None:
    shutil.copy(ca / "drone-2" / "drone-2.sign.key", ca / "drone-1" / "drone-1.sign.key")


def take_another_ca(ca: Path) -> None:
    create_authority(ca.parent / "other", "red", now())
    shutil.copy(ca.parent / "other" / "ca.pem", ca / "drone-1" / "ca.pem")


def edit_the_roster(ca: Path) -> None:
    path = ca / "drone-1" / "roster.toml"
    path.write_text(path.read_text().replace("number = 1", "number = 2"))


def lose_the_signature(ca: Path) -> None:
    (ca / "drone-1" / "roster.sig").unlink()


def write_garbage(ca: Path) -> None:
    (ca / "drone-1" / "drone-1.pem").write_bytes(b"\xff" * 100)


@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        (break_mode, r"drone-1\.sign\.key: mode 0640 lets others on this machine read the key.*chmod 600"),
        (take_anothers, r"holds the keys of drone-2, expected those of drone-1; or is drone\.id wrong\?"),
        (
            take_anothers_certificate,
            r"drone-1\.pem: is the certificate of 'drone-2', expected that of drone-1",
        ),
        (take_anothers_key, r"drone-1\.key: does not belong to drone-1\.pem"),
        (take_an_old_signing_key, r"roster\.toml: number 1 does not list this key of drone-1"),
        (take_another_ca, r"drone-1\.pem: was not issued by the CA in ca\.pem"),
        (edit_the_roster, r"roster\.toml: is not what this team's CA signed"),
        (lose_the_signature, r"roster\.sig: cannot be read"),
        (write_garbage, r"drone-1\.pem: is not a certificate"),
        (lambda ca: shutil.rmtree(ca / "drone-1"), r"no folder .*drone-1, expected the one that"),
    ],
)
def test_keys_that_would_fail_in_silence_are_refused_with_what_to_do(
    ca: Path, mistake: Callable[[Path], None], says: str
) -> None:
    load(ca / "drone-1", "drone-1")
    mistake(ca)
    with pytest.raises(KeysError, match=says):
        load(ca / "drone-1", "drone-1")


def test_a_certificate_out_of_its_time_makes_the_clock_the_suspect(
    ca: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = ca / "drone-1"
    end = read_certificate(folder / "drone-1.pem").not_valid_after_utc.timestamp()
    with pytest.raises(KeysError, match=r"is not valid before .* clock shows 1970-01-01.* the clock is off"):
        load_credentials(folder, "drone-1", 0.0)
    with pytest.raises(KeysError, match=r"drone-1\.pem: expired on .*--renew"):
        load_credentials(folder, "drone-1", end + 1.0)
    with caplog.at_level(logging.WARNING):
        load_credentials(folder, "drone-1", end - 3600.0)
    assert "expires on" in caplog.text


def test_an_agent_complains_of_its_keys_at_the_line_of_its_config(
    ca: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from swarmtrack.agents.vehicle import main as agent  # noqa: PLC0415

    (tmp_path / "team.toml").write_text('[network]\nteam = "red"\nkeys = "ca/drone-{id}"\n')
    drone = tmp_path / "drone.toml"
    drone.write_text('extends = "team.toml"\ndrone.id = 1\ncamera.source = "sim://hover-triangle"\n')
    assert agent(["--config", str(drone), "--check"]) == 0
    break_mode(ca)
    assert agent(["--config", str(drone), "--check"]) == 2
    assert f"{tmp_path / 'team.toml'}:3: network.keys: " in capsys.readouterr().err
    (tmp_path / "team.toml").write_text('[network]\nteam = "blue"\nkeys = "ca/drone-{id}"\n')
    (ca / "drone-1" / "drone-1.sign.key").chmod(0o600)
    assert agent(["--config", str(drone), "--check"]) == 2
    assert "team.toml:2: network.team: found 'blue', expected 'red'" in capsys.readouterr().err


def test_an_agent_without_keys_loads_no_cryptography() -> None:
    program = "import sys, swarmtrack.runtime.agent; sys.exit('cryptography' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=False).returncode == 0


# --- the roster's text ------------------------------------------------------------------


def test_a_roster_reads_as_it_was_written() -> None:
    roster = Roster("red", 7, {1: bytes(32), 65535: bytes(range(32))}, ("monitor",), ("router-a", "router-b"))
    assert read_roster(roster.to_toml(), "here") == roster


@pytest.mark.parametrize(
    "text",
    [
        "",
        "team = 1\nnumber = 1\nmonitors = []\nrouters = []\n[drones]\n",
        'team = "a"\nnumber = 1\nmonitors = ["drone-1; rm"]\nrouters = []\n[drones]\n',
        'team = "a"\nnumber = 1\nmonitors = []\nrouters = []\n[drones]\n0 = "00"\n',
        'team = "a"\nnumber = 1\nmonitors = []\nrouters = []\n[drones]\n1 = "00"\n',
        'team = "a"\nnumber = 1\nmonitors = []\nrouters = []\ndrones = []\n',
        "\x00",
    ],
)
def test_a_roster_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(KeysError, match=r"^here: "):
        read_roster(text.encode(), "here")
