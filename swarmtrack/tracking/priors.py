"""Priors, gates and limits that all trackers share, or one has for itself, one section per estimator.

What a config may set is in `parameters`. Probabilities and ratios bear no unit.
"""

import math

import numpy as np

from swarmtrack.messages import Array

# Largest lag of the smoothed output that a config may ask for.
MAX_LAG_S = 10.0

# Existence (`lifecycle`): no track is as certain as 1.
MAX_EXISTENCE = 1.0 - 1e-6
# A detector misses in bursts (a drone in front of a tree, behind another), which the recursion takes for proof of
# absence. Existence of a confirmed track stops here, so that one clear detection brings it back; time ends it, not
# misses.
MIN_CONFIRMED_EXISTENCE = 0.05
# Existence of a missed track: rather hidden or gone than there.
LOST_BELOW_EXISTENCE = 0.1
# Focal lengths: in the tangent plane 80 degrees off the axis, in a wide lens' stereographic one 141. A pixel further
# out covers next to nothing, and every turn of the camera would multiply the covariance of what is there, without
# bound, until it comes back.
MAX_SLANT = 5.7
# Times the longer side of the image: who may be anywhere is nowhere.
MAX_SIGMA_IMAGES = 10.0
# Sigmas inside the image, from which on a double tells the probability from one no more.
SURELY_INSIDE_SIGMAS = 8.5

# Turn of the camera (`base`): a change of its rate from scan to scan, below which a clock 10 ms off moves nothing by
# half a pixel.
STEADY_RATE_CHANGE_RAD_S = 0.1

# Population (`population`): share of the old box size that a new detection leaves; boxes jitter, drones grow slowly.
BOX_SIZE_MEMORY = 0.8
# Side of a box that no detector told, in sigmas of its centre.
UNKNOWN_BOX_SIGMAS = 6.0
# Existence, after a detection, that says the track was there: clutter keeps nobody alive.
DETECTED_EXISTENCE = 0.997
# Of `max_coast_s`, that a doubtful detection is counted as older than it is.
DOUBTFUL_COAST_SHARE = 0.9
# For which a track may be off its own box: as long as the detector sees but a part of its drone.
BOX_JUMP_S = 0.25
# Of times that are sums of frame periods.
FRAME_TIME_ROUNDING_S = 1e-6
# Times the gate, in squared sigmas: up to here a detection may be the track's own although it seemed not to be.
OUTLYING_GATES = 4.0
# Looks that follow each other sooner are alike, and count for less.
INDEPENDENT_LOOK_S = 0.1
# What a look at once counts: a track that was told, and is seen at that very time.
REPEATED_LOOK_WEIGHT = 1e-6
# Looks over which the likeness is a mean.
LIKENESS_MEMORY_LOOKS = 30.0
# Log odds by which a mean is better or worse than it should be, for one look: one sigma of those of a real drone.
LIKENESS_SIGMA_LOG_ODDS = 0.5
# A tenth of a chance that a track made no detection is full doubt. Clutter is seldom better than that: it keeps nobody.
UNDETECTED_DOUBT_GAIN = 10.0
# Of the time since the last scan: who is hidden coasts for three times as long at most.
MOST_HIDDEN_SHARE = 2.0 / 3.0
# A probability of being in view that is as good as none.
OUT_OF_VIEW_PROBABILITY = 1e-9
# Of the direction of a track that is out of view: about the whole view of an ordinary lens. Beyond it, whatever comes
# into view might be taken for it.
HIDDEN_MOST_SIGMA_RAD = 0.7
# Off the axis of an ordinary lens, from which on a track that is out of view is kept on the sphere, and within which it
# is back in the tangent plane.
HIDDEN_FROM_RAD, HIDDEN_UNTIL_RAD = math.radians(70.0), math.radians(65.0)
# Share of its existence at birth, below which a tentative track ends.
FADED_BIRTH_SHARE = 0.05

