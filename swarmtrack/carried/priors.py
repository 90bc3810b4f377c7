"""Priors, noises and limits of the own place by teammates, by what they are about.

Units are in the names: `_s`, `_m`, `_rad`; `_SIGMA` is one standard deviation; `_SQRT_S` per root of a second, of a
random walk. Where nothing else is said, a value was chosen by hand and held against `swarmtrack bench carried`.
"""

import math

# Own motion where no autopilot measures it, beside what tilts say of it: gusts change it by 0.3 m/s
# within a second. A velocity that forgets itself, one sigma per axis.
OWN_SPEED_SIGMA_M_S, OWN_SPEED_LASTS_S = 0.87, 15.0
# What of a push lasts for so long is drag, wind, or an error of the attitude; from one attitude to another that comes
# later than this, nobody knows it; nor by a tilt whose cosine is smaller.
STEADY_PUSH_S, PUSH_KNOWN_S, TILT_PUSHES_LEAST = 5.0, 0.5, 0.5
# Of an autopilot's position, from one comparison to the next.
OWN_PLACE_WHITE_M = 0.04
# How the error of a sound position walks, an autopilot's or a teammate's; and that of a false one, beside its drift.
PLACE_WALK_M_SQRT_S, ADRIFT_WALK_M_SQRT_S = 0.01, 0.04
DRIFT_SIGMA_M_S, DRIFT_LASTS_S = 0.4, 30.0
# How a heading's error walks, a gyro without a compass; and a tilt's. No heading is known better at first, of a
# teammate; nor a tilt.
TURN_WALK_RAD_SQRT_S, TILT_WALK_RAD_SQRT_S = math.radians(0.1), math.radians(0.02)
TEAMMATE_TURN_SIGMA_RAD, TEAMMATE_TILT_SIGMA_RAD = math.radians(2.0), math.radians(0.5)
# ln: how the lasting error of a box's width walks.
WIDTH_WALK_SQRT_S = 0.005

# Of rays, white: what attitudes add to a detection's own noise from one comparison to the next.
OWN_RAY_WHITE_RAD, REPORTED_RAY_WHITE_RAD = 0.004, 0.010
# Of a reported ray: so much of its stated sigma is its heading's, which is a state here.
REPORTED_RAY_LASTING_RAD = 0.035
# By how much a teammate's rays are late, or early: its clock, and its camera's.
RAY_LATE_SIGMA_S = 0.1
# Comparisons of one camera's scans: a track's error lasts about as long.
COMPARED_EVERY_S = 0.25
# A report farther from the last scan than this is of another time; within it the own velocity is carried over, and
# changes by the acceleration, one sigma.
REPORT_NEAR_S, REPORT_ACCELERATION_M_S2 = 1.5, 1.5
# m per axis: a teammate that knows its place no better holds nobody. One that is itself carried errs alike for seconds.
ANCHOR_VAGUE_M, ANCHOR_CARRIED_LASTS_S = 2.0, 5.0
# Teammates in the filter, whose cost grows with the fourth power of them: more hold a place hardly better.
ANCHORS_MOST = 6
# A ray to whom it says.
P_RAY_SURE = 0.9
# Nearer than this no ray counts; where the own place is known worse than by this share of the distance, a ray is
# compared in metres beside it, which is linear, and not as an angle.
NEAREST_ANCHOR_M, VAGUE_SHARE = 0.5, 0.4

# Whose word is false: the rate of each, and how soon it is right again; and the least log likelihood ratio of one
# measurement.
FALSE_PER_S, RIGHT_AGAIN_S = 1.0 / 900.0, 30.0
# Before a drone suspects itself, so many rays must have fitted while names found all as configured with that
# probability; then it does from such a probability on that its own autopilot's word is false; below the least its error
# is known. It reports that it is adrift from this squared Mahalanobis distance on, if it is so far off; and is sound
# again once it has been nearer for so long.
FITTED_RAYS, P_SOUND, P_SUSPECT, P_CONFIGURED = 10, 0.02, 0.6, 0.5
ADRIFT_GATE, ADRIFT_LEAST_M, SOUND_AGAIN_S = 16.0, 0.5, 5.0
# s: a teammate whose own sight of us, or ours of it, is older holds us no more; of what has held us the place still is
# made for so long.
HELD_S, REPORTED_HELD_S, LEANS_S = 0.9, 1.3, 30.0
# s without a position of the autopilot, from which on it has none.
NO_POSITION_S = 0.4
