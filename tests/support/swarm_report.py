"""The report of a flight in which everything is as expected."""

import math
from dataclasses import replace

from swarmtrack.lab.score.swarm_score import SwarmScore
from swarmtrack.lab.score.swarm_verdict import AgentFigures, Limits, SwarmReport

GOOD_SCORE = SwarmScore(
    samples=400,
    time_to_identify_s={1: 0.4, 2: 0.9},
    correct=0.99,
    proved=0.0,
    wrong=0.0,
    wrong_max_probability=math.nan,
    unknown=0.01,
    agreement=1.0,
    rmse_px={1: 1.2, 2: 1.4},
    recall=0.99,
    false_tracks_per_s=0.01,
    switches=0,
)
GOOD_AGENT = AgentFigures(
    drone_id=1,
    start_s=0.0,
    first_tracks_s=-2.0,
    track_rate_hz=99.8,
    imu_rate_hz=200.1,
    detection_rate_hz=15.0,
    latency_p50_s=0.020,
    latency_p95_s=0.040,
    cpu_percent=12.0,
    rss_mb=120.0,
    announcement_bytes=161,
    announcements_sent=1,
)
GOOD = SwarmReport(
    scenario="hover-triangle",
    drones=2,
    seconds=20.0,
    seed=1,
    tracker="kalman",
    detector="onnx",
    score=GOOD_SCORE,
    all_known_s=0.7,
    agents=(GOOD_AGENT, replace(GOOD_AGENT, drone_id=2)),
    asked_tracks_hz=100.0,
    asked_imu_hz=200.0,
    image_width=640,
    limits=Limits(wrong=0.0),
)
