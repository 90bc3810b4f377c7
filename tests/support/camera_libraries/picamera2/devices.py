"""What docs/examples use of picamera2.devices."""

from types import SimpleNamespace

import numpy as np


class IMX500:
    camera_num = 1

    def __init__(self, network):
        if network == "undescribed.rpk":
            self.network_intrinsics = None
            return
        self.network_intrinsics = SimpleNamespace(
            bbox_normalization=True, bbox_order="yx", postprocess="", inference_rate=30.0
        )

    def get_input_size(self):
        return 320, 320

    def get_outputs(self, metadata, add_batch):
        """A drone, one of another class and one of a low score; nothing at all with every third picture."""
        assert add_batch
        if metadata["k"] % 3 == 0:
            return None
        # y0, x0, y1, x1: half as high as wide, in the middle of the sensor.
        box = [155.0, 150.0, 165.0, 170.0]
        return [np.array([[box, box, box]]), np.array([[0.9, 0.8, 0.1]]), np.array([[4.0, 0.0, 4.0]])]
