"""Relative perception for drone swarms: each drone finds its teammates in its own camera and learns who is who."""

__version__ = "0.1.0"
