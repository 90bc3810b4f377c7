"""Advice is followed: for each remedy of doctor and of the network's errors, somebody does what it says, and it helps.

What takes hands (a plug, a cable, a tool of another firm) no test can do; each such fault is listed with its reason, so
that a new one is either followed here or said to be beyond a test. Advice of errors is followed next to their tests:
of V4L2 cameras in test_camera_v4l2.py, of calibrations, nets and logs in test_advice_on_*.py.
"""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import socket
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from support.drone_on_the_bench import NUMBERS, Server, camera_at, written
from support.fake_autopilot import FakeAutopilot, serve_udp
from support.network_of_keys import announcement, free_addresses
from support.patience import PATIENCE
from support.streams import first, jpeg, part, repeating, stream_server
from swarmtrack.agents import main as swarmtrack
from swarmtrack.camera_sources.opening import open_camera
from swarmtrack.clock import ManualClock, SystemClock
from swarmtrack.config.drone import NetworkSection, load_config
from swarmtrack.diagnosis import sources
from swarmtrack.diagnosis.autopilot_limits import Asked, check_limits
from swarmtrack.diagnosis.findings import FAULTS, Finding
from swarmtrack.diagnosis.mounting import MountFacts, check_calibration, check_mount
from swarmtrack.diagnosis.sources import AutopilotFacts, CameraFacts
from swarmtrack.diagnosis.surroundings import NetworkFacts, check_detector, check_disk, check_network
from swarmtrack.doctor import team
from swarmtrack.doctor.examination import detector_facts, mount_facts
from swarmtrack.doctor.watching import SensorWatch
from swarmtrack.errors import TransportError
from swarmtrack.formation.parameters import FlightLimits
from swarmtrack.messages import Array, LinkStatus, StampKind
from swarmtrack.runtime.disk_facts import disk_facts
from swarmtrack.runtime.network_facts import network_facts
from swarmtrack.security import names
from swarmtrack.security.authority import Authority, create_authority, open_authority
from swarmtrack.security.credentials import Credentials
from swarmtrack.security.loading import load_credentials
from swarmtrack.transport import zenoh_config
from swarmtrack.transport.settings import Mode, NetworkSettings, check
from swarmtrack.transport.zenoh_session import close_session, open_session
from swarmtrack.transport.zenoh_transport import ZenohTransport

CLOCK = SystemClock()
HANDS = "takes hands: a plug, a cable, a tool or the weather"
GROUND_STATION = "is done with another firm's program, in the autopilot"
CALIBRATION = "a calibration is followed in tests/calibration and tests/live/test_doctor.py"
TUNING = "depends on the scene; docs/tracking.md has measurements"
BEYOND = {
    **dict.fromkeys(
        (
            "camera.missing", "camera.forbidden", "camera.broken", "camera.late", "camera.slow",
            "camera.damaged", "autopilot.missing", "autopilot.forbidden", "autopilot.lost",
            "autopilot.strangers", "autopilot.losing", "autopilot.clock", "autopilot.drift", "autopilot.unsteady",
            "autopilot.broken", "autopilot.no_position", "autopilot.thrown_away", "limits.silent", "disk.full",
            "disk.low", "heat.hot", "heat.throttled",
        ),
        HANDS,
    ),
    **dict.fromkeys(
        (
            "autopilot.silent", "autopilot.garbage", "autopilot.signature", "autopilot.no_imu", "autopilot.too_slow",
            "autopilot.shared", "autopilot.no_pose",
            "imu.upside_down", "imu.tilted", "imu.gravity", "imu.bias", "limits.unknown",
        ),
        GROUND_STATION,
    ),
    **dict.fromkeys(
        (
            "calibration.aspect", "calibration.centre", "calibration.field",
            "calibration.distortion", "mount.backwards", "motion.sign", "motion.rotation", "motion.offset",
        ),
        CALIBRATION,
    ),
    **dict.fromkeys(
        ("feed.ignored", "feed.circle", "feed.unusable", "feed.covariance", "feed.unknown"),
        "each value to set is tried in test_autopilot_feed.py, and what it does in "
        "tests/lab/autopilots/test_external_position.py",
    ),
    **dict.fromkeys(("detector.slow", "tracking.noisy", "tracking.sure", "tracking.careful"), TUNING),
    "camera.login": "a login that is given or wrong is followed in tests/camera_sources/test_http_login.py",
    "camera.busy": "a program that ends is followed, as all that a V4L2 camera names, in "
    "tests/camera_sources/test_camera_v4l2.py",
    "network.id_clash": "a clash and its end are followed in tests/transport/test_transport.py",
    "autopilot.second": "an ID that is set chooses its autopilot in tests/autopilot/test_shared_links.py",
    "network.absent": "an agent that is started answers in tests/live/test_doctor.py",
    "network.running": "as network.id_clash",
    "network.wrong_address": "its remedies are followed in tests/transport/test_addresses.py",
}  # fmt: skip

