"""Every rate, timeout, noise and cap of the link to an autopilot, one section per module.

Numbers of the MAVLink protocol itself (message IDs, lengths of its fields) are where its bytes are read.
"""

# Addresses (`address`): USB ports ignore it; on a UART the wrong one is named within 3 s.
DEFAULT_BAUD = 115200
# A smaller number after the last colon belongs to the name (/dev/serial/by-path/…-usb-0:1).
SLOWEST_BAUD = 1200

# Links (`links`, `datagrams`): without a valid frame for so long, another address may be the autopilot's, a router that
# was restarted. Heartbeats come each second.
UDP_PEER_SILENT_S = 2.0
# Every failure names its reason within 3 s.
LINK_CONNECT_TIMEOUT_S = 2.5
# A tenth of a second of the fastest serial link.
SERIAL_READ_BYTES = 4096
# Waiting to be sent; beyond it new frames are dropped, all of ours are soon repeated.
LINK_SEND_BUFFER_BYTES = 4096
# Of a recording as fast as it goes, before others on the event loop get their turn; likewise datagrams read in one
# piece.
RECORDS_PER_TURN = 200
DATAGRAMS_PER_TURN = 200
# Senders of datagrams whose cut frames wait for their rest, until it is known which one is the autopilot.
FRAMED_SENDERS = 8
# Between two records, or from a log's middle to its ends; what claims more is no stamp.
LONGEST_RECORDING_S = 86_400.0
# Beyond it a counter of milliseconds does not fit into 32 bits; what says more counts from 1970.
LONGEST_UPTIME_S = 4.2e6
# Telemetry logs (`tlog`): stamps of neighbours that are farther apart are a pause, or a step of the log's clock; and
# how much of the log on either side tells which.
TLOG_PAUSE_S, TLOG_WINDOW_S, TLOG_WINDOW_RECORDS = 0.5, 5.0, 1000
# Records at a log's beginning by which its stamps are judged; times as fast or slow as the autopilot's clock, which a
# simulation may be.
TLOG_JUDGED_RECORDS, TLOG_CLOCK_RATE = 5000, 20.0
# Of a log that is searched, before others on the event loop get their turn: 4 ms.
TLOG_BYTES_PER_TURN = 1 << 20
# No clock is set so often: the autopilot's tells the time from then on. And steps that are said one by one.
TLOG_MOST_STEPS, TLOG_SAID_STEPS = 100, 3
# Logs (`log_files`): of the processor's time before a file is given up; ten times what was measured.
LOG_READ_S, LOG_READ_S_PER_MB = 1.5, 2.0
# Of a ULog's definitions (`ulog_definitions`): PX4's largest topic has some 200 fields, its deepest two formats within.
ULOG_MOST_FIELDS, ULOG_DEEPEST_FORMAT = 1024, 8
# Of all its topics together, some 10 000.
ULOG_MOST_SUBSCRIBED_FIELDS = 100_000
# Bytes that may be the end of the last message, of a tail that was never written.
ULOG_LONGEST_END = 10_000
# Bytes, of one definition of an unknown type; and of what is no definition, over which it is looked for the next one.
ULOG_LARGEST_DEFINITION, ULOG_MOST_DAMAGED_BYTES = 10_000, 10_000
# The rest of a frame would have come, so its header was false. A slow radio sends a few times per second.
FRAME_FLUSH_AFTER_S = 0.3

# Datagrams with heartbeats of other senders than the autopilot's: more are not looked at.
OVERHEARD_HZ = 20
# Contact (`mavlink_autopilot`, `link_state`, `contact`): also what makes routers learn us.
AGENT_HEARTBEAT_PERIOD_S = 1.0
LINK_TICK_S = 0.05
# Without a byte for so long, the other end of TCP went without saying so.
TCP_SILENT_S = 5.0
# Between attempts to connect, doubling.
FIRST_RETRY_S, LONGEST_RETRY_S = 0.5, 5.0
# What the sensors themselves reach.
FASTEST_IMU_HZ = 8000.0
# Kept until it is known whose they are: more than two seconds of a fast link.
EARLY_FRAMES_KEPT = 2000
# Other systems remembered by name.
NAMED_SOURCES = 8
# Without any message of the autopilot for so long, it is lost.
AUTOPILOT_LOST_AFTER_S = 3.0
# A silence waits so long until it is given a name.
SILENCE_DIAGNOSED_AFTER_S = 2.5
# Before the same news is logged again.
LINK_NEWS_PERIOD_S = 10.0

