"""What a drone's files say: the config, the team, the formation, cameras, trajectories."""
