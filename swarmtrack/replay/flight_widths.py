"""Boxes of teammates whose distance was known, out of recordings of a flight: what `calibrate size` fits.

Where drones were is known from the truth, where a simulation recorded it; else from the drones' own recordings, or from
what teammates told. The detection nearest to where a teammate must have been is its box, if no other teammate may have
been there. A box that is cut off, of a camera that banks, or at a distance that is not known well enough, is left out.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from swarmtrack.calibration.box_width import Widths, level_width
from swarmtrack.geometry import rotation
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array, Detections
from swarmtrack.motion.ego import TeamPose
from swarmtrack.recording import inputs
from swarmtrack.recording.reader import FLIGHT_PLAN, Recording
from swarmtrack.relative.looks import camera_roll
from swarmtrack.relative.priors import WHOLE_BOX_BORDER_PX
from swarmtrack.replay.flight_labels import RecordedDrone, pose_of, read_drones
from swarmtrack.runtime.swarm_recorder import TRUTH_TOPIC, read_truth

# rad: a camera that banks by more draws the height of drones into the width of their boxes.
MOST_ROLL = math.radians(10.0)
# Of the distance: one that is known no better says nothing of a width.
UNSURE = 0.07
# Of a box's longer side; px and σ: how far from where a drone must be the middle of its box may be.
HIT, HIT_PX, HIT_SIGMAS = 0.5, 4.0, 2.0
# s between two true poses.
TRUTH_GAP = 0.5


@dataclass(slots=True)
class TruePath:
    """True trajectory of a drone, on the simulation's common clock."""

    t: list[float] = field(default_factory=list)
    pose: list[Pose] = field(default_factory=list)

    def at(self, t: float) -> TeamPose | None:
        """Interpolation between two samples."""
        k = bisect_left(self.t, t)
        if k in (0, len(self.t)) or self.t[k] - self.t[k - 1] > TRUTH_GAP:
            return None
        one, other = self.pose[k - 1], self.pose[k]
        share = (t - self.t[k - 1]) / (self.t[k] - self.t[k - 1])
        turn = rotation.log(one.rotation.T @ other.rotation)
        nothing = np.zeros((3, 3))
        return TeamPose(
            t,
            one.position + share * (other.position - one.position),
            one.rotation @ rotation.exp(share * turn),
            nothing,
            nothing,
        )