# Flight state (`flight`): so long a landed state is believed beside the heartbeat.
LANDED_STATE_AGE_S = 5.0

# Streams (`streams`): over which a rate is measured.
STREAM_RATE_WINDOW_S = 2.0
# Of the target; below it the stream is asked for again.
STREAM_RATE_SHARE = 0.8
# Of a denied rate is asked for next; and times the rate is asked for once, where it was granted and does not come.
DENIED_RATE_FACTOR, MISSED_RATE_FACTOR = 0.8, 2.0
# Denied below it, the message itself is not offered.
LOWEST_STREAM_HZ = 10.0
# A busy link takes 0.2 s.
COMMAND_ACK_TIMEOUT_S = 1.0
# Unanswered ones, before the command counts as not understood.
COMMAND_ATTEMPTS = 3
# Before a slow stream is asked for again, doubling up to the second.
STREAM_ASKED_AGAIN_S, STREAM_LONGEST_ASKED_AGAIN_S = 4.0, 30.0
# What is asked for. A local or global position is carried on by its velocity in between, at 5 m/s² to 4 mm and to
# 25 mm.
ATTITUDE_HZ = 50.0
LOCAL_POSITION_HZ, GLOBAL_POSITION_HZ = 25.0, 10.0
# That of most receivers.
GPS_FIX_HZ = 5.0
# Of a range finder, where there is one.
RANGE_FINDER_HZ = 4.0
PILOT_SWITCH_HZ = 5.0
CURRENT_MODE_HZ = 5.0
# Above the sea: what says more is damaged.
HIGHEST_PLACE_M = 1e5
# Between two logged places of which a velocity is made.
POSITION_GAP_S = 0.5
# Poses that are made of an autopilot's own log.
LOGGED_POSES_HZ = 50.0
# Of what the line carries may be ours; the rest is for parameters and other programs.
LINE_SHARE = 0.7

# Telemetry (`telemetry`): without an IMU sample for so long, or for three of its periods where it comes slower.
IMU_STALE_AFTER_S = 0.5
# Without an IMU sample for so long its rate is counted from the start again; and over which it is counted.
IMU_FORGOTTEN_AFTER_S, IMU_RATE_WINDOW_S = 3.0, 2.0
# A better source of angular velocity must be silent so long before a lesser one is used.
IMU_PREFERRED_S = 2.0
# No sensor measures more; what claims it is corrupt.
FASTEST_GYRO_RAD_S = 100.0
# m from where the local frame began, and m/s: an estimator that says so has diverged.
DIVERGED_LOCAL_POSE = 1e6
# Per axis, against where the local frame began.
LOCAL_POSITION_SIGMA_M = 0.1
# So long a position is carried on by its velocity.
LOCAL_POSITION_AGE_S = 0.5
# Between a pose's mapped time and its arrival: it is stamped by another clock.
POSE_CLOCK_MISMATCH_S = 5.0
# In a row, before a clock of the poses' own is believed.
OTHER_BASE_STAMPS = 5
# The first exchanges come faster, so that sigma is soon known.
TIMESYNC_PERIOD_S = 1.0
TIMESYNC_FIRST_EXCHANGES, TIMESYNC_FIRST_PERIOD_S = 10, 0.2
# Between what the range finder measured and the pose that it is told with.
GROUND_FRESH_S = 0.2
# Cosine of the tilt, 37°: beyond, it measures the ground beside the drone.
GROUND_LEAST_UPRIGHT_COSINE = 0.8

# Fed positions (`fed_position`): after the last fed place an estimator carries on for so long at most: EKF3 drops to
# attitude after 15 s, EKF2 after 5 s. And so long a receiver must have a fix again before an estimator goes by it.
FED_POSITION_RESTS_S, FED_FIX_BACK_S = 30.0, 10.0
# s between two positions of one estimator of which the origin of its local frame is learned.
LOCAL_ORIGIN_GAP_S = 0.2
LOCAL_ORIGIN_HZ, FED_FIX_HZ = 5.0, 2.0

