"""Calibration of cameras from images: intrinsics and mounting."""
