"""The agent as a user runs it: real processes, real files, real sockets."""

import asyncio
import json
import os
import re
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager

import cv2
import numpy as np
import pytest

from support.called import called
from support.clips import shorten
from support.launcher import ended
from support.patience import PATIENCE, until
from support.places import ROOT
from swarmtrack.agents import vehicle
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.outputs.annotated_video import CLOSING_S
from swarmtrack.runtime.agent import make_health
from swarmtrack.runtime.assembly import assemble
from swarmtrack.wire import codec
from swarmtrack.wire.health import GyroBiasHealth, HealthMessage, TimeOffsetHealth

CLIP = ROOT.parent / "shared" / "data" / "drones_real" / "tracks" / "V_DRONE_106.mp4"
TLOG = ROOT.parent / "shared" / "data" / "mavlink" / "ardupilot_sitl.tlog"
LENS = "intrinsics = { fx = 600.0, fy = 600.0, cx = 320.0, cy = 256.0, width = 640, height = 512 }"

FRAMES = 60  # of the clip's 304: pace and outputs say no more with all of them

needs_clip = pytest.mark.skipif(not CLIP.exists(), reason="../shared/data is not here: no real video")


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("clip") / "short.avi"
    shorten(CLIP, path, FRAMES)
    return path


def command(config, *options):
    return [sys.executable, "-m", "swarmtrack.agents.vehicle", "--config", str(config), *options]


def run(config, *options, **keywords):
    keywords.setdefault("timeout", PATIENCE)
    return subprocess.run(command(config, *options), capture_output=True, text=True, check=False, **keywords)


