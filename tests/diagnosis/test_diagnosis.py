"""Every sentence of doctor comes from facts that deserve it, and stands in docs/troubleshooting.md."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from support.places import ROOT
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import MountedCamera, load_config
from swarmtrack.diagnosis.autopilot_feed import check_feed
from swarmtrack.diagnosis.autopilot_limits import Asked, check_limits, unheard
from swarmtrack.diagnosis.findings import FAULTS, Finding, Level, markdown_table, worst
from swarmtrack.diagnosis.mounting import (
    MotionFacts,
    MountFacts,
    check_calibration,
    check_motion,
    check_mount,
    looks,
)
from swarmtrack.diagnosis.readiness import judge
from swarmtrack.diagnosis.sources import (
    AutopilotFacts,
    CameraFacts,
    ImuFacts,
    PoseFacts,
    check_autopilot,
    check_camera,
    check_door,
    check_imu,
    check_pose,
)
from swarmtrack.diagnosis.surroundings import (
    DetectorFacts,
    DiskFacts,
    HeatFacts,
    NetworkFacts,
    check_detector,
    check_disk,
    check_heat,
    check_network,
    check_tracks,
    in_words,
)
from swarmtrack.diagnosis.tracking import check_tracking
from swarmtrack.doctor import machine
from swarmtrack.formation.parameters import FlightLimits
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera, RadTan
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import IdClash, LinkStatus, PeerDeparted, StampKind
from swarmtrack.motion.hand_eye import Agreement, HandEye
from swarmtrack.runtime.agent import make_health
from swarmtrack.runtime.assembly import assemble
from swarmtrack.runtime.network_facts import _multicast
from swarmtrack.tracking.consistency import Consistency
from swarmtrack.tracking.noise import MeasuredNoise
from swarmtrack.wire import codec
from swarmtrack.wire.health import HealthMessage

DOCS = ROOT / "docs" / "troubleshooting.md"
FORWARD = rotation.BODY_FROM_FORWARD_CAMERA
GOOD = PinholeCamera(430.0, 430.0, 319.5, 239.5, 640, 480)
FOLDING = RadTan((-0.8, 0.0, 0.0, 0.0))


def camera(text="streaming; 30.0 fps", *, ok=True, **facts):
    counters = facts.pop("counters", {"fps": 30.0, "frames": 100, "age_p50_ms": 20.0, "t_sigma_ms": 1.0})
    status = LinkStatus("camera", ok, text, tuple(counters.items()))
    told = {"frames": 100, "stamps": frozenset({StampKind.EXPOSURE}), "shade": (90.0, 40.0)} | facts
    return check_camera(CameraFacts(8.0, 0.5, status, **told))


def autopilot(text="udpin:0.0.0.0:1: streaming: IMU 200 Hz", *, ok=True, **changes):
    counters = {
        "imu_rate_asked_hz": 200.0,
        "imu_rate_hz": 200.0,
        "imu_samples": 1000,
        "imu_lost": 0,
    } | changes
    return check_autopilot(
        AutopilotFacts(8.0, status=LinkStatus("autopilot", ok, text, tuple(counters.items())))
    )


def test_others_on_the_link_are_named_beside_another_finding():
    text = "udpin:0.0.0.0:1: streaming: IMU 200 Hz, also on the link: 2/1 (antenna tracker)"
    beside = "also on the link: 2/1 (antenna tracker)"
    assert [one.found for one in autopilot(text)] == [text]
    assert autopilot(text, foreign_datagrams=7)[-1].found == beside


def imu(accel, *, gyro=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0)):
    attitudes = np.repeat(rotation.from_euler(*rpy)[None], 50, axis=0)
    samples = [np.tile(np.array(each, dtype=float), (200, 1)) for each in (gyro, accel)]
    return check_imu(ImuFacts(*samples, np.linspace(0.0, 5.0, 50), attitudes))


def mounted(camera=GOOD, R=FORWARD, position=(0.1, 0.0, 0.0)):
    return MountedCamera(camera, Pose(R, np.array(position)), 0.0)


def motion(gain=(1.0, 1.0, 1.0), rpy=(0.0, 0.0, 0.0), offset=0.0):
    C = (rotation.from_euler(*rpy) @ FORWARD).T
    found = HandEye(
        C, offset, np.zeros(3), np.full(3, 1e-3), 1e-3, np.ones(3), np.ones(3), 1e-3, 0.0, 100, False
    )
    return check_motion(MotionFacts("", Agreement(np.array(gain), np.ones(3), offset), found), mounted())


def network(**facts):
    return check_network(NetworkFacts(1, "red", **facts))


def disk(refused="", free=1e10):
    return check_disk((DiskFacts("output.jsonl", Path("/data/t.jsonl"), refused, free),))


def late(age_ms):
    return {"fps": 30.0, "frames": 100, "age_p50_ms": age_ms}


RIGHT = Consistency(2.0, 1.5, 2.5)
# Of an ArduCopter that is fed.
FED_WELL = {
    "VISO_TYPE": 1, "VISO_QUAL_MIN": 0, "EK3_SRC1_POSXY": 3, "EK3_SRC1_YAW": 1, "EK3_SRC2_POSXY": 6,
    "EK3_SRC2_YAW": 1, "EK3_SRC3_POSXY": 0, "EK3_SRC3_YAW": 0,
}  # fmt: skip
# All but GUID_TIMEOUT, of an ArduCopter.
WELL_SET = {
    "FENCE_ENABLE": 1,
    "FENCE_ACTION": 1,
    "FENCE_TYPE": 7,
    "FENCE_RADIUS": 60,
    "FENCE_ALT_MAX": 30,
    "WP_SPD": 4,
}
PRODUCED = {
    "limits.unsafe": lambda: check_limits(3, {**WELL_SET, "GUID_TIMEOUT": 3.0}, Asked(FlightLimits(), 6.0)),
    "limits.silent": lambda: unheard("searching: port open, 0 bytes"),
    "feed.ignored": lambda: check_feed(3, FED_WELL | {"VISO_TYPE": 0}),
    "feed.circle": lambda: check_feed(3, FED_WELL | {"EK3_SRC2_YAW": 6}),
    "feed.unusable": lambda: check_feed(3, FED_WELL | {"VISO_QUAL_MIN": -1}),
    "feed.covariance": lambda: check_feed(12, {"EKF2_EV_CTRL": 1, "EKF2_EV_NOISE_MD": 1}),
    "feed.unknown": lambda: check_feed(12, {"EKF2_EV_CTRL": 1}),
    "limits.unknown": lambda: check_limits(3, WELL_SET, Asked(FlightLimits(), 6.0)),
    "camera.address": lambda: check_camera(CameraFacts(8.0, 0.5, refused="camera source x: unknown scheme")),
    "camera.missing": lambda: camera("/dev/video7 is not there, and no other /dev/video*", ok=False, frames=0),
    "camera.forbidden": lambda: camera("/dev/video0: permission denied; run `sudo …`", ok=False, frames=0),
    "camera.busy": lambda: camera("/dev/video0: busy, held by cheese (pid 7)", ok=False, frames=0),
    "camera.unreachable": lambda: camera("cannot connect to pi port 80: refused; trying again", ok=False),
    "camera.login": lambda: camera("RTSP 401 Unauthorized: give user and password; trying again", ok=False),
    "camera.silent": lambda: camera("UVC: YUYV 640x480; waiting for the first frame", ok=False, frames=0),
    "camera.garbled": lambda: camera("bytes come, but no picture: no line holds the boundary", ok=False, frames=0),
    "camera.size": lambda: camera("frames are 64x48, the calibration is for 640x480: set", ok=False),
    "camera.stale": lambda: camera(counters=late(900.0)),
    "camera.broken": lambda: camera("the driver reports an error", ok=False),
    "camera.late": lambda: camera(counters=late(300.0)),
    "camera.slow": lambda: camera(counters={**late(20.0), "fps": 12.0}, asked_hz=30.0),
    "camera.damaged": lambda: camera(counters={**late(20.0), "corrupt": 20}),
    "camera.stamps": lambda: camera(stamps=frozenset({StampKind.ARRIVAL})),
    "camera.blank": lambda: camera(shade=(3.0, 0.4)),
    "autopilot.address": lambda: check_autopilot(AutopilotFacts(8.0, refused="autopilot link 'x'")),
    "autopilot.open": lambda: check_door("udpin:0.0.0.0:14540", signed=False),
    "autopilot.strangers": lambda: autopilot(foreign_datagrams=7),
    "autopilot.missing": lambda: autopilot("serial:/dev/a:1: searching: no such device: /dev/a", ok=False),
    "autopilot.forbidden": lambda: autopilot("serial:/dev/a:1: searching: permission: /dev/a is", ok=False),
    "autopilot.busy": lambda: autopilot("udpin:h:1: searching: busy, port 1 is held by x (pid 1)", ok=False),
    "autopilot.unreachable": lambda: autopilot("tcp:h:1: searching: nothing listens at h:1", ok=False),
    "autopilot.silent": lambda: autopilot("udpin:h:1: searching: port open, 0 bytes", ok=False),
    "autopilot.garbage": lambda: autopilot("serial:x: searching: bytes but no valid frame: wrong baud?", ok=False),
    "autopilot.foreign": lambda: autopilot("x: searching: frames but no autopilot heartbeat (heard: 1/100)", ok=False),
    "autopilot.signature": lambda: autopilot("x: searching: frames, but 1/1 signs with another key", ok=False),
    "autopilot.second": lambda: autopilot("x: searching: two autopilots send, 1/1 (x) and 2/1 (x): set", ok=False),
    "autopilot.shared": lambda: autopilot("x: faulty: two autopilots send as system 1 component 1, th", ok=False),
    "autopilot.no_pose": lambda: autopilot("x: no pose: IMU 200 Hz asked, but neither ATTITUDE", ok=False),
    "autopilot.thrown_away": lambda: autopilot("x: faulty: 400 of 420 gyro samples in 2 s thrown away", ok=False),
    "autopilot.lost": lambda: autopilot("udpin:h:1: lost: nothing from autopilot 1 for 4 s", ok=False),
    "autopilot.no_imu": lambda: autopilot("x: requesting: heartbeat, no IMU (RAW_IMU asked for)", ok=False),
    "autopilot.no_position": lambda: autopilot("x: streaming: IMU, but no position: no fix", ok=False),
    "autopilot.broken": lambda: autopilot("x: searching: something else", ok=False),
    "autopilot.none": lambda: check_autopilot(AutopilotFacts(8.0, wanted=False)),
    "pose.unmeasured": lambda: check_pose(PoseFacts(3.0, 1.5, unmeasured_m=1.0))[1:],
    "autopilot.slow": lambda: autopilot(imu_rate_hz=100.0),
    "autopilot.too_slow": lambda: autopilot(imu_rate_hz=20.0),
    "autopilot.losing": lambda: autopilot(imu_lost=100),
    "autopilot.clock": lambda: autopilot(clock_sigma_s=0.05),
    "autopilot.drift": lambda: autopilot(clock_skew_ppm=11122, clock_drift_ppm=11200, clock_restarts=3),
    "autopilot.unsteady": lambda: autopilot(clock_restarts=5, clock_sigma_s=0.02),
    "imu.upside_down": lambda: imu((0.0, 0.0, 9.81)),
    "imu.tilted": lambda: imu((3.0, 0.0, -9.3)),
    "imu.gravity": lambda: imu((0.0, 0.0, -7.0)),
    "imu.bias": lambda: imu((0.0, 0.0, -9.81), gyro=(0.1, 0.0, 0.0)),
    "calibration.unreadable": lambda: check_calibration(MountFacts(None, "cam.yaml: det R = -1, a reflection")),
    "calibration.aspect": lambda: check_calibration(
        MountFacts(mounted(PinholeCamera(430, 300, 320, 240, 640, 480)))
    ),
    "calibration.centre": lambda: check_calibration(
        MountFacts(mounted(PinholeCamera(430, 430, 100, 240, 640, 480)))
    ),
    "calibration.field": lambda: check_calibration(MountFacts(mounted(PinholeCamera(9e3, 9e3, 320, 240, 640, 480)))),
    "calibration.distortion": lambda: check_calibration(
        MountFacts(mounted(PinholeCamera(300, 300, 320, 240, 640, 480, FOLDING)))
    ),
    "mount.radians": lambda: check_mount(MountFacts(mounted(), rpy_deg=(0.0, 1.5708, 0.0))),
    "mount.position": lambda: check_mount(MountFacts(mounted(position=(10.0, 0.0, 0.0)))),
    "mount.backwards": lambda: check_mount(MountFacts(mounted(R=rotation.from_euler(0, 0, math.pi) @ FORWARD))),
    "motion.sign": lambda: motion(gain=(1.0, -1.0, 1.0)),
    "motion.rotation": lambda: motion(rpy=(0.0, 0.3, 0.0)),
    "motion.offset": lambda: motion(offset=0.05),
    "detector.model": lambda: check_detector(DetectorFacts(refused="x.onnx: not a model that ONNX Runtime can load")),
    "detector.provider": lambda: check_detector(DetectorFacts(refused="detector providers: none of cuda is installed")),
    "detector.fallback": lambda: check_detector(DetectorFacts(providers=("cuda", "cpu"), runs_on=("cpu",))),
    "detector.slow": lambda: check_detector(DetectorFacts(ms=90.0, fps=30.0)),
    "tracking.noisy": lambda: check_tracking(RIGHT, MeasuredNoise(2.1, 0.5)),
    "tracking.sure": lambda: check_tracking(Consistency(9.0, 1.5, 2.5), None),
    "tracking.careful": lambda: check_tracking(Consistency(0.2, 1.5, 2.5), None),
    "network.closed": lambda: network(refused="network: cannot listen on tcp/127.0.0.1:7447: Address already in use"),
    "network.router": lambda: network(refused="network: no router answers at tcp/10.0.0.1:7447"),
    "network.wrong_address": lambda: network(wrong_address="network.peers: 1: found alpha, which means 127.0.1.1"),
    "network.address": lambda: network(absent_hosts=("10.0.0.1",)),
    "network.id_clash": lambda: network(alive={2: ("aaaaaaaa", "bbbbbbbb")}),
    "network.running": lambda: network(alive={1: ("aaaaaaaa",)}),
    "network.absent": lambda: network(missing=("drone-2",)),
    "network.stranger": lambda: network(strangers=("drone-9",)),
    "network.clock": lambda: network(alive={2: ("aaaaaaaa",)}, apart_s={2: -7200.0}),
    "network.multicast": lambda: network(multicast=("wlan7", "there is no such interface")),
    "keys.expired": lambda: network(keys_refused="drone-1.pem: expired on 2020-01-01 00:00 UTC, and"),
    "keys.early": lambda: network(keys_refused="drone-1.pem: is not valid before 2030-01-01 00:00 UTC, and"),
    "keys.mode": lambda: network(keys_refused="drone-1.key: mode 0644 lets others on this machine read the key"),
    "keys.broken": lambda: network(keys_refused="keys: holds no keys, expected those of drone-1"),
    "keys.soon": lambda: network(expires_days=3.0, expires="2030-01-01 00:00"),
    "disk.unwritable": lambda: disk("/data/t.jsonl: no permission to write there"),
    "disk.full": lambda: disk(free=1e6),
    "disk.low": lambda: disk(free=3e8),
    "heat.hot": lambda: check_heat(HeatFacts({"cpu-thermal": 86.0})),
    "heat.throttled": lambda: check_heat(HeatFacts({}, 0x50005)),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_every_sentence_comes_from_facts_that_deserve_it(name: str):
    findings: list[Finding] = PRODUCED[name]()
    assert [finding.fault for finding in findings] == [name]
    (finding,) = findings
    assert finding.level == FAULTS[name].level
    assert finding.remedy
    assert "{" not in finding.found + finding.remedy


PX4, ARDUPILOT = 12, 3
UDP, TCP, SERIAL = "udpin:0.0.0.0:14540", "tcp:127.0.0.1:5760", "serial:/dev/ttyAMA0:921600"
ADVISED = {
    "autopilot.slow": {"imu_rate_hz": 124.0},
    "autopilot.too_slow": {"imu_rate_hz": 20.0},
    "autopilot.losing": {"imu_lost": 200},
}


def advice(name: str, link: str, kind: int) -> str:
    (finding,) = autopilot(f"{link}: streaming: IMU", autopilot_kind=kind, **ADVISED[name])
    assert finding.fault == name
    return finding.remedy


@pytest.mark.parametrize("name", ADVISED)
@pytest.mark.parametrize("link", [UDP, TCP, SERIAL])
@pytest.mark.parametrize("kind", [PX4, ARDUPILOT, 0])
def test_advice_is_of_the_autopilot_and_of_the_link_at_hand(name, link, kind):
    remedy = advice(name, link, kind)
    assert ("baud" in remedy or "flow control" in remedy) == (link == SERIAL)
    assert ("BRD_SERn_RTSCTS" in remedy) == (
        link == SERIAL and kind == ARDUPILOT and name == "autopilot.losing"
    )
    assert ("IMU_INTEG_RATE" in remedy) == (kind == PX4 and name != "autopilot.losing")


@pytest.mark.parametrize("kind", ["v4l2", "http", "https", "rtsp", "file", "images", "detections"])
def test_advice_is_for_the_kind_of_camera_at_hand(kind):
    """USB and fourcc are of V4L2, browsers and Wi-Fi of HTTP."""
    said = [
        camera("waiting for the first frame", ok=False, frames=0, kind=kind),
        camera(
            "frames come, but no picture can be read from them; the last: x", ok=False, frames=0, kind=kind
        ),
        camera("frames are 64x48, the calibration is for 640x480: set", ok=False, kind=kind),
        camera(counters={**late(20.0), "corrupt": 20}, kind=kind),
        camera(counters=late(300.0), kind=kind),
        camera(stamps=frozenset({StampKind.ARRIVAL}), kind=kind),
    ]
    live = ("v4l2", "http", "https", "rtsp", "detections")
    words = " ".join(finding.remedy for (finding,) in said) if kind in live else said[2][0].remedy
    assert ("fourcc=" in words) == (kind == "v4l2")
    assert ("browser" in words) == kind.startswith("http")
    assert ("X-Timestamp" in words) == kind.startswith("http")
    assert ("player" in words) == (kind == "rtsp")
    assert ("resize=1" in words) == (kind in ("file", "images"))


def test_stamps_of_another_clock_are_named_with_their_offset():
    text = "streaming; 15.0 fps; stamps are not used: their clock is 1.2 s behind UTC, expected -5 to +500 ms"
    (finding,) = camera(text, stamps=frozenset({StampKind.ARRIVAL}), kind="http")
    assert "their clock is 1.2 s behind UTC" in finding.found


def test_a_late_stream_may_be_a_clock_that_is_behind():
    doubt = "stamps are 299 ms old or more: the stream is late, or their clock is behind UTC"
    text = f"streaming; 15.0 fps, age 300 ms; {doubt}"
    (finding,) = camera(text, counters=late(300.0), kind="http")
    assert "their clock is behind UTC" in finding.found
    assert "chrony" in finding.remedy


def test_a_port_that_is_no_uart_is_not_told_of_baud_rates():
    said = {
        link: autopilot(f"{link}: searching: bytes but no valid frame", ok=False)[0] for link in (UDP, SERIAL)
    }
    assert "baud" not in said[UDP].remedy
    assert "baud" in said[SERIAL].remedy


@pytest.mark.parametrize(
    ("consistency", "noise"),
    [
        (None, None),
        (RIGHT, None),
        (RIGHT, MeasuredNoise(0.15, 0.1)),
        (Consistency(3.9, 1.5, 2.5), MeasuredNoise(1.9, None)),
        (Consistency(0.5, 1.5, 2.5), MeasuredNoise(1.0, None)),
    ],
)
def test_tracks_that_know_how_wrong_they_are_are_not_spoken_of(consistency, noise):
    """Nor is a detector that is better than told: the tracker has learned it."""
    assert check_tracking(consistency, noise) == []


def test_doctor_repeats_what_running_agents_say_of_their_tracks():
    said = {1: ("detections scatter 2.1 times more than told", "look"), 3: ("detections lie off", "check")}
    findings = check_tracks(NetworkFacts(1, "swarm", tracks_say=said))
    assert [finding.found for finding in findings] == [
        "detections scatter 2.1 times more than told",
        "drone 3: detections lie off",
    ]
    assert all(finding.level is Level.WARNING and finding.remedy for finding in findings)
    assert check_tracks(NetworkFacts(1, "swarm")) == []


def test_the_page_lists_every_sentence_as_doctor_says_it():
    assert markdown_table() in DOCS.read_text(encoding="utf-8"), "run python -m swarmtrack.diagnosis.findings"


@pytest.mark.parametrize(
    "findings",
    [
        camera(),
        autopilot(),
        imu((0.0, 0.0, -9.81)),
        imu((9.81 * math.sin(0.3), 0.0, -9.81 * math.cos(0.3)), rpy=(0.0, 0.3, 0.0)),
        check_calibration(MountFacts(mounted())),
        check_mount(MountFacts(mounted(), rpy_deg=(0.0, 0.0, 0.0))),
        motion(),
        check_detector(
            DetectorFacts(name="default.onnx", providers=("cpu",), runs_on=("cpu",), ms=9.0, fps=30.0)
        ),
        network(alive={2: ("aaaaaaaa",)}, apart_s={2: 0.1}, expires_days=300.0),
        disk(),
        check_heat(HeatFacts({"cpu-thermal": 50.0}, 0)),
    ],
)
def test_what_is_well_is_one_line_that_says_so(findings: list[Finding]):
    assert [finding.level for finding in findings] == [Level.OK]


def test_a_still_drone_is_told_to_be_turned_and_not_judged():
    still = MotionFacts("", Agreement(np.array([-1.0, 0.1, 9.0]), np.full(3, 0.01), 0.0), None)
    (finding,) = check_motion(still, mounted())
    assert finding.level == Level.SKIPPED
    assert "turn the drone by hand" in finding.found


@pytest.mark.parametrize(
    ("rpy_deg", "words"),
    [
        ((0, 0, 0), "forward"),
        ((0, -20, 0), "forward, 20° down"),
        ((0, 0, 90), "right"),
        ((0, 0, 180), "backward"),
        ((0, -90, 0), "straight down"),
        ((180, 0, 0), "forward, upside down"),
    ],
)
def test_where_a_camera_looks_is_said_in_words(rpy_deg, words):
    assert looks(rotation.from_euler(*np.radians(rpy_deg)) @ FORWARD) == words


def test_heat_is_read_as_the_kernel_writes_it(tmp_path):
    for name, millidegrees in (("cpu-thermal", "86500\n"), ("broken", "nonsense"), ("absent", "-274000")):
        zone = tmp_path / f"thermal_zone_{name}"
        zone.mkdir()
        (zone / "type").write_text(f"{name}\n")
        (zone / "temp").write_text(millidegrees)
    assert machine.heat(tmp_path).celsius == {"cpu-thermal": 86.5}


def test_an_interface_that_cannot_multicast_is_named(tmp_path):
    for name, flags in (("eth0", "0x1003"), ("lo", "0x9"), ("wlan0", "0x1002")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "flags").write_text(f"{flags}\n")
    assert _multicast("eth0", tmp_path) == ("eth0", "")
    assert _multicast("auto", tmp_path) == ("auto", "")
    assert _multicast("wlan0", tmp_path)[1] == "it is down"
    assert "no such interface" in _multicast("wlan9", tmp_path)[1]


@pytest.mark.parametrize(
    ("seconds", "words"), [(4.2, "4.2 s"), (180.0, "3.0 min"), (5400.0, "1.5 h"), (864000.0, "10.0 days")]
)
def test_durations_are_for_people(seconds, words):
    assert in_words(seconds) == words


def test_the_worst_of_nothing_is_ok():
    assert worst([]) is Level.OK


# ── the readiness of a running agent ─────────────────────────────────────────────────────────────────────────────────

FINE = LinkStatus("x", True, "fine", (("fps", 30.0), ("frames", 100.0), ("age_p50_ms", 20.0)))
CUT_OFF = LinkStatus("zenoh", False, "no router answers")


def readiness(camera=FINE, autopilot=FINE, network=FINE, clones=(), unmeasured_m=None, others=()):
    return judge(
        cameras=[CameraFacts(3.0, 0.5, camera, frames=100), *others],
        autopilot=AutopilotFacts(3.0, status=autopilot),
        detector=None,
        network=network,
        clones=clones,
        unmeasured_m=unmeasured_m,
    )


def test_a_drone_is_ready_where_nothing_fails():
    assert readiness() == (True, ())
    late = LinkStatus("x", True, "fine", (("fps", 30.0), ("frames", 100.0), ("age_p50_ms", 300.0)))
    assert readiness(camera=late).ready  # a warning keeps nobody on the ground


def test_a_start_that_nobody_measured_is_said_and_keeps_nobody_on_the_ground():
    told = readiness(unmeasured_m=1.0)
    assert told.ready
    assert told.reasons == ("drone.start.position_sigma_m is missing: ± 1 m is assumed for the start",)
    assert not readiness(network=CUT_OFF, unmeasured_m=1.0).ready


def test_a_certificate_that_ends_within_the_hour_keeps_a_drone_on_the_ground():
    def linked(left_s):
        return LinkStatus("zenoh", True, "linked", (("certificate_s", left_s),))

    assert readiness(network=linked(3700.0)).ready
    for left_s, minutes in ((3500.0, 58), (-5.0, 0)):
        ready, (reason,) = readiness(network=linked(left_s))
        assert not ready
        assert reason.startswith(f"network: our certificate ends in {minutes} min")


def test_each_failure_is_a_reason_not_to_fly():
    silent = LinkStatus("x", False, "udpin:h:1: searching: port open, 0 bytes")
    unplugged = LinkStatus("x", False, "unplugged; waiting for it")
    ready, reasons = readiness(unplugged, silent, CUT_OFF, ("aaaaaaaa",))
    assert not ready
    assert [reason.split(":")[0] for reason in reasons] == [
        "no camera",
        "no data from the autopilot in 3 s",
        "network",
        "another agent uses this drone's ID (boots aaaaaaaa)",
    ]


def test_of_several_cameras_the_reason_says_which():
    unplugged = CameraFacts(3.0, 0.5, LinkStatus("x", False, "unplugged; waiting for it"))
    fine = CameraFacts(3.0, 0.5, FINE, frames=100)
    assert readiness(others=[fine]) == (True, ())
    ready, (reason,) = readiness(others=[fine, unplugged])
    assert not ready
    assert reason.startswith("camera 3: no camera: unplugged")


def test_an_agent_says_in_its_health_that_it_is_not_ready_and_why(tmp_path):
    path = tmp_path / "drone.toml"
    path.write_text(
        '[drone]\nid = 1\n[camera]\nsource = "http://127.0.0.1:9/"\n'
        "intrinsics = { fx = 160, fy = 160, cx = 79.5, cy = 59.5, width = 160, height = 120 }\n"
        '[network]\ntransport = "memory"\n[detector]\nscore_threshold = 0.5\n'
    )
    parts = assemble(load_config(path), SystemClock())
    health = make_health(parts)
    sent = codec.decode(HealthMessage, codec.encode(health.message())).readiness
    assert sent is not None
    assert not sent.ready
    assert sent.reasons[0].startswith("the camera is open but sent no frame")
    for event in (IdClash(1, (parts.boot, "aaaaaaaa"), True), IdClash(2, ("bbbbbbbb", "cccccccc"), False)):
        health.on_membership(event)
    assert "another agent uses this drone's ID (boots aaaaaaaa)" in health.readiness().reasons
    health.on_membership(PeerDeparted(1, "aaaaaaaa"))
    assert "another agent" not in " ".join(health.readiness().reasons)
    assert "drone.start.position_sigma_m is missing" in health.readiness().reasons[-1]


@pytest.mark.parametrize(
    ("sigmas", "words"),
    [
        (
            (),
            "heading taken as ±3° on the ground, ±1.5° in flight (autopilot.heading_sigma_deg, drone.start)",
        ),
        ((0.9, 1.78), "in flight; position ±0.9 m, height ±1.8 m ("),
        ((0.1, None), "in flight; position ±0.1 m, height ±0.1 m ("),
    ],
)
def test_how_well_the_pose_is_known_is_said(sigmas, words):
    (finding,) = check_pose(PoseFacts(3.0, 1.5, *sigmas))
    assert finding.level is Level.OK
    assert words in finding.found


def test_a_start_of_which_nobody_wrote_how_well_it_is_known_is_warned_of():
    _, finding = check_pose(PoseFacts(3.0, 1.5, unmeasured_m=1.0))
    assert finding.level is Level.WARNING
    assert finding.found.startswith("drone.start.position_sigma_m is missing")
    assert "± 1 m" in finding.found
