"""The web page of a running swarm or of a recording."""
