"""Faults that only a whole flight shows, in addition to those of `diagnosis.findings`.

`python -m swarmtrack.review.faults` prints the table of docs/review.md; a test keeps page and program equal.
"""

from __future__ import annotations

import sys

from swarmtrack.diagnosis.findings import FAULTS, Fault, Finding, Level, fault, markdown_table

W, F = Level.WARNING, Level.FAILURE

FLIGHT_FAULTS: dict[str, Fault] = {
    # --- recording
    "recording.cut": Fault(
        W,
        "a file of the recording {damage}",
        "complete it with swarmtrack log repair; if the agent was not killed, look for a loose supply or a full disk",
    ),
    "recording.refused": Fault(
        W,
        "{count} records of the recording cannot be read and are left out",
        "was it written by another version? swarmtrack log info shows the versions and what is damaged",
    ),
    "recording.lost": Fault(
        F,
        "the recording is incomplete, {count:.0f} records are lost: {reason}",
        "free some space on the disk, lower recording.max_mb or frames_hz, or use a faster card",
    ),
    # --- camera
    "camera.gap": Fault(
        F,
        "no frame was processed for {seconds:.1f} s",
        "check cable, power and USB bandwidth; look at the detector's time per frame below",
    ),
    "camera.rate": Fault(
        W,
        "{got_hz:.1f} frames per second were processed, too few to follow a drone",
        "try more light, a shorter exposure, a smaller size, or a faster detector (docs/detector.md)",
    ),
    # --- autopilot
    "autopilot.gap": Fault(
        F,
        "no gyro sample for {seconds:.1f} s",
        "check the cable and the autopilot's power, and that nothing else takes its port",
    ),
    "autopilot.rebooted": Fault(
        F,
        "the autopilot rebooted in flight (number of reboots: {count})",
        "look for a brown-out or a watchdog in the autopilot's own log; check its supply and connectors",
    ),
    "autopilot.place_lost": Fault(
        F,
        "the autopilot had no position for {seconds:.1f} s",
        "check the GPS receiver, its antenna and its cable; keep away from metal roofs and transmitters",
    ),
    "autopilot.invalid": Fault(
        W,
        "{count:.0f} of the autopilot's samples were no numbers, or impossible ones",
        "restart the autopilot, calibrate its sensors, and update its firmware; a gyro may be broken",
    ),
    # --- pose
    "pose.pads": Fault(
        F,
        "it stands where drone {other} is stated to start",
        "exchange the two drones, or drone.start in their configs",
    ),
    "pose.heading": Fault(
        F,
        "its heading is off by about {degrees:.0f}°",
        "calibrate the compass away from metal, or correct yaw_deg in drone.start; then check body_from_camera",
    ),
    "pose.start": Fault(
        F,
        "it started elsewhere than stated: {reason}",
        "measure the start again and correct drone.start",
    ),
    "pose.doubt": Fault(
        F,
        "what it sees contradicts its own start or heading",
        "check drone.start, the compass and camera.body_from_camera",
    ),
    "pose.teammate": Fault(
        W,
        "the start or heading of drone {other} does not fit what this drone sees",
        "check drone.start and the compass of both, and the camera's mounting of this one",
    ),
    "mount.direction": Fault(
        F,
        "its camera sees teammates {degrees:.0f}° from where they report to be",
        "check body_from_camera (swarmtrack calibrate extrinsics), then the compass",
    ),
    "calibration.scale": Fault(
        F,
        "teammates lie {factor:.2f} times as far from the image's centre as they should: a wrong field of view",
        "was the calibration made for another lens, zoom or size? Calibrate again: swarmtrack calibrate intrinsics",
    ),
    # --- detector
    "detector.clutter": Fault(
        F,
        "{count:.0f} detections per frame, with {teammates} teammates",
        "raise detector.score_threshold, or train the detector on pictures of this place (docs/detector.md)",
    ),
    "detector.unusable": Fault(
        W,
        "{count:.0f} detections were no numbers, or outside the image",
        "check what the smart camera or the network sends (configs/smart-camera.toml)",
    ),
    # --- team
    "team.gone": Fault(
        F,
        "it fell silent {seconds:.0f} s before the flight's end",
        "look at its log and its battery; `journalctl -u swarmtrack-agent@*` shows whether its agent died",
    ),
    "team.restarted": Fault(
        F,
        "its agent was started again (number of restarts: {count})",
        "look at its log for the reason; `journalctl -u swarmtrack-agent@*`",
    ),
    "team.loss": Fault(
        W,
        "{share:.0%} of the messages from drone {other} were lost",
        "check antennas, range and channel; a 2.4 GHz remote control disturbs Wi-Fi on the same band",
    ),
    "team.dropped": Fault(
        F,
        "nothing from drone {other} arrived for {seconds:.1f} s, while that one was sending",
        "check range and antennas of both; a router at the ground station closes gaps (swarmtrack router)",
    ),
    "team.deaf": Fault(
        F,
        "nothing from drone {other} ever arrived",
        "check that both have the same team, keys from one CA, and addresses that reach each other",
    ),
    "clock.step": Fault(
        F,
        "this machine's clock was set by {step_s:+.1f} s in flight",
        "set the clock before take-off (chrony with makestep at the start only); certificates depend on it",
    ),
    # --- machine
    "machine.busy": Fault(
        F,
        "the machine is too busy: the agent waited {lag_ms:.0f} ms for its turn (95 %), at {cpu:.0f} % CPU",
        "close other programs, lower the frame rate or the detector's size, or improve the cooling",
    ),
    # --- names
    "names.unknown": Fault(
        W,
        "drone {other} was in view and had no name for {seconds:.0f} s: {why}",
        "see the timeline; docs/identity.md lists what a name needs",
    ),
    "names.wrong": Fault(
        F,
        "drone {other} had the name of another for {seconds:.1f} s",
        "please report this flight: a wrong name is a bug (docs/identity.md)",
    ),
    "formation.hold": Fault(
        W,
        "the formation held for {seconds:.0f} s: {reason}",
        "docs/formation.md lists each hold with its remedy",
    ),
}


def flight_fault(name: str, **values: object) -> Finding:
    """The named fault of either table, with its words filled in."""
    return fault(name, of=FLIGHT_FAULTS if name in FLIGHT_FAULTS else FAULTS, **values)  # type: ignore[arg-type]


if __name__ == "__main__":
    sys.stdout.buffer.write(f"{markdown_table(FLIGHT_FAULTS)}\n".encode())
