"""Two drones that look at each other, and what a busy machine may spoil of their verdict."""

import re
from pathlib import Path

PAIR = """
about = "two drones look at each other"
seconds = 4.0
[agents]
tracks_hz = 20.0
imu_rate_hz = 50.0
[formation]
drones = 2
ring = { radius_m = 2.0 }
[expected]                    # only what no busy machine can spoil
rmse_px = 15.0
time_to_identify_s = 60.0
all_known_s = 60.0
first_tracks_s = 60.0
correct = 0.5
rate = 0.1
"""


def pair(folder: Path, **expected: float) -> tuple[str, str]:
    """A scenario file of two drones, as arguments of the command; expected: of its limits others than stated."""
    path = folder / "pair.toml"
    lines = [line for line in PAIR.splitlines() if line.partition(" =")[0] not in expected]
    lines += [f"{name} = {value}" for name, value in expected.items()]
    path.write_text("\n".join(lines), encoding="utf-8")
    return "--scenario", str(path)


def is_judged(said: str) -> bool:
    """Whether every drone was heard; where the machine is busy, a flight may be over before its agents speak."""
    unheard = ("nothing to judge", "no tracks were received", "never announced")
    # What comes before the verdict says "nothing to judge yet" of every flight's first second.
    verdict = re.split("^(?:PASSED|FAILED|NOT JUDGED)", said, flags=re.MULTILINE)[-1]
    return not any(words in verdict for words in unheard)


def is_fair(code: int, said: str) -> bool:
    """Whether a flight passed, or fell short of nothing but what a busy machine spoils: rates, delays, shares.

    Wrong names and announcements that are too long are no machine's fault.
    """
    if code == 0:
        return said.rstrip().splitlines()[-1].startswith("PASSED")
    if code == 3:
        return "NOT JUDGED" in said
    found = said.rpartition("FAILED")[2]
    return code == 1 and "FAILED" in said and "wrong names" not in found and "announcement bytes" not in found
