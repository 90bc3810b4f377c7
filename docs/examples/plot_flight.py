"""Three plots of a flight from its tables: paths, distances, and errors where the truth is known.

`swarmtrack log csv flight` writes flight-csv; `python docs/examples/plot_flight.py flight-csv` then draws the plots.
It needs matplotlib.
"""

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")

import matplotlib.pyplot as plt


def read(folder: Path, name: str) -> np.ndarray | None:
    """A table with named columns; None where the recording has none. With pandas: `pandas.read_csv(file)`."""
    file = folder / f"{name}.csv"
    if not file.is_file():
        return None
    return np.atleast_1d(np.genfromtxt(file, delimiter=",", names=True, dtype=None, encoding="utf-8"))


def position(table: np.ndarray) -> np.ndarray:
    return np.column_stack([table["north_m"], table["east_m"], table["down_m"]])


def pairs(places: np.ndarray):
    """Observer, teammate, and their rows."""
    for observer, teammate in sorted(set(zip(places["observer"], places["teammate"], strict=True))):
        yield observer, teammate, places[(places["observer"] == observer) & (places["teammate"] == teammate)]


def true_position(truth: np.ndarray, drone: int, t: np.ndarray) -> np.ndarray:
    rows = truth[truth["drone"] == drone]
    known = [np.interp(t, rows["t_s"], axis, np.nan, np.nan) for axis in position(rows).T]
    return np.column_stack(known)


def draw_paths(axis, drones: np.ndarray) -> None:
    for drone in sorted(set(drones["drone"])):
        rows = drones[drones["drone"] == drone]
        axis.plot(rows["east_m"], rows["north_m"], label=f"drone {drone}")
    axis.set(xlabel="east, m", ylabel="north, m", aspect="equal")


def draw_distances(axis, places: np.ndarray) -> None:
    for observer, teammate, rows in pairs(places):
        axis.plot(rows["t_s"], np.linalg.norm(position(rows), axis=1), label=f"{observer} sees {teammate}")
    axis.set(xlabel="time, s", ylabel="distance, m", ylim=(0, None))


def draw_errors(axis, places: np.ndarray, truth: np.ndarray) -> None:
    for observer, teammate, rows in pairs(places):
        there, here = (true_position(truth, drone, rows["t_s"]) for drone in (teammate, observer))
        error = np.linalg.norm(position(rows) - (there - here), axis=1)
        axis.plot(rows["t_s"], error, label=f"{observer} sees {teammate}")
    axis.set(xlabel="time, s", ylabel="error of the position, m", ylim=(0, None))


def save(file: Path, draw, *tables: np.ndarray | None) -> None:
    if any(table is None for table in tables):
        print(f"{file}: not drawn, the recording lacks a table")
        return
    figure, axis = plt.subplots(figsize=(8, 5), layout="constrained")
    draw(axis, *tables)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    figure.savefig(file, dpi=110)
    print(file)


def main(folder: Path) -> None:
    places, truth, ego = (read(folder, name) for name in ("places", "truth", "ego"))
    save(folder / "paths.png", draw_paths, ego if truth is None else truth)
    save(folder / "distances.png", draw_distances, places)
    save(folder / "errors.png", draw_errors, places, truth)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, metavar="DIR", help="of swarmtrack log csv")
    main(parser.parse_args().folder)
