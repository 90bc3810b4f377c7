"""Which detection belongs to which track: gates and one-to-one assignment."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array

Indices = NDArray[np.intp]


def gate_threshold(probability: float) -> float:
    """The χ² quantile with two degrees of freedom: squared distance that a true detection stays below."""
    return -2.0 * math.log1p(-probability)


def most_likely_matching(log_ratio: Array) -> tuple[Indices, Indices]:
    """The one-to-one matching with the largest sum of log_ratio (n, m); pairs that do not gain are left out.

    log_ratio is the log-likelihood of "i made j" over "i made nothing and j is something else"; −inf forbids a pair.
    Returns (rows, columns).
    """
    cost = np.where(log_ratio > 0.0, -log_ratio, 0.0)
    rows = np.flatnonzero((cost < 0.0).any(axis=1))
    columns = cost[rows].argmin(axis=1) if rows.size else rows
    if len(set(columns.tolist())) == rows.size:
        return rows, columns  # everybody's best is wanted by nobody else: the rule, and nothing is better
    if rows.size > cost.shape[1]:
        columns, chosen = most_likely_matching(log_ratio[rows].T)
        return rows[chosen], columns
    columns = np.array(_cheapest_assignment(cost[rows].tolist()))
    gains = cost[rows, columns] < 0.0
    return rows[gains], columns[gains]


def _cheapest_assignment(cost: list[list[float]]) -> list[int]:
    """For each of n rows its column, one of m ≥ n, in the assignment with the smallest sum of cost.

    Shortest augmenting paths with dual prices: Crouse, "On implementing 2D rectangular assignment algorithms", IEEE
    Trans. AES 52(4), 2016. SciPy has it in C, but importing `scipy.optimize` takes each agent 0.3 s and 44 MB, which
    thirty of them on one machine do not have. Whoever comes first to its best column has it: with rows paid their
    least cost and columns free, the duals are feasible, and only the rows in dispute have to search.
    """
    n, m = len(cost), len(cost[0])
    price, paid = [0.0] * m, [min(row) for row in cost]  # the duals of columns and rows
    column_of, row_of = [-1] * n, [-1] * m
    for i in range(n):
        best = cost[i].index(paid[i])
        if row_of[best] < 0:
            column_of[i], row_of[best] = best, i
    for newcomer in [i for i in range(n) if column_of[i] < 0]:
        distance, came_from = [math.inf] * m, [newcomer] * m
        open_columns = list(range(m))
        passed = []  # columns whose rows have to move on
        row, reached = newcomer, 0.0
        while True:
            here, nearest, costs = reached - paid[row], math.inf, cost[row]
            for j in open_columns:
                through = here + costs[j] - price[j]
                if through < distance[j]:
                    distance[j], came_from[j] = through, row
                if distance[j] < nearest:
                    nearest, column = distance[j], j
            reached = nearest
            open_columns.remove(column)
            if row_of[column] < 0:
                break
            passed.append(column)
            row = row_of[column]
        paid[newcomer] += reached
        for j in passed:
            paid[row_of[j]] += reached - distance[j]
            price[j] -= reached - distance[j]
        while True:  # back along the path, everybody moves on
            row = came_from[column]
            row_of[column] = row
            column_of[row], column = column, column_of[row]
            if row == newcomer:
                break
    return column_of
