"""The shape of a multirotor, as a few numbers and as a solid model of flat faces. Body axes are FRD, metres."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array

OUTLINE_CORNERS = 16  # of every face; simpler ones repeat their last
AMBIENT = 0.55  # share of the light that comes from everywhere


@dataclass(frozen=True, slots=True)
class Airframe:
    """The shape of a quadrotor in X configuration. All lengths in metres, z is down.

    `span` is from the outer rim of one rotor disc to that of its neighbour, so the drone is about that wide
    from the front.
    """

    span: float = 0.5
    rotor_radius: float = 0.11
    rotor_z: float = -0.05
    body_length: float = 0.19
    body_width: float = 0.12
    body_top: float = -0.055
    body_bottom: float = 0.055
    legs_z: float = 0.075

    def scaled(self, span: float) -> Airframe:
        """The same shape with another span [m]."""
        factor = span / self.span
        return Airframe(**{name: factor * length for name, length in asdict(self).items()})

    @property
    def motors(self) -> Array:
        """Centres of the rotor discs, (4, 3) m in body axes: front right, rear left, front left, rear right."""
        offset = self.span / 2.0 - self.rotor_radius
        signs = np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
        return np.column_stack([offset * signs, np.full(4, self.rotor_z)])

    @property
    def feet(self) -> Array:
        """Ends of the four legs, (4, 3) m in body axes; the same order as `motors`."""
        signs = np.sign(self.motors[:, :2])
        return np.column_stack(
            [signs * [0.35 * self.span / 2.0, 0.45 * self.span / 2.0], np.full(4, self.legs_z)]
        )

    def outline(self) -> Array:
        """Points (n, 3) m in body axes whose projection has the bounding box of the drone's. Not to be written to."""
        return _outline(self)


@lru_cache(maxsize=64)
def _outline(frame: Airframe) -> Array:
    """Kept: a swarm's boxes are asked for thousands of times a second."""
    angle = np.arange(16) * (2.0 * math.pi / 16)
    rim = frame.rotor_radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(16)])
    discs = (frame.motors[:, None, :] + rim).reshape(-1, 3)
    outline = np.concatenate([discs, frame.feet])
    outline.setflags(write=False)
    return outline


@dataclass(frozen=True, slots=True, eq=False)
class SolidModel:
    """A drone as flat faces. Turning blades are made anew for each look at it (`vertices`).

    points (n, 3) m; faces (f, CORNERS) indices of points, convex, the last one repeated; normals (f, 3) unit,
    outward, zero where both sides show; colours (f, 3) BGR in full light; opacity (f,) 0…1; blades: for each
    rotor its centre and the slice of its points.
    """

    points: Array
    faces: NDArray[np.int64]
    normals: Array
    colours: Array
    opacity: Array
    blades: tuple[tuple[Array, slice], ...]

    def vertices(self, phases: Array) -> Array:
        """The points (n, 3) m, with the blades of each rotor turned by its phase [rad]."""
        vertices = self.points.copy()
        for (centre, part), phase in zip(self.blades, phases, strict=True):
            c, s = math.cos(phase), math.sin(phase)
            vertices[part, :2] = (self.points[part, :2] - centre[:2]) @ np.array([[c, s], [-s, c]]) + centre[
                :2
            ]
        return vertices

    def shaded(self, sun: Array) -> Array:
        """Colours (f, 3) under a sun in direction (3,), body axes (Lambert)."""
        light = AMBIENT + (1.0 - AMBIENT) * np.maximum(self.normals @ sun, 0.0)
        return self.colours * light[:, None]

    def back_to_front(self, vertices: Array, eye: Array) -> NDArray[np.int64]:
        """Indices of the faces that show their outside to `eye` (3,) m, farthest first."""
        centres = vertices[self.faces].mean(axis=1)
        towards = eye - centres
        two_sided = ~self.normals.any(axis=1)
        shown = np.flatnonzero(two_sided | ((self.normals * towards).sum(axis=1) > 0.0))
        return shown[np.argsort(-(towards[shown] ** 2).sum(axis=1), kind="stable")]