# Sensor (`sensor_model`): sigmas of a box's side; beyond, it is that of a box around two drones.
BOX_SIZE_GATE_SIGMAS = 3.0
# The noise of detections of lower scores is not known.
LEAST_NOISE_SCORE = 0.33
# A smaller variance is not believed, and no covariance gets singular; likewise the correlation of u's error with v's.
LEAST_MEASUREMENT_VARIANCE_PX2 = 1e-6
MOST_MEASUREMENT_CORRELATION = 0.9999
# A detector that is surer than that is not believed.
SCORE_BOUNDS = (0.01, 0.99)
# What the configured clutter rate is worth: at most so many scans, for targets not yet found look like clutter, nor
# more than so many false detections, for where ten come with each scan the first one tells more than a guess.
CLUTTER_PRIOR_SCANS, CLUTTER_PRIOR_DETECTIONS = 20.0, 8.0
CLUTTER_MEMORY_SCANS = 200.0
# At most so many times the configured rate, or so many times less.
CLUTTER_BOUND = 10.0
# Likewise of the noise: after so many detections a new one counts for a quarter of a percent.
NOISE_PRIOR_DETECTIONS, NOISE_MEMORY_DETECTIONS = 20.0, 400.0
NOISE_BOUND = 10.0
# Share of detections that are off by more than their noise.
OUTLIER_SHARE = 0.05
# Of its longer side, one sigma: how far a box is off that is drawn round a drone and what stands behind it, or round a
# part of one.
MISDRAWN_BOX_SIGMA = 0.1

# Learned noise (`noise`): mean side of a box between one class of sizes and the next. A point is a class too: its side
# is NaN, which is sorted behind infinity.
NOISE_CLASS_SIDES_PX: Array = np.array([16.0, 32.0, 64.0, math.inf])
# Detections of a class after which an old one counts for 1/e.
NOISE_CLASS_MEMORY_DETECTIONS = 200.0
NOISE_CLASS_KEPT = 1.0 - 1.0 / NOISE_CLASS_MEMORY_DETECTIONS
# Standard deviation of the logarithm of R's true scale (sigma is told within a factor of 2), and of Q's.
LOG_R_PRIOR_SIGMA = math.log(4.0)
LOG_Q_PRIOR_SIGMA = math.log(10.0)
# Times the prior's information, from which on a scale is measured rather than configured.
MEASURED_SCALE_INFORMATION = 10.0
# Of variances. Below: the shipped detector is ten times better from frame to frame than it is configured to be
# (decision 21), and no drone hovers more quietly than with 0.06 m/s² for a second, which is a hundredth of the calm
# model's default.
R_SCALE_BOUNDS, Q_SCALE_BOUNDS = (0.01, 10.0), (0.01, 10.0)
# A box has edges of whole pixels.
PIXEL_SIGMA_PX = 0.25
# Of u, and of r in size: Winsor's limit, which costs 0.7 % in the mean.
WINSOR_LIMIT = 5.0
# Of Newton's method at most; one or two from the value before. A smaller step, of the logarithm, is none.
NOISE_NEWTON_STEPS = 8
NOISE_NEWTON_TOLERANCE = 1e-9

# Boxes that overlap (`occlusion`), of their mean side: two boxes whose centres are closer than that are hardly told
# apart. At 0.38 sides the shipped detector finds both in half the frames (`swarmtrack bench detection-noise`), and so
# does the model.
UNRESOLVED_SIDES = 0.45
# What is further apart is resolved, to one part in three thousand.
RESOLVED_SIGMAS = 4.0

# Consistency (`consistency`): at 7 Hz a quarter of a minute of one target, or four seconds of four; and with fewer
# there is no verdict.
NIS_WINDOW_DETECTIONS, NIS_LEAST_DETECTIONS = 100, 30
# The standard normal's 99.5 % quantile.
NORMAL_QUANTILE_995 = 2.5758293035489004
# Before the scan, of a track whose lone detection is taken for its own.
LONE_DETECTION_EXISTENCE = 0.95

