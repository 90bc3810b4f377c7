"""Faults as a user makes them, with real sockets, files and processes, and the sentence that doctor finds for each."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
import tty
from collections.abc import AsyncIterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from support.drone_on_the_bench import SMALL, SOURCE, Server, TurnedAutopilot, camera_at, written
from support.fake_autopilot import FakeAutopilot, serve_udp
from support.network_of_keys import Drone, Team, announcement, free_addresses, now
from support.patience import PATIENCE
from support.places import ROOT, V4L2_STAND_IN
from support.ports import free_port
from swarmtrack.agents import doctor
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.diagnosis.findings import Finding, Level
from swarmtrack.diagnosis.mounting import check_motion
from swarmtrack.diagnosis.sources import check_autopilot, check_camera, check_imu
from swarmtrack.diagnosis.surroundings import check_detector, check_disk, check_network
from swarmtrack.doctor import examination, team
from swarmtrack.doctor.examination import examine
from swarmtrack.doctor.watching import SensorWatch
from swarmtrack.geometry import rotation
from swarmtrack.lab.autopilots.channel import Channel
from swarmtrack.lab.world.hand_turned import HandTurned, Room
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_transport import ZenohTransport

STAND_IN = V4L2_STAND_IN / "stand_in.c"
CC = shutil.which("cc") or shutil.which("gcc")


def faults(findings: list[Finding]) -> set[str]:
    return {finding.fault for finding in findings if finding.fault}


# ── cameras ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def lively(t: float, width: int = 160, height: int = 120):
    return np.random.default_rng(int(10 * t)).integers(0, 255, (height, width, 3), dtype=np.uint8)


async def watched_camera(folder: Path, source: str, seconds: float = 2.0) -> set[str]:
    config = load_config(written(folder, camera=camera_at(source)))
    clock = SystemClock()
    watch = SensorWatch(config, [examination.mount_facts(config.camera, None).mounted], clock)
    return faults(check_camera((await watch.run(seconds)).cameras[0].facts))


async def test_network_cameras_and_what_is_wrong_with_each(tmp_path):
    servers = {
        "silent": Server(lambda t: None),
        "of another size": Server(lambda t: lively(t, 64, 48)),
        "a second old": Server(lively, late=1.0),
        "unstamped": Server(lively, late=None),
        "with its cap on": Server(lambda t: np.full((120, 160, 3), 4, np.uint8)),
        "good": Server(lively),
    }
    async with contextlib.AsyncExitStack() as stack:
        urls = {name: (await stack.enter_async_context(server)).url for name, server in servers.items()}
        urls["of another path"] = urls["good"].replace("stream", "nothing")
        urls["gone"] = SOURCE
        urls["unplugged"] = "v4l2:///dev/video177"
        urls["nonsense"] = "htttp://127.0.0.1"
        found = await asyncio.gather(
            *(watched_camera(tmp_path / str(i), url) for i, url in enumerate(urls.values()))
        )
    # A machine that is busy makes any camera a slow one.
    assert {name: faults - {"camera.slow"} for name, faults in zip(urls, found, strict=True)} == {
        "silent": {"camera.silent"},
        "of another size": {"camera.size"},
        "a second old": {"camera.stamps"},  # or its clock is a second behind: the stamps cannot say
        "unstamped": {"camera.stamps"},
        "with its cap on": {"camera.blank"},
        "good": set(),
        "of another path": {"camera.unreachable"},
        "gone": {"camera.unreachable"},
        "unplugged": {"camera.missing"},
        "nonsense": {"camera.address"},
    }


@pytest.mark.skipif(CC is None, reason="no C compiler to build the stand-in with")
def test_a_usb_camera_that_is_busy_hangs_or_has_one_size_only(tmp_path):
    library = tmp_path / "stand_in.so"
    command = [str(CC), "-O1", "-shared", "-fPIC", str(STAND_IN), "-o", str(library), "-ldl", "-lpthread"]
    subprocess.run(command, check=True)
    scripts = {
        "camera.busy": "busy 1",
        "camera.silent": "silent 1",
        "camera.size": "width 320\nheight 240",
        "camera.slow": "fps 8",
    }
    running = {}
    for fault, script in scripts.items():
        source = "v4l2:///dev/video99?fps=30"
        folder = tmp_path / fault
        config = written(folder, camera=camera_at(source))
        (folder / "script").write_text(script + "\n")
        environment = {
            "V4L2_STAND_IN_DEVICE": "/dev/video99",
            "V4L2_STAND_IN_SCRIPT": str(folder / "script"),
            "LD_PRELOAD": str(library),
            "PYTHONPATH": str(ROOT),
        }
        command = [sys.executable, "-m", "swarmtrack.agents.main", "doctor", "--json", "--seconds", "3"]
        running[fault] = subprocess.Popen(
            [*command, "--config", str(config)], stdout=subprocess.PIPE, env=os.environ | environment
        )
    for fault, process in running.items():
        out, _ = process.communicate(timeout=PATIENCE)
        findings = json.loads(out)
        assert fault in {finding["fault"] for finding in findings}, findings
        assert process.returncode == (0 if fault == "camera.slow" else 1)


# ── autopilots ───────────────────────────────────────────────────────────────────────────────────────────────────────


class Gimbal(FakeAutopilot):
    """A gimbal whose firmware is an autopilot's."""

    def _heartbeat(self) -> Any:
        beat = super()._heartbeat()
        beat.type = common.MAV_TYPE_GIMBAL
        return beat


