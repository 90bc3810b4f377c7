"""From a frame to detections: letterbox, ONNX session, decoding of the net's heads."""
