"""Every period, timeout, rate and cap of the transport, one section per protocol.

What a config may set is in `settings`.
"""

from typing import Final

# Membership (`membership`): live IDs; beyond it is an attack or a mistake. And boots of one ID at a time.
MAX_PEERS, MAX_BOOTS_PER_ID = 1024, 4
# After a newer boot's token: what an older one still says was not on its way already.
OLD_BOOT_ON_ITS_WAY_S = 0.5

# Announcements (`peers`, `outgoing`): from a newcomer's token to the first question; what it says of itself may be on
# its way.
NEWCOMER_GRACE_S = 0.15
# From an answer that it was just put until it is asked for again.
PUT_ON_ITS_WAY_S: Final = 0.3
# Between two requests to announce again, at both ends; the next comes after twice the time until one is fulfilled, and
# so on, so many times.
ANNOUNCEMENT_REQUEST_PERIOD_S: Final = 1.0
REQUEST_BACK_OFFS: Final = 6
# Questions of subscribers that come within so long get one put together; twice as long while they go on.
ANSWERS_TOGETHER_S, MAX_ANSWERS_TOGETHER_S = 0.05, 0.8
# For which the same bytes are told again: a flood of questions costs no encoding.
ANSWER_FRESH_S: Final = 0.05
# More than a hundred newcomers ask at once; whoever is refused asks again.
ANSWERS_PER_S: Final = 256
# Events waiting for the agent: more than MAX_PEERS can cause at once, so only a stalled agent loses any.
MAX_WAITING_EVENTS = 8192
# Characters of a key; whoever makes up longer ones shall not fill our memory.
USUAL_KEY_LENGTH = 128

# ID clashes (`zenoh_transport`, `memory`): beyond the lease; of a process that was killed, the token is gone by then.
CLASH_MARGIN_S: Final = 0.5
# That two boots of one ID may live beside each other in memory. Nothing there takes time, but a restart in two steps.
MEMORY_CLASH_S = 0.1

# Silence (`silence`, `zenoh_transport`): between two of a teammate's reports; and without a word, until it is asked. It
# is asked again after twice the time, and so on, so many times: after 77 s at most.
REPORT_PERIOD_S: Final = 1.0
ASK_AFTER_SILENCE_S: Final = 1.2 * REPORT_PERIOD_S
QUESTION_BACK_OFFS: Final = 6
# Between two questions to those that owe no word: a hundred drones that do not report cost less than their keep-alives.
QUESTION_REST_S: Final = 9.6
# Leases without a word, until something is done; and the first period in which it is not done again for that teammate:
# all links made anew, and our declarations repeated, a few hundred bytes to each.
REOPEN_LEASES: Final = 2.0
REOPEN_PERIOD_S, REPEAT_PERIOD_S = 600.0, 30.0
# So many times as many leases where packets wait: words may be among them, and new links would add to them.
QUEUE_PATIENCE: Final = 4.0
# Between two times that all links are made again, for different teammates; a start with two fifths lost takes ten.
REOPEN_REST_S: Final = 15.0
# Between two checks of who says nothing.
SILENCE_CHECK_PERIOD_S: Final = 0.5

# Clocks of senders (`sender_clock`): how far apart two clocks that somebody keeps may seem. An announcement may have
# been on its way for so long, and it is the only one; of many reports one was quick.
ANNOUNCED_CLOCKS_AGREE_S: Final = 2.0
REPORTED_CLOCKS_AGREE_S: Final = 1.0
# At least, of a time that is known by its arrival only.
ARRIVAL_SIGMA_S: Final = 0.2
# How many differences count: seconds, so that a clock that drifts is followed.
CLOCK_DIFFERENCES_KEPT: Final = 16
# No message is on its way for so long over a link that lives, so a clock was set.
CLOCK_STEP_S: Final = 5.0

# Congestion (`congestion`): round trips that are kept of a link.
CONGESTION_SAMPLES: Final = 2
# Without an answer to what was sent, while it could be that nothing was sent.
SIGN_OF_LIFE_S: Final = 0.5
# The mean round trip moves by an eighth of what a new sample is off.
ROUND_TRIP_MEAN_WEIGHT: Final = 8

