"""Gates: innovations beyond which a measurement is rejected."""

from __future__ import annotations

# The χ² quantile of 0.9999, by how many numbers were measured. Written out, because `scipy.stats` takes every agent a
# second and 70 MB.
GATE = {1: 15.1367, 2: 18.4207, 3: 21.1075, 4: 23.5127}
