"""Findings of a check, and every sentence they may use.

All sentences are in one place so that `docs/troubleshooting.md` can list them. A test keeps the two equal.
"""

from __future__ import annotations

import enum
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple


class Level(enum.StrEnum):
    """Severity."""

    OK = "ok"
    # There was nothing to check, or no way to.
    SKIPPED = "skipped"
    # It works, but not as well as it could.
    WARNING = "warning"
    # It does not work.
    FAILURE = "failure"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line. check: the subject; fault: its name in `FAULTS`, empty where all is well; remedy: what to do."""

    check: str
    level: Level
    found: str
    remedy: str = ""
    fault: str = ""


def as_line(finding: Finding) -> str:
    """For a pipe, or a log."""
    remedy = f" -> {finding.remedy}" if finding.remedy else ""
    return f"{finding.level:8} {finding.check:12} {finding.found}{remedy}"


def of_camera(number: int, finding: Finding) -> Finding:
    """The same of one of several cameras, by its place in the config: people count them from 1."""
    return replace(finding, check=f"{finding.check} {number + 1}")


class Fault(NamedTuple):
    """A sentence and its remedy. Words in braces are filled in.

    instead: the remedy where it is another, by the autopilot (PX4, ArduPilot), by the link (serial), or by both; by the
    kind of camera (its scheme).
    """

    level: Level
    found: str
    remedy: str
    instead: Mapping[str, str] = MappingProxyType({})


W, F = Level.WARNING, Level.FAILURE

# By name, `check.what`; in the order in which one would look for them.
FAULTS: dict[str, Fault] = {
    # --- camera
    "camera.address": Fault(
        F, "{reason}", "correct camera.source; README and configs/ show one of each kind"
    ),
    "camera.missing": Fault(
        F,
        "no camera: {reason}",
        "plug it in, look at `ls -l /dev/v4l/by-id/`, and use that path as camera.source: it survives replugging",
    ),
    "camera.forbidden": Fault(
        F, "no permission to open the camera: {reason}", "add the agent's user to the device's group and log in again"
    ),
    "camera.busy": Fault(
        F, "another program is using the camera: {reason}", "stop that program; it may be a running agent"
    ),
    "camera.unreachable": Fault(
        F,
        "the camera's server does not answer: {reason}",
        "ping its host, open the address in a browser, and check port, path and password",
        {"rtsp": "ping its host, open the address in a player (ffplay, VLC), and check port, path and password"},
    ),
    "camera.login": Fault(
        F,
        "the camera refuses the login: {reason}",
        "write the camera's user and password into camera.source, SCHEME://USER:PASSWORD@HOST/PATH (docs/boards.md, a "
        "camera by network), and check the user's rights in the camera's settings",
    ),
    "camera.silent": Fault(
        F,
        "the camera is open but sent no frame in {seconds:.0f} s: {reason}",
        "check cable, power and USB bandwidth; try a smaller size or fourcc=MJPG",
        {
            "http": "open the address in a browser; stop other clients, since some cameras serve one only, and restart "
            "the camera",
            "rtsp": "open the address in a player (ffplay, VLC); stop other clients, since some cameras serve one "
            "only, and restart the camera",
            "detections": "check that the source's program runs and sends a line for each frame",
        },
    ),
    "camera.garbled": Fault(
        F,
        "data arrive from the camera, but no picture can be read from them: {reason}",
        "see the reason; open the source with another program",
        {
            "http": "open the address in a browser; select MJPEG in the camera's settings, or use rtsp:// for H.264",
            "rtsp": "open the address in a player (ffplay, VLC); select H.264 in the camera's settings",
            "v4l2": "try another fourcc= or a smaller size in camera.source, and another cable, port or hub",
            "images": "convert the images with another program",
            "detections": "make the source send lines of the form in configs/smart-camera.toml",
        },
    ),
    "camera.size": Fault(
        F,
        "the camera's image is not the calibrated one: {reason}",
        "request the calibrated size in camera.source (width=, height=), or calibrate again: swarmtrack calibrate "
        "intrinsics",
        {
            "http": "set the calibrated size in the camera's settings, or calibrate again: swarmtrack calibrate "
            "intrinsics",
            "rtsp": "set the calibrated size in the camera's settings, or calibrate again: swarmtrack calibrate "
            "intrinsics",
            "file": "use the recording's own calibration, or add resize=1 if both show the same view",
            "images": "use the recording's own calibration, or add resize=1 if both show the same view",
        },
    ),
    "camera.stale": Fault(
        F,
        "frames are {age_ms:.0f} ms old when they arrive, older than camera.max_age_s = {limit_s:g}: none is used",
        "shorten the stream's buffers (encoder, server, network), or raise camera.max_age_s",
    ),
    "camera.broken": Fault(
        F, "the camera does not work: {reason}", "see the reason; the agent's log (--log debug) has more"
    ),
    "camera.late": Fault(
        W,
        "frames are {age_ms:.0f} ms old when they arrive{why}",
        "use fewer buffers, a faster encoder or a USB camera; below 100 ms, identities come sooner",
        {
            "v4l2": "set a shorter exposure (exposure_us=) or a smaller size; below 100 ms, identities come sooner",
            "http": "set the camera's clock (chrony); use fewer buffers, a faster encoder or a USB camera; below "
            "100 ms, identities come sooner",
        },
    ),
    "camera.slow": Fault(
        W,
        "{got_hz:.1f} frames per second, {asked_hz:.0f} requested",
        "try more light, a fixed exposure (exposure_us=), a smaller size, fourcc=MJPG, or another USB port",
    ),
    "camera.damaged": Fault(
        W,
        "{share:.0%} of the frames are damaged",
        "check cable and USB hub, or lower the size or rate of the stream",
        {
            "http": "check the Wi-Fi or network, or lower the size or rate of the stream",
            "images": "copy the images again",
            "detections": "make the source send lines of the form in configs/smart-camera.toml",
        },
    ),
    "camera.stamps": Fault(
        W,
        "frames are stamped at arrival, not at exposure (± {sigma_ms:.0f} ms){why}",
        "measure the delay: swarmtrack calibrate extrinsics",
        {
            "http": "make the server send X-Timestamp in UTC and set its clock (chrony), or measure the delay: "
            "swarmtrack calibrate extrinsics",
        },
    ),
    "camera.blank": Fault(
        W,
        "the image is uniform (brightness {mean:.0f} ± {spread:.1f} of 255)",
        "take the cap off the lens; check exposure and light",
    ),
    # --- autopilot
    "autopilot.address": Fault(F, "{reason}", "correct autopilot.link; README and configs/ show one of each kind"),
    "autopilot.missing": Fault(
        F,
        "no autopilot: {reason}",
        "plug it in, look at `ls -l /dev/serial/by-id/`, and use that path in autopilot.link",
    ),
    "autopilot.forbidden": Fault(
        F,
        "no permission to open the autopilot's port: {reason}",
        "run `sudo usermod -aG dialout $USER` and log in again (under systemd: SupplementaryGroups=dialout)",
    ),
    "autopilot.busy": Fault(
        F,
        "the autopilot's port is taken: {reason}",
        "stop the other program (a ground station, ModemManager, another agent), or have the autopilot use another "
        "port",
    ),
    "autopilot.unreachable": Fault(
        F, "the autopilot's address does not answer: {reason}", "ping it, and check host and port in autopilot.link"
    ),
    "autopilot.silent": Fault(
        F,
        "no data from the autopilot in {seconds:.0f} s: {reason}",
        "check that TX goes to RX, and that this port speaks MAVLink 2 (ArduPilot SERIALn_PROTOCOL = 2, PX4 "
        "MAV_n_CONFIG); over UDP, check that it sends to this machine's address and port",
    ),
    "autopilot.garbage": Fault(
        F,
        "bytes arrive, but they are not MAVLink: {reason}",
        "another program sends there: check host and port in autopilot.link",
        {
            "serial": "set the port's baud rate as in autopilot.link (ArduPilot SERIALn_BAUD, PX4 SER_*_BAUD), or use "
            "the port that speaks MAVLink"
        },
    ),
    "autopilot.foreign": Fault(
        F,
        "MAVLink arrives, but no heartbeat from an autopilot: {reason}",
        "connect the autopilot itself, not only a ground station or gimbal; check autopilot.system_id",
    ),
    "autopilot.second": Fault(
        F,
        "several autopilots send on this link: {reason}",
        "set autopilot.system_id in this drone's config to the system ID of its own autopilot",
    ),
    "autopilot.shared": Fault(
        F,
        "two vehicles have the same ID: {reason}",
        "set another ID in one of them and restart it, or take it off this link",
        {
            "ArduPilot": "set another SYSID_THISMAV (newer: MAV_SYSID) in one of them and restart it, or take it off "
            "this link",
            "PX4": "set another MAV_SYS_ID in one of them and restart it, or take it off this link",
        },
    ),
    "autopilot.signature": Fault(
        F,
        "the autopilot's signature does not match ours: {reason}",
        "give both the same key (autopilot.signing_key), or none",
    ),
    "autopilot.lost": Fault(
        F,
        "the autopilot went silent: {reason}",
        "check the cable and the autopilot's power; if it was rebooting, run doctor again",
    ),
    "autopilot.no_imu": Fault(
        F,
        "heartbeats arrive, but no gyro samples: {reason}",
        "our requests must reach the autopilot: on a UART connect its RX as well, and enable a stream on the port",
        {
            "ArduPilot": "our requests must reach the autopilot: on a UART connect its RX as well, and set "
            "SRn_RAW_SENS",
            "PX4": "our requests must reach the autopilot: on a UART connect its RX as well, and set "
            "MAV_n_MODE = Onboard",
        },
    ),
    "autopilot.no_pose": Fault(
        F,
        "gyro samples come, but no attitude: {reason}",
        "wait until the autopilot's estimator has started (half a minute at rest), and keep ATTITUDE_QUATERNION on the "
        "link: SRn_EXTRA1 of ArduPilot, MAV_n_MODE of PX4",
        {
            "ArduPilot": "wait until its EKF has started (half a minute at rest); on a UART set SRn_EXTRA1",
            "PX4": "wait until its EKF has started (half a minute at rest); on a UART set MAV_n_MODE = Onboard",
        },
    ),
    "autopilot.thrown_away": Fault(
        F,
        "most of what the autopilot sends cannot be used: {reason}",
        "connect the autopilot by a cable to a port of its own, without router and radio in between, and run doctor "
        "again",
    ),
    "autopilot.no_position": Fault(
        F,
        "no position, and drone.start needs one: {reason}",
        "wait for a fix under open sky, or give the start as position_m and yaw_deg",
    ),
    "autopilot.broken": Fault(
        F, "the autopilot's link does not work: {reason}", "see the reason; the agent's log has more"
    ),
    "autopilot.none": Fault(
        W,
        "no autopilot is configured: the first camera's turns are measured in its images",
        'set autopilot.link, unless this is a recording, or the camera is on a tripod: motion.turn_from = "nothing"',
    ),
    "pose.unmeasured": Fault(
        W,
        "drone.start.position_sigma_m is missing: ± {sigma_m:g} m is assumed for the start",
        "set drone.start.position_sigma_m: 0.1 by a tape, 0.3 on a marked pad; closer teammates stay unknown",
    ),
    "autopilot.open": Fault(
        W,
        "{address} accepts MAVLink from any host that reaches it: the first sender is taken for the autopilot",
        "listen on 127.0.0.1 if the autopilot's router runs on this computer; else set autopilot.signing_key "
        "(docs/security.md)",
    ),
    "autopilot.strangers": Fault(
        W,
        "{count:.0f} datagrams came from elsewhere than the autopilot's address, and were not read",
        "find the other sender (the log names one): a second autopilot or router needs a port of its own",
    ),
    "autopilot.slow": Fault(
        W,
        "{got_hz:.0f} gyro samples per second, {asked_hz:g} requested",
        "request fewer other streams on this port, or a lower autopilot.imu_rate_hz",
        {
            "serial": "use a faster baud rate (921600), fewer other streams on this port, or a lower "
            "autopilot.imu_rate_hz",
            "PX4": "PX4 sends at most IMU_INTEG_RATE: set autopilot.imu_rate_hz to it, or raise it",
            "PX4 serial": "PX4 sends at most IMU_INTEG_RATE: set autopilot.imu_rate_hz to it, or raise it; use a "
            "faster baud rate (921600), and raise MAV_n_RATE",
        },
    ),
    "autopilot.too_slow": Fault(
        F,
        "{got_hz:.0f} gyro samples per second, {asked_hz:g} requested and at least 50 needed",
        "use a link that carries our requests and that rate (no telemetry radio), and fewer other streams on it",
        {
            "serial": "use a faster baud rate (921600), fewer other streams on this port, or a link that carries our "
            "requests",
            "PX4": "raise PX4's IMU_INTEG_RATE, and use a link that carries our requests",
            "PX4 serial": "use a faster baud rate (921600), raise MAV_n_RATE and IMU_INTEG_RATE, or use a link that "
            "carries our requests",
        },
    ),
    "autopilot.losing": Fault(
        W,
        "{share:.0%} of the gyro samples are lost on the link",
        "use a cable instead of a radio or Wi-Fi, fewer other streams, or a lower autopilot.imu_rate_hz",
        {
            "serial": "check the cable, the baud rate and flow control; a radio is too slow for this",
            "ArduPilot serial": "check the cable, the baud rate and flow control (BRD_SERn_RTSCTS); a radio is too "
            "slow for this",
        },
    ),
    "autopilot.clock": Fault(
        W,
        "the autopilot's clock is known only to ± {sigma_ms:.0f} ms",
        "it must be able to answer TIMESYNC (the link must work both ways); avoid radios and Wi-Fi in between",
    ),
    "autopilot.drift": Fault(
        W,
        "the autopilot's clock runs {percent:.1f} % {way}: a simulator?",
        "nothing, in a simulation: it is followed; for true timing let the simulator keep real time",
        {
            "PX4": "nothing, in a simulation: it is followed; for true timing build PX4 without lockstep, and leave "
            "its speed factor at 1"
        },
    ),
    "autopilot.unsteady": Fault(
        W,
        "the autopilot's clock jumps against ours, {restarts:.0f} times so far: a simulator, or a busy machine?",
        "let a simulator keep real time; on a drone, close other programs: this machine must read in time",
    ),
    "imu.upside_down": Fault(
        F,
        "gravity points the wrong way ({angle_deg:.0f}° off): the drone, or the autopilot in it, is upside down",
        "turn the drone upright, then check the board's orientation (ArduPilot AHRS_ORIENTATION, PX4 SENS_BOARD_ROT)",
    ),
    "imu.tilted": Fault(
        W,
        "gravity is {angle_deg:.0f}° off the autopilot's own attitude",
        "calibrate the accelerometer and the level horizon in the ground station",
    ),
    "imu.gravity": Fault(
        W,
        "the accelerometer measures {norm:.1f} m/s² instead of 9.8",
        "hold the drone still; if it was still, calibrate the accelerometer",
    ),
    "imu.bias": Fault(
        W,
        "the gyro reads {rate_deg_s:.1f}°/s while the attitude does not change",
        "calibrate the gyro at rest, or set motion.gyro_bias_rad_s",
    ),
    # --- what the autopilot does by itself, of a drone that its agent may fly
    "limits.unsafe": Fault(
        W,
        "{parameter} is {value}: {why}",
        "set {parameter} to {wanted}, or to what you know to be right; swarmtrack writes no parameter",
    ),
    "limits.silent": Fault(
        F, "no autopilot answers: {reason}", "switch it on, and stop the agent: only one program may have its link"
    ),
    "limits.unknown": Fault(
        W,
        "the autopilot does not report {names}",
        "look them up in your ground station: they set what the autopilot does when the agent that flies it fails",
    ),
    # --- what the autopilot makes of our place, where it is fed
    "feed.ignored": Fault(
        W,
        "{parameter} is {value}: the autopilot does not take the place that autopilot.feed sends",
        "set {wanted} (docs/feeding.md), or remove autopilot.feed; swarmtrack writes no parameter",
    ),
    "feed.circle": Fault(
        W,
        "{parameter} is {value}: the autopilot takes its heading from autopilot.feed, which has it from the autopilot",
        "set {wanted} (docs/feeding.md); swarmtrack writes no parameter",
    ),
    "feed.unusable": Fault(
        W,
        "{parameter} is {value}: the autopilot would use what autopilot.feed calls unusable",
        "set {wanted} (docs/feeding.md); swarmtrack writes no parameter",
    ),
    "feed.covariance": Fault(
        W,
        "{parameter} is {value}: the autopilot ignores how vague the fed place is",
        "set {wanted} (docs/feeding.md); swarmtrack writes no parameter",
    ),
    "feed.unknown": Fault(
        W,
        "the autopilot does not report {names}",
        "look them up in your ground station: they decide whether it takes the place that autopilot.feed sends",
    ),
    # --- calibration
    "calibration.unreadable": Fault(
        F, "{reason}", "make a new file with swarmtrack calibrate intrinsics, or write the numbers inline"
    ),
    "calibration.aspect": Fault(
        W,
        "fx and fy differ by {percent:.0f} %, but almost every camera has square pixels",
        "was it made for another size, or are numbers mixed up? Calibrate again: swarmtrack calibrate intrinsics",
    ),
    "calibration.centre": Fault(
        W,
        "the principal point is off the image centre by {percent:.0f} % of the image",
        "was it made for another size, or a cropped image? Calibrate again: swarmtrack calibrate intrinsics",
    ),
    "calibration.field": Fault(
        W,
        "the horizontal field of view is {degrees:.0f}°, which few cameras have",
        "compare with the lens's data sheet; focal lengths are in pixels of the calibrated size",
    ),
    "calibration.distortion": Fault(
        W,
        "the lens model folds over: it is undefined for {share:.0%} of the image's border",
        "calibrate with the board in all corners; for a wide lens add --model equidistant",
    ),
    "mount.radians": Fault(
        W,
        "body_from_camera.rpy_deg = {rpy} looks like radians",
        "write degrees: 90, not 1.57",
    ),
    "mount.position": Fault(
        W,
        "the camera is {metres:.1f} m from the drone's centre",
        "body_from_camera.position_m is in metres, not in centimetres or millimetres",
    ),
    "mount.backwards": Fault(
        W,
        "the camera looks {where}",
        "if it looks forward, body_from_camera is wrong: rpy_deg = [0, 0, 0] means forward and upright; with a Kalibr "
        "file also check camera.imu_frame",
    ),
    "motion.sign": Fault(
        F,
        "gyro and image turn opposite ways about the camera's {axes} (times {gain:.1f})",
        "correct body_from_camera or camera.imu_frame; swarmtrack calibrate extrinsics measures it",
    ),
    "motion.rotation": Fault(
        W,
        "the camera is turned by {angle_deg:.0f}° against body_from_camera",
        "measure it: swarmtrack calibrate extrinsics",
    ),
    "motion.offset": Fault(
        W,
        "the camera's clock is {off_ms:+.0f} ms off the gyro's, in addition to camera.time_offset_s",
        "set camera.time_offset_s = {offset_s:.3f}, or measure it: swarmtrack calibrate extrinsics",
    ),
    # --- detector
    "detector.model": Fault(
        F, "{reason}", "copy the model again (compare sizes), or correct [detector]; docs/detector.md"
    ),
    "detector.provider": Fault(
        F, "{reason}", "install the ONNX Runtime build with that provider, or add \"cpu\" to detector.providers"
    ),
    "detector.fallback": Fault(
        W,
        "{wanted} was the first choice, but the network runs on {runs_on}",
        "install the ONNX Runtime build with that provider, and its drivers (docs/detector.md), or write {runs_on} "
        "first in detector.providers",
    ),
    "detector.slow": Fault(
        W,
        "{ms:.0f} ms per frame, but frames come every {period_ms:.0f} ms",
        "try a lower detector.input_scale, look = \"guided\", more threads, or an accelerator in detector.providers",
    ),
    # --- tracking, by what a running agent says
    "tracking.noisy": Fault(
        W,
        "detections scatter {times:.1f} times more than configured; the tracks allow for it, and are less certain",
        "look for blur, vibration or a rolling shutter; if the detector is like that, raise tracker.measurement_sigma",
    ),
    "tracking.sure": Fault(
        W,
        "detections lie {times:.1f} times further off than the tracks expect: directions are less exact than stated",
        "check camera.time_offset_s and the mount (swarmtrack calibrate extrinsics); keep learn_noise = \"both\"",
    ),
    "tracking.careful": Fault(
        W,
        "detections lie {times:.1f} times nearer than the tracks expect: directions are more exact than stated",
        "use tracker.name = \"mbm\" with learn_noise = \"both\"; or lower measurement_sigma and acceleration_psd",
    ),
    # --- network
    "network.closed": Fault(
        F, "{reason}", "stop the other agent or choose another port in [network]; docs/security.md"
    ),
    "network.wrong_address": Fault(
        F, "{reason}", "correct that entry in the file of every drone, then run swarmtrack config check"
    ),
    "network.router": Fault(
        F, "{reason}", "start `swarmtrack router` there; check network.routers and firewalls (UDP with keys, else TCP)"
    ),
    "network.address": Fault(
        W,
        "{host} is not an address of this machine now",
        "check network.peers or network.listen, and whether the interface is up (`ip address`)",
    ),
    "network.id_clash": Fault(
        F,
        "{count} agents use drone.id = {id} (boots {boots})",
        "give each drone its own drone.id; until then no track gets this ID",
    ),
    "network.running": Fault(
        W,
        "an agent already uses drone.id = {id} (boot {boot})",
        "if it is not this drone's own agent, give one of them another drone.id",
    ),
    "network.absent": Fault(
        W,
        "no answer from {names}",
        "start their agents; check addresses, range, firewalls (TCP and UDP, the port and the next one) and their keys",
    ),
    "network.stranger": Fault(
        W,
        "{names} have certificates from our CA but are not in our roster",
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
    "keys.expired": Fault(
        F, "{reason}", "check this machine's clock, then: swarmtrack keys issue --renew, and copy it here"
    ),
    "keys.early": Fault(
        F, "{reason}", "set this machine's clock (`timedatectl`); a Raspberry Pi loses the time without power"
    ),
    "keys.mode": Fault(F, "{reason}", "chmod 600, and make new keys if anyone else uses this machine"),
    "keys.broken": Fault(F, "{reason}", "copy the whole folder that `swarmtrack keys issue` made for this drone"),
    "keys.soon": Fault(
        W,
        "the certificate expires in {days:.0f} days, on {date} UTC",
        "swarmtrack keys issue --renew, then copy it here",
    ),
    # --- machine
    "disk.unwritable": Fault(
        F, "{what} cannot be written: {reason}", "correct the path in [output], or the folder's owner"
    ),
    "disk.full": Fault(
        F, "{free_mb:.0f} MB are left for {what} ({path})", "free some space, or write to another disk"
    ),
    "disk.low": Fault(
        W, "{free_mb:.0f} MB are left for {what} ({path})", "free some space: video takes about 1 MB per second"
    ),
    "heat.hot": Fault(
        W, "{celsius:.0f} °C at {where}", "improve the cooling: above 80 °C most boards slow down"
    ),
    "heat.throttled": Fault(
        W,
        "the board is throttling: {reasons}",
        "under-voltage needs a better power supply or cable, heat a heat sink or fan",
    ),
}  # fmt: skip


def markdown_table(faults: Mapping[str, Fault] = FAULTS) -> str:
    """All faults as a Markdown table, with … for what is filled in."""
    rows = ["| fault | level | finding | remedy |", "|---|---|---|---|"]
    for name, (level, found, remedy, instead) in faults.items():
        remedies = [remedy, *(f"*{where.replace(' ', ', ')}:* {text}" for where, text in instead.items())]
        words = [
            re.sub(r"\{[^}]*\}", "…", text).replace("|", "\\|") for text in (found, " · ".join(remedies))
        ]
        rows.append(f"| `{name}` | {level} | {' | '.join(words)} |")
    return "\n".join(rows)


def ok(check: str, found: str) -> Finding:
    return Finding(check, Level.OK, found)


def skipped(check: str, found: str) -> Finding:
    return Finding(check, Level.SKIPPED, found)


def fault(
    name: str, *, setting: Sequence[str] = (), of: Mapping[str, Fault] = FAULTS, **values: object
) -> Finding:
    """The named fault with its words filled in; setting: selects the remedy, best first; of: the table it is in."""
    level, found, remedy, instead = of[name]
    check = name.partition(".")[0]
    remedy = next((instead[key] for key in setting if key in instead), remedy)
    return Finding(check, level, found.format(**values), remedy.format(**values), name)


def worst(findings: Iterable[Finding]) -> Level:
    """The worst level, OK where there are none."""
    order = list(Level)
    return max((finding.level for finding in findings), key=order.index, default=Level.OK)


if __name__ == "__main__":
    # A part of docs/troubleshooting.md, whatever the terminal's encoding.
    sys.stdout.buffer.write(f"{markdown_table()}\n".encode())
