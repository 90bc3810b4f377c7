"""Priors, gates, noises and limits of the motion estimators, one section per estimator.

Units are in the names: `_s`, `_m`, `_rad`, `_m_s` and so on; `_SIGMA` is one standard deviation. What bears none is a
ratio or a count.
"""

import math

import numpy as np

from swarmtrack.messages import Array

# Own motion (`ego`): the velocity is the slope of the poses over the last `EGO_VELOCITY_SPAN_S`.
EGO_VELOCITY_SPAN_S = 0.3
# Of an autopilot's position, from one pose to the next.
EGO_POSITION_JITTER_M = 0.02
# How fast a drone may be moving where no pose says so.
EGO_SPEED_SIGMA_M_S = 1.0
# Time constant with which one that has lost its place is expected to stop: then teammates hold it, or nobody knows.
EGO_FLIES_ON_S = 1.0
# Of a drone whose velocity, or attitude, was known a moment ago.
EGO_ACCELERATION_SIGMA_M_S2 = 1.0
EGO_TURN_RATE_SIGMA_RAD_S = 0.5
# Of a drone that hovers where it was put, by an autopilot that knows no position; and how far it tilts.
HOVER_POSITION_SIGMA_M = 0.3
HOVER_TILT_SIGMA_RAD = 0.05
# An estimator that finds its heading, or finds it again, jumps; a drone turns no faster than this between two poses
# that are compared.
YAW_JUMP_RAD, FASTEST_YAW_RATE_RAD_S, YAW_COMPARED_WITHIN_S = 0.2, 4.0, 0.5

# Leaps of a place (`leap`): one that moves farther than this from one look to the next has leapt. Where the velocity is
# known, one that is farther than this from where that leads.
LEAP_SPEED_M_S, LEAP_DISTANCE_M = 8.0, 0.5

# Exposures (`exposures`): a gyro that is silent for longer is not waited for.
GYRO_WAIT_S = 0.05

# Gyro (`gyro`): a step longer than this many usual steps is a gap. An autopilot that rounds 333 Hz to whole
# milliseconds alternates between 2.5 and 5 ms (1.7 usual steps) without losing anything; one lost sample is 2.
GYRO_GAP_STEPS = 1.9
# Nothing is known of an angle: uniform over a turn. And of a rate, per axis, until a camera without a gyro has seen two
# images: most drones yaw no faster than 90 degrees a second.
UNKNOWN_ANGLE_VARIANCE_RAD2 = math.pi**2 / 3
UNKNOWN_RATE_VARIANCE_RAD2_S2 = 1.0
# Squared distance of a rotation by images from the gyro's, over its variance per axis: three axes, five sigmas.
VISUAL_TURN_GATE = 3 * 25.0

# Gyro bias (`gyro_bias`): time between attitudes that are used, and how long an attitude's error lasts.
BIAS_ATTITUDE_PERIOD_S = 0.2
BIAS_ATTITUDE_ERROR_LASTS_S = 1.0
# Of a gyro that nobody calibrated since it warmed up.
BIAS_PRIOR_SIGMA_RAD_S = 0.05
# rad/s/√s: how fast a bias changes as the board warms up.
BIAS_RANDOM_WALK_RAD_S_SQRT_S = 1e-4
# No autopilot's attitude is better, whatever it says.
BIAS_ATTITUDE_LEAST_SIGMA_RAD = 1e-3
# Squared residuals over their variance, of three axes; and attitudes in a row outside of it that are a jump.
BIAS_RESIDUAL_GATE = 3 * 16.0
BIAS_JUMP_ATTITUDES = 5
# A bias that is known so well is taken off.
BIAS_USED_SIGMA_RAD_S = 1e-3

# Heading steps (`heading`): so long after take-off the autopilot has aligned its heading in flight.
HEADING_ALIGNED_AFTER_S = 20.0
# From where a drone was first, in m and in standard deviations of its position: that far off it flies, where its
# autopilot does not say so.
TAKE_OFF_DISTANCE_M, TAKE_OFF_SIGMAS = 2.0, 5.0
# A smaller step is no news, the compass alone brings as much.
HEADING_STEP_RAD = math.radians(1.0)
# Attitudes before and after a step, whose means are compared.
HEADING_STEP_ATTITUDES = 5
# An attitude may be so much older or younger than its stamp, by filters and by the clock.
HEADING_ATTITUDE_LAG_S = 0.03
# What a gyro may read at rest before its bias is known; and the gyro's error of scale, of the angle turned.
HEADING_GYRO_BIAS_RAD_S = 0.02
HEADING_GYRO_SCALE_ERROR = 0.02
# Standard deviations of a mean's error that are no step.
HEADING_STEP_SIGMAS = 4.0
# A drone at rest: its gyro scatters by less, within a window, and reads no more than a bias. Simulated and live
# autopilots on the ground with motors off: 0.002 to 0.005 rad/s.
REST_GYRO_SIGMA_RAD_S, REST_WINDOW_S = 0.01, 0.25
# Its heading is taken as the mean of so many attitudes, and rays are turned along with it by no less at once.
REST_HEADING_ATTITUDES, REST_HEADING_STEP_RAD = 10, math.radians(0.5)
# Between two attitudes; a step within a longer gap cannot be told from a turn.
HEADING_LONGEST_GAP_S = 0.5
# Between two pieces of news: each costs the team an announcement.
HEADING_NEWS_PERIOD_S = 10.0

