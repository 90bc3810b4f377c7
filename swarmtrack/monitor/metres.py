"""Positions of teammates relative to an observer, in metres, for the page's map."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from swarmtrack.plain_text import plain
from swarmtrack.relative.read_out import flat_ellipses, read_outs
from swarmtrack.wire.checks import symmetric
from swarmtrack.wire.strangers import StrangerPlaceMessage, StrangersMessage
from swarmtrack.wire.tracks import TracksMessage

METRES_SIGMAS = 3.0  # of an ellipse
NEAREST_SHOWN_M = 1e-3
RELATIVE_ORIGIN = (0.0, 0.0, 0.0)
MAPPED = 8  # drones, of whom all metres are told; of more those that somebody watches


class SeenInMetres(NamedTuple):
    """To the page a plain array. called: by which name; north_m, east_m: of the observer's camera; long_m, short_m:
    radii of the ellipse, bearing rad of the long one; distance_m with sigma_m; closing_m_s."""

    called: int
    north_m: float
    east_m: float
    long_m: float
    short_m: float
    bearing: float
    distance_m: float
    sigma_m: float
    closing_m_s: float


class SeenStranger(NamedTuple):
    """To the page a plain array. north_m, east_m, down_m: in the team's frame; the ellipse as in `SeenInMetres`; speed
    in m/s; observers: how many see it; remote_id: what it claims to be, or empty."""

    number: int
    north_m: float
    east_m: float
    down_m: float
    long_m: float
    short_m: float
    bearing: float
    speed_m_s: float
    observers: int
    remote_id: str


def strangers(messages: Iterable[StrangersMessage]) -> list[SeenStranger]:
    """By number, as the observer knows it best whose message has it; messages: the fresh ones of all drones."""
    best: dict[int, StrangerPlaceMessage] = {}
    for message in messages:
        for one in message.located:
            known = best.get(one.number)
            if known is None or one.cov[0] + one.cov[6] < known.cov[0] + known.cov[6]:
                best[one.number] = one
    if not best:
        return []
    placed = [best[number] for number in sorted(best)]
    position = np.array([one.position_m for one in placed])
    ellipses = flat_ellipses(symmetric(np.array([one.cov for one in placed]), 6), METRES_SIGMAS)
    speeds = np.linalg.norm([one.velocity_m_s for one in placed], axis=1)
    numbers = np.column_stack([position, ellipses, speeds]).round(2).tolist()
    return [
        SeenStranger._make((one.number, *row, len(one.observers), plain(one.remote_id)))
        for one, row in zip(placed, numbers, strict=True)
    ]


def metres(tracks: TracksMessage | None) -> list[SeenInMetres]:
    """One entry per teammate with a known position."""
    if tracks is None:
        return []
    # What is nearer has no direction, and is a mistake or an attack.
    placed = [
        said for said in tracks.relatives if math.dist(said.position_m, RELATIVE_ORIGIN) > NEAREST_SHOWN_M
    ]
    if not placed:
        return []
    called = {track.id: track.identity for track in tracks.tracks}
    position = np.array([said.position_m for said in placed])
    cov = symmetric(np.array([said.cov for said in placed]), 6)
    read = read_outs(position, np.array([said.velocity_m_s for said in placed]), cov)
    numbers = np.concatenate([position[:, :2], flat_ellipses(cov, METRES_SIGMAS), read], axis=1)
    return [
        SeenInMetres(int(called[said.track_id] or 0), *row)
        for said, row in zip(placed, numbers.round(2).tolist(), strict=True)
    ]
