"""A camera source of one's own: grey images from a named pipe, fed by any program (docs/add_a_camera.md).

`mkfifo cam`, `rpicam-vid --codec yuv420 …` or `ffmpeg … -f rawvideo -pix_fmt gray cam`, and in the config
`source = "pipe://cam?width=640&height=480"`. `python pipe_camera.py --config drone.toml` is the agent with it.
"""

import sys
from dataclasses import dataclass

import numpy as np

from swarmtrack.agents.vehicle import main
from swarmtrack.camera_sources.address import in_range, read_options
from swarmtrack.camera_sources.frame_slot import FrameSlot, RawFrame, already
from swarmtrack.camera_sources.opening import CAMERA_SOURCES
from swarmtrack.camera_sources.thread_camera import ThreadCamera
from swarmtrack.messages import StampKind


@dataclass(frozen=True, slots=True)
class PipeOptions:
    width: int = 640
    height: int = 480
    latency_ms: float = 30.0  # from the middle of the exposure to the last byte

    def __post_init__(self):
        in_range("width", self.width, 1, 10_000)
        in_range("height", self.height, 1, 10_000)


class PipeCamera(ThreadCamera):
    def __init__(self, address, *, clock, size, base):
        super().__init__(FrameSlot(str(address), clock, size, resize=False))
        self._path, self._options, self._clock = address.path(base), read_options(address, PipeOptions), clock

    def _run(self, loop):
        tell, sequence = loop.call_soon_threadsafe, 0
        shape = self._options.height, self._options.width
        while not self._stop.is_set():
            try:
                with self._path.open("rb") as pipe:
                    tell(self._slot.source.report, True, "streaming")
                    while len(data := pipe.read(shape[0] * shape[1])) == shape[0] * shape[1]:
                        t, image = self._clock.now(), np.frombuffer(data, np.uint8).reshape(shape)
                        t -= 1e-3 * self._options.latency_ms
                        raw = RawFrame(t, 0.01, sequence, StampKind.ARRIVAL, already(image))
                        tell(self._slot.put, raw)
                        sequence += 1
                tell(self._slot.source.report, False, "the program that fed it has gone; waiting for another")
            except OSError as error:
                tell(self._slot.source.report, False, f"{error.strerror}; trying again")
            self._stop.wait(0.5)


CAMERA_SOURCES["pipe"] = PipeCamera
if __name__ == "__main__":
    sys.exit(main())
