"""Tracks whose explanations hang together: a cluster has its own global hypotheses, whatever happens in others.

A single-target hypothesis, or *leaf*, is one story of one track: which detections made it. A global hypothesis takes a
leaf for each track of the cluster. Two tracks that never wanted the same detection have nothing to say to each other;
kept in one list, the hypotheses about them would multiply. Reid (1979), section III.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array

Indices = NDArray[np.intp]


class Cluster(NamedTuple):
    """h hypotheses about k tracks. tracks (k,): rows of the table; leaf (h, k): rows of the leaves; log_weight (h,),
    best first; their exponentials add up to one. shown: the hypothesis that is published."""

    tracks: Indices
    leaf: Indices
    log_weight: Array
    shown: int = 0

    @property
    def weight(self) -> Array:
        return np.exp(self.log_weight)


def product(first: Cluster, second: Cluster, count: int) -> Cluster:
    """Two clusters that begin to share a detection: the `count` best pairs of their hypotheses."""
    log_weight = (first.log_weight[:, None] + second.log_weight[None]).ravel()
    best = np.argsort(-log_weight, kind="stable")[:count]
    a, b = np.divmod(best, len(second.log_weight))
    return Cluster(
        np.concatenate([first.tracks, second.tracks]),
        np.concatenate([first.leaf[a], second.leaf[b]], axis=1),
        normalised(log_weight[best]),
        int(((a == first.shown) & (b == second.shown)).argmax()),
    )


def merged(cluster: Cluster) -> Cluster:
    """Without doubles: hypotheses that take the same leaves are one."""
    first: dict[bytes, int] = {}
    double_of = np.array([first.setdefault(row.tobytes(), i) for i, row in enumerate(cluster.leaf)])
    if len(first) == len(cluster.leaf):
        return cluster
    log_weight = np.full(len(double_of), -np.inf)
    np.logaddexp.at(log_weight, double_of, cluster.log_weight)
    order = np.argsort(-log_weight, kind="stable")[: len(first)]
    shown = int((order == double_of[cluster.shown]).argmax())
    return Cluster(cluster.tracks, cluster.leaf[order], normalised(log_weight[order]), shown)


def in_dispute(cluster: Cluster) -> Cluster | None:
    """What is left when the tracks that have the same leaf in all hypotheses go."""
    differs = (cluster.leaf != cluster.leaf[0]).any(axis=0)
    if not differs.any():
        return None
    return cluster._replace(tracks=cluster.tracks[differs], leaf=cluster.leaf[:, differs])


def faded(cluster: Cluster, by: float) -> Cluster:
    """The hypotheses that are not published have lost `by` of their log weight, in order of weight as before."""
    log_weight = cluster.log_weight - by
    log_weight[cluster.shown] += by
    order = np.argsort(-log_weight, kind="stable")
    shown = int((order == cluster.shown).argmax())
    return Cluster(cluster.tracks, cluster.leaf[order], normalised(log_weight[order]), shown)


def normalised(log_weight: Array) -> Array:
    top = log_weight.max()
    return np.asarray(log_weight - top - np.log(np.exp(log_weight - top).sum()))


def components(related: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(n,) for each of n, the first of its connected component; related (n, n) symmetric, True on the diagonal."""
    label = np.arange(len(related))
    while True:
        lowest = np.where(related, label, len(label)).min(axis=1, initial=len(label))
        if (lowest == label).all():
            return label
        label = lowest
