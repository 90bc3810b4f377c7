"""Priors, gates and limits of what joins several cameras, one section per estimator."""

import math

# Fields of view (`field_of_view`): halvings of the way from the middle to the border, to a thousandth of a picture; and
# points on each side of the picture.
BORDER_HALVINGS = 12
OUTLINE_POINTS_PER_SIDE = 8

# How the picture is turned (`picture_turn`): evidence with one scale, and the least components of innovations of which
# there is one.
PICTURE_BLOCK_S, PICTURE_BLOCK_LEAST_COMPONENTS = 1.0, 8.0
# Between two verdicts.
PICTURE_VERDICT_PERIOD_S = 0.3
# Evidence loses all but 1/e of its weight in so long, and is forgotten after so long.
PICTURE_EVIDENCE_FADES_S, PICTURE_EVIDENCE_FORGOTTEN_S = 60.0, 180.0
# Of the own turn, either of which must be exceeded: the direction of a teammate 4 m away changes so when that flies
# past at 1.6 m/s, or brakes with 2 m/s².
PICTURE_TURN_RATE_RAD_S, PICTURE_TURN_ACCELERATION_RAD_S2 = 0.4, 0.5
# Share of these from which on, and time for which after it, targets are followed: nothing is to be learned in a hover.
PICTURE_STIRS_SHARE, PICTURE_STIRS_S = 0.3, 0.5
# Between two scans that are used: drones turn slowly.
PICTURE_SCAN_SPACING_S = 0.05
# Log-likelihood by which another mounting leads when it is reported, in so many blocks by so much; and by which the
# configured one leads the first of the others when nothing more is to be learned in this flight.
PICTURE_TURNED_LEAD, PICTURE_TURNED_BLOCKS, PICTURE_BLOCK_LEAD, PICTURE_SETTLED_LEAD = 30.0, 2, 8.0, 50.0
# The second detection of a target counts: how far it has come, nobody has had a chance to learn.
PICTURE_LEAST_HITS = 1

# Tracks over several cameras (`rig`): a scan that was exposed longer before a track's last one does not take it over.
TAKEOVER_LONGEST_BACK_S = 0.3
# A track must have been with a camera so long to tell how the next one is turned against it; and a camera must not have
# detected it for so long, to have lost it to another one.
CAMERA_SETTLED_S = 0.7
# Of an airframe whose box is as wide; and the distance where there is no box.
SEAM_DRONE_SPAN_M, SEAM_UNKNOWN_DISTANCE_M = 0.45, 5.0
# Relative, one sigma: a box tells a distance within a factor.
SEAM_DISTANCE_SIGMA = 0.5
# Nobody is nearer.
SEAM_NEAREST_M = 0.5
# Between two detections of one camera, with one of another between them, that are compared.
COMPARED_WITHIN_S = 0.7
# By how much a teammate's way between the two may bend, one sigma, as of one 5 m away that brakes with 1 m/s².
COMPARED_BEND_RAD_S2 = 0.2
# Focal lengths off the axis: what another camera sees farther aside is not searched for in this one's picture.
SEAM_MOST_ASIDE = 10.0
# Of the picture, on each side: whoever is foretold so far inside is surely inside; and scans that do not show it.
EXPECTED_BORDER_SHARE, EXPECTED_MISSED_SCANS = 0.12, 8
# Scans that did not show it, of a track that ended meanwhile: a slow camera has no eight before that.
EXPECTED_ENDED_SCANS = 3
# A track that a camera shows with this probability at least may be what it detects, and with that one surely is seen.
MAY_BE_SEEN_PROBABILITY, SURELY_SEEN_PROBABILITY = 0.01, 0.95
# Outside every picture.
OUTSIDE_EVERY_PICTURE_PX = 1e6
# Tracks of whom it is kept when they came; most have ended by then.
MOST_REMEMBERED_TRACKS = 200

# Turn between two cameras (`seams`): no seam is known better. What a crossing adds beside noise lasts as well: lenses,
# parallax, boxes off centre.
SEAM_LEAST_SIGMA_RAD = math.radians(0.15)
# Squared Mahalanobis distance of a residual, in two dimensions: beyond it something else was detected.
SEAM_RESIDUAL_GATE = 16.0
# A turn is news once so many crossings tell it, it is so large, and by crossings alone is not zero by so many squared
# sigmas.
SEAM_TURN_LEAST_CROSSINGS, SEAM_TURN_LEAST_RAD, SEAM_TURN_GATE = 4, math.radians(0.5), 25.0
# Cameras do not fit together once so many targets that left one did not come into the other, for each that did.
SEAM_LOST_TARGETS, SEAM_LOST_PER_CROSSING = 4, 4
# Variance of a detection and of what was foretold, beside what they say of themselves.
SEAM_LASTING_PX2 = 1.0
# Without a comparison for so long, or so far from where it began, a stay is over.
STAY_ENDS_AFTER_S, STAY_REACH_PX = 0.6, 60.0
# Comparisons that are worth a crossing.
COMPARISONS_PER_CROSSING = 15
# Variance: a shift is known no better; boxes have edges of whole pixels.
SEAM_LEAST_SHIFT_PX2 = 0.1

# Stuck cameras (`stuck`): two pixels or so. A camera that has turned by more shows no target at the very same pixel.
STUCK_LEAST_TURN_RAD = 5e-3
# Nor does one that has not turned, for so long.
STUCK_AFTER_S = 1.0
