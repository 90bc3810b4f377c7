"""What brings swarmtrack onto a machine: the image's files, the compose swarm, the units. Checked by their own tools.

The image itself is not built here: docs/deployment.md says how it was.
"""

from __future__ import annotations

import argparse
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from support.places import ROOT
from swarmtrack.agents import simulator, vehicle
from swarmtrack.agents.main import COMMANDS
from swarmtrack.config.drone import load_config, load_team_config, mount_camera
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.runtime.health_file import ENVIRONMENT

DOCKER, UNITS = ROOT / "docker", ROOT / "configs" / "systemd"
DOCKERFILE = (DOCKER / "Dockerfile").read_text(encoding="utf-8")
COMPOSE = yaml.safe_load((DOCKER / "compose.yaml").read_text(encoding="utf-8"))
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
ONE_SHOT = ("keys", "judge")
PUBLISHED = ("monitor",)  # services that a browser reaches


def parser_of(command: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(exit_on_error=False, allow_abbrev=False)
    import_module(COMMANDS[command][0]).add_arguments(parser)
    return parser


def parse(words: list[str]) -> argparse.Namespace:
    """A command line of a container, by the parser of the program itself; wrong ones exit."""
    match words:
        case ["swarmtrack-agent", *rest]:
            return vehicle.parser().parse_args(rest)
        case ["python", "-m", "swarmtrack.agents.simulator", *rest]:
            return simulator.parser().parse_args(rest)
        case ["swarmtrack", command, *rest] if command in COMMANDS:
            return parser_of(command).parse_args(rest)
    raise AssertionError(f"no program of ours: {shlex.join(words)}")


def command_lines(service: dict[str, Any]) -> list[list[str]]:
    entrypoint = service.get("entrypoint", ["swarmtrack-agent"])  # the image's own
    if entrypoint[0] == "/bin/sh":
        lines = service["command"][0].splitlines()
        return [shlex.split(line) for line in lines if line.startswith("swarmtrack")]
    return [[*entrypoint, *map(str, service["command"])]]


# --- the image ------------------------------------------------------------------------------------


def test_the_image_holds_what_the_lock_lists_less_what_builds_the_wheel():
    assert "--require-hashes --only-binary :all: -r requirements.lock" in DOCKERFILE
    taken_away = set(re.search(r"pip uninstall --yes (.+)", DOCKERFILE)[1].split()) - {"pip", "setuptools"}
    pinned = re.findall(r"^([a-z0-9-]+)==", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    assert "hatchling" in taken_away <= set(pinned)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert not taken_away & {re.split(r"[<>=,\s]", line)[0] for line in project["dependencies"]}


def test_the_dockerfile_is_clean_by_hadolint():
    program = Path(sys.executable).with_name("hadolint")
    if not program.exists():
        pytest.skip("hadolint is not installed")
    found = subprocess.run(
        [program, "--no-color", DOCKER / "Dockerfile"], capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stdout + found.stderr


def test_the_image_runs_as_nobody_special_with_a_health_check_of_ours():
    last_stage = DOCKERFILE.rpartition("\nFROM ")[2]
    assert re.search(r"^USER \d{4,}$", last_stage, re.MULTILINE)
    check = re.search(r"^HEALTHCHECK .* CMD (\[.*\])$", last_stage, re.MULTILINE)
    parse(yaml.safe_load(check[1]))
    assert f"{ENVIRONMENT}=/tmp/" in last_stage
    assert re.search(r"^ENTRYPOINT \[\"swarmtrack-agent\"\]$", last_stage, re.MULTILINE)
    parse(["swarmtrack-agent", *yaml.safe_load(re.search(r"^CMD (\[.*\])$", last_stage, re.MULTILINE)[1])])


def test_what_the_dockerfile_copies_is_let_through_by_dockerignore():
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = re.findall(r"^COPY (?!--from)(.+) \S+$", DOCKERFILE, re.MULTILINE)
    for name in " ".join(copied).split():
        assert (ROOT / name).exists()
        assert name in allowed, name


# --- the compose swarm ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_runs_a_program_of_ours_with_arguments_it_takes(name):
    lines = command_lines(SERVICES[name])
    assert lines
    for line in lines:
        parse(line)


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_may_nothing_that_it_does_not_need(name):
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["tmpfs"] == ["/tmp"]
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert not {"privileged", "user", "cap_add"} & service.keys()
    ports = service.get("ports", [])
    assert bool(ports) == (name in PUBLISHED)
    assert all(port.startswith("127.0.0.1:") for port in ports)


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_that_stays_says_how_it_is(name):
    check = SERVICES[name].get("healthcheck")
    if name in ONE_SHOT:
        assert check == {"disable": True}
    elif name in ("simulator", "monitor"):
        compile(check["test"][3], "healthcheck", "exec")
    else:
        assert check is None  # the image's own


@pytest.mark.parametrize("name", SERVICES)
def test_what_a_service_mounts_and_reads_is_there(name):
    service = SERVICES[name]
    mounts = dict(volume.split(":")[:2][::-1] for volume in service.get("volumes", []))
    for target, source in mounts.items():
        assert (DOCKER / source).is_dir() if source.startswith(".") else source in COMPOSE["volumes"], target
    for line in command_lines(service):
        for word in line:
            if word.startswith("/etc/swarmtrack/"):
                assert (DOCKER / mounts["/etc/swarmtrack"] / Path(word).name).is_file()


def test_who_runs_the_judge_starts_everybody_it_judges():
    waits_for = {name: on["condition"] for name, on in SERVICES["judge"]["depends_on"].items()}
    flying = {name for name in SERVICES if name == "simulator" or name.startswith("drone-")}
    assert waits_for == {"keys": "service_completed_successfully", **dict.fromkeys(flying, "service_healthy")}


def test_drones_find_each_other_by_their_services_names_and_speak_by_keys():
    team = load_team_config(DOCKER / "swarm" / "team.toml").network
    assert not team.insecure
    assert {f"drone-{drone_id}" for drone_id in team.peers} == {s for s in SERVICES if s.startswith("drone-")}
    assert set(team.peers.values()) <= SERVICES.keys()
    issue = next(parse(line) for line in command_lines(SERVICES["keys"]) if "issue" in line)
    assert {*team.peers, "monitor", "monitor-page"} == set(issue.names)


def test_the_drones_configs_say_what_the_simulator_flies():
    told = parse(command_lines(SERVICES["simulator"])[0])
    seed = simulator.DEFAULT_SEED if told.seed is None else told.seed
    scenario = load_scenario(told.scenario, seed=seed, drones=told.drones)
    for drone_id in scenario.members:
        config = load_config(DOCKER / "swarm" / f"drone-{drone_id}.toml")
        assert config.drone.id == drone_id
        assert config.camera.source == f"http://simulator:{told.port}/{drone_id}"
        assert config.autopilot.link == f"udpout:simulator:{told.port + drone_id}"
        assert config.autopilot.imu_rate_hz == scenario.imu_rate_hz
        assert config.output.tracks_hz == scenario.tracks_hz
        announced = scenario.announced[drone_id]
        np.testing.assert_allclose(config.drone.start.offset_m, announced.position_m, atol=1e-4)
        assert config.drone.start.position_sigma_m == pytest.approx(announced.position_sigma_m)
        mounted = mount_camera(config.camera)
        assert mounted.camera == scenario.camera
        np.testing.assert_allclose(
            mounted.body_from_camera.rotation, scenario.body_from_camera.rotation, atol=1e-6
        )


def test_the_script_without_compose_starts_the_same_programs():
    script = (DOCKER / "run-by-hand.sh").read_text(encoding="utf-8").replace("\\\n", " ")
    script = script.replace('"$drone"', "1").replace("$drone", "1").replace('"$seconds"', "20")
    script = script.replace('"$detector"', "onnx")
    assert subprocess.run(["sh", "-n", DOCKER / "run-by-hand.sh"], check=False).returncode == 0
    agent = re.search(r'"\$image" (--config \S+ --quiet)', script)
    parse(["swarmtrack-agent", *shlex.split(agent[1])])
    simulated = re.search(r'"\$image" (-m swarmtrack.agents.simulator [^>]+)', script)
    assert vars(parse(["python", *shlex.split(simulated[1])])) == vars(
        parse(command_lines(SERVICES["simulator"])[0])
    )
    judged = re.search(r'"\$image" (judge [^|]+)\|\|', script)
    assert vars(parse(["swarmtrack", *shlex.split(judged[1])])) == vars(
        parse(command_lines(SERVICES["judge"])[0])
    )


# --- systemd and udev -----------------------------------------------------------------------------


@pytest.fixture
def units(tmp_path):
    """The units, with programs that are on this machine."""
    for unit in UNITS.glob("*.service"):
        text = re.sub("^ExecStart=[^ ]+", "ExecStart=/bin/true", unit.read_text(encoding="utf-8"), flags=re.M)
        (tmp_path / unit.name).write_text(text, encoding="utf-8")
    return tmp_path


def systemd_analyze(*words: object) -> subprocess.CompletedProcess[str]:
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("systemd is not installed")
    return subprocess.run([program, *map(str, words)], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", ["swarmtrack-agent@drone-1.service", "swarmtrack-router.service"])
def test_systemd_finds_nothing_wrong_with_a_unit(units, name):
    found = systemd_analyze("verify", "--recursive-errors=no", units / name)
    assert not [line for line in found.stderr.splitlines() if "swarmtrack" in line], found.stderr
    assert found.returncode == 0, found.stderr


@pytest.mark.parametrize("name", ["swarmtrack-agent@.service", "swarmtrack-router.service"])
def test_a_unit_may_little(units, name):
    """systemd's own mark: 10 may all, 0 nothing; below 2.0 with a network and devices is as good as it gets."""
    found = systemd_analyze("security", "--offline=true", "--threshold=20", "--no-pager", units / name)
    assert found.returncode == 0, found.stdout[-300:] + found.stderr


@pytest.mark.parametrize("unit", sorted(UNITS.glob("*.service")), ids=lambda path: path.name)
def test_a_unit_starts_a_program_of_ours_with_arguments_it_takes(unit):
    [start] = re.findall(r"^ExecStart=(.+)$", unit.read_text(encoding="utf-8"), re.MULTILINE)
    program, *words = shlex.split(start.replace("%i", "drone-1"))
    if Path(program).name == "swarmtrack-agent":
        parse(["swarmtrack-agent", *words])
    else:
        parse(["swarmtrack", *words])
