"""What docs/examples use of picamera2."""

import cv2
import fake_exposures
import numpy as np

READOUT = 20e-3


class Request:
    released = 0

    def __init__(self, size, metadata):
        self._size, self._metadata = size, metadata

    def get_metadata(self):
        return self._metadata

    def save(self, name, file, format):
        assert (name, format) == ("main", "jpeg")
        image = np.full((self._size[1], self._size[0], 3), 128, np.uint8)
        file.write(cv2.imencode(".jpg", image)[1].tobytes())

    def release(self):
        Request.released += 1


class Picamera2:
    def __init__(self, camera_num=0):
        self.camera_num, self._taken = camera_num, 0

    def create_video_configuration(self, main, controls):
        assert controls == {"FrameRate": 30.0}
        return main["size"]

    create_preview_configuration = create_video_configuration

    def configure(self, size):
        self._size = size

    def start(self, size=None):
        self._size = size or self._size
        self._exposures = fake_exposures.exposures()

    def capture_metadata(self):
        """The sensor's stamp is the start of the readout."""
        k, middle = next(self._exposures)
        begin = middle + fake_exposures.EXPOSURE / 2 - READOUT / 2
        return {
            "SensorTimestamp": round(1e9 * (begin + fake_exposures.ASLEEP)),
            "ExposureTime": round(1e6 * fake_exposures.EXPOSURE),
            "ScalerCrop": (508, 0, 3040, 3040),
            "k": k,
        }

    def capture_request(self):
        assert Request.released == self._taken, "requests that are kept stop the camera"
        self._taken += 1
        return Request(self._size, self.capture_metadata())