Before = list[Finding]
After = list[Finding]


def only(findings: list[Finding], name: str) -> Finding:
    """The finding of that name, which must be there."""
    (found,) = [each for each in findings if each.fault == name]
    return found


# --- camera, autopilot, calibration: the config is what is changed ---------------------------------


def camera_address(folder: Path) -> tuple[Before, After]:
    def look(source: str) -> list[Finding]:
        code = swarmtrack.main(["config", "check", str(written(folder, camera=camera_at(source)))])
        return sources.check_camera(
            CameraFacts(8.0, 0.5, refused="camera source" if code else "", status=FINE)
        )

    right = re.search(
        r'^source = "(v4l2:[^"]+)"', (Path("README.md")).read_text(encoding="utf-8"), re.MULTILINE
    )
    assert right is not None
    return look("usb0"), look(right[1].partition("?")[0])


FINE = LinkStatus(
    "camera", True, "streaming; 30.0 fps", (("fps", 30.0), ("frames", 100.0), ("age_p50_ms", 400.0))
)


STREAMING = LinkStatus("autopilot", True, "udpin:127.0.0.1:14540: streaming", (("imu_rate_hz", 200.0),))


def camera_stale(folder: Path) -> tuple[Before, After]:
    def look(limit: str) -> list[Finding]:
        config = load_config(written(folder, camera=f"{camera_at('http://127.0.0.1:9/stream')}\n{limit}"))
        facts = CameraFacts(
            8.0,
            config.camera.max_age_s,
            FINE,
            frames=100,
            stamps=frozenset({StampKind.EXPOSURE}),
            shade=(90.0, 40.0),
        )
        return sources.check_camera(facts)

    return look("max_age_s = 0.3"), look("max_age_s = 0.6")


def camera_garbled(folder: Path) -> tuple[Before, After]:
    """Its remedy: "select MJPEG in the camera's settings"."""
    del folder
    h264 = b"\0\0\0\1\x67\x42\xc0\x1e" * 50

    async def look(message: bytes) -> list[Finding]:
        async with stream_server("/stream", "multipart/x-mixed-replace; boundary=frame") as server:
            server.script = repeating(message)
            camera = open_camera(server.url + "?timeout_s=0.5", clock=CLOCK)
            taking = asyncio.create_task(first(3, camera.frames()))
            async with asyncio.timeout(PATIENCE):
                while not taking.done() and "but no picture" not in camera.status().text:  # noqa: ASYNC110
                    await asyncio.sleep(0.02)
            found = CameraFacts(8.0, 0.5, camera.status(), frames=3 * taking.done(), kind="http")
            await camera.close()
            await taking
            return sources.check_camera(found)

    return asyncio.run(look(h264)), asyncio.run(look(part(jpeg(50))))


def autopilot_address(folder: Path) -> tuple[Before, After]:
    def look(link: str) -> list[Finding]:
        code = swarmtrack.main(["config", "check", str(written(folder, autopilot=f'link = "{link}"'))])
        return sources.check_autopilot(
            AutopilotFacts(8.0, refused="autopilot link" if code else "", status=STREAMING)
        )

    return look("uart0"), look("udpin:127.0.0.1:14540")


def autopilot_none(folder: Path) -> tuple[Before, After]:
    def look(table: str) -> list[Finding]:
        link = load_config(written(folder, autopilot=table)).autopilot.link
        return sources.check_autopilot(AutopilotFacts(8.0, wanted=link != "none", status=STREAMING))

    return look('link = "none"'), look('link = "udpin:127.0.0.1:14540"')


def autopilot_open(folder: Path) -> tuple[Before, After]:
    del folder
    assert not sources.check_door("udpin:0.0.0.0:14540", signed=True)
    return sources.check_door("udpin:0.0.0.0:14540", signed=False), sources.check_door(
        "udpin:127.0.0.1:14540", signed=False
    )