# Pacing (`pacing`, `giving_way`): packets wait so long, far beyond what a radio that sleeps between beacons adds.
PACKETS_LATE_S: Final = 0.25
# And this share of the shortest round trip: a long way varies more.
PACKETS_LATE_SHARE: Final = 0.5
# Where every answer takes so much longer than the shortest, half of the time, packets queue. Losses alone do not slow
# the quickest of several links so much.
PACKETS_QUEUED_S: Final = 0.1
# That TCP could not send yet: a quarter of a second of 64 kbit/s.
PACKETS_UNSENT_BYTES: Final = 2048
# Between two cuts: until the first is felt. And what is left of the rate.
PACE_CUT_HOLD_S: Final = 0.6
PACE_CUT: Final = 0.7
# Tracks messages per second to each listener that nobody is denied, and those of the few seconds of a trial.
PACE_LEAST_HZ, PACE_TRIAL_HZ = 5.0, 2.0
# The least rate before the first message.
PACE_LEAST_BYTES_PER_S: Final = 2000.0
# A trial takes so long, at least and at most, until packets wait for less than these shares of the time before: over,
# or shorter.
PACE_TRIAL_LEAST_S, PACE_TRIAL_S = 2.0, 4.0
PACE_TRIAL_OVER, PACE_TRIAL_SHORTER = 0.5, 0.8
# What no packet waits for but in a queue; and times the least, what is low.
PACE_DEEP_QUEUE_S, PACE_LOW = 1.0, 1.5
# Nothing is answered in a whole trial, by the median of its second half.
PACE_MUTE_S: Final = 2.5
# After a trial that shortened nothing, until the next; twice as long after each further one, so many times.
PACE_TRIAL_REST_S: Final = 15.0
PACE_TRIAL_BACK_OFFS: Final = 4
# Unless packets wait so many times longer than in that trial.
PACE_WORSE: Final = 2.0
# Looks of which the median counts in a trial: two seconds.
PACE_USUAL_LOOKS: Final = 10
# Growth in a second: before packets waited, and after.
PACE_QUICK_GROWTH, PACE_CAREFUL_GROWTH = 2.0, 1.25
PACE_BURST_S: Final = 0.4
# Times what is asked for: no limit then.
PACE_UNLIMITED_FACTOR: Final = 2.0
# Of each message below Zenoh: QUIC or TCP and TLS, IP, the radio's header.
MESSAGE_OVERHEAD_BYTES: Final = 80
# Between two checks of the links.
PACE_CHECK_PERIOD_S: Final = 0.2
# After which it is worth a line of the log again.
PACE_LOG_QUIET_S: Final = 60.0

# Links (`link_watch`, `knocking`, `tcp_options`, `ports`, `addresses`, `joining`): between two checks.
LINK_CHECK_PERIOD_S: Final = 1.0
# Checks after the start: whoever starts with us is there by then.
LINK_START_CHECKS: Final = 10
# Checks without a link for datagrams; after a renewal of keys half a minute is usual.
DATAGRAM_LINK_CHECKS: Final = 45
# Names in one line of the log.
LINK_NAMES_SHOWN: Final = 8
# A kernel asks no more often.
KNOCK_PERIOD_S: Final = 1.0
# A new link's first loss is not much older.
TCP_OPTIONS_PERIOD_S: Final = 0.2
# With the headers of TCP, IPv6 and a radio in frames of less than 1000 bytes.
LONGEST_SEGMENT_BYTES: Final = 880
# A predecessor that is ending holds its ports for a moment.
PORT_TRIES: Final = 8
PORT_TRY_PERIOD_S: Final = 0.25
# For a name that is not in /etc/hosts, where the name server does not answer (`addresses`).
LOOK_UP_S: Final = 2.0
# Between two attempts.
REJOIN_PERIOD_S: Final = 1.0

# Ranging radios (`ranging_radios`): processes at a time, of whom the one that was silent longest is forgotten; and
# teammates that one may measure.
MAX_RADIOS, MAX_MEASURED_PER_RADIO = 4, 1024

# Zenoh (`zenoh_config`): bytes of a fragmented message; Zenoh drops larger ones before we see them.
MAX_ZENOH_BYTES: Final = 1024 * 1024
# Between two with keys (`links.Links.PAIR`).
MAX_LINKS_PER_PAIR: Final = 2
# In one lease, of streams, which repeat what is lost, and where there are datagrams: with 4, an idle link of those was
# lost twice a minute where a fifth of all frames is.
KEEP_ALIVES_PER_LEASE, DATAGRAM_KEEP_ALIVES_PER_LEASE = 3, 6
# What stalls in a handshake waits longer and longer, and is better begun again; one that loses two packets is not.
HANDSHAKE_MS: Final = 4000
# Then the next router is tried.
CLIENT_HANDSHAKE_MS: Final = 1500
# A client's `open` blocks until a router answers, but not for ever.
CLIENT_CONNECT_MS: Final = 6000

# Session (`zenoh_session`, `zenoh_listener`, `zenoh_speaker`, `zenoh_transport`).
SESSION_OPEN_S: Final = 10.0
# A packet or two of a question may be lost.
SESSION_ANSWER_S: Final = 1.5
# SIGTERM must end the agent within 2 s; a link that hangs half open would hold us for 3.
SESSION_CLOSE_S: Final = 1.5
SESSION_PUT_S: Final = 3.0
# For answers to who lives; and teams that are named then.
TEAMS_ANSWER_S: Final = 1.0
MOST_TEAMS_NAMED = 5
MAX_SPOKEN_KEYS: Final = 1024
MAX_LIVELINESS_TOKENS: Final = 65536

# From Zenoh's threads into the event loop (`zenoh_bridge`): samples, 64 MiB at most, and never reached while the loop
# turns.
BRIDGE_CAPACITY: Final = 1024
# Samples taken in one turn of the loop: at 0.2 ms for the dearest, 6 ms.
BRIDGE_HANDFUL: Final = 32
# Where only the newest counts: between two handfuls, 3200 samples a second at most, whoever sends.
BRIDGE_REST_S: Final = 0.01
# Before samples that came in between are read: of one key, the newest, at most twenty times per second.
BRIDGE_ROUND_S: Final = 0.05
