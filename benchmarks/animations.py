"""The README's two animations: `python -m swarmtrack.benchmarks.animations RECORDING TRACKED --out docs/images`.

RECORDING: of `swarmtrack sim formation-3 --record`, whose pictures are drawn again from the recorded truth, since a
recording holds none unless asked for. TRACKED: the folder of `swarmtrack video CLIP`. Needs Pillow, which comes with
matplotlib.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from swarmtrack.config.toml.layers import Layer, Layers
from swarmtrack.errors import RecordingError
from swarmtrack.lab.scenarios.files import scenario_of
from swarmtrack.lab.scenarios.scenario import Scenario, as_told
from swarmtrack.lab.world.rendering import Optics, Renderer
from swarmtrack.messages import Array, Frame, Image, ScanReport, StampKind
from swarmtrack.outputs.annotated_video import annotate
from swarmtrack.outputs.drawing import Trails, as_seen, drawn
from swarmtrack.outputs.palette import DRONE_COLOURS
from swarmtrack.recording.outputs import TRACKS_TOPIC, decode_report
from swarmtrack.recording.reader import FLIGHT_PLAN, Recording, recordings_below
from swarmtrack.replay.verdict import tell_truth

FPS = 8.0
FORMATION_S, FORMATION_STEP_S = (
    (8.0, 42.0),
    0.6,
)  # s of the flight: its begin, its end, and one frame to the next
PANE = (384, 288)  # px
MAP_M = 30.0  # m, from one edge of the map to the other
VIDEO_FRAMES, VIDEO_WIDTH = 56, 480
QUALITY = 55  # of WebP


def formation(folder: Path) -> Iterator[Image]:
    """Pictures of both followers beside the map, over one flight. Raises RecordingError."""
    recordings = recordings_below(folder)
    flight = next((one for one in recordings if one.is_simulated_flight), None)
    if flight is None:
        raise RecordingError(
            f"{folder}: holds no simulated flight, expected that of sim formation-3 --record"
        )
    plan = flight.attached(FLIGHT_PLAN)
    layers = Layers([Layer(flight.folder / FLIGHT_PLAN, "", plan["files"])], plan["files"])
    planned = scenario_of(layers, plan["scenario"], seed=plan["seed"], drones=plan["drones"])
    scenario, followed = as_told(planned)
    tell_truth(flight, followed)
    quiet = Optics(noise=0.0)  # which costs more bytes than all else
    renderer = Renderer(scenario.world, scenario.camera, scenario.body_from_camera, quiet)
    drones = {one.drone_id: _reports(one, plan["epoch_s"]) for one in recordings if one.kind == "drone"}
    trails = {drone_id: Trails() for drone_id in drones}
    for t in np.arange(*FORMATION_S, FORMATION_STEP_S):
        panes = [_view(renderer, drones[d], trails[d], d, float(t)) for d in sorted(drones) if d != 1]
        yield np.hstack([*panes, _map(scenario, float(t))])


def _reports(recording: Recording, epoch: float) -> list[tuple[float, ScanReport]]:
    """Every scan with its exposure in world time [s]."""
    reports = [decode_report(message.data).report for message in recording.messages({TRACKS_TOPIC})]
    return [(report.tracks.t - epoch, report) for report in reports]


def _view(
    renderer: Renderer, scans: Sequence[tuple[float, ScanReport]], trails: Trails, drone_id: int, t: float
) -> Image:
    """The newest picture that was looked at, with its tracks."""
    exposed, report = max((scan for scan in scans if scan[0] <= t), key=lambda scan: scan[0])
    image = renderer.image(drone_id, exposed, report.sequence)
    frame = Frame(exposed, 0.0, report.sequence, image, StampKind.MEDIA)
    picture = annotate(frame, exposed, drawn(as_seen(report, renderer.camera)), trails)
    picture[:32] = image[:32]  # the clock and the count of frames are not of this picture's concern
    pane = cv2.resize(picture, PANE, interpolation=cv2.INTER_AREA)
    return _titled(np.asarray(pane, np.uint8), f"drone {drone_id} sees", drone_id)


def _map(scenario: Scenario, t: float) -> Image:
    """North up, with the path of each drone until now."""
    width, height = PANE[1], PANE[1]
    canvas = np.full((height, width, 3), (35, 29, 23), np.uint8)
    scale = width / MAP_M
    poses = scenario.world.drones
    times = np.arange(FORMATION_S[0], t + 1e-6, 0.25)
    middle = np.mean([drone.position(t)[:2] for drone in poses.values()], axis=0)

    def pixel(place: Array) -> tuple[int, int]:
        north, east = place[:2] - middle
        return round(width / 2 + scale * east), round(height / 2 - scale * north)

    for drone_id, drone in poses.items():
        colour = DRONE_COLOURS[drone_id - 1][::-1]
        way = np.array([pixel(drone.position(float(when))) for when in times], np.int32)
        cv2.polylines(canvas, [way], False, colour, 2, cv2.LINE_AA)
        cv2.circle(canvas, pixel(drone.position(t)), 9, colour, cv2.FILLED, cv2.LINE_AA)
        u, v = pixel(drone.position(t))
        cv2.putText(
            canvas, str(drone_id), (u - 5, v + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA
        )
    return _titled(canvas, f"from above, {t:.0f} s", None)


def _titled(image: Image, text: str, drone_id: int | None) -> Image:
    colour = (255, 255, 255) if drone_id is None else DRONE_COLOURS[drone_id - 1][::-1]
    cv2.rectangle(image, (0, 0), (image.shape[1], 24), (20, 20, 20), cv2.FILLED)
    cv2.putText(image, text, (8, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
    return image


def tracked_video(folder: Path) -> Iterator[Image]:
    """Evenly spaced frames of an annotated video, its summary among them."""
    capture = cv2.VideoCapture(str(folder / "annotated.webm"))
    frames: list[Image] = []
    while True:
        there, frame = capture.read()
        if not there:
            break
        frames.append(np.asarray(frame, np.uint8))
    if not frames:
        raise RecordingError(f"{folder}: holds no annotated.webm, expected the output of swarmtrack video")
    for k in np.linspace(0, len(frames) - 1, VIDEO_FRAMES):
        height = round(VIDEO_WIDTH * frames[0].shape[0] / frames[0].shape[1])
        small = cv2.resize(frames[round(k)], (VIDEO_WIDTH, height), interpolation=cv2.INTER_AREA)
        yield np.asarray(small, np.uint8)


def write(frames: Iterator[Image], path: Path) -> None:
    """An animated WebP, which loops."""
    from PIL import Image as Picture  # noqa: PLC0415 - of the extra `bench`

    first, *others = (Picture.fromarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)) for frame in frames)
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=round(1e3 / FPS),
        loop=0,
        quality=QUALITY,
        method=6,
    )
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the README's animations.")
    parser.add_argument("recording", type=Path)
    parser.add_argument("tracked", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    write(formation(args.recording), args.out / "formation.webp")
    write(tracked_video(args.tracked), args.out / "video.webp")


if __name__ == "__main__":
    main()