def autopilot_slow(folder: Path) -> tuple[Before, After]:
    def look(asked: float) -> list[Finding]:
        config = load_config(written(folder, autopilot=f'link = "udpin:127.0.0.1:1"\nimu_rate_hz = {asked}'))
        counters = {
            "imu_rate_asked_hz": config.autopilot.imu_rate_hz,
            "imu_rate_hz": 98.0,
            "imu_samples": 1000.0,
        }
        status = LinkStatus("autopilot", True, "udpin:127.0.0.1:1: streaming", tuple(counters.items()))
        return sources.check_autopilot(AutopilotFacts(8.0, status=status))

    return look(200.0), look(100.0)


def pose_unmeasured(folder: Path) -> tuple[Before, After]:
    def look(more: str) -> list[Finding]:
        start = f"id = 1\nstart = {{ position_m = [0.0, 0.0, 0.0], yaw_deg = 0.0{more} }}"
        known = load_config(written(folder, drone=start)).drone.start
        unmeasured = known.position_sigma_m if known.has_unknown_sigma else None
        return sources.check_pose(sources.PoseFacts(3.0, 0.1, unmeasured_m=unmeasured))

    return look(""), look(", position_sigma_m = 0.1")


def limits_unsafe(folder: Path) -> tuple[Before, After]:
    del folder
    values = {
        "FENCE_ENABLE": 1.0, "FENCE_ACTION": 1.0, "FENCE_TYPE": 7.0, "FENCE_RADIUS": 60.0, "FENCE_ALT_MAX": 30.0,
        "WP_SPD": 4.0, "GUID_TIMEOUT": 3.0,
    }  # fmt: skip
    before = check_limits(3, values, Asked(FlightLimits(), 6.0))
    said = re.match(r"set (\w+) to [^\d]*([\d.]+)", only(before, "limits.unsafe").remedy)
    assert said is not None
    return before, check_limits(
        3, {**values, said[1]: float(said[2].rstrip("."))}, Asked(FlightLimits(), 6.0)
    )


def calibration_unreadable(folder: Path) -> tuple[Before, After]:
    def look(lens: str) -> list[Finding]:
        config = load_config(written(folder, camera=f'source = "http://127.0.0.1:9/stream"\n{lens}'))
        return check_calibration(mount_facts(config.camera, None))

    folder.mkdir(exist_ok=True)
    (folder / "cam.yaml").write_text("nonsense: [")
    return look('calibration = "cam.yaml"'), look(f"intrinsics = {NUMBERS}")


def mount(entry: str, wrong: str, right: str) -> Callable[[Path], tuple[Before, After]]:
    def follow(folder: Path) -> tuple[Before, After]:
        def look(value: str) -> list[Finding]:
            camera = f"{camera_at('http://127.0.0.1:9/stream')}\nbody_from_camera = {{ {entry} = {value} }}"
            facts = mount_facts(load_config(written(folder, camera=camera)).camera, None)
            assert isinstance(facts, MountFacts)
            return check_mount(facts)

        return look(wrong), look(right)

    return follow


# --- cameras and autopilots of real sockets: one as it was, one as it is then -----------------------


def lively(t: float, width: int = 160, height: int = 120) -> Array:
    return np.random.default_rng(int(10 * t)).integers(0, 255, (height, width, 3), dtype=np.uint8)


def camera(wrong: Server, wrong_path: str = "") -> Callable[[Path], tuple[Before, After]]:
    """A camera over HTTP, and one that is set right."""

    def follow(folder: Path) -> tuple[Before, After]:
        async def look(server: Server, path: str = "") -> list[Finding]:
            async with server:
                config = load_config(
                    written(folder / path / str(id(server)), camera=camera_at(server.url + path))
                )
                watch = SensorWatch(config, [mount_facts(config.camera, None).mounted], CLOCK)
                return sources.check_camera((await watch.run(2.0)).cameras[0].facts)

        async def both() -> tuple[Before, After]:
            return await asyncio.gather(look(wrong, wrong_path), look(Server(lively)))

        return asyncio.run(both())

    return follow


