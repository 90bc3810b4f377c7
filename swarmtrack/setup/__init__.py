"""`swarmtrack config`: a first config from a few answers, the reference of all keys, checks of a whole team."""
