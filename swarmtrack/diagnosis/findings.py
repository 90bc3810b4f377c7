"""What a check says, and every sentence that one may say.

The sentences stand together here so that `docs/troubleshooting.md` can list them all: a test holds the two together.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple


class Level(enum.StrEnum):
    """How bad it is."""

    OK = "ok"
    SKIPPED = "skipped"  # there was nothing to check, or no way to
    WARNING = "warning"  # it works, less well than it could
    FAILURE = "failure"  # it does not work


@dataclass(frozen=True, slots=True)
class Finding:
    """One line. check: what was looked at; fault: its name in `FAULTS`, empty where all is well; remedy: what to do."""

    check: str
    level: Level
    found: str
    remedy: str = ""
    fault: str = ""


class Fault(NamedTuple):
    """A sentence and its remedy; words in braces are filled in."""

    level: Level
    found: str
    remedy: str


W, F = Level.WARNING, Level.FAILURE

# By name, `check.what`; in the order in which one would look for them.
FAULTS: dict[str, Fault] = {
    # --- camera
    "camera.address": Fault(
        F, "{reason}", "mend camera.source; README and configs/ show one of each kind"
    ),
    "camera.missing": Fault(
        F,
        "no camera: {reason}",
        "plug it in and look at `ls -l /dev/v4l/by-id/`; write that path into camera.source, it survives replugging",
    ),
    "camera.forbidden": Fault(
        F, "the camera may not be opened: {reason}", "add the agent's user to the device's group, log in again"
    ),
    "camera.busy": Fault(
        F, "another program holds the camera: {reason}", "end that program; a running agent is one, too"
    ),
    "camera.unreachable": Fault(
        F,
        "the camera's server does not answer: {reason}",
        "ping its host, open the address in a browser, check port, path and password",
    ),
    "camera.silent": Fault(
        F,
        "the camera is open but gave no frame in {seconds:.0f} s: {reason}",
        "check cable, power and USB bandwidth; try a smaller size or fourcc=MJPG",
    ),
    "camera.size": Fault(
        F,
        "the camera does not give what was calibrated: {reason}",
        "ask for the calibrated size in camera.source (width=, height=), or calibrate again: swarmtrack calibrate "
        "intrinsics",
    ),
    "camera.stale": Fault(
        F,
        "frames are {age_ms:.0f} ms old when they come, more than camera.max_age_s = {limit_s:g} allows: none is used",
        "shorten the stream's buffers (encoder, server, network), or raise camera.max_age_s",
    ),
    "camera.broken": Fault(
        F, "the camera does not work: {reason}", "see the reason; the agent's log (--log debug) tells more"
    ),
    "camera.late": Fault(
        W,
        "frames are {age_ms:.0f} ms old when they come",
        "below 100 ms identities come sooner: fewer buffers, a faster encoder, or a camera on USB",
    ),
    "camera.slow": Fault(
        W,
        "{got_hz:.1f} frames a second of {asked_hz:.0f} asked",
        "more light or a fixed exposure (exposure_us=), a smaller size, fourcc=MJPG, another USB port",
    ),
    "camera.damaged": Fault(
        W,
        "{share:.0%} of the frames are damaged",
        "check cable and USB hub, lower the size or the rate of the stream",
    ),
    "camera.stamps": Fault(
        W,
        "frames are stamped when they arrive, not when they were exposed (± {sigma_ms:.0f} ms)",
        "have the server send X-Timestamp, or measure the delay: swarmtrack calibrate extrinsics",
    ),
    "camera.blank": Fault(
        W,
        "the picture is of one shade (brightness {mean:.0f} ± {spread:.1f} of 255)",
        "take the cap off the lens; check exposure and light",
    ),
    # --- autopilot
    "autopilot.address": Fault(F, "{reason}", "mend autopilot.link; README and configs/ show one of each kind"),
    "autopilot.missing": Fault(
        F,
        "no autopilot: {reason}",
        "plug it in; look at `ls -l /dev/serial/by-id/` and write that path into autopilot.link",
    ),
    "autopilot.forbidden": Fault(
        F,
        "the autopilot's port may not be opened: {reason}",
        "sudo usermod -aG dialout $USER, and log in again (under systemd: SupplementaryGroups=dialout)",
    ),
    "autopilot.busy": Fault(
        F,
        "the autopilot's port is taken: {reason}",
        "end that program (a ground station, ModemManager, another agent), or have the autopilot speak to another port",
    ),
    "autopilot.unreachable": Fault(
        F, "the autopilot's address does not answer: {reason}", "ping it; check host and port in autopilot.link"
    ),
    "autopilot.silent": Fault(
        F,
        "not a byte from the autopilot in {seconds:.0f} s: {reason}",
        "check that TX goes to RX, and that this port speaks MAVLink 2 (ArduPilot SERIALn_PROTOCOL = 2, PX4 "
        "MAV_n_CONFIG); over UDP, that it sends to this machine's address and port",
    ),
    "autopilot.garbage": Fault(
        F,
        "bytes come, but none of them are MAVLink: {reason}",
        "set the port's baud rate as in autopilot.link (ArduPilot SERIALn_BAUD, PX4 SER_*_BAUD), or take the port that "
        "speaks MAVLink",
    ),
    "autopilot.foreign": Fault(
        F,
        "MAVLink comes, but no autopilot's heartbeat: {reason}",
        "connect the autopilot itself, not only a ground station or gimbal; check autopilot.system_id",
    ),
    "autopilot.signature": Fault(
        F,
        "the autopilot's signature is not ours: {reason}",
        "give both the same key (autopilot.signing_key), or none",
    ),
    "autopilot.lost": Fault(
        F,
        "the autopilot fell silent: {reason}",
        "check the cable and the autopilot's power; was it rebooting? Run doctor again",
    ),
    "autopilot.no_imu": Fault(
        F,
        "heartbeats come, but no gyro samples: {reason}",
        "the link must carry our requests back: connect RX as well, and give the port a stream (ArduPilot "
        "SRn_RAW_SENS, PX4 MAV_n_MODE = Onboard)",
    ),
    "autopilot.no_position": Fault(
        F,
        "no position, and drone.start needs one: {reason}",
        "wait for a fix under open sky, or write the start as position_m and yaw_deg",
    ),
    "autopilot.broken": Fault(
        F, "the autopilot's link does not work: {reason}", "see the reason; the agent's log tells more"
    ),
    "autopilot.none": Fault(
        W,
        "no autopilot is asked for: the camera is taken to be still",
        'write autopilot.link, unless the camera stands on a tripod or the pictures are a recording\'s',
    ),
    "autopilot.slow": Fault(
        W,
        "the gyro comes {got_hz:.0f} times a second of {asked_hz:g} asked",
        "a faster baud rate (921600), fewer streams of others on this port, or a lower autopilot.imu_rate_hz",
    ),
    "autopilot.too_slow": Fault(
        F,
        "the gyro comes {got_hz:.0f} times a second of {asked_hz:g} asked, too few to turn tracks by (50)",
        "a faster baud rate (921600), fewer streams of others on this port, a link that carries our requests back",
    ),
    "autopilot.losing": Fault(
        W,
        "{share:.0%} of the gyro samples are lost on the way",
        "check the cable, the baud rate and flow control (BRD_SERn_RTSCTS); a radio is too slow for this",
    ),
    "autopilot.clock": Fault(
        W,
        "the autopilot's clock is known to ± {sigma_ms:.0f} ms only",
        "let it answer TIMESYNC (the link must carry both ways); avoid radios and Wi-Fi between the two",
    ),
    "imu.upside_down": Fault(
        F,
        "gravity pulls the wrong way ({angle_deg:.0f}° off): the drone, or the autopilot in it, lies on its back",
        "set it on its feet; then the board's orientation (ArduPilot AHRS_ORIENTATION, PX4 SENS_BOARD_ROT)",
    ),
    "imu.tilted": Fault(
        W,
        "gravity is {angle_deg:.0f}° off where the autopilot's own attitude says",
        "calibrate the accelerometer and the level horizon in the ground station",
    ),
    "imu.gravity": Fault(
        W,
        "the accelerometer feels {norm:.1f} m/s² instead of 9.8",
        "hold the drone still; if it was, calibrate the accelerometer",
    ),
    "imu.bias": Fault(
        W,
        "the gyro says {rate_deg_s:.1f}°/s while the attitude stands still",
        "calibrate the gyro at rest, or write motion.gyro_bias_rad_s",
    ),
    # --- calibration
    "calibration.unreadable": Fault(
        F, "{reason}", "make a new file: swarmtrack calibrate intrinsics; or write the numbers inline"
    ),
    "calibration.aspect": Fault(
        W,
        "fx and fy differ by {percent:.0f} %, and pixels are square in almost every camera",
        "was it made for another size, or are numbers mixed up? Calibrate again: swarmtrack calibrate intrinsics",
    ),
    "calibration.centre": Fault(
        W,
        "the principal point lies {percent:.0f} % of the image off its middle",
        "was it made for another size, or a cropped picture? Calibrate again: swarmtrack calibrate intrinsics",
    ),
    "calibration.field": Fault(
        W,
        "{degrees:.0f}° of horizontal field of view, which few cameras have",
        "compare with the lens' data sheet; focal lengths are in pixels of the calibrated size",
    ),
    "calibration.distortion": Fault(
        W,
        "the lens model folds over: it says nothing of {share:.0%} of the image's border",
        "calibrate with the board in all corners, a wide lens with --model equidistant",
    ),
    "mount.radians": Fault(
        W,
        "body_from_camera.rpy_deg = {rpy} looks like radians",
        "write degrees: 90, not 1.57",
    ),
    "mount.position": Fault(
        W,
        "the camera sits {metres:.1f} m from the drone's middle",
        "body_from_camera.position_m is in metres, not in centimetres or millimetres",
    ),
    "mount.backwards": Fault(
        W,
        "the camera looks {where}",
        "if it looks forward, body_from_camera is wrong: rpy_deg = [0, 0, 0] is a camera that looks forward, upright; "
        "with a Kalibr file also check camera.imu_frame",
    ),
    "motion.sign": Fault(
        F,
        "the gyro turns the wrong way against the image about the camera's {axes} (times {gain:.1f})",
        "mend body_from_camera or camera.imu_frame: swarmtrack calibrate extrinsics finds it",
    ),
    "motion.rotation": Fault(
        W,
        "the camera sits {angle_deg:.0f}° off what body_from_camera says",
        "measure it: swarmtrack calibrate extrinsics",
    ),
    "motion.offset": Fault(
        W,
        "the camera's clock is {off_ms:+.0f} ms off the gyro's, beyond camera.time_offset_s",
        "write camera.time_offset_s = {offset_s:.3f}, or measure it: swarmtrack calibrate extrinsics",
    ),
    # --- detector
    "detector.model": Fault(
        F, "{reason}", "copy the model anew (compare sizes), or mend detector.model; docs/detector.md"
    ),
    "detector.provider": Fault(
        F, "{reason}", "install ONNX Runtime's build with that provider, or take \"cpu\" into detector.providers"
    ),
    "detector.fallback": Fault(
        W,
        "{wanted} was asked for first, but the net runs on {runs_on}",
        "install ONNX Runtime's build with that provider and its drivers; docs/detector.md",
    ),
    "detector.slow": Fault(
        W,
        "{ms:.0f} ms a frame, and one comes every {period_ms:.0f} ms",
        "a lower detector.input_scale, look = \"guided\", more threads, or an accelerator in detector.providers",
    ),
    # --- network
    "network.closed": Fault(F, "{reason}", "end the other agent or choose another port in [network]; docs/security.md"),
    "network.router": Fault(
        F, "{reason}", "start `swarmtrack router` there; check network.routers and firewalls (UDP with keys, else TCP)"
    ),
    "network.address": Fault(
        W,
        "{host} is no address of this machine now",
        "check network.peers or listen, and that the interface is up (`ip address`)",
    ),
    "network.id_clash": Fault(
        F,
        "{count} agents speak as drone {id} (boots {boots})",
        "give each drone its own drone.id; until then nobody is taken for it",
    ),
    "network.running": Fault(
        W,
        "an agent speaks as drone {id} already (boot {boot})",
        "if it is not this drone's own agent, give one of them another drone.id",
    ),
    "network.absent": Fault(
        W,
        "no answer from {names}",
        "start their agents; check addresses, reach, firewalls (TCP and UDP, port and the next one), and their keys",
    ),
    "network.stranger": Fault(
        W,
        "{names} have certificates of our CA but are not in our roster",
        "copy the newest roster.toml and roster.sig from the CA's folder",
    ),
    "network.clock": Fault(
        W,
        "this machine's clock is {off} {direction} drone {id}'s",
        "set both clocks (`timedatectl`, chrony); certificates and recordings depend on them",
    ),
    "network.multicast": Fault(
        F,
        "network.multicast on {interface}: {reason}",
        "name an interface that is up in network.interface, or list network.peers instead",
    ),
    "keys.expired": Fault(F, "{reason}", "swarmtrack keys issue --renew, after a look at this machine's clock"),
    "keys.early": Fault(F, "{reason}", "set this machine's clock (`timedatectl`); a Pi's does not survive power-off"),
    "keys.mode": Fault(F, "{reason}", "chmod 600, and make new keys if somebody else uses this machine"),
    "keys.broken": Fault(F, "{reason}", "copy the whole folder that `swarmtrack keys issue` made for this drone"),
    "keys.soon": Fault(
        W, "the certificate expires in {days:.0f} days, on {date} UTC", "swarmtrack keys issue --renew, copy it here"
    ),
    # --- machine
    "disk.unwritable": Fault(
        F, "{what} cannot be written: {reason}", "mend the path in [output], or the folder's owner"
    ),
    "disk.full": Fault(
        F, "{free_mb:.0f} MB are left where {what} goes ({path})", "make room, or write to another disk"
    ),
    "disk.low": Fault(
        W, "{free_mb:.0f} MB are left where {what} goes ({path})", "make room: video takes about 1 MB a second"
    ),
    "heat.hot": Fault(
        W, "{celsius:.0f} °C at {where}", "give it air: above 80 °C most boards slow down"
    ),
    "heat.throttled": Fault(
        W,
        "the board slows itself down: {reasons}",
        "a better power supply and cable against under-voltage, a heat sink or fan against heat",
    ),
}  # fmt: skip


def markdown_table() -> str:
    """All of `FAULTS` as a Markdown table, what is filled in as …."""
    rows = ["| fault | level | what doctor says | what to do |", "|---|---|---|---|"]
    for name, (level, found, remedy) in FAULTS.items():
        words = [re.sub(r"\{[^}]*\}", "…", text).replace("|", "\\|") for text in (found, remedy)]
        rows.append(f"| `{name}` | {level} | {' | '.join(words)} |")
    return "\n".join(rows)


def ok(check: str, found: str) -> Finding:
    return Finding(check, Level.OK, found)


def skipped(check: str, found: str) -> Finding:
    return Finding(check, Level.SKIPPED, found)


def fault(name: str, **values: object) -> Finding:
    """The fault of that name, with its words filled in."""
    level, found, remedy = FAULTS[name]
    check = name.partition(".")[0]
    return Finding(check, level, found.format(**values), remedy.format(**values), name)


def worst(findings: Iterable[Finding]) -> Level:
    """The worst level, OK where there are none."""
    order = list(Level)
    return max((finding.level for finding in findings), key=order.index, default=Level.OK)


if __name__ == "__main__":
    print(markdown_table())
