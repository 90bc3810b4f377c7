"""Every prior, noise and rate of the team's posterior, by what it is about.

Units are in the names: `_s`, `_m`, `_rad`, `_per_s`; `_SIGMA` is one standard deviation, `P_` a probability. What bears
none is a ratio or a count. Where nothing else is said, a value was chosen by hand and held against the flights of
`swarmtrack bench misconfigured`.
"""

import math

# --- Own errors: one component of the mixture each, beside "as configured". ---

# The own heading is off: uniform over the circle, in cells.
P_HEADING_OFF = 0.04
HEADING_CELL_RAD = math.radians(6.0)
# Of a cell; and no autopilot's heading is known better than the least.
HEADING_CELL_SIGMA_RAD, HEADING_LEAST_SIGMA_RAD = math.radians(3.0), math.radians(2.0)
# With a heading that is off: by GPS the own path is where it is, and the rays alone are turned; without it the path is
# turned as well; and indoors, all headings of a team may be turned as one.
P_PATH_TRUE, P_PATH_TURNED, P_TEAM_TURNED = 0.45, 0.45, 0.10
# The own start is off: in rings around the stated one, of so many directions each.
P_START_OFF = 0.05
START_RINGS_M = (0.7, 1.5, 3.0, 5.0)
START_RING_DIRECTIONS = 8
# Of a component of a ring, as a share of its radius.
START_RING_SIGMA = 0.35
# All starts of the team were measured loosely; with the probabilities then of how far each is off, below.
P_STARTS_LOOSE = 0.02
P_LOOSE_START_OFF = (0.25, 0.55)
# Two drones stand on each other's pads, or everybody on the next one's.
P_PADS_PERMUTED = 0.06
# In a large team only drones whose pads are next to each other are taken for one another.
PADS_SWAPPED_WITH = 3
# Two faults at once: of headings the second is looked for in coarser cells, of starts on one ring.
COUPLED_HEADING_CELL_RAD, COUPLED_HEADING_SIGMA_RAD = math.radians(12.0), math.radians(5.0)
COUPLED_START_RING_M = 2.5
# In a larger team only swaps of the own pad are second faults.
COUPLED_PADS_ALL = 6
# Of a larger team than this, single faults of this drone are all that is looked for; and a heading as stated is looked
# for in fine cells, of such a width and sigma, within so much of what is stated.
SINGLE_FAULTS_FROM = 40
SHARED_HEADING_CELL_RAD, SHARED_HEADING_SIGMA_RAD = math.radians(0.6), math.radians(0.3)
SHARED_HEADING_WITHIN_RAD = math.radians(9.3)

# --- A teammate's errors. ---

TEAMMATE_HEADING_SIGMA_RAD = math.radians(2.0)
# Its start is worse than it says, by so much per axis, with such probabilities; its heading is off, by any angle.
START_OFF_SIGMA_M = (0.5, 2.5)
P_TEAMMATE_START_OFF = (0.10, 0.06)
P_TEAMMATE_HEADING_OFF = 0.02
TEAMMATE_HEADING_CELL_RAD, TEAMMATE_HEADING_CELL_SIGMA_RAD = math.radians(20.0), math.radians(7.0)
# The same of a teammate that says that it doubts its own pose.
P_DOUBTING_START_OFF, P_DOUBTING_HEADING_OFF = (0.2, 0.6), 0.15
# How much likelier that makes it that its pad is another's.
DOUBTING_PADS_RATIO = 20.0
# A start is a place on the ground: as a share of what is off to the side.
START_OFF_VERTICAL = 0.2
# Of any stated start, beside what is stated.
START_LEAST_SIGMA_M = 0.05

# All that a teammate sees has wrong names, of drones that are where others should be; or of any others.
P_RAYS_MISNAMED, P_RAYS_ANYWHERE = 0.05, 0.05
# Whatever they show, so likely is that they are all wrong.
P_FRAME_LEAST = 1e-6
RAYS_WEIGHED_EVERY_S = 1.0
# What it sees counts from such a probability of a name on, where places are known at most so much sooner or later; its
# drones fly as fast as that where its clock is unsure.
P_RAY_COUNTS, RAY_NEAR_S, RAY_M_S = 0.9, 0.5, 1.5

# Whoever knows no place is within this, per axis.
SOMEWHERE_SIGMA_M = 30.0

# --- Bearings and reported places. ---

