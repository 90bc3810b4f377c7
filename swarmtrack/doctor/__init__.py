"""`swarmtrack doctor`: opens the camera, the link and the network, and collects the facts that `diagnosis` judges."""
