"""Recordings: MCAP files that hold what a drone was told, in its order, and what it made of it (docs/recording.md)."""