def write(folder, text, name="drone.toml"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def drone_config(folder, source, *, autopilot="none", camera="", more=""):
    """Of a drone with this camera that speaks to nobody."""
    text = f"""
        drone.id = 1
        network.transport = "memory"
        autopilot.link = "{autopilot}"
        [camera]
        source = "{source}"
        {LENS}
        {camera}
        {more}
        """
    return write(folder, text)


@contextmanager
def timed(what):
    """Prints how long it took (pytest -s); no test asserts it."""
    began = time.monotonic()
    yield
    print(f"\n{what}: {time.monotonic() - began:.2f} s")


class Flying:
    """An agent that runs until the test ends; `said` waits for a line of its log."""

    def __init__(self, config, *options, env=None):
        self._log = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen(
            command(config, "--quiet", "--log", "info", *options),
            stdout=subprocess.DEVNULL,
            stderr=self._log,
            env={**os.environ, **(env or {})},
        )

    def said(self, *words, times=1):
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            self._log.seek(0)
            log = self._log.read()
            lines = [line for line in log.splitlines() if all(word in line for word in words)]
            if len(lines) >= times:
                return lines[-1]
            time.sleep(0.02)
        raise AssertionError(f"never said {words}; it said:\n{log}")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        self._log.close()


@needs_clip
def test_a_real_clip_becomes_a_line_and_a_picture_for_every_frame(tmp_path, clip):
    config = drone_config(
        tmp_path,
        f"file://{clip}?pace=fast",
        more=f"""
        [output]
        jsonl = "{tmp_path}/tracks.jsonl"
        video = "{tmp_path}/annotated.mp4"
        """,
    )
    result = run(config)
    assert result.returncode == 0, result.stderr
    lines = [json.loads(line) for line in (tmp_path / "tracks.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == list(range(FRAMES))
    assert lines[30]["t_s"] == pytest.approx(1.0, abs=0.002)
    track = next(t for line in lines for t in line["tracks"] if t["status"] == "confirmed")
    assert set(track) == {
        *("id", "identity", "u_px", "v_px", "vu_px_s", "vv_px_s", "var_u_px2", "var_v_px2"),
        *("w_px", "h_px", "status", "probability", "relative"),
    }  # fmt: skip
    video = cv2.VideoCapture(str(tmp_path / "annotated.mp4"))
    closing = round(CLOSING_S * video.get(cv2.CAP_PROP_FPS)) + 1
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == FRAMES + closing
    assert f"Summary of 2.0 s, {FRAMES} scans" in result.stdout


@needs_clip
@pytest.mark.skipif(not TLOG.exists(), reason="../shared/data is not here: no real recording")
@pytest.mark.parametrize(
    "pace", ["realtime", pytest.param("fast", marks=pytest.mark.long("the log at full speed, too"))]
)
def test_a_recorded_gyro_keeps_step_with_frames_at_pace_fast(tmp_path, clip, pace):
    config = drone_config(
        tmp_path,
        f"file://{clip}?pace=fast",
        autopilot=f"tlog:{TLOG}?pace={pace}",
        more=f'[output]\njsonl = "{tmp_path}/tracks.jsonl"',
    )
    result = run(config)
    assert result.returncode == 0, result.stderr
    assert len((tmp_path / "tracks.jsonl").read_text().splitlines()) == FRAMES


def test_the_simulation_shows_every_teammate_by_its_id(tmp_path):
    config = write(
        tmp_path, f'extends = "{ROOT}/configs/sim.toml"\noutput.jsonl = "{tmp_path}/tracks.jsonl"\n'
    )

    def mostly_named():
        """Of eight scans and more. Quiet machines have both names within a second; in front of a house a name may be
        doubted for a moment."""
        if not (tmp_path / "tracks.jsonl").exists():
            return False
        scans = [json.loads(line)["tracks"] for line in whole_lines(tmp_path / "tracks.jsonl")]
        named = [{track["identity"] for track in tracks} >= {2, 3} for tracks in scans]
        return len(named) >= 8 and sum(named) > 0.6 * len(named)

    flying = subprocess.Popen(command(config), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with ended(flying) as agent:
        until(mostly_named, "both teammates are named in most scans")
        agent.terminate()
        said, complained = agent.communicate(timeout=PATIENCE)
    assert agent.returncode == 0, complained
    assert "announced teammates: 2, 3" in said


def whole_lines(path):
    """Without the one that is being written."""
    return path.read_text().split("\n")[:-1]


async def test_what_a_ranging_radio_says_is_in_the_metres_that_the_agent_writes(tmp_path):
    pytest.importorskip("zenoh", reason="Zenoh has no wheel here")
    from swarmtrack.client import Ranging  # noqa: PLC0415

    team = f"test-{secrets.token_hex(4)}"
    places = {i: pose.position for i, pose in load_scenario("hover-triangle").initial_poses.items()}
    drones = ", ".join(
        f"{i} = {{ position_m = {place.tolist()}, position_sigma_m = 0.3 }}" for i, place in places.items()
    )
    output = tmp_path / "tracks.jsonl"
    config = write(
        tmp_path,
        f"""
        extends = "{ROOT}/configs/sim.toml"
        output.jsonl = "{output}"
        [network]
        transport = "zenoh"
        team = "{team}"
        [team]
        announce = false
        drones = {{ {drones} }}
        """,
    )

    def sources():
        if not output.exists():
            return set()
        tracks = [track for line in whole_lines(output) for track in json.loads(line)["tracks"]]
        said = [(t["identity"], t["relative"]["sources"]) for t in tracks if t["relative"] is not None]
        return {identity for identity, names in said if "range" in names}

    distance = float(np.linalg.norm(places[2] - places[1]))
    with Flying(config):
        async with Ranging(1, team) as ranging, asyncio.timeout(PATIENCE):
            while 2 not in sources():
                await ranging.say(2, distance, 0.3)
                await asyncio.sleep(0.1)
    assert sources() == {2}


def test_sigterm_ends_it_cleanly_and_systemd_is_told(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as supervisor:
        supervisor.bind(str(tmp_path / "notify"))
        supervisor.settimeout(PATIENCE)
        environment = {"NOTIFY_SOCKET": str(tmp_path / "notify")}
        with Flying(write(tmp_path, f'extends = "{ROOT}/configs/sim.toml"'), env=environment) as agent:
            assert supervisor.recv(200) == b"READY=1"
            assert supervisor.recv(200) == b"WATCHDOG=1"
            agent.process.send_signal(signal.SIGTERM)
            with timed("SIGTERM to the end"):
                assert agent.process.wait(PATIENCE) == 0
        supervisor.setblocking(False)
        said = []
        while True:
            try:
                said.append(supervisor.recv(200))
            except BlockingIOError:
                break
        assert said[-1] == b"STOPPING=1"


STUCK = """
import threading, sys
from swarmtrack.agents import vehicle
from swarmtrack.detection.detector import Detector

def detect(self, planned):
    print("stuck", flush=True)
    threading.Event().wait(3600)

Detector.detect = detect
sys.exit(vehicle.main(["--config", sys.argv[1], "--quiet"]))
"""


def test_sigterm_ends_it_though_the_detector_hangs(tmp_path):
    config = write(tmp_path, f'extends = "{ROOT}/configs/sim.toml"')
    process = subprocess.Popen(
        [sys.executable, "-c", STUCK, str(config)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdout.readline() == "stuck\n"
        process.send_signal(signal.SIGTERM)
        try:
            assert process.wait(PATIENCE) == 0
        finally:
            process.kill()


@pytest.fixture
def hangup_ends_programs():
    """Whoever started the tests may have said nohup, which programs inherit."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("hangup_ends_programs")
def test_a_terminal_that_goes_ends_it_cleanly_and_nohup_keeps_it_flying(tmp_path):
    config = write(tmp_path, f'extends = "{ROOT}/configs/sim.toml"\noutput.video = "{tmp_path}/seen.mp4"\n')
    for prefix in ([], ["nohup"]):
        process = subprocess.Popen(
            [*prefix, *command(config)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        with process:
            try:
                for _ in range(2):
                    assert b"sees" in process.stdout.readline()
                process.send_signal(signal.SIGHUP)
                if prefix:
                    assert b"sees" in process.stdout.readline()
                    process.terminate()
                assert process.wait(PATIENCE) == 0
            finally:
                process.kill()
    assert cv2.VideoCapture(str(tmp_path / "seen.mp4")).read()[0]


def test_check_says_what_the_config_leads_to(tmp_path):
    result = run(ROOT / "configs" / "sim.toml", "--check")
    assert result.returncode == 0, result.stderr
    assert "ok" in result.stdout.splitlines()[-1]


def test_check_names_a_device_that_is_not_there_yet_and_an_output_that_cannot_be(tmp_path):
    source = "drone.id = 1\n[camera]\nsource = 'v4l2:///dev/no-camera?width=640&height=512'\n" + LENS
    config = write(tmp_path, source + "\n[autopilot]\nlink = 'serial:/dev/no-autopilot:921600'\n")
    result = run(config, "--check")
    assert result.returncode == 0, result.stderr
    said = [line for line in result.stdout.splitlines() if "not there now" in line]
    assert ["no-camera" in said[0], "no-autopilot" in said[1]] == [True, True]

    for output in (f"jsonl = '{tmp_path}'", "video = 'annotated.txt'"):
        result = run(write(tmp_path, source + f"\n[output]\n{output}\n"), "--check")
        assert result.returncode == 2
        assert f"drone.toml:6: output.{output.split()[0]}: " in result.stderr


def test_a_terminal_without_our_signs_is_no_reason_to_stop(tmp_path):
    result = run(
        ROOT / "configs" / "sim.toml", "--seconds", "2.5", env={**os.environ, "PYTHONIOENCODING": "ascii"}
    )
    assert result.returncode == 0, result.stderr
    # "±" is none of its signs.
    assert re.search(r"sees (drone|track) .* \? [0-9.]+ ?(px)?", result.stdout)
    assert result.stdout.isascii()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("drone.id = 0\ncamera.source = 'sim://hover-triangle'\n", ["drone.toml:1: drone.id: 0, expected"]),
        ("drone.id = 1\ncamera.sorce = 'sim://hover-triangle'\n", ["drone.toml:2: camera.sorce", "source"]),
        ("drone.id = 1\ncamera = {\n", ["drone.toml:"]),
        (
            f"drone.id = 1\n[camera]\nsource = 'file:///nowhere.mp4'\n{LENS}\n",
            ["drone.toml:3: camera.source", "nowhere.mp4: not found"],
        ),
        (f"drone.id = 1\n[camera]\nsource = 'teleport://1'\n{LENS}\n", ["teleport"]),
        (
            f"drone.id = 1\n[camera]\nsource = 'flight.mp4'\n{LENS}\n",
            ["drone.toml:3: camera.source", "file://flight.mp4"],
        ),
        (
            "drone.id = 1\ncamera.source = 'sim://hover-triangle'\nautopilot.link = 'udp in:14540'\n",
            ["udp in"],
        ),
        ("drone.id = 1\ncamera.source = 'sim://hover-triangle'\ndetector.model = 'no.onnx'\n", ["no.onnx"]),
        (
            "drone.id = 1\ncamera.source = 'sim://hover-triangle'\nnetwork.listen = ['tcp/10.1.2.3:7447']\n",
            ["drone.toml:3: network.listen: tcp/10.1.2.3:7447", "insecure = true"],
        ),
        ("drone.id = 1\ncamera.source = 'sim://hover-triangle'\ntracker.name = 'sort'\n", ["sort", "kalman"]),
    ],
)
def test_a_wrong_config_is_answered_by_a_sentence_and_code_2(tmp_path, capsys, text, expected):
    code, _, err = called(vehicle.main, ["--config", str(write(tmp_path, text)), "--seconds", "1"], capsys)
    assert code == 2, err
    for words in expected:
        assert words.lower() in err.lower()


def test_a_wrong_config_ends_the_process_with_the_sentence_alone(tmp_path):
    result = run(write(tmp_path, "drone.id = 0\ncamera.source = 'sim://hover-triangle'\n"), "--seconds", "1")
    assert result.returncode == 2, result.stderr
    assert "Traceback" not in result.stderr
    assert "drone.toml:1: drone.id: 0, expected" in result.stderr


def test_a_network_that_cannot_be_opened_now_is_no_wrong_config(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        config = write(
            tmp_path,
            f"drone.id = 1\ncamera.source = 'sim://hover-triangle'\nnetwork.listen = ['{endpoint}']\n",
        )
        result = run(config, "--seconds", "1")
    assert result.returncode == 1, result.stderr
    assert "Traceback" not in result.stderr
    assert "network" in result.stderr


@needs_clip
def test_a_video_of_another_size_than_its_calibration_is_refused(tmp_path):
    lens = LENS.replace("width = 640, height = 512", "width = 320, height = 256")
    config = write(tmp_path, f'drone.id = 1\n[camera]\nsource = "file://{CLIP}?pace=fast"\n{lens}\n')
    result = run(config)
    assert result.returncode == 2, result.stderr
    assert "640" in result.stderr
    assert "320" in result.stderr


def test_a_missing_camera_and_a_missing_autopilot_are_said_and_waited_for(tmp_path):
    config = drone_config(tmp_path, "v4l2:///dev/video97", autopilot="serial:/dev/ttyNOTHERE:57600")
    with Flying(config) as agent:
        agent.said("/dev/video97")
        agent.said("/dev/ttyNOTHERE")
        assert agent.process.poll() is None
        agent.process.send_signal(signal.SIGTERM)
        assert agent.process.wait(PATIENCE) == 0


def test_its_health_can_be_sent_before_the_autopilot_was_ever_heard(tmp_path):
    config = drone_config(
        tmp_path,
        "v4l2:///dev/video97",
        autopilot="udpin:127.0.0.1:14999",
        camera="time_offset_s = 0.012",
        more="[motion]\ngyro_bias_rad_s = [0.01, 0.0, -0.02]",
    )
    health = make_health(assemble(load_config(config), SystemClock()))
    sent = codec.decode(HealthMessage, codec.encode(health.message()))
    assert sent.clock_offset_s is None
    assert sent.clock_offset_sigma_s is None
    assert sent.time_offset == TimeOffsetHealth(None, None, 0.012)
    assert sent.gyro_bias == GyroBiasHealth(None, None, pytest.approx((0.01, 0.0, -0.02)))
    assert sent.consistency is None
    assert "autopilot" in {link.name for link in sent.links}


def test_what_is_found_in_flight_can_be_switched_off(tmp_path):
    text = f'drone.id = 1\nnetwork.transport = "memory"\n[camera]\nsource = "v4l2:///dev/video97"\n{LENS}\n'
    off = text + "estimate_time_offset = false\n[motion]\nestimate_gyro_bias = false\n"
    for config, on in ((text, True), (off, False)):
        onboard = assemble(load_config(write(tmp_path, config)), SystemClock()).door.perceived
        assert (onboard.cameras[0].clock._evidence is not None, onboard._bias._estimates) == (on, on)


def teammate(tmp_path, drone_id, team):
    text = f'drone.id = {drone_id}\ncamera.source = "sim://hover-triangle?seed=1&fps=2"\nnetwork.team = "{team}"\n'
    return write(tmp_path, text, f"drone-{drone_id}.toml")


@pytest.mark.long(
    "five processes; live/test_zenoh_processes.py and test_faults.py have it in the default run"
)
def test_agents_know_each_other_notice_a_death_a_restart_and_a_clone(tmp_path):
    team = f"test-{os.getpid()}"
    first, second = teammate(tmp_path, 1, team), teammate(tmp_path, 2, team)
    with Flying(first) as one:
        with Flying(second) as two:
            with timed("known to each other, both just started"):
                boot = one.said("drone 2 announced itself").split("boot ")[1]
                two.said("drone 1 announced itself")
            two.process.kill()
            with timed("kill -9 noticed"):
                one.said("drone 2 is gone", boot)
        with Flying(second):
            with timed("one that starts beside a running one is known, from exec"):
                one.said("drone 2 announced itself", times=2)
            with Flying(second) as clone, timed("clone reported, from exec"):
                one.said("two agents use drone.id = 2")
                clone.said("another agent uses our drone.id = 2")