def autopilot(wrong: Callable[[int], str], more: str = "") -> Callable[[Path], tuple[Before, After]]:
    """A link that is wrong for the autopilot at a port, and the one that is right."""

    def follow(folder: Path) -> tuple[Before, After]:
        async def look(here: Path, link: Callable[[int], str], more: str = "") -> list[Finding]:
            port = free_port(socket.SOCK_DGRAM)
            async with serve_udp(FakeAutopilot(boot_at=time.monotonic() - 40.0), "127.0.0.1", port):
                config = load_config(written(here, autopilot=f'link = "{link(port)}"\n{more}'))
                watched = await SensorWatch(config, [None], CLOCK).run(4.0)
            return sources.check_autopilot(watched.autopilot)

        async def both() -> tuple[Before, After]:
            return await asyncio.gather(
                look(folder / "wrong", wrong, more), look(folder / "right", "udpin:127.0.0.1:{}".format)
            )

        return asyncio.run(both())

    return follow


def autopilot_busy(folder: Path) -> tuple[Before, After]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        taken = other.getsockname()[1]
        return autopilot(lambda _: f"udpin:127.0.0.1:{taken}")(folder)


def network_clock(folder: Path) -> tuple[Before, After]:
    async def look(ahead_s: float) -> list[Finding]:
        ours, theirs = free_addresses(2)
        path = written(
            folder / str(ahead_s), network=f'team = "red"\npeers = {{ 1 = "{ours}", 2 = "{theirs}" }}'
        )
        # The other dials us, as the higher one.
        settings = NetworkSettings(team="red", listen=(f"tcp/{theirs}",), connect=(f"tcp/{ours}",))
        other = ZenohTransport(settings, 2, "aaaaaaaa", ClockAhead(ahead_s))
        await other.open()
        try:
            await other.announce(announcement(2, "aaaaaaaa", 1))
            return check_network(await team.ask(load_config(path), CLOCK, 4.0))
        finally:
            await other.close()

    async def both() -> tuple[Before, After]:
        return await asyncio.gather(look(7200.0), look(0.0))

    return asyncio.run(both())


class ClockAhead(SystemClock):
    """Of a machine whose time is ahead."""

    def __init__(self, ahead_s: float) -> None:
        self._ahead_s = ahead_s

    def utc(self) -> float:
        return super().utc() + self._ahead_s


# --- detector and disk --------------------------------------------------------------------------


def detector(name: str, wrong: str, right: str) -> Callable[[Path], tuple[Before, After]]:
    def follow(folder: Path) -> tuple[Before, After]:
        def look(table: str) -> list[Finding]:
            config = load_config(written(folder, detector=table))
            return check_detector(detector_facts(config, CLOCK, None, None, None))

        (folder / "cut.onnx").parent.mkdir(exist_ok=True)
        (folder / "cut.onnx").write_bytes(b"half of a model")
        assert name in FAULTS
        return look(wrong), look(right)

    return follow


def disk_unwritable(folder: Path) -> tuple[Before, After]:
    def look(path: Path) -> list[Finding]:
        config = load_config(written(folder, output=f"jsonl = {json.dumps(str(path))}"))
        return [each for each in check_disk(disk_facts(config)) if each.fault == "disk.unwritable"]

    (folder / "a-file").write_text("")
    return look(folder / "a-file" / "t.jsonl"), look(folder / "t.jsonl")


# --- network ------------------------------------------------------------------------------------


def look_at(network: str, folder: Path, seconds: float = 0.3) -> list[Finding]:
    """What doctor says of a drone's network."""
    return check_network(asyncio.run(team.ask(load_config(written(folder, network=network)), CLOCK, seconds)))


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def network_closed(folder: Path) -> tuple[Before, After]:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        before = look_at(f'listen = ["127.0.0.1:{taken}"]', folder)
        return before, look_at(f'listen = ["127.0.0.1:{free_port()}"]', folder)


def network_router(folder: Path) -> tuple[Before, After]:
    port = free_port()
    network = f'topology = "routers"\nrouters = ["127.0.0.1:{port}"]'
    with pytest.MonkeyPatch.context() as impatient:
        impatient.setattr(zenoh_config, "CLIENT_CONNECT_MS", 200)
        before = look_at(network, folder)

    async def with_router() -> list[Finding]:
        endpoint = f"tcp/127.0.0.1:{port}"
        router = await open_session(NetworkSettings(listen=(endpoint,), mode=Mode.ROUTER))
        try:
            facts = await team.ask(load_config(written(folder, network=network)), CLOCK, 0.3)
        finally:
            await close_session(router, [])
        return check_network(facts)

    return before, asyncio.run(with_router())


