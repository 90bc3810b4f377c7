"""Recordings: MCAP files with the inputs of a drone, in order, and its outputs (docs/recording.md)."""
