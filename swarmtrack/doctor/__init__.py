"""`swarmtrack doctor`: opens the camera, the link and the network, and notes the facts that `diagnosis` judges."""