# GPS (`global_position`): per axis, of a receiver that does not say; open sky, no corrections.
GPS_USUAL_SIGMA_M = 1.5
# What ArduPilot's estimator asks of a receiver before it uses it.
GPS_WORST_SIGMA_M = 5.0
# So long a fix is believed: PX4 tells of a receiver that went once a second.
GPS_FIX_AGE_S = 3.0
# From the team's origin: one of the two is wrong.
GPS_FARTHEST_FROM_ORIGIN_M = 100e3

# Clock of the autopilot (`clock_map`): one extreme is kept of each bucket; and buckets, long against jitter, short
# against the wandering of a crystal with temperature.
CLOCK_BUCKET_S, CLOCK_WINDOW_BUCKETS = 1.0, 60
# Of stamps before a slope is read from them.
CLOCK_SKEW_BASELINE_S = 10.0
# Crystals stay below 1e-4; what is steeper is congestion.
CLOCK_MAX_SKEW = 1e-3
# s/s: how fast a correction is brought in, so that no sample's dt is wrong by more than 2 %.
CLOCK_MAX_SLEW = 0.02
# An error this large is corrected at once, and reported.
CLOCK_RESYNC_S = 0.1
# Bounds that cross by more mean a stepped clock, by less a request dated back.
CLOCK_CROSSING_S = 0.02
# A first reply may have been seconds under way.
CLOCK_LEAST_EXCHANGES = 5
# Of exchanges that one line must explain before its slope is believed: two restarts at 1 %.
CLOCK_DRIFT_BASELINE_S = 4.0
# Exchanges kept for it: the first, fast ones and ten seconds more.
CLOCK_EXCHANGES_KEPT = 20
# How far an exchange may miss the line. A simulator's stamps are those of its last step, 4 ms in PX4.
CLOCK_LINE_SLACKS_S = (0.0, 0.5e-3, 1e-3, 2e-3, 5e-3)
# Restarts within the window: the clock neither keeps time nor errs by a constant rate.
CLOCK_UNSTEADY_RESTARTS = 3
# A step of the clock, which no drift explains, is a part of its standard deviation for so long.
CLOCK_STEPS_LAST_S = 20.0
# Standard deviation to own up to without TIMESYNC.
CLOCK_UNKNOWN_LATENCY_S = 0.005

# Delay of the gyro (`gyro_delay`): between two requests of a parameter, and requests; an ArduPilot that boots answers
# when it has read its storage.
PARAMETER_REQUEST_PERIOD_S, PARAMETER_REQUESTS = 1.0, 5
# One sigma, of a delay that the autopilot told: seven flights of ArduPilot and one of PX4 were no farther off.
GYRO_DELAY_TOLD_SIGMA_S = 1e-3
# Likewise, of an autopilot whose filters we do not know.
GYRO_DELAY_UNKNOWN_SIGMA_S = 10e-3
# What says more is no filter of a gyro that somebody flies by.
GYRO_DELAY_LONGEST_S = 0.1

# Engagement (`engagement`): without a heartbeat for so long, nobody knows the mode any more. Heartbeats come once per
# second, and with each change of mode.
ENGAGEMENT_SILENT_S = 2.5
# Between two readings of the clock: sooner than a guard lets go of an agent that stood still for as long.
AGENT_STOOD_STILL_S = 0.9
# After it has gone on: so long what comes may have waited in a buffer for it.
AGENT_BACKLOG_S = 0.5
# So long after a change of the mode it is known whether the pilot intended that; and before it, a failsafe was told.
MODE_SETTLES_S, FAILSAFE_TOLD_WITHIN_S = 0.6, 3.0
# Characters of an autopilot's own words.
LONGEST_FAILSAFE_TEXT = 40

# Pilot's switch (`pilot_switch`): no receiver says less or more. A channel that there is not is 0 on ArduPilot and
# 65535 on PX4.
SHORTEST_CHANNEL_US, LONGEST_CHANNEL_US = 800, 2200
# Who was silent for longer is heard of for the first time.
CHANNEL_FORGOTTEN_AFTER_S = 2.0
# Below the threshold: a channel that trembles there is thrown once.
CHANNEL_TREMBLES_US = 50