class _Builder:
    """Collects solids into a `SolidModel`."""

    def __init__(self) -> None:
        self._points: list[Array] = []
        self._count = 0
        self._faces: list[list[int]] = []
        self._normals: list[Array] = []
        self._colours: list[Array] = []
        self._opacity: list[float] = []

    def sheet(self, corners: Array, colour: Array, opacity: float) -> slice:
        """A flat polygon (n, 3) that shows both sides; returns where its points are."""
        first = self._add(corners)
        self._face(list(range(first, first + len(corners))), np.zeros(3), colour, opacity)
        return slice(first, first + len(corners))

    def prism(self, bottom: Array, top: Array, colour: Array) -> None:
        """The convex solid between two polygons (n, 3) with as many corners."""
        n = len(bottom)
        corners = np.concatenate([bottom, top])
        first = self._add(corners)
        middle = corners.mean(axis=0)
        sides = [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
        for face in (list(range(n)), list(range(n, 2 * n)), *sides):
            a, b, c = corners[face[:3]]
            normal = np.cross(b - a, c - a)
            normal /= np.linalg.norm(normal)
            outward = normal if normal @ (a - middle) > 0.0 else -normal
            self._face([first + k for k in face], outward, colour, 1.0)

    def beam(self, start: Array, end: Array, half_width: float, colour: Array) -> None:
        """A bar with square section, a third slimmer at its end."""
        along = (end - start) / np.linalg.norm(end - start)
        side = np.cross(along, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side)
        section = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) @ np.stack([side, np.cross(along, side)])
        self.prism(start + half_width * section, end + 0.67 * half_width * section, colour)

    def model(self, blades: tuple[tuple[Array, slice], ...]) -> SolidModel:
        return SolidModel(
            points=np.concatenate(self._points),
            faces=np.array(self._faces),
            normals=np.array(self._normals),
            colours=np.array(self._colours),
            opacity=np.array(self._opacity),
            blades=blades,
        )

    def _add(self, corners: Array) -> int:
        first = self._count
        self._points.append(np.asarray(corners, dtype=float))
        self._count += len(corners)
        return first

    def _face(self, indices: list[int], normal: Array, colour: Array, opacity: float) -> None:
        self._faces.append(indices + indices[-1:] * (OUTLINE_CORNERS - len(indices)))
        self._normals.append(normal)
        self._colours.append(colour)
        self._opacity.append(opacity)


def solid_model(frame: Airframe, shell: Array, accent: Array) -> SolidModel:
    """The airframe with a `shell` and details in an `accent` colour, (3,) BGR."""
    build = _Builder()
    dark = np.array([34.0, 34.0, 36.0])
    length, width = frame.body_length / 2.0, frame.body_width / 2.0

    def deck(z: float, along: float, across: float, shift: float = 0.0) -> Array:
        """A level rectangle with its corners cut, (8, 3)."""
        x, y = along * length, across * width
        half = np.array([[x, 0.5 * y], [0.6 * x, y], [-0.6 * x, y], [-x, 0.5 * y]])
        ring = np.concatenate([half, half[::-1] * [1.0, -1.0]])
        return np.column_stack([ring[:, 0] + shift, ring[:, 1], np.full(8, z)])

    middle = 0.4 * frame.body_top + 0.6 * frame.body_bottom
    build.prism(deck(frame.body_top, 0.75, 0.7), deck(middle, 1.0, 1.0), shell)
    build.prism(deck(middle, 1.0, 1.0), deck(frame.body_bottom, 0.8, 0.7), 0.7 * shell)
    build.prism(deck(frame.body_top - 0.012, 0.4, 0.4), deck(frame.body_top, 0.5, 0.5), accent)
    build.prism(
        deck(middle, 0.2, 0.5, 0.95 * length), deck(frame.body_bottom + 0.015, 0.2, 0.4, 0.95 * length), dark
    )

    angle = np.arange(OUTLINE_CORNERS) * (2.0 * math.pi / OUTLINE_CORNERS)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(OUTLINE_CORNERS)])
    blades = []
    for motor, foot in zip(frame.motors, frame.feet, strict=True):
        seat = motor + np.array([0.0, 0.0, 0.025])
        build.beam(np.append(0.2 * motor[:2], 0.0), seat, 0.016, shell)
        build.prism(
            seat + 0.024 * circle[::2], motor + np.array([0.0, 0.0, 0.004]) + 0.020 * circle[::2], dark
        )
        build.beam(np.append(0.45 * motor[:2], 0.015), foot, 0.008, 0.6 * shell)
        build.sheet(motor + frame.rotor_radius * circle, np.array([72.0, 72.0, 74.0]), 0.30)
        blade = frame.rotor_radius * np.array(
            [[0.1, 0.0], [0.35, 0.18], [1.0, 0.1], [1.0, -0.08], [0.35, -0.1]]
        )
        parts = [
            build.sheet(motor + np.column_stack([sign * blade, np.full(5, -0.002)]), dark, 0.45)
            for sign in (1.0, -1.0)
        ]
        blades.append((motor, slice(parts[0].start, parts[1].stop)))
    return build.model(tuple(blades))
