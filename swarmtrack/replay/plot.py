"""Plot of the difference of two replays along the flight."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib as mpl

from swarmtrack.errors import RecordingError
from swarmtrack.replay.diff import ReplayDiff

mpl.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.ticker import MaxNLocator

PLOT_COLOURS = ("#e69f00", "#56b4e9", "#009e73", "#d55e00", "#cc79a7", "#0072b2")


def plot(diffs: Mapping[int, ReplayDiff], path: Path, title: str) -> None:
    """One row per figure, one colour per drone. Raises RecordingError where the file cannot be written."""
    figure, (apart, counts, names) = plt.subplots(
        3, 1, sharex=True, figsize=(9.0, 7.0), height_ratios=(2, 1, 1), layout="constrained"
    )
    for k, (drone_id, diff) in enumerate(sorted(diffs.items())):
        colour = PLOT_COLOURS[k % len(PLOT_COLOURS)]
        t = [scan.t for scan in diff.course]
        apart.plot(t, [scan.rmse_px for scan in diff.course], color=colour, lw=1.0, label=f"drone {drone_id}")
        missing = [scan.tracks[0] - scan.tracks[1] for scan in diff.course]
        counts.step(t, missing, color=colour, lw=1.0, where="post")
        names.step(t, [scan.other_names for scan in diff.course], color=colour, lw=1.0, where="post")
        if diff.parted_s is not None:
            apart.axvline(diff.parted_s, color=colour, lw=0.8, ls=":")
    apart.set_ylabel("RMSE between\nmatched tracks, px")
    apart.set_ylim(bottom=0.0)
    figure.legend(loc="outside upper right", ncols=6, title="dotted: where they part", fontsize="small")
    counts.set_ylabel("more tracks here\n(less: below 0)")
    names.set_ylabel("tracks named\notherwise")
    names.set_xlabel("time in the recording, s")
    for axis in (apart, counts, names):
        axis.grid(alpha=0.3)
    for axis in (counts, names):  # whole numbers, also where all are 0
        low, high = axis.get_ylim()
        axis.set_ylim(min(low, -1.5), max(high, 1.5))
        axis.yaxis.set_major_locator(MaxNLocator(integer=True))
    figure.suptitle(title, x=0.02, ha="left")
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"--plot {path}: {error}, expected a .png or .svg that can be written"
        ) from error
    finally:
        plt.close(figure)