def network_address(folder: Path) -> tuple[Before, After]:
    port = free_port()
    return (
        look_at(f'insecure = true\nlisten = ["192.0.2.1:{port}"]', folder),
        look_at(f'insecure = true\nlisten = ["127.0.0.1:{port}"]', folder),
    )


def network_multicast(folder: Path) -> tuple[Before, After]:
    def look(more: str) -> list[Finding]:
        facts, _ = network_facts(load_config(written(folder, network=f"insecure = true\n{more}")), CLOCK)
        return check_network(facts)

    listed = 'peers = { 1 = "127.0.0.1:7447", 2 = "127.0.0.1:7450" }'
    return look('multicast = true\ninterface = "wlan77"\nlisten = ["127.0.0.1"]'), look(listed)


# --- keys: the program that the remedy names is run -----------------------------------------------


def ca(folder: Path, days_ago: float = 0.0) -> Authority:
    made = datetime.now(UTC) - timedelta(days=days_ago)
    authority = create_authority(folder / "keys", "red", made)
    authority.issue([names.drone(1)], made)
    return authority


def keys_say(folder: Path, clock: ManualClock | SystemClock = CLOCK) -> list[Finding]:
    config = load_config(
        written(folder, network=f'team = "red"\nkeys = {json.dumps(str(folder / "keys/drone-1"))}')
    )
    facts, _ = network_facts(config, clock)
    return check_network(facts)


def renewed(folder: Path) -> list[Finding]:
    assert swarmtrack.main(["keys", "issue", "--renew", str(folder / "keys")]) == 0
    return keys_say(folder)


def keys_expired(folder: Path) -> tuple[Before, After]:
    ca(folder, days_ago=120.0)
    return keys_say(folder), renewed(folder)


def keys_soon(folder: Path) -> tuple[Before, After]:
    ca(folder, days_ago=85.0)
    return keys_say(folder), renewed(folder)


def keys_early(folder: Path) -> tuple[Before, After]:
    ca(folder)
    return keys_say(folder, ManualClock(utc=1.0e9)), keys_say(folder, CLOCK)  # the clock is set


def keys_mode(folder: Path) -> tuple[Before, After]:
    ca(folder)
    key = next((folder / "keys" / "drone-1").glob("*.key"))
    key.chmod(0o644)
    before = keys_say(folder)
    said = re.search(r"run: chmod (\d+) (\S+)", only(before, "keys.mode").found)
    assert said is not None
    Path(said[2]).chmod(int(said[1], 8))
    return before, keys_say(folder)


def keys_broken(folder: Path) -> tuple[Before, After]:
    ca(folder)
    whole, here = folder / "on the CA's machine", folder / "keys" / "drone-1"
    shutil.copytree(here, whole)
    next(here.glob("*.key")).unlink()
    before = keys_say(folder)
    shutil.rmtree(here)
    shutil.copytree(whole, here)
    return before, keys_say(folder)


def network_stranger(folder: Path) -> tuple[Before, After]:
    ca(folder)
    here = folder / "keys" / "drone-1"
    copied = folder / "copied long ago"
    shutil.copytree(here, copied)
    open_authority(folder / "keys").issue([names.drone(9)], datetime.now(UTC))

    def look(credentials: Credentials) -> list[Finding]:
        strangers = {names.drone(9)} - set(credentials.roster.names)
        return check_network(NetworkFacts(1, "red", strangers=tuple(strangers)))

    def loaded() -> Credentials:
        return load_credentials(copied, names.drone(1), CLOCK.utc())

    before = look(loaded())
    for file in re.findall(r"roster\.\w+", only(before, "network.stranger").remedy):
        shutil.copy(folder / "keys" / file, copied / file)
    return before, look(loaded())