# How far a teammate is from a place that it reports, slowly, m and rad/s, and white: the estimates of both autopilots
# walk. A live ArduPilot's walks by 2 cm RMS per axis, a PX4's by 5 to 18 cm, within a minute or two. The white part is
# what a curve through one report per second does not follow.
REPORTED_DEVIATION, REPORTED_WHITE_M = (0.2, 0.1), 0.1
# Of a place that teammates carry, rad/s.
CARRIED_BANDWIDTH_RAD_S = 1.0
# How far a teammate is from where it says that it moved, smoothly, m and rad/s, and white; the same of a code, and of a
# plan.
MOTION_DEVIATION, MOTION_WHITE_M = (0.05, 0.5), 0.04
CODED_DEVIATION, PLANNED_DEVIATION, AGREED_WHITE_M = (0.1, 1.5), (0.3, 1.0), 0.02
# A place is carried on from the last report, with its velocity for so long at most; the drone may accelerate by so much
# meanwhile.
CARRIED_MOST_S, CARRIED_M_S2 = 1.5, 1.5
# Of a teammate that has said nothing for longer, only a new track is compared with its last place: it waits or hovers
# there, give or take so much for each second, and not beyond a limit; half of them have left after so long. One that
# flew then is farther off.
PLACE_LASTS_S = 1.2
WAITING_M_S, WAITING_MOST_M, WAITING_HALF_S = 0.2, 0.4, 30.0
FLEW_ON_M_S, FLEW_M_S = 0.6, 0.3
# A teammate that says nothing comes back near where it was seen: so long it keeps its course, and leaves it by so much;
# of some nothing is known but that they are within an angle that grows. No teammate is nearer than that, as far as the
# own way turns its bearing. The rate of a bearing is taken from two that are so far apart.
SEEN_COURSE_S, SEEN_TURN_RAD_S = 1.0, 0.1
SHARE_SEEN_LOST, SEEN_LOST_RAD, SEEN_LOST_RAD_S = 0.1, 0.3, 1.0
SEEN_NEAREST_M, SEEN_RATE_APART_S = 2.0, 0.3
# Whoever says that it is farther away is not compared: nobody would see it.
FARTHEST_COMPARED_M = 2000.0
# A path between two reports bends as the last three did; of its sagitta so much is error.
BEND_ERROR = 0.7
# Beside what the tracker says: of the own attitude, of a box's centre against its drone's.
BEARING_SIGMA_RAD, CENTRE_SIGMA_PX2 = 4e-3, 1.0
# A tracker remembers: for so long the error of a track is the same, and another bearing says nothing new.
TRACKED_ERROR_LASTS_S = 0.4
# What lasts of the own attitude's error.
ATTITUDE_LASTING_SIGMA_RAD = 0.006
# Bearings are compared in rounds, those of an agreed motion as often as they say something new.
ROUND_S = 0.5
# A comparison is of bearings at most this far from the round's time.
ROUND_NEAR_S = 0.2
# So long is waited for a report of the same time; then for nobody.
REPORT_WAIT_S = 1.6
# What bearings say fades: errors that were taken to be constant wander.
BEARINGS_LAST_S = 40.0
# What ended tracks said of the own errors lasts longer.
OWN_ERRORS_LAST_S = 120.0

# Of a track whose teammate is silent: that it moves as others do, or as anything else that would fit by chance.
P_MOVES_ALIKE = 0.1

# --- Sizes. ---

# The larger side of a box, m, and how it varies: between airframes, and from box to box.
BOX_SPAN_M, BOX_SPAN_SIGMA_LN, BOX_SIZE_SIGMA_LN = 0.55, 0.22, 0.3
BOX_SPAN_LEAST_SIGMA_LN = 0.1
BOX_LEARNED_EVERY_S = 1.0
# By its box a target is at one of several distances, so far from each other, within such a share of each.
DISTANCE_STEP_LN, DISTANCE_SHARE = 0.45, 0.3
# A stranger's distance is anywhere within this, ln.
STRANGER_DISTANCE_RANGE_LN = 3.0
NEAREST_BOX_M, FARTHEST_BOX_M = 1.0, 80.0
SMALLEST_BOX_PX = 2.0

# --- Strangers: what is not in the team stands, hovers, manoeuvres or flies straight. ---

STRANGER_HOVER_M_SQRT_S = 0.15
STRANGER_MANOEUVRES_M_SQRT_S, STRANGER_MANOEUVRES_M_S2, STRANGER_MANOEUVRES_M_S = 0.1, 1.0, 0.7
STRANGER_STRAIGHT_M_S, STRANGER_STRAIGHT_M_S2 = 2.0, 0.3
# How well the parallax of a stranger is known, as a share of it: most are scenery, at any distance.
STRANGER_PARALLAX_SIGMA = 1.0

# --- Tracks and scenes. ---

