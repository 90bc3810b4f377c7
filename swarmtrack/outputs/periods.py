"""What an agent says, and how often [s]. Tracks come at `output.tracks_hz`, and at once after each scan.

Readers count on it: a drone's word is out of date where the next two have not come.
"""

from __future__ import annotations

# To the team, and to whoever watches it.
HEALTH_PERIOD_S = 1.0
# Of tracks that nobody listens to: what waits for them, a scan without its gyro samples, waits no longer.
UNHEARD_TRACKS_PERIOD_S = 0.1
IDENTITIES = 1.0
# Whom we see as whom is told at once where it changed, but no more often than that.
IDENTITIES_CHANGED = 0.1
VIDEO = 0.1
# Whose reports are received, in a large team.
NEIGHBOURS = 1.0
# Rays to strangers, while one is in view: what lasts of their errors is larger than what more of them would average.
STRANGERS = 0.4

# To the autopilot. Five boxes a second are 0.2 kB/s.
BOX = 0.2
TEAMMATES_IN_VIEW = 1.0
REPORTED_POSITIONS = IDENTITIES
# One teammate's position as a text; half of the lines stay free for news.
PLACE_TEXTS = 5.0
