"""Margins, gains, gates and limits of formation flight, one section per estimator or law.

What a config may set is in `parameters`.
"""

import math

# Bounds of what a config may set.
LIMIT_BOUNDS = {
    "speed": (0.1, 5.0),
    "climb": (0.1, 2.0),
    "acceleration": (0.2, 5.0),
    # Never less than an acceleration may be; a fence asks for 2.5 m/s² at the highest speed.
    "evasion": (5.0, 20.0),
    "yaw_rate": (0.05, 1.5),
    "yaw_acceleration": (0.2, 10.0),
    "least_height": (0.5, 100.0),
    "fence_radius": (2.0, 500.0),
    "fence_height": (1.0, 100.0),
}

# Plan (`plan`): two slots are never nearer, whatever their heights. Places are kept to about half a metre.
SLOTS_LEAST_APART_M = 2.0
# Of the half view: beyond it a reference is lost in the first gust.
REFERENCE_VIEW_SHARE = 0.8
# A drone tilts to accelerate, and its camera with it. Rounded, for a margin (`geometry.geodesy` has the standard one).
TILT_GRAVITY_M_S2 = 9.81
# Drones from the leader on: the last of four in a row swings more than twice as far as the first.
LONGEST_CHAIN_LINKS = 3
# Of the distance, by size: with 35 % every third flight lost a follower, with 15 % none did.
LARGEST_SIZE_ERROR = 0.12
# Neighbours at one height that do not see each other came nearer than 1.5 m in 9 of 40 flights; with 1 m between their
# heights in none.
UNSEEN_NEIGHBOURS_M, ONE_HEIGHT_M = 6.0, 0.5
# A leader that covers its distance to a follower in less is upon it before the follower knows.
LEADER_GAP_S = 3.0
# Length of the mean of the directions to the references, below which there is nowhere to turn to: of two, 145° apart.
LEAST_MEAN_DIRECTION = 0.3

# Inputs (`formation`, `setpoint`): a pose, the gyro or a scan that is older tells nothing of now.
OLDEST_POSE_S, OLDEST_GYRO_S, OLDEST_SCAN_S = 0.2, 0.3, 1.0
# Of a place that is known worse the fence means nothing; and a height that is known worse keeps nobody apart from who
# flies beside it: the height above a reference counts then, as measured.
VAGUEST_OWN_PLACE_M, VAGUEST_OWN_HEIGHT_M = 5.0, 1.0
# So long after its heading stepped a drone does not fly by it.
HEADING_SETTLES_S = 3.0
# What a busy computer or link delays for a moment: only where it lasts so long it costs the references their trust.
LATE_INPUT_LASTS_S = 0.5
# Who seems to be beyond could not be seen.
FARTHEST_SEEN_M = 1e3
# From the team frame's origin, and speed: no drone is beyond.
FARTHEST_FROM_ORIGIN_M, FASTEST_OWN_SPEED_M_S = 1e6, 60.0
# A step of time is never longer, of the law and of the model it is compared with.
LONGEST_TIME_STEP_S = 0.3

# References (`references`): a name comes in when it was surer than the parameters' `sure` for so long.
REFERENCE_ENTRY_S = 1.0
# A track that was flown by before is known: its name comes back at the first probability, and one that is flown by
# goes out below the second.
REFERENCE_KNOWN_PROBABILITY, REFERENCE_DOUBTED_PROBABILITY = 0.95, 0.9
# Without a detection for so long, where it is is not known well enough any more.
REFERENCE_UNSEEN_S = 1.5
# Of ln(range): a range that is known no better is none.
REFERENCE_VAGUE_LOG_RANGE = 0.5
# A reference that is this much elsewhere than it was expected is another drone.
REFERENCE_JUMP_M, REFERENCE_JUMP_M_S = 2.0, 3.0
# So long the nose is kept to where it was last seen.
REFERENCE_NOSE_KEPT_S = 4.0

# Law (`law`, `formation`): nobody's place [m] or velocity [m/s] is known better, one sigma.
STATE_LEAST_SIGMA = 0.05
# With this time constant the last command fades, and then it is over. Who brakes harder tilts its camera away from what
# it has just lost.
COMMAND_FADES_S, COMMAND_FADED_S = 1.0, 2.0
# 1/s, on the error of the height, of the heading, and on the room that is left up or down where somebody is about to
# collide.
HEIGHT_GAIN_PER_S, YAW_GAIN_PER_S, ESCAPE_GAIN_PER_S = 0.8, 1.5, 3.0
# Nearer to its height than this a drone may fly level.
AT_HEIGHT_M = 0.3
# The sweeps of the barrier end so near to what they look for; farther off there is nothing to be found.
BARRIERS_CONTRADICT_M_S = 0.05
# So far from its slot a drone is led by whom it keeps clear of; who holds, from where it began to. And within so long
# it is back, or what keeps it off is something else.
LED_MOST_ASIDE_M, LED_BACK_WITHIN_S = 12.0, 10.0

# Whom to keep clear of (`obstacles`): beyond the clearance, who is farther away need not be kept clear of.
OBSTACLE_WATCHED_M = 6.0
# Sigmas of ln(range) that somebody may be nearer than it seems; a range that is not known at all counts as 0.6.
OBSTACLE_NEARER_SIGMAS, OBSTACLE_VAGUEST_LOG_RANGE = 2.0, 0.6
# At most, to a drone that is carried: with the clearance this is less than slots are apart.
OBSTACLE_CARRIED_NEARER_M = 1.0
# One sigma: nobody's speed is taken to be known worse.
OBSTACLE_VAGUEST_SPEED_M_S = 1.0