class Sluggish(FakeAutopilot):
    """Grants every rate, and sends 20 Hz."""

    def set_interval(
        self, message_id: float, interval_us: float, now: float, channel: Channel | None = None
    ) -> int:
        return super().set_interval(message_id, max(interval_us, 50_000.0), now, channel)


async def watched_autopilot(folder: Path, link: str, more: str = "", seconds: float = 5.0) -> set[str]:
    config = load_config(written(folder, autopilot=f'link = "{link}"\n{more}'))
    watched = await SensorWatch(config, [None], SystemClock()).run(seconds)
    return faults([*check_autopilot(watched.autopilot), *check_imu(watched.imu)])


@contextlib.asynccontextmanager
async def serial_port(noise: bytes) -> AsyncIterator[str]:
    ours, theirs = os.openpty()
    tty.setraw(ours)

    async def chatter() -> None:
        while noise:
            os.write(ours, noise)
            await asyncio.sleep(0.05)

    task = asyncio.create_task(chatter())
    try:
        yield os.ttyname(theirs)
    finally:
        task.cancel()
        os.close(ours)
        os.close(theirs)


async def test_autopilots_and_what_is_wrong_with_each(tmp_path):
    boot = time.monotonic() - 40.0
    fakes = {
        "good": FakeAutopilot(boot_at=boot),
        "slow": Sluggish(boot_at=boot),
        "on its back": FakeAutopilot(boot_at=boot),
        "biased": FakeAutopilot(boot_at=boot),
        "a gimbal": Gimbal(boot_at=boot, component=154),
        "another system": FakeAutopilot(boot_at=boot, system=7),
        "without an IMU": FakeAutopilot(boot_at=boot, offered=()),
    }
    for name, fake in fakes.items():
        if name != "biased":
            fake.gyro = np.zeros(3)
    fakes["on its back"].accel = np.array((0.0, 0.0, 9.80665))
    ports = {name: free_port() for name in fakes}
    async with contextlib.AsyncExitStack() as stack:
        for name, fake in fakes.items():
            await stack.enter_async_context(serve_udp(fake, "127.0.0.1", ports[name]))
        taken = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        taken.bind(("127.0.0.1", 0))
        noisy = await stack.enter_async_context(serial_port(b"\x80\x00\xfd\x07" * 9))
        mute = await stack.enter_async_context(serial_port(b""))
        links = {name: f"udpin:127.0.0.1:{port}" for name, port in ports.items()}
        links |= {
            "wrong baud": f"serial:{noisy}:57600",
            "TX and RX swapped": f"serial:{mute}:57600",
            "unplugged": f"serial:{tmp_path}/ttyACM0:115200",
            "a port that is taken": f"udpin:127.0.0.1:{taken.getsockname()[1]}",
            "refused": "tcp:127.0.0.1:9",
            "nonsense": "udpin:127.0.0.1:0",
        }
        found = await asyncio.gather(
            *(
                watched_autopilot(
                    tmp_path / str(i), link, "system_id = 3" if name == "another system" else ""
                )
                for i, (name, link) in enumerate(links.items())
            )
        )
    # A machine that is busy makes any autopilot a slow one.
    slow = {name: set() if name == "slow" else {"autopilot.too_slow"} for name in links}
    assert {name: faults - slow[name] for name, faults in zip(links, found, strict=True)} == {
        "good": set(),
        "slow": {"autopilot.too_slow"},
        "on its back": {"imu.upside_down"},
        "biased": {"imu.bias"},
        "a gimbal": {"autopilot.foreign"},
        "another system": {"autopilot.foreign"},
        "without an IMU": {"autopilot.no_imu"},
        "wrong baud": {"autopilot.garbage"},
        "TX and RX swapped": {"autopilot.silent"},
        "unplugged": {"autopilot.missing"},
        "a port that is taken": {"autopilot.busy"},
        "refused": {"autopilot.unreachable"},
        "nonsense": {"autopilot.address"},
    }


