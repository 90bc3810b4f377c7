"""A Raspberry Pi's ribbon camera as MJPEG with the times of exposure, for `source = "http://127.0.0.1:8080/"`.

`sudo apt install python3-picamera2`, then `python3 picamera2_mjpeg.py --size 640 480 --fps 30`.

`SensorTimestamp` counts on CLOCK_BOOTTIME, which goes on while the board sleeps; the agent's CLOCK_MONOTONIC does not.
It is the start of the readout: the first row's exposure has just ended. The middle of a picture is exposed half an
exposure earlier, and with a rolling shutter half the readout later (--readout-ms; 0 for a global shutter).
"""

import io
import sys
import time

from picamera2 import Picamera2
from stream_server import agent_time, arguments, serve


def exposure_time(metadata, readout_ms):
    """Middle of the exposure, s on CLOCK_MONOTONIC."""
    asleep = time.clock_gettime(time.CLOCK_BOOTTIME) - time.clock_gettime(time.CLOCK_MONOTONIC)
    half_exposure = 0.5e-6 * metadata["ExposureTime"]
    return 1e-9 * metadata["SensorTimestamp"] - asleep - half_exposure + 0.5e-3 * readout_ms


def parts(camera, readout_ms, utc):
    """The parts of the stream, each a JPEG with its stamp."""
    while True:
        request, jpeg = camera.capture_request(), io.BytesIO()
        try:
            metadata = request.get_metadata()
            request.save("main", jpeg, format="jpeg")
        finally:
            request.release()
        t = agent_time(exposure_time(metadata, readout_ms), utc)
        head = f"--frame\r\nContent-Type: image/jpeg\r\nX-Timestamp: {t:.6f}\r\n"
        head += f"Content-Length: {jpeg.tell()}\r\n\r\n"
        yield head.encode() + jpeg.getvalue() + b"\r\n"


def main():
    parser = arguments("A Raspberry Pi's camera as MJPEG with the times of exposure.", 8080)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--readout-ms", type=float, default=0.0, help="from the first to the last row")
    args = parser.parse_args()
    camera = Picamera2()
    controls = {"FrameRate": args.fps}
    camera.configure(camera.create_video_configuration(main={"size": tuple(args.size)}, controls=controls))
    camera.start()
    stream = parts(camera, args.readout_ms, args.utc)
    serve(stream, "multipart/x-mixed-replace; boundary=frame", args.host, args.port)


if __name__ == "__main__":
    sys.exit(main())