# Heights on the ground (`ground_heights`): geoids are tens of metres from the ellipsoid; and how steep a field is at
# most.
GROUND_HEIGHT_LEAST_M, GROUND_HEIGHT_SIGMAS, GROUND_STEEPEST_SLOPE = 5.0, 4.0, 0.2

# Bearing filters (`bearing_filters`): squared innovations over their variance, under whichever assumption suits best;
# and the step of the gate's own scale, for each innovation.
BEARING_GATE = 16.0
BEARING_GATE_SCALE_STEP = 0.05
# rad²/s³ by rad² of a bearing's variance.
BEARING_AGILITIES: Array = 430.0**2 * np.array([1e-4, 1e-3, 1e-2, 1e-1])
# Of a target that is new.
BEARING_RATE_SIGMA_RAD_S = 0.2
# Detections in a row, until then clutter is as likely.
BEARING_ESTABLISHED_HITS = 3
# Without a detection for longer, the target is followed from the start again.
BEARING_LONGEST_LAPSE_S = 0.5
# A gap in the gyro's samples; nothing is known across a larger one.
BEARING_MAX_TURN_VARIANCE_RAD2 = 3e-3**2
# Targets that are followed, and detections of a scan that are used.
BEARING_MAX_TARGETS = 8
BEARING_MAX_DETECTIONS = 24
# Of the variances: a simulation without noise is no reason to divide by zero.
BEARING_LEAST_SCALE = 1e-9

# Time offset of the camera (`time_offset`), by bearings beside the gyro: span searched about the start value, and the
# grid's step. A rotation of 5 Hz still is a parabola about its minimum.
OFFSET_REACH_S = 0.15
OFFSET_GRID_STEP_S = 0.01
# Steps to either side over which slopes are taken: fewer let the gyro's noise in.
OFFSET_SLOPE_STEPS = 2
# Evidence loses all but 1/e of its weight in so long, and is not worth the work after so long.
OFFSET_EVIDENCE_FADES_S = 60.0
OFFSET_EVIDENCE_FORGOTTEN_S = 3.0 * OFFSET_EVIDENCE_FADES_S
# One block of evidence: about a manoeuvre. With fewer components of innovations its scale is anything.
OFFSET_BLOCK_S = 2.0
OFFSET_BLOCK_LEAST_COMPONENTS = 8.0
# By which a block may err beyond its noise: from less than any estimate's own σ to as much as is searched. Each is as
# likely as the next before the flight.
OFFSET_BLOCK_ERRORS_S: Array = np.geomspace(6e-5, 64e-3, 11)
# Log-likelihood below the best, down to which an offset's gates stay open.
OFFSET_LIKELY_LOG_RATIO = 30.0
# Instead of a division by zero.
OFFSET_LEAST_INFORMATION = 1e-300
# By then the gyro has passed whatever may be asked of it, early stamps included; and scans that wait for it, more only
# where the stamps jump.
OFFSET_GYRO_WAIT_S = 0.05 + 2.0 * OFFSET_REACH_S
OFFSET_MAX_WAITING_SCANS = 64
# An offset that is known so well is used; and s of correction for each second.
OFFSET_USED_SIGMA_S = 3e-3
OFFSET_SLEW = 0.1
# Between two estimates.
OFFSET_ESTIMATE_PERIOD_S = 0.5
# Little less than if all that are searched were as likely.
OFFSET_UNKNOWN_SIGMA_S = 0.5 * OFFSET_REACH_S
# Grid points at either end where a minimum is none.
OFFSET_EDGE_POINTS = OFFSET_SLOPE_STEPS + 1

# Hand-eye calibration (`hand_eye`): span searched to either side, and the search's two grids: rotations by hand stay
# below 5 Hz.
HAND_EYE_REACH_S = 0.3
HAND_EYE_COARSE_STEP_S, HAND_EYE_FINE_STEP_S = 0.02, 0.005
# Over which the slope by the offset is taken: less lets the gyro's noise in.
HAND_EYE_SLOPE_STEP_S = 0.005
HAND_EYE_ITERATIONS = 12
# Cauchy's constant of the weights: 95 % efficient for normal noise.
HAND_EYE_CAUCHY = 2.385
# Errors within one block go together; and draws of the blocks, for the sigma (bootstrap).
HAND_EYE_BLOCK_S = 1.0
HAND_EYE_BLOCK_DRAWS = 300
HAND_EYE_LEAST_TURNS = 20
# A simulation without noise is no reason to divide by zero.
HAND_EYE_LEAST_SCALE_RAD = 1e-9

# Agreed sway (`sway`), a protocol: all drones of a team compute with these same numbers.
SWAY_AMPLITUDE_M = 0.25
SWAY_SLOWEST_HZ, SWAY_FASTEST_HZ = 0.20, 0.55
SWAY_LASTS_S = 8.0
# At either end, in which the sine grows and fades: at most 0.9 m/s and 3.7 m/s² at 0.55 Hz.
SWAY_EASE_S = 1.5
# s of UTC: a sway begins at a multiple of it, so clocks that are off by seconds still agree on which.
SWAY_BEGINS_EVERY_S = 10.0
# By how much two drones may differ in when a switch was thrown, by their clocks and radios.
SWAY_SWITCH_DELAY_S = 1.0
# Drones of a team in which neighbours come less than three quarters of a swing apart while a code lasts.
SWAY_LARGE_TEAM = 5