async def turned_by_hand(folder: Path, signs: tuple[float, float, float]) -> Finding:
    hand = HandTurned(np.random.default_rng(5), amplitude=(0.3, 0.4, 0.7), sway_m=0.0)
    room = Room(np.random.default_rng(6), SMALL)

    def seen(t: float):
        exposed = np.array([t - 0.02])
        eye = hand.world_from_body(exposed)[0] @ rotation.BODY_FROM_FORWARD_CAMERA
        return room.image(eye, np.zeros(3))

    port = free_port()
    fake = TurnedAutopilot(hand, signs, time.monotonic() - 40.0)
    async with Server(seen, fps=10.0) as server, serve_udp(fake, "127.0.0.1", port):
        link = f'link = "udpin:127.0.0.1:{port}"'
        config = load_config(written(folder, camera=camera_at(server.url), autopilot=link))
        mounted = examination.mount_facts(config.camera, None).mounted
        for seconds in (8.0, 16.0, 32.0, 64.0):
            watched = await SensorWatch(config, [mounted], SystemClock()).run(seconds)
            (finding,) = check_motion(watched.cameras[0].motion, mounted)
            # A machine that is busy shows too few frames, or none with the gyro around it, and has to look longer.
            if finding.level is not Level.SKIPPED:
                break
    return finding


async def test_a_flipped_gyro_is_told_from_a_right_one_by_turning_the_drone(tmp_path):
    right, flipped = await asyncio.gather(
        turned_by_hand(tmp_path / "right", (1.0, 1.0, 1.0)),
        turned_by_hand(tmp_path / "flipped", (1.0, 1.0, -1.0)),
    )
    assert right.level is Level.OK, right
    assert flipped.fault == "motion.sign", flipped
    assert "its yaw" in flipped.found


# ── network and keys ─────────────────────────────────────────────────────────────────────────────────────────────────


class SkewedClock(SystemClock):
    def utc(self) -> float:
        return super().utc() + 7200.0


async def test_a_clash_an_absent_drone_and_a_clock_two_hours_ahead(tmp_path):
    addresses = free_addresses(5)
    # The clone listens elsewhere, as its own config would have it.
    clone = NetworkSettings(team="red", listen=(f"tcp/{addresses[4]}",), connect=(f"tcp/{addresses[1]}",))
    peers = ", ".join(f'{i + 1} = "{address}"' for i, address in enumerate(addresses[:4]))
    path = written(tmp_path, network=f'team = "red"\npeers = {{ {peers} }}\nconnect = ["{addresses[4]}"]')
    config = load_config(path)

    def settings(i: int) -> NetworkSettings:
        return NetworkSettings(
            team="red",
            listen=(f"tcp/{addresses[i - 1]}",),
            connect=tuple(f"tcp/{a}" for a in addresses[1 : i - 1]),
        )

    ahead = SkewedClock()
    skewed = ZenohTransport(settings(3), 3, "cccccccc", ahead)
    drones = [Drone(settings(2), 2, "aaaaaaaa"), Drone(clone, 2, "bbbbbbbb")]
    try:
        for drone in drones:
            await drone.start()
        await skewed.open()
        await skewed.announce(announcement(3, "cccccccc", 1))
        findings = check_network(await team.ask(config, SystemClock(), 4.0))
    finally:
        await asyncio.gather(skewed.close(), *(drone.stop() for drone in drones))
    by_fault = {finding.fault: finding for finding in findings}
    assert set(by_fault) == {"network.id_clash", "network.absent", "network.clock"}
    assert by_fault["network.id_clash"].found == "2 agents use drone.id = 2 (boots aaaaaaaa, bbbbbbbb)"
    assert by_fault["network.absent"].found == "no answer from drone-4"
    assert by_fault["network.clock"].found == "this machine's clock is 2.0 h behind drone 3's"


async def test_a_port_that_another_program_holds(tmp_path):
    (address,) = free_addresses(1)
    host, port = address.split(":")
    with socket.socket() as taken:
        taken.bind((host, int(port)))
        taken.listen()
        config = load_config(written(tmp_path, network=f'peers = {{ 1 = "{address}" }}'))
        (finding,) = check_network(await team.ask(config, SystemClock(), 0.5))
    assert finding.fault == "network.closed"
    assert "Address already in use" in finding.found


async def test_keys_that_are_expired_readable_by_all_or_not_there(tmp_path):
    authority = Team(tmp_path / "team").authority
    long_ago, today = now() - timedelta(days=40), now()
    authority.issue(["drone-1"], long_ago, days=5)
    authority.issue(["drone-2", "drone-3"], today, days=5)
    (tmp_path / "team" / "drone-2" / "drone-2.key").chmod(0o644)
    found = {}
    for drone_id in (1, 2, 3, 4):
        keys = f'keys = "{tmp_path}/team/drone-{{id}}"\nteam = "{authority.roster.team}"'
        folder = tmp_path / str(drone_id)
        config = load_config(written(folder, drone=f"id = {drone_id}", network=keys))
        found[drone_id] = faults(check_network(await team.ask(config, SystemClock(), 0.5)))
    assert found == {1: {"keys.expired"}, 2: {"keys.mode"}, 3: {"keys.soon"}, 4: {"keys.broken"}}


