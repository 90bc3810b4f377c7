"""Two drones that look at each other, and what no busy machine can spoil."""

PAIR = """
about = "two drones look at each other"
seconds = 4.0
[agents]
tracks_hz = 20.0
imu_rate_hz = 50.0
[formation]
drones = 2
ring = { radius_m = 2.0 }
[expected]                    # only what no busy machine can spoil
rmse_px = 15.0
time_to_identify_s = 60.0
all_known_s = 60.0
first_tracks_s = 60.0
correct = 0.5
rate = 0.1
"""
