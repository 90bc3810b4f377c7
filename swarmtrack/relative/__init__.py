"""Metres: where each identified teammate is, and how it moves, relative to this drone's camera (decision 26)."""