# "This track is that teammate" against "a stranger, and the teammate is not seen": teammates that have a track while
# others are seen, those that have none, and strangers in a picture.
P_TEAMMATE_SEEN, P_TEAMMATE_MISSED, STRANGERS_SEEN = 0.9, 0.3, 0.2
LOG_SEEN = math.log(P_TEAMMATE_SEEN / P_TEAMMATE_MISSED / STRANGERS_SEEN)
# A teammate of which nobody knows where it is: it is in the picture, and may be any track.
P_UNLOCATED_SEEN = 0.4
# Of a teammate that may stand anywhere around: that it is in the picture at all is known from the track.
LOG_ANYWHERE = math.log(4.0 * math.pi)
# Of a track that is not confirmed yet: of strangers there are three times as many such, of teammates a quarter.
LOG_WEAK = math.log(0.25 / 3.0)
# A teammate's track is confirmed within so long, or the less likely by that rate [nats] up to that.
WEAK_FREE_S, WEAK_PER_S, WEAK_MOST = 1.0, 1.0, 4.0
# A track goes over to another target: at any time; where it meets another; where it comes back after a miss.
HANDOVER_PER_S, HANDOVER_MET, HANDOVER_MISSED_PER_S = 0.0005, 0.002, 0.01
HANDOVER_LEAST, HANDOVER_MOST = 1e-6, 0.3
TRACKS_MEET_PX = 25.0
# How many segments of a track are kept beside the first, and the least time between two.
SEGMENTS_KEPT, SEGMENT_LEAST_S = 3, 1.5
# After such a miss a track may be another at once.
SEGMENT_MISSED_S, SEGMENT_AFTER_MISS_S = 0.6, 0.3
# Only a track that was named so lately is believed about the own errors when it ends.
BELIEVED_ENDED_S = 4.0
# From such a probability on the frame of whom it was is kept, from the other on it is kept as a supposition.
P_SUPPOSED = 0.2
# A track with such a name has been that teammate.
P_HELD = 0.5
P_BELIEVED, P_FRAME_KEPT, P_SIZE_LEARNED = 0.97, 0.97, 0.99
# m per axis: a drone whose place becomes more uncertain than at first, by the first, has lost it; one that states the
# second doubts itself. After a reboot of its autopilot a place is off by the last, at least.
ADRIFT_M, DOUBTS_M, REBOOTED_M = 2.0, 100.0, 1.0
# No frame begins sooner after its drone lost its place.
ADRIFT_LEAST_S = 1.0
# A name outlives its drone's frame, or ours, by a log ratio of this at most.
CARRIED_MOST = 5.0
# Another process that speaks as a teammate is aboard the same drone.
P_SAME_DRONE = 0.9
# Log ratios of pairs: below the least they are impossible; above the most, a track is somebody.
LOG_NONSENSE = -1e6
LOG_RATIO_LEAST, LOG_RATIO_MOST = -60.0, 60.0

# --- Read-outs. ---

# A name is kept down to this.
P_NAME_KEPT = 0.8
P_NAME_MOST = 0.9999
# A fault of the own is said from this on, once it has lasted.
P_FAULT_SAID, FAULT_SAID_AFTER_S = 0.75, 0.5
# Who is likelier than this to be wrong says of nobody that it is elsewhere.
P_FAULT_SILENT = 0.25
P_STRANGER = 0.98
# A track that has no name for so long lets so many drones be asked for their pose, that are as likely as that.
ASK_AFTER_S, ASKED_AT_ONCE, P_ASKED = 0.5, 2, 0.01

# A place is the average over so many components, the likeliest; and what motion alone says is.
PLACE_COMPONENTS, PROOF_COMPONENTS = 3, 4
# A teammate is elsewhere than it says beyond so many sigmas, and so far; of a name that is as sure.
ELSEWHERE_GATE, ELSEWHERE_LEAST_M, P_ELSEWHERE = 16.0, 0.5, 0.99

# --- Which components are worked out. ---

# A component that is less likely sleeps. Of so many parts of the sleepers one is looked at in each round, and more of
# them while a component, or a name, is less sure than that.
LOG_SLEEPS = -12.0
SLEEPERS_PARTS, SLEEPERS_PARTS_DOUBTFUL = 48, 8
# By beliefs alone the log weight of all matchings may lack so much for each track: ln √2 (Anari & Rezaei 2019).
BELIEFS_LACK_PER_TRACK = 0.35
P_SETTLED = 0.99
# So many tracks with a name, by their probabilities, say that the own pose is right, whatever other tracks are.
NAMES_TELL = 8.0
# Of more teammates a team is large.
SMALL_TEAM = 8
# In a large team, a pair of a log ratio below this by all components sleeps while its track has another name, and keeps
# its ratio, until the track is seen that near to where the teammate should be. All pairs are compared every so many s,
# and what motion alone says is worked out every so many weighings.
LOG_PAIR_SLEEPS, PAIR_WAKES_RAD = -3.0, math.radians(10.0)
ALL_COMPARED_EVERY_S, MOTION_WEIGHED_EVERY = 4.0, 8
# So many matrices, times components and 20, are worked out at once: some 8 MB.
PAIRS_AT_ONCE = 5e4
# Where everything is surer, so often is enough.
CALM_WEIGHED_EVERY_S = 1.0
