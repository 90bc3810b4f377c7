"""Where this drone is by its teammates: what carries it when its own autopilot's position is gone, or wrong."""
