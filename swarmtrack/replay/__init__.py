"""Recorded flights through the real perception again, and their verdict."""
