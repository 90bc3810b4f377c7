"""What docs/examples use of depthai 3."""

import datetime
from types import SimpleNamespace

import fake_exposures


class Message:
    def __init__(self, k, middle):
        self._k, self._end = k, middle + fake_exposures.EXPOSURE / 2
        box = SimpleNamespace(xmin=0.5, xmax=0.75, ymin=0.25, ymax=0.5, confidence=0.9, label=4)
        self.detections = [box, SimpleNamespace(**(vars(box) | {"label": 0}))]

    def getTransformation(self):
        return SimpleNamespace(getSize=lambda: (512, 288))

    def getTimestamp(self):
        return datetime.timedelta(seconds=self._end)

    def getSequenceNum(self):
        return 100 + self._k


class _Network:
    def build(self, camera, model, fps):
        assert (camera, model, fps) == ("camera", "a/drone-net", 20.0)
        return self

    def setConfidenceThreshold(self, score):
        assert score == 0.3

    @property
    def out(self):
        exposures = fake_exposures.exposures()
        queue = SimpleNamespace(get=lambda: Message(*next(exposures)))
        return SimpleNamespace(createOutputQueue=lambda maxSize, blocking: queue)


node = SimpleNamespace(Camera=lambda: SimpleNamespace(build=lambda: "camera"), DetectionNetwork=_Network)


class Pipeline:
    def __enter__(self):
        return self

    def __exit__(self, *error):
        return None

    def create(self, kind):
        return kind()

    def start(self):
        return None

    def isRunning(self):
        return True