FOLLOWED: dict[str, Callable[[Path], tuple[Before, After]]] = {
    "camera.address": camera_address,
    "camera.stale": camera_stale,
    "camera.garbled": camera_garbled,
    "camera.unreachable": camera(Server(lively), "s"),
    "camera.silent": camera(Server(lambda t: None)),
    "camera.size": camera(Server(lambda t: lively(t, 64, 48))),
    "camera.stamps": camera(Server(lively, late=None)),
    "camera.blank": camera(Server(lambda t: np.full((120, 160, 3), 4, np.uint8))),
    "autopilot.address": autopilot_address,
    "autopilot.busy": autopilot_busy,
    "autopilot.unreachable": autopilot("tcp:127.0.0.1:{}".format),
    "autopilot.foreign": autopilot("udpin:127.0.0.1:{}".format, "system_id = 3"),
    "autopilot.none": autopilot_none,
    "autopilot.open": autopilot_open,
    "autopilot.slow": autopilot_slow,
    "pose.unmeasured": pose_unmeasured,
    "limits.unsafe": limits_unsafe,
    "calibration.unreadable": calibration_unreadable,
    "mount.radians": mount("rpy_deg", "[0.0, 1.5708, 0.0]", "[0.0, 90.0, 0.0]"),
    "mount.position": mount("position_m", "[10.0, 0.0, 0.0]", "[0.1, 0.0, 0.0]"),
    "detector.model": detector("detector.model", 'model = "cut.onnx"', ""),
    "detector.provider": detector("detector.provider", 'providers = ["cuda"]', 'providers = ["cuda", "cpu"]'),
    "detector.fallback": detector("detector.fallback", 'providers = ["qnn", "cpu"]', 'providers = ["cpu"]'),
    "disk.unwritable": disk_unwritable,
    "network.clock": network_clock,
    "network.closed": network_closed,
    "network.router": network_router,
    "network.address": network_address,
    "network.multicast": network_multicast,
    "network.stranger": network_stranger,
    "keys.expired": keys_expired,
    "keys.early": keys_early,
    "keys.mode": keys_mode,
    "keys.broken": keys_broken,
    "keys.soon": keys_soon,
}


@pytest.mark.parametrize("name", FOLLOWED)
def test_who_follows_a_remedy_does_not_hear_of_the_fault_again(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(Path(__file__).parents[2])
    before, after = FOLLOWED[name](tmp_path)
    assert only(before, name).remedy
    assert name not in {finding.fault for finding in after}


def test_every_fault_has_its_remedy_followed_or_is_said_to_be_beyond_a_test() -> None:
    listed = FOLLOWED.keys() | BEYOND.keys()
    assert FAULTS.keys() <= listed, sorted(FAULTS.keys() - listed)
    assert not FOLLOWED.keys() & BEYOND.keys()


# --- the network's errors, which offer several ways out --------------------------------------------

ABROAD = NetworkSettings(listen=("tcp/192.0.2.1:7447",))


@pytest.mark.parametrize(
    ("wrong", "advice", "right"),
    [
        (ABROAD, "write `insecure = true`", replace(ABROAD, insecure=True)),
        (ABROAD, "stay on tcp/127.0.0.1:PORT", replace(ABROAD, listen=("tcp/127.0.0.1:7447",))),
        (replace(ABROAD, insecure=True, lease_s=0.1), "expected 0.5", replace(ABROAD, insecure=True, lease_s=0.5)),
        (NetworkSettings(team="red team"), "letters, digits, '-' or '_'", NetworkSettings(team="red-team")),
        (NetworkSettings(listen=("tls/127.0.0.1:1",)), "or tcp/", NetworkSettings(listen=("tcp/127.0.0.1:1",))),
        (
            NetworkSettings(multicast=True),
            "leave it out and list network.peers",
            NetworkSettings(),
        ),
        (
            NetworkSettings(multicast=True, insecure=True),
            "tcp/ADDRESS:PORT",
            NetworkSettings(multicast=True, insecure=True, listen=("tcp/192.0.2.1:7447",)),
        ),
        (
            NetworkSettings(connect=("10.0.0.1",)),
            "such as tcp/127.0.0.1:7447",
            NetworkSettings(connect=("tcp/127.0.0.1:7447",)),
        ),
    ],
)  # fmt: skip
def test_each_way_out_of_a_wrong_network_is_one(
    wrong: NetworkSettings, advice: str, right: NetworkSettings
) -> None:
    with pytest.raises(TransportError) as refused:
        check(wrong)
    assert advice in str(refused.value)
    check(right)


def test_routers_without_a_list_are_told_what_to_write_and_that_is_right() -> None:
    with pytest.raises(ValueError, match=r'expected routers = \["HOST:PORT", …\]'):
        NetworkSection(topology="routers")
    NetworkSection(topology="routers", routers=("10.0.0.1:7447",))
