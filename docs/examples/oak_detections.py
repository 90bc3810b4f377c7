"""A Luxonis OAK that detects by itself, for `source = "detections://127.0.0.1:8091/"`.

`pip install "depthai>=3"`, then `python oak_detections.py MODEL`: a name in Luxonis' zoo, or an archive
(.tar.xz) of your own. Boxes are in pixels of the network's input, whose size is printed: calibrate the camera at that
size. Depthai stamps the end of an exposure, on this machine's CLOCK_MONOTONIC.
"""

import json
import sys

import depthai
from stream_server import agent_time, arguments, serve


def box_px(box, size):
    """u, v, w, h, score of a box in shares of the picture. Pixel centres are whole numbers."""
    u0, u1 = (x * size[0] - 0.5 for x in (box.xmin, box.xmax))
    v0, v1 = (y * size[1] - 0.5 for y in (box.ymin, box.ymax))
    return [(u0 + u1) / 2, (v0 + v1) / 2, u1 - u0, v1 - v0, min(max(box.confidence, 0.0), 1.0)]


def lines(pipeline, queue, args):
    """A line for each picture, also where nothing was found."""
    told = None
    while pipeline.isRunning():
        message = queue.get()
        size = message.getTransformation().getSize()
        if size != told:
            told = size
            print(f"boxes are in pixels of {size[0]} x {size[1]}", file=sys.stderr, flush=True)
        t = message.getTimestamp().total_seconds() - 0.5e-3 * args.exposure_ms
        drones = [box for box in message.detections if not args.label or box.label in args.label]
        yield (
            json.dumps(
                {
                    "t_s": agent_time(t, args.utc),
                    "sequence": message.getSequenceNum(),
                    "detections": [box_px(box, size) for box in drones],
                }
            ).encode()
            + b"\n"
        )
    raise RuntimeError("the camera has stopped")


def main():
    parser = arguments("Detections of a Luxonis OAK as JSON lines.", 8091)
    parser.add_argument("model", help="name in Luxonis' zoo, or a .tar.xz archive")
    parser.add_argument("--fps", type=float, default=20.0)
    parser.add_argument("--score", type=float, default=0.3, help="least score (default: %(default)s)")
    parser.add_argument("--label", type=int, action="append", help="number of a drone class (default: any)")
    parser.add_argument("--exposure-ms", type=float, default=8.0, help="the usual one (default: %(default)s)")
    args = parser.parse_args()
    with depthai.Pipeline() as pipeline:
        model = depthai.NNArchive(args.model) if args.model.endswith(".tar.xz") else args.model
        camera = pipeline.create(depthai.node.Camera).build()
        network = pipeline.create(depthai.node.DetectionNetwork).build(camera, model, fps=args.fps)
        network.setConfidenceThreshold(args.score)
        queue = network.out.createOutputQueue(maxSize=1, blocking=False)
        pipeline.start()
        serve(lines(pipeline, queue, args), "application/x-ndjson", args.host, args.port)


if __name__ == "__main__":
    sys.exit(main())