# JPDAF (`jpdaf`): existence never reaches 0.
JPDAF_LEAST_EXISTENCE = 1e-12
# Of a confirmed track, below which it may be a double of another; and the squared distance, in the sigmas of two
# tracks, of which half of all pairs on one target are below 3.4.
JPDAF_DOUBLE_EXISTENCE, JPDAF_DOUBLE_GATE = 0.95, 4.0
# Share of all detections, from which on a scan counts as having detected a track.
JPDAF_DETECTED_SHARE = 0.5

# GM-PHD (`gmphd`): added to the diagonal of a correlation, positive definite to the computer, too.
GMPHD_CORRELATION_ROUNDING = 1e-9
# Of a detection as a target's, or a tentative track's claim: nothing is as certain, and doubles end at 709.
LARGEST_CLAIM_LOG_RATIO = 300.0

# MBM (`mbm`): a detection that the confirmed tracks take more surely than that is nobody else's.
MBM_LEAST_AVAILABLE = 1e-3
# Within so many two leaves of a track say the same.
MBM_SAME_LEAF_SIGMAS = 0.25
# Share of manoeuvres, where nobody knows how hard they are.
MBM_GENTLE_MANOEUVRE_SHARE = 0.9
# By which the gyro's noise moves a target from scan to scan; beyond it something was wrong.
MBM_ORDINARY_FLOW_PX = 1.0
# Of a track with all others: below it, nobody is near.
MBM_LEAST_OVERLAP = 1e-9

# Manoeuvres (`manoeuvre`): a mode's probability never underflows: nothing would bring it back, and 0 / 0 is next.
MANOEUVRE_LEAST_MODE = 1e-12
# Share of an acceleration's time, up to which the process noise is integrated: its closed form cancels.
MANOEUVRE_SHORT_STEP = 0.5

# Best matchings (`hypotheses`): partial ones kept at once, in multiples of the count wanted, and at least.
MATCHINGS_BREADTH, MATCHINGS_LEAST_BREADTH = 8, 100
# Relative: what sums of gains in another order differ by.
MATCHINGS_ROUNDING = 1e-9

# Marginals of matchings (`marginals`): rows open at once, 8192 sets, some milliseconds.
MARGINALS_MOST_OPEN_ROWS = 13
# Matchings up to which all are listed, 4 x 5 and 3 x 8: beyond, sweeping is cheaper.
MARGINALS_MOST_LISTED = 550
# Columns up to which all is swept as it comes, and up to which an order is not worth its time.
MARGINALS_SMALL, MARGINALS_UNORDERED = 9, 12
# Of a product of one ratio for each open row: a double ends at 709. And e to the second: nothing is more certain.
MARGINALS_LARGEST_EXPONENT, MARGINALS_LARGEST_LOG_RATIO = 600.0, 1e6
BELIEF_ITERATIONS, BELIEF_TOLERANCE = 200, 1e-6
# Beliefs below which pairs are left out of the sweep, the first that makes it narrow enough.
BELIEF_CUTS: Array = np.geomspace(1e-6, 0.51, 40)
# How much a pair lets on around a loop, from which on beliefs are not enough; where these are too many, the first of
# these with few enough rows open: 256 sets.
BELIEF_LOOP_LEAST, BELIEF_LOOP_WIDEST = 0.01, 8
BELIEF_LOOP_CUTS: Array = np.geomspace(0.015, 1.0, 12)
# Rows up to which all sets of them are kept: 256 sets; and those swept at once, which a cache holds.
MARGINALS_OF_EACH_MOST_ROWS, MARGINALS_OF_EACH_SETS = 8, 8192
# Rows of which a matrix of sets is cheaper than a step for each of them.
MARGINALS_OF_EACH_BY_MATRICES = 4

# Smoothing (`smoothing`): ten seconds at 60 Hz: beyond, the lag is shorter than it was configured.
SMOOTHER_MOST_SCANS = 600
SMOOTHER_SAME_INSTANT_S = 1e-9
# Keeps a prediction that is sure to the last digit invertible.
SMOOTHER_LEAST_COV: Array = 1e-9 * np.eye(4)
