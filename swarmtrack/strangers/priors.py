"""Priors, gates and limits of the strangers that a team locates together."""

# --- A stranger (`ray_filter`): speed per axis, m/s, level and upright, and how it changes: a visitor crosses at 2 to
# 5 m/s, and a hobby quadrotor turns with 1 to 2 m/s².
VISITOR_SPEED_M_S, VISITOR_CLIMB_M_S = 3.0, 1.0
VISITOR_ACCELERATION_PSD_M2_S3 = 0.5
# Its distance where no box tells it, m and sigma of the logarithm.
VISITOR_DISTANCE_M, VISITOR_DISTANCE_SIGMA_LN = 12.0, 0.8
# Sigmas of ln(size): of a drone of unknown span, with what lasts of a detector's boxes (0.6 and 0.19); and of one box:
# these wander by 0.13 within 2 s, so that at 7 Hz only one in thirty is news.
VISITOR_SIZE_SIGMA_LN, VISITOR_BOX_SIGMA_LN = 0.63, 0.7
# Nearer than this, the point that directions are counted from is moved back by so much, m, where the range is known so
# well, ln.
ANCHOR_LEAST_M, ANCHOR_STEP_M, ANCHOR_SIGMA_LN = 3.0, 10.0, 0.15

# --- What lasts of an observer's errors, s: it is forgotten within this time. An autopilot's heading error lasts until
# it aligns itself, a receiver's for minutes.
OBSERVER_ATTITUDE_LASTS_S, OBSERVER_PLACE_LASTS_S = 60.0, 120.0
# Of a ray from scan to scan, rad: of the own attitude, and of a box's centre against its drone.
RAY_WHITE_RAD = 4e-3
# Of a ray to a teammate, m: from its camera to the middle of its box, and how it flew between two reports.
MATE_CENTRE_SIGMA_M, MATE_BEND_M_S2 = 0.1, 0.5
# Squared Mahalanobis distance, two degrees of freedom, 99.98 %.
RAY_GATE = 17.0
# The same of one degree of freedom.
SIZE_GATE = 14.0
# Gauss-Newton steps of one ray, ln(range) that each may go, and when the last one was small.
RAY_STEPS, RAY_STEP_MOST_LN, RAY_STEP_SMALL = 6, 0.7, 0.02
# ln: of a range that is known better the size of a box shows nothing more.
SIZE_SHOWS_SIGMA_LN = 0.15
# cos: a ray that is turned farther from where it is expected is of another target, wherever along its ray that is.
RAY_LEAST_COSINE = 0.05

# --- Rays to teammates (`mates`): how many teammates, and how many rays are kept.
MOST_MATES, MATE_TURNED_SIGHTS_KEPT = 64, 64
# s between two reports that a teammate's place is interpolated in; m/s, how it flies on; m, nearer its box is none.
MATE_BRACKET_S, MATE_SPEED_M_S, MATE_NEAREST_M = 2.0, 1.0, 1.5
# Of a sighting that shows a heading.
MATE_LEAST_PROBABILITY = 0.95
# s between two of one observer to one teammate that do.
MATE_SIGHT_PERIOD_S = 1.0
# What lasts of the attitude of an observer that does not state it, rad: tilt and heading.
MATE_TILT_RAD, MATE_HEADING_RAD = 0.0087, 0.026

# --- Who may take part (`located`): observers and strangers at a time, and rays of one report.
MOST_RAY_OBSERVERS, MOST_STRANGERS, MOST_RAYS_OF_REPORT = 8, 8, 4
# A report that is vaguer is not used: m, rad and s; later or earlier than this, s.
VAGUE_OBSERVER_M, VAGUE_OBSERVER_RAD, VAGUE_RAY_S, LATE_RAY_S, EARLY_RAY_S = 10.0, 0.3, 0.5, 2.0, 0.5

# --- Tracks (`sights`): probability of being none of the teammates, of one whose rays are used, and of one that keeps
# its number meanwhile. Only a track that is foreign may claim a number.
P_STRANGER_RAY, P_STRANGER_KEPT = 0.9, 0.5

# --- Numbers (`located`): 100 · the observer's ID + its own count.
NUMBERS_OF_OBSERVER = 100
# s that a track fits a stranger before it takes that number, and before it claims one; and before it gives up a number
# for a lower one, or because its rays do not fit.
FITS_FOR_S, CLAIMS_AFTER_S, CLAIMS_AT_LAST_S, GIVES_WAY_AFTER_S, MISFITS_FOR_S = 0.5, 0.7, 2.0, 1.2, 1.0
FITS_LEAST_RAYS = 3
# s between two own rays that are used: of more the lasting errors are the same.
OWN_RAY_PERIOD_S = 0.25
# Mean cost of the rays while they fit: its expectation is 2. And by so much, per ray, it must be less than with any
# other.
FITS_MOST_COST, FITS_MARGIN = 6.0, 3.0
# s without a ray after which a stranger is no more; and after which a ray is old, so that its observer counts no more.
STRANGER_LASTS_S, STRANGER_SEEN_S = 4.0, 1.0
# A stranger that is so near to where a teammate is, m and sigmas, may be that.
MAY_BE_MATE_M, MAY_BE_MATE_SIGMAS = 1.5, 3.0
# A stranger is kept clear of where its place is known to this share of its distance: one sigma of the worst axis.
BARRIER_STRANGER_SIGMA_LN = 0.3

# --- Claims by Remote ID (`claims`): how many, and s that the newest counts: these are broadcast once a second.
MOST_CLAIMS, CLAIM_LASTS_S = 32, 4.0
# Squared Mahalanobis distance, three degrees of freedom, 99.9 %; the least sigma of a claim; how its drone may turn.
CLAIM_GATE, CLAIM_LEAST_SIGMA_M, CLAIM_ACCELERATION_M_S2 = 16.3, 1.0, 2.0
# s that it fits a stranger, or that it cannot be true, before that is reported.
CLAIM_FITS_AFTER_S, CLAIM_FALSE_AFTER_S = 1.0, 2.0
# px: as wide as a usual drone's box must be for a detector to find it; and so far from the border or a track.
CLAIM_SEEN_PX, CLAIM_MARGIN_PX = 12.0, 20.0
# Sigmas around a claimed place that must be in view, and empty.
CLAIM_SIGMAS = 2.0
