"""A scenario in which two pairs of drones look at each other, and those of each pair change sides."""

CROSSING = """\
about = "drones cross in the image, again and again"
seconds = 60.0

[formation]
drones = 4
lanes = { gap_m = 5.0, lane_step_m = 2.0, lanes_a_side = 2, spacing_m = 2.4, heights_m = [5.0, 5.4] }
weave = { reach_m = 1.2, period_s = [10.0, 16.0] }

[camera]
fps = 10.0

[agents]
tracks_hz = 25.0
imu_rate_hz = 50.0
"""
