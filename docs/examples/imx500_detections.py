"""A Sony IMX500 (Raspberry Pi AI Camera) that detects by itself, for `source = "detections://127.0.0.1:8091/"`.

`sudo apt install imx500-all`, then `python3 imx500_detections.py NETWORK.rpk`. The network must do its own non-maximum
suppression, as the makers' SSD and EfficientDet do, and yours if exported so. Boxes are in pixels of --size; calibrate
the camera at that size. Its times are those of picamera2_mjpeg.py, which stands beside it.
"""

import json
import sys

from picamera2 import Picamera2
from picamera2.devices import IMX500
from picamera2_mjpeg import exposure_time
from stream_server import agent_time, arguments, serve

SENSOR = (4056, 3040)  # px: ScalerCrop's unit


def boxes_px(outputs, network, crop, args):
    """Rows u, v, w, h, score. crop: x, y, w, h of the picture on the sensor."""
    boxes, scores, classes = outputs[0][0], outputs[1][0], outputs[2][0]
    intrinsics, (width, height) = network.network_intrinsics, network.get_input_size()
    found = []
    for box, score, label in zip(boxes.tolist(), scores.tolist(), classes.tolist(), strict=False):
        if score < args.score or (args.label and int(label) not in args.label):
            continue
        y0, x0, y1, x1 = box if intrinsics.bbox_order != "xy" else (box[1], box[0], box[3], box[2])
        if intrinsics.bbox_normalization:
            x0, x1, y0, y1 = x0 / width, x1 / width, y0 / height, y1 / height
        # Not convert_inference_coords: it rounds to whole pixels. Pixel centres are whole numbers.
        u0, u1 = ((x * SENSOR[0] - crop[0]) / crop[2] * args.size[0] - 0.5 for x in (x0, x1))
        v0, v1 = ((y * SENSOR[1] - crop[1]) / crop[3] * args.size[1] - 0.5 for y in (y0, y1))
        found.append([(u0 + u1) / 2, (v0 + v1) / 2, abs(u1 - u0), abs(v1 - v0), min(max(score, 0.0), 1.0)])
    return found


def lines(camera, network, args):
    """A line for each picture that the network looked at, also where it found nothing."""
    while True:
        metadata = camera.capture_metadata()
        outputs = network.get_outputs(metadata, add_batch=True)
        if outputs is None:  # no result came with this picture
            continue
        t = agent_time(exposure_time(metadata, args.readout_ms), args.utc)
        found = boxes_px(outputs, network, metadata["ScalerCrop"], args)
        yield json.dumps({"t_s": t, "detections": found}).encode() + b"\n"


def main():
    parser = arguments("Detections of a Sony IMX500 as JSON lines.", 8091)
    parser.add_argument("network", help="an .rpk file")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--score", type=float, default=0.3, help="least score (default: %(default)s)")
    parser.add_argument("--label", type=int, action="append", help="number of a drone class (default: any)")
    parser.add_argument("--readout-ms", type=float, default=0.0, help="from the first to the last row")
    args = parser.parse_args()
    network = IMX500(args.network)  # before the camera
    if network.network_intrinsics is None or network.network_intrinsics.postprocess:
        parser.error(
            f"{args.network}: expected a network with its description and its own non-maximum suppression"
        )
    camera = Picamera2(network.camera_num)
    main_stream, rate = {"size": tuple(args.size)}, network.network_intrinsics.inference_rate
    camera.start(camera.create_preview_configuration(main=main_stream, controls={"FrameRate": rate}))
    serve(lines(camera, network, args), "application/x-ndjson", args.host, args.port)


if __name__ == "__main__":
    sys.exit(main())
