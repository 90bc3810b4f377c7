"""Priors, gates and limits of the relative states and of what feeds them, one section per estimator."""

import math

# Distances (all estimators): nearer and farther is nobody; a guess that runs away ends here.
RELATIVE_NEAREST_M, RELATIVE_FARTHEST_M = 0.3, 300.0

# Airframes nobody told the span of: half are between 0.3 and 0.7 m (sigma of the logarithm).
USUAL_SPAN_M, USUAL_SPAN_SIGMA = 0.45, 0.6

# Prediction in log-range coordinates (`log_range`): times the variance of the own way along three axes; what moved by
# less tells nothing of ranges.
OWN_WAY_LEVER = 9.0
# Of forget_s: a step that is shorter uses the series.
WANDER_SHORT_STEP = 1e-2

# Filter (`states`): beliefs of scans are kept so long for what comes late; and a message may be so far ahead of the
# last scan.
BELIEF_HISTORY_S, MESSAGE_AHEAD_S = 1.0, 0.5
# Times the covariance: one ray inflates it by no more.
MOST_INFLATION = 100.0
# So long the box may be one around two drones.
ODD_BOX_LASTS_S = 1.0
# No drone is faster; its own frame was set again.
FRAME_RESET_SPEED_M_S = 50.0
# Of ln(range): a range that is known no better is none.
VAGUE_LOG_RANGE = 0.5
# Of a reported place, one sigma per axis: what does not last, and what lasts of the best.
REPORTED_PLACE_WHITE_SIGMA_M, REPORTED_PLACE_LASTING_SIGMA_M = 0.05, 0.1
# Of a reported velocity, one sigma per axis; and how much it changes while clocks are apart.
REPORTED_SPEED_WHITE_SIGMA_M_S, REPORTED_SPEED_CHANGE_M_S2 = 0.05, 1.5
# How far a drone whose own word is all that is known may be from there.
UNREPORTED_PLACE_SIGMA_M = 0.5
# Of a place, beyond which it tells no range.
VAGUE_PLACE_SIGMA_M = 3.0
# That a third drone's ray is to whom it says.
SURE_SIGHTING_PROBABILITY = 0.9

# Detections (`detected`): squared Mahalanobis distance of a track after the scan from the detection that it took, 4 σ.
TAKEN_DETECTION_GATE = 16.0

# Names that ended (`held_names`): a track is still whose it was for so long.
NAME_HELD_S = 3.0

# Boxes as measurements (`box_width`, `looks`). Of the width: a box that is padding for the rest tells no distance.
LEAST_DRONE_SHARE = 0.25
# A camera rolled by more sees no width of its own.
MOST_ROLL_RAD = math.radians(35.0)
# A box that is nearer to the border may be cut off.
WHOLE_BOX_BORDER_PX = 2.0

# Frames (`frames`): between two judgements of a teammate's frame, and how often in a row it must be otherwise before
# that is reported.
FRAME_JUDGED_EVERY_S, FRAME_JUDGED_TIMES = 1.5, 3
# What is worth a word.
FRAME_OFF_LEAST_M, FRAME_OFF_LEAST_RAD = 0.5, math.radians(4.0)
# Of two places that are compared: nobody reports where its camera is.
FRAME_PLACE_SIGMA_M = 0.1

# Heights (`heights`): a teammate's reports are kept so long; reports farther from the scan than this tell nothing of
# its height then.
HEIGHT_REPORTS_KEPT_S, HEIGHT_CARRIED_S = 3.0, 0.6
# Of a reported height, and of the own, from one moment to the next.
HEIGHT_JITTER_M = 0.05
# One sigma: by which a reported velocity may have changed since; and of a teammate that reports no velocity.
HEIGHT_ACCELERATION_SIGMA_M_S2, HEIGHT_SPEED_SIGMA_M_S = 1.0, 0.7

# Parallax of ghosts (`parallax`): what is beyond is far off; and what nobody is kept clear of.
PARALLAX_FAR_M, PARALLAX_REACH_M = 10.0, 7.5
# Of ln(width): what came from the one to the other has grown by this.
PARALLAX_GROWN_LOG_WIDTH = math.log(PARALLAX_FAR_M / PARALLAX_REACH_M)
# Time, looks, and bends, RMS across the ray: after so much it is reported. A drone that hovers sways by a tenth of a
# metre.
PARALLAX_LEAST_S, PARALLAX_LEAST_LOOKS, PARALLAX_LEAST_ACROSS_M = 1.0, 6, 0.3
# 1/s: who grows no faster, by one sigma, takes 16 s at least to come.
PARALLAX_GROWTH_PER_S = 0.06
# Of ln(width), the least sigma.
PARALLAX_LOG_WIDTH_SIGMA = 0.1
# Over which the fit forgets, and over which what has just been seen is averaged.
PARALLAX_FORGET_S, PARALLAX_RECENT_S = 20.0, 0.7
# Per axis: of the own attitude, from one look to the next.
PARALLAX_ATTITUDE_SIGMA_RAD = 0.006
# Of squared residuals over their variance: as large is their mean where the fit fits, and where it does of late.
PARALLAX_MISFIT, PARALLAX_RECENT_MISFIT = 2.0, 4.0
# So long a fit is remembered once its track has ended, if it had so many looks; and squared sigmas that a new track may
# be beside.
PARALLAX_REMEMBERED_S, PARALLAX_REMEMBERED_LOOKS, PARALLAX_SAME_PLACE_GATE = 15.0, 3, 9.0
# Cosine: seen at a larger angle from where it was seen first, the fit begins again.
PARALLAX_TURNED_COSINE = 0.5
# Sigmas that it may be nearer.
PARALLAX_NEARER_SIGMAS = 2.0

# Ranging radios (`range_watch`): so many in a row, over so long, are no chance.
RANGES_IN_A_ROW, RANGES_IN_A_ROW_S = 5, 1.0

# Tracks without a name (`metres`): per axis, no drone is taken to be calmer. One that has hovered for long and then
# comes straight on grows in the image, and no more; a filter that takes it for calm takes that for an error of its
# boxes.
STRANGER_LEAST_SPEED_M_S = 1.0
