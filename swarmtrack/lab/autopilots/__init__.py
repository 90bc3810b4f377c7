"""Autopilots that speak MAVLink as ArduPilot and PX4 do."""