# Out of sight (`out_of_sight`): so long somebody is remembered.
OUT_OF_SIGHT_REMEMBERED_S = 3.0
# One sigma: how somebody may change its velocity meanwhile.
OUT_OF_SIGHT_ACCELERATION_M_S2 = 0.3
# Who is seen so near to where somebody was expected is that one, on another track.
OUT_OF_SIGHT_SAME_M = 2.0

# Barrier (`barrier`), 1/s: how fast the distance left may be used up. Faster, a camera that is 150 ms late sees too
# late who comes.
BARRIER_GAMMA_PER_S = 0.5
# Of the other's speed away from us: as much is relied on.
BARRIER_TRUSTED_AWAY = 0.8
# Who moves slower, comes later, or passes farther off needs no step aside; and the longest step.
COMING_SPEED_M_S, COMING_WITHIN_S, PASSING_M, SIDESTEP_SPEED_M_S = 0.5, 4.0, 3.0, 2.0
# Who passes nearer comes straight on.
STRAIGHT_ON_M = 0.4
# So little a sweep changes when it has found the nearest point.
BARRIER_SWEEPS, BARRIER_TOLERANCE_M_S = 25, 1e-6

# Squeezed (`squeezed`): from so far below t is projected. Less of it follows the goal, at the cost of t. With these the
# worst closing speed is the least in nearly all of random squeezes, and 0.2 m/s above it in the worst.
SQUEEZE_REACH_M_S = 20.0
# So little a sweep changes when it has found the answer.
SQUEEZE_SWEEPS, SQUEEZE_TOLERANCE_M_S = 40, 1e-3

# Escape (`escape`): time until a collision.
COLLISION_WITHIN_S = 1.0
# So near two drones touch, with what a camera does not know of a distance; and who passes farther off than this does
# not collide.
COLLISION_CONTACT_M, COLLISION_MISSES_M = 1.0, 1.5
# Of its own slot's height it leaves so much, and to other slots' heights it keeps so far.
ESCAPE_MOST_M, ESCAPE_APART_M = 1.5, 0.5
# Somebody this much higher or lower is given way to on the other side; else the side with more room counts.
ESCAPE_LEVEL_M = 0.3
# Off its slot's height: whoever has begun to give way goes on.
ESCAPE_BEGUN_M = 0.05

# Divergence (`divergence`): first-order lag, that of an ArduPilot and of a PX4 as measured (`lab/world/response.py`:
# 0.6 to 0.8 s after a step of 1.5 m/s) and the 0.15 s over which a velocity is measured; accelerations level and
# vertical, the slower of both.
MODEL_LAG_S, MODEL_LEVEL_M_S2, MODEL_VERTICAL_M_S2 = 0.8, 2.1, 1.17
# Over which the difference is averaged.
DIVERGENCE_MEAN_S = 2.0
# Of the speed: a PX4 in its simulator falls short by 0.3 of it at first, by drag that its integral takes up within
# seconds: half of that is left on the average.
DIVERGENCE_SHORTFALL_SHARE = 0.15
# Of how far what it is told is from how it flies, averaged likewise: an autopilot at the limits of its acceleration and
# jerk is modelled that badly.
DIVERGENCE_DEMAND_SHARE = 0.5
# A larger difference is reported; a smaller one than the second ends the report, once it has lasted so long.
DIVERGENCE_REPORTED_M_S, DIVERGENCE_AGREES_M_S, DIVERGENCE_AGREES_S = 0.6, 0.3, 3.0
# So much farther off its slot within so long, while it was told to come nearer by so much; and so long it holds then,
# as who holds learns nothing new of it.
DIVERGENCE_FARTHER_M, DIVERGENCE_WITHIN_S, DIVERGENCE_NEARER_M, DIVERGENCE_HOLDS_S = 1.0, 5.0, 2.0, 10.0

# Drift of heights (`heights`): by how much the constant may differ from the first sight; an honest barometer wanders by
# so much, one sigma.
HEIGHT_CONSTANT_SIGMA_M, HEIGHT_RATE_SIGMA_M_S = 5.0, 0.05
# m/s per √s: by which the rate of a drift changes: 0.1 m/s within 10 s.
HEIGHT_RATE_WALK_M_S_SQRT_S = 0.03
# An autopilot's tilt is off by so much, for so long; and so long the error of a distance stays the same.
TILT_ERROR_RAD, TILT_ERROR_LASTS_S, RANGE_ERROR_LASTS_S = math.radians(1.0), 20.0, 30.0
# A drift is reported from here on, and until it is less again; and it is surer than so many sigmas.
HEIGHT_DRIFT_REPORTED_M, HEIGHT_DRIFT_GONE_M, HEIGHT_DRIFT_SIGMAS = 0.5, 0.35, 3.0
# A single sight that is farther off is a wrong box; where all are for so long, a height has leapt.
HEIGHT_GATE_SIGMAS, HEIGHT_LEAP_AFTER_S = 4.0, 1.0
# A height above a reference is measured once it is known so well. So many sigmas the own height may be off; what is
# more is another's error.
HEIGHT_MEASURED_SIGMA_M, HEIGHT_CORRECTED_SIGMAS = 0.4, 3.0
# Without a sight for so long a drift is neither known nor reported any more.
HEIGHT_DRIFT_STALE_S = 30.0
# Against a teammate that drifts less than this the own height is right, and another's is wrong.
HEIGHT_AGREES_M = 0.25
# No height is measured better; and no teammate that is seen is farther, and no height more wrong.
HEIGHT_LEAST_SIGMA_M, HEIGHT_FARTHEST_M = 0.01, 1e4

# Own flight (`own_flight`): an older measurement of the range finder does not describe the ground that is below now.
GROUND_STALE_S = 1.0
# The latest codes; and half the span over which the velocity of a sway is taken.
OWN_CODES_KEPT, SWAY_DIFFERENCE_S = 32, 0.05