class FlightWidths:
    """All recordings of one flight. skipped: number of boxes left out, by reason. span: of the teammates, m; None:
    from their configs.
    """

    def __init__(self, recordings: Sequence[Recording], span: float | None) -> None:
        self.skipped: Counter[str] = Counter()
        self._span = span
        self._truth = _read_truth(recordings)
        self._drones = read_drones(recordings)

    @property
    def observers(self) -> list[int]:
        return [drone.drone_id for drone in self._drones]

    @property
    def span(self) -> float | None:
        """Span, m: as given, else from the first config that has it."""
        spans = (drone.settings.config.team.airframe_span_m for drone in self._drones)
        return self._span or next((span for span in spans if span is not None), None)

    def widths(self) -> list[Widths]:
        """Widths of each teammate's boxes in each observer's images."""
        span = self.span
        assert span is not None
        rows: dict[tuple[int, int], list[tuple[float, float, float]]] = defaultdict(list)
        for observer in self._drones:
            for seen, t in _looks(observer):
                for drone_id, span_px, box_px in self._boxes(observer, seen, t, span):
                    rows[observer.drone_id, drone_id].append((t, span_px, box_px))
        return [Widths(*np.array(table).T) for table in rows.values()]

    def _boxes(
        self, observer: RecordedDrone, seen: Detections, t: float, span: float
    ) -> Iterator[tuple[int, float, float]]:
        """Of each teammate in one look, exposed at t on the observer's clock: ID, width of its span and of its box."""
        here = self._pose(observer.drone_id, observer, t)
        if here is None:
            self.skipped["the observer's own pose is not known"] += 1
            return
        mounted = observer.settings.cameras[seen.camera]
        camera, eye = mounted.camera, here.pose @ mounted.body_from_camera
        if abs(camera_roll(eye.rotation)) > MOST_ROLL:
            self.skipped["the camera banks"] += 1
            return
        places = {}
        for drone_id in observer.teammates | self._truth.keys() - {observer.drone_id}:
            there = self._pose(drone_id, observer, t)
            if there is not None:
                away = there.position - eye.position
                pixel, _, valid = camera.project((away @ eye.rotation)[None])
                if valid[0] and camera.contains(pixel)[0]:
                    sigma = math.hypot(here.position_sigma, there.position_sigma)
                    places[drone_id] = (pixel[0], away, sigma)
        for drone_id, (pixel, away, sigma) in places.items():
            distance = float(np.linalg.norm(away))
            if sigma > UNSURE * distance:
                self.skipped["the distance is not known well enough"] += 1
                continue
            sigma_px = camera.fx * math.hypot(sigma / distance, here.attitude_sigma)
            reach = np.maximum(HIT * seen.size.max(axis=1, initial=0.0), HIT_PX + HIT_SIGMAS * sigma_px)
            others = [other for name, (other, _, _) in places.items() if name != drone_id]
            box = _box_at(seen, pixel, reach, others)
            if box is None:
                self.skipped["no box, or one that may be another drone's"] += 1
            elif _cut(seen.centre[box], seen.size[box], (camera.width, camera.height)):
                self.skipped["the box is at the image's border"] += 1
            else:
                span_px = level_width(away, span, camera, eye.rotation)
                yield drone_id, span_px, float(seen.size[box, 0])

    def _pose(self, drone_id: int, observer: RecordedDrone, t: float) -> TeamPose | None:
        """Of a drone at t on the observer's clock."""
        if drone_id in self._truth:
            return self._truth[drone_id].at(t)
        if drone_id == observer.drone_id:
            return observer.pose_at(t + observer.clock_offset)
        return pose_of(drone_id, observer, self._drones, t + observer.clock_offset)


def _box_at(seen: Detections, pixel: Array, reach: Array, others: Sequence[Array]) -> int | None:
    """The detection there, if it is the only one within reach (m,) px and no other teammate is near it."""
    off = np.linalg.norm(seen.centre - pixel, axis=1)
    hit = np.flatnonzero(off < reach)
    if len(hit) != 1:
        return None
    box = int(hit[0])
    wide = float(seen.size[box].max())
    if any(float(np.linalg.norm(other - seen.centre[box])) < wide + float(reach[box]) for other in others):
        return None
    return box


def _cut(centre: Array, size: Array, image: tuple[int, int]) -> bool:
    low, high = centre - size / 2.0, centre + size / 2.0
    return bool(
        (low < WHOLE_BOX_BORDER_PX).any() or (high > np.array(image) - 1.0 - WHOLE_BOX_BORDER_PX).any()
    )


def _looks(observer: RecordedDrone) -> Iterator[tuple[Detections, float]]:
    """Everything that was detected, and when it was exposed, by the IMU's clock."""
    topic = inputs.FORM_OF_KIND[Detections].topic
    for message in observer.recording.messages({topic}):
        _, event = inputs.decode(topic, message.data)
        if isinstance(event, Detections) and len(event):
            yield event, event.t + observer.settings.cameras[event.camera].time_offset_s


def _read_truth(recordings: Sequence[Recording]) -> dict[int, TruePath]:
    """By drone; of a flight that was not simulated, nothing."""
    truth: dict[int, TruePath] = {}
    for recording in recordings:
        if recording.kind != "swarm" or FLIGHT_PLAN not in recording.attachments:
            continue
        epoch = float(recording.attached(FLIGHT_PLAN)["epoch_s"])
        for message in recording.messages({TRUTH_TOPIC}):
            true = read_truth(message)
            of = truth.setdefault(true.drone_id, TruePath())
            of.t.append(epoch + true.t_s)
            of.pose.append(
                Pose(rotation.from_quaternion(np.array(true.quaternion_wxyz)), np.array(true.position_m))
            )
    return truth