# ── the rest ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_models_that_do_not_load_and_providers_that_are_not_here(tmp_path):
    shipped = ROOT / "swarmtrack" / "detection" / "models" / "default.onnx"
    (tmp_path / "half.onnx").write_bytes(shipped.read_bytes()[: shipped.stat().st_size // 2])
    sections = {
        "detector.model": f'model = "{tmp_path}/half.onnx"',
        "detector.provider": 'providers = ["qnn"]',
        "detector.fallback": 'providers = ["qnn", "cpu"]',
    }
    for i, (fault, section) in enumerate(sections.items()):
        config = load_config(written(tmp_path / str(i), detector=section))
        assert faults(
            check_detector(examination.detector_facts(config, SystemClock(), None, None, None))
        ) == {fault}


@pytest.mark.parametrize(
    "text",
    [
        "no: calibration\n",
        "camera_matrix: {rows: 3, cols: 3, data: [160, 0, 80, 0, 160, 60, 0, 0, 1]}\n",  # of no size
        "\0\1\2",
    ],
)
async def test_a_calibration_that_cannot_be_read_is_said_and_the_rest_is_still_looked_at(tmp_path, text):
    (tmp_path / "cam.yaml").write_text(text)
    path = written(tmp_path, camera=f'source = "{SOURCE}"\ncalibration = "cam.yaml"')
    findings = await examine(load_config(path), SystemClock(), 0.2)
    assert "calibration.unreadable" in faults(findings)
    assert {"camera", "detector", "network", "heat"} <= {finding.check for finding in findings}


def test_a_reflection_in_a_calibration_file_is_called_one(tmp_path):
    (tmp_path / "cam.yaml").write_text(
        "cam0:\n  camera_model: pinhole\n  intrinsics: [160, 160, 80, 60]\n  resolution: [160, 120]\n"
        "  T_cam_imu: [[1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]\n"
    )
    config = load_config(written(tmp_path, camera=f'source = "{SOURCE}"\ncalibration = "cam.yaml"'))
    assert "a reflection" in examination.mount_facts(config.camera, None).refused


def test_outputs_that_cannot_be_written_and_a_disk_that_is_full(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    config = load_config(written(tmp_path, output=f'jsonl = "{tmp_path}/file/tracks.jsonl"'))
    assert faults(check_disk(examination.disk_facts(config))) == {"disk.unwritable"}
    config = load_config(written(tmp_path, recording=f'dir = "{tmp_path}/file/flights"'))
    assert faults(check_disk(examination.disk_facts(config))) == {"disk.unwritable"}
    config = load_config(written(tmp_path, recording=f'dir = "{tmp_path}/flights"'))
    assert faults(check_disk(examination.disk_facts(config))) <= {"disk.low", "disk.full"}
    config = load_config(written(tmp_path, output=f'jsonl = "{tmp_path}/tracks.jsonl"'))
    full = os.statvfs_result((4096, 4096, 10**6, 10, 10, 10**6, 10**6, 10**6, 0, 255))
    monkeypatch.setattr(os, "statvfs", lambda path: full)
    assert faults(check_disk(examination.disk_facts(config))) == {"disk.full"}


def test_the_command_says_lines_or_json_and_its_code_tells(tmp_path, capsys):
    path = written(tmp_path)
    arguments = doctor_arguments(path, "--seconds", "0.5")
    assert doctor.run(arguments) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("failure  camera ") and " -> " in line for line in lines)
    assert lines[-1].startswith("1 failure and ")
    assert doctor.run(doctor_arguments(path, "--seconds", "0.5", "--json")) == 1
    records = json.loads(capsys.readouterr().out)
    assert {"check", "level", "fault", "found", "remedy"} == set(records[0])


def test_a_wrong_config_is_code_2_and_names_the_line(tmp_path):
    path = tmp_path / "drone.toml"
    path.write_text("[drone]\nid = 0\n")
    result = subprocess.run(
        [sys.executable, "-m", "swarmtrack.agents.main", "doctor", "--config", str(path)],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert result.returncode == 2
    assert "drone.toml:2: drone.id" in result.stderr


def doctor_arguments(path: Path, *more: str):
    parser = argparse.ArgumentParser()
    doctor.add_arguments(parser)
    return parser.parse_args(["--config", str(path), *more])