# Boot clock (`boot_clock`): by so much a stamp may be ahead of the one before it; and by so much per second that passes
# beyond a usual interval, of a simulator that runs faster than time.
CLOCK_AHEAD_S, CLOCK_AHEAD_RATE, CLOCK_INTERVAL_S = 0.5, 20.0, 0.05
# Stamps at the beginning that may leap, for what a buffer had held back comes first.
CLOCK_FIRST_READINGS = 20
# A rebooted clock counts less than the time since it was last read, give or take what a buffer held back.
REBOOT_SLACK_S = 0.5
# Stamps of another clock in a row before it is believed, after less than the shortest reboot.
REBOOT_READINGS = 3
# Ours must be silent so long before another clock takes its place without a reboot.
CLOCK_REPLACED_AFTER_S = 3.0
# Every autopilot takes longer to reboot, a simulated one aside: within it, a counter that begins again has wrapped.
SHORTEST_REBOOT_S = 1.0
# So long after a message its copies are recognised: the slowest second way there was took 1.3 s, and buffers of
# cellular modems hold back for longer.
COPY_REMEMBERED_S = 60.0
# So long after the last copy a message without a stamp that equals an earlier one to the byte is a copy as well.
COPIES_EXPECTED_S = 5.0
# In one window of the gyro's rate: from so many copies on they are said. A single one is no news.
COPIES_SAID = 20
# Of the stamps that came: from this share on, those of a second clock are a second autopilot's.
SECOND_CLOCK_SHARE = 0.2

# Senders (`senders`): numbers that one may have lost between two of its frames; and counts that are followed.
SEQUENCE_LOSS, FRAME_COUNTS_KEPT = 8, 12
# Alternations in a row until a contradiction is believed: with heartbeats once per second four of each, more than three
# seconds, so that a change of the mode that comes late by a second port is none.
CONTRADICTION_TURNS = 7
# A delay, of a way or of a port: clocks that are closer may be one.
LATEST_WAY_S = 5.0
# Of one vehicle's places, carried on by its velocity over so long, and of attitudes so close in time: less than that.
SENDERS_APART_M, SENDERS_PLACE_GAP_S = 3.0, 0.3
SENDERS_APART_RAD, SENDERS_ATTITUDE_GAP_S = 0.35, 0.03
# Late frames, less others, that are remembered of a count.
MOST_LATE = 20
# Heartbeats that were sent so soon after each other may come in any order.
STATE_ORDER_S = 0.05
# Between two frames of a kind: within it fewer than 256 frames come, at twice the rates that are asked for.
NUMBERED_GAP_S = 0.4

# Who is the autopilot (`candidates`): heartbeats come once per second, so after so long everyone has been heard.
CANDIDATES_HEARD_S = 1.2
# Without a heartbeat for so long another autopilot is gone.
CANDIDATE_GONE_S = 3.0

# What is used (`intake`): so many must be thrown away in a window until that is a fault.
INTAKE_LEAST = 4
# Below, a turn within a sample moves tracks by more than their own size.
SLOWEST_USEFUL_GYRO_HZ = 50.0
# Of it, or of a lower rate that is asked for: what comes slower is too slow.
GYRO_RATE_SHARE = 0.95
# Without an attitude for so long beside a gyro, there is none.
POSE_MISSED_S = 3.0
# An attitude as a quaternion must be silent so long before Euler angles are used.
QUATERNION_PREFERRED_S = 1.0
# Unanswered for so long by an autopilot that speaks MAVLink 1, we speak that too.
MAVLINK_1_AFTER_S = 2.0

# Remote ID (`remote_id`): how OPEN_DRONE_ID_LOCATION states what is unknown.
REMOTE_ID_NO_ALTITUDE_M = -1000.0
REMOTE_ID_SPEED_UNKNOWN_CM_S, REMOTE_ID_COURSE_UNKNOWN_CDEG, REMOTE_ID_CLIMB_UNKNOWN_CM_S = 25500, 36100, 6300
# One sigma of a height above another drone's take-off as one above the origin, and of one above the ellipsoid.
REMOTE_ID_GROUND_SIGMA_M, REMOTE_ID_ELLIPSOID_SIGMA_M = 5.0, 50.0
# Senders whose names are remembered.
REMOTE_IDS_KEPT = 256
