"""Procedural pictures: multirotors in any attitude, what is mistaken for them, and what lies behind.

Everything is drawn with OpenCV from a `numpy.random.Generator`, so a seed names a picture. Nothing here was
photographed: the pictures carry no licence but the project's own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]
Vector = Sequence[float] | NDArray[np.float64]
Rng = np.random.Generator

# px: side of the square in which a sprite is drawn, before it is scaled to its size in the picture
CANVAS = 128
SUBPIXEL_BITS = 3  # OpenCV's fixed-point drawing: coordinates in eighths of a pixel


class Sprite(NamedTuple):
    """A cut-out, cropped to what is visible. colour (h, w, 3) BGR 0…255, multiplied by alpha; alpha (h, w) 0…1."""

    colour: FloatImage
    alpha: FloatImage


def rotation(rng: Rng, tilt: float = 0.4) -> NDArray[np.float64]:
    """Camera from body (3, 3): any heading, pitch and roll of standard deviation `tilt`, seen from about level."""
    yaw, pitch, roll = rng.uniform(0, 2 * np.pi), rng.normal(0, tilt), rng.normal(0, tilt)
    elevation = rng.normal(0, 0.5)
    turn = cv2.Rodrigues(np.array([0.0, 0.0, yaw]))[0]
    lean = cv2.Rodrigues(np.array([roll, pitch, 0.0]))[0]
    look = cv2.Rodrigues(np.array([elevation, 0.0, 0.0]))[0]
    return np.asarray(look @ lean @ turn)


class _Canvas:
    """Draws solids in body axes (x forward, y left, z up; the whole body within radius 1.75) as seen along y."""

    def __init__(self, camera_from_body: NDArray[np.float64], side: int = CANVAS) -> None:
        self._camera_from_body = camera_from_body
        self._side = side
        self._scale = side / 2 / 1.75
        self._colour = np.zeros((side, side, 3), np.float32)
        self._alpha = np.zeros((side, side), np.float32)

    def hull(self, points: NDArray[np.float64], colour: Vector, opacity: float = 1.0) -> None:
        """Fill the outline of the convex body with these corners, points (n, 3)."""
        mask = np.zeros((self._side, self._side), np.uint8)
        outline = cv2.convexHull(self._pixels(points))
        cv2.fillConvexPoly(mask, outline, 255, cv2.LINE_AA, SUBPIXEL_BITS)
        self._cover(mask, colour, opacity)

    def bar(
        self,
        start: Vector,
        end: Vector,
        width: float,
        colour: Vector,
        opacity: float = 1.0,
    ) -> None:
        mask = np.zeros((self._side, self._side), np.uint8)
        a, b = self._pixels(np.array([start, end], float)).tolist()
        cv2.line(mask, a, b, 255, max(1, round(width * self._scale)), cv2.LINE_AA, SUBPIXEL_BITS)
        self._cover(mask, colour, opacity)

    def sprite(self) -> Sprite:
        """What was drawn, cropped. Faint rotor discs count: cutting them would leave straight edges to learn from."""
        return crop_to_visible(Sprite(self._colour, self._alpha), 0.03)

    def _pixels(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        seen = points @ self._camera_from_body.T
        uv = np.stack([seen[:, 0], -seen[:, 2]], axis=1) * self._scale + self._side / 2
        return np.asarray(np.round(uv * 2**SUBPIXEL_BITS), np.int32)

    def _cover(self, mask: NDArray[np.uint8], colour: Vector, opacity: float) -> None:
        a = mask.astype(np.float32) * np.float32(opacity / 255)
        self._colour = self._colour * (1 - a[..., None]) + np.asarray(colour, np.float32) * a[..., None]
        self._alpha = self._alpha + a * (1 - self._alpha)


def crop_to_visible(sprite: Sprite, threshold: float) -> Sprite:
    """Cut away the rows and columns where alpha never reaches `threshold`."""
    visible = sprite.alpha > threshold
    rows, columns = np.flatnonzero(visible.any(axis=1)), np.flatnonzero(visible.any(axis=0))
    if rows.size == 0:
        return sprite
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return Sprite(sprite.colour[window].copy(), sprite.alpha[window].copy())


def _paint(rng: Rng) -> Callable[[float], NDArray[np.float64]]:
    """A body's paint: called with a relative brightness, returns BGR. Dark bodies are the most common in the sky."""
    base = rng.choice([rng.uniform(10, 70), rng.uniform(70, 150), rng.uniform(170, 250)], p=[0.5, 0.2, 0.3])
    tint = rng.normal(0, 10, 3)

    def colour(brightness: float) -> NDArray[np.float64]:
        return np.asarray(np.clip(base * brightness + tint + rng.normal(0, 8, 3), 0, 255))

    return colour


def _box(centre: Vector, half: Vector) -> NDArray[np.float64]:
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    return np.asarray(corners * half + centre)


def _ellipsoid(centre: Vector, half: Vector) -> NDArray[np.float64]:
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 10), np.linspace(-1.4, 1.4, 5))
    ball = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], axis=-1).reshape(-1, 3)
    return np.asarray(ball * half + centre)


def _disc(centre: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    u = np.linspace(0, 2 * np.pi, 18)
    return np.asarray(centre + radius * np.stack([np.cos(u), np.sin(u), np.zeros_like(u)], axis=1))


def multirotor(rng: Rng, canvas_side: int = CANVAS) -> Sprite:
    """Three to eight rotors on arms, a body, maybe legs and a camera; rotors as faint discs, blades or both.

    canvas_side: px, of the square it is drawn in; what is shown large is drawn large.
    """
    rotors = int(rng.choice([3, 4, 6, 8], p=[0.05, 0.7, 0.15, 0.1]))
    paint = _paint(rng)
    canvas = _Canvas(rotation(rng), canvas_side)
    bearing = (0.0 if rng.random() < 0.2 else np.pi / rotors) + 2 * np.pi * np.arange(rotors) / rotors
    stretch, droop = rng.uniform(0.75, 1.3), rng.uniform(-0.1, 0.2)
    tips = np.stack([np.cos(bearing) * stretch, np.sin(bearing), np.full(rotors, droop)], axis=1)

    if rng.random() < 0.55:  # landing gear
        depth, span = -rng.uniform(0.25, 0.65), rng.uniform(0.2, 0.5)
        for side in (-1, 1):
            for end in (-0.3, 0.3):
                canvas.bar((side * span * 0.5, end * 0.7, 0), (side * span, end, depth), 0.05, paint(0.8))
            if rng.random() < 0.6:
                canvas.bar((side * span, -0.4, depth), (side * span, 0.4, depth), 0.05, paint(0.8))
    arm_width = rng.uniform(0.05, 0.16)
    for tip in tips:
        canvas.bar((0, 0, 0), tip, arm_width, paint(rng.uniform(0.7, 1.2)))

    length, width, height = rng.uniform(0.22, 0.6), rng.uniform(0.16, 0.4), rng.uniform(0.06, 0.24)
    solid = _ellipsoid if rng.random() < 0.4 else _box
    canvas.hull(solid((0, 0, 0), (length, width, height)), paint(1.0))
    lid = rng.uniform(0, 255, 3) if rng.random() < 0.25 else paint(rng.uniform(1.0, 1.5))
    canvas.hull(_box((0, 0, height), (length * 0.8, width * 0.8, 0.01)), lid)
    if rng.random() < 0.6:  # camera, battery
        canvas.hull(_box((length * 0.8, 0, -height), (0.14, 0.14, 0.14)), paint(0.5))

    style, radius = rng.random(), rng.uniform(0.3, 0.65)
    disc_opacity = rng.uniform(0.04, 0.35)
    for tip in tips:
        canvas.hull(_box(tip, (0.09, 0.09, 0.12)), paint(0.7))
        hub = tip + np.array([0, 0, 0.14])
        if style < 0.7:
            canvas.hull(_disc(hub, radius), paint(rng.uniform(0.8, 1.8)), disc_opacity)
        if style > 0.35:
            angle = rng.uniform(0, np.pi)
            blade = radius * np.array([np.cos(angle), np.sin(angle), 0])
            canvas.bar(hub - blade, hub + blade, 0.06, paint(0.8), rng.uniform(0.4, 1.0))
    return _shade(rng, canvas.sprite())


def bird(rng: Rng) -> Sprite:
    """A body and two wings somewhere in their beat."""
    paint = _paint(rng)
    canvas = _Canvas(rotation(rng, tilt=0.5))
    span, chord, beat = rng.uniform(0.8, 1.5), rng.uniform(0.15, 0.4), rng.uniform(-0.8, 0.9)
    for side in (-1, 1):
        elbow = np.array([rng.uniform(-0.1, 0.3), side * span * 0.5, beat * 0.6])
        tip = np.array([rng.uniform(-0.6, 0.1), side * span, beat * rng.uniform(0.2, 1.2)])
        forward = np.array([chord, 0, 0])
        inner = np.array([forward, -forward, elbow + forward, elbow - forward])
        canvas.hull(inner, paint(rng.uniform(0.8, 1.2)))
        canvas.hull(np.array([elbow + forward, elbow - 0.8 * forward, tip]), paint(0.9))
    canvas.hull(_ellipsoid((0, 0, 0), (rng.uniform(0.4, 0.8), 0.14, 0.14)), paint(1.0))
    return _shade(rng, canvas.sprite())


def aeroplane(rng: Rng) -> Sprite:
    """Fuselage, wings, tail, maybe engines."""
    paint = _paint(rng)
    canvas = _Canvas(rotation(rng, tilt=0.25))
    span, sweep, chord = rng.uniform(0.7, 1.4), rng.uniform(-0.1, 0.6), rng.uniform(0.12, 0.3)
    thickness, rise = rng.uniform(0.07, 0.16), rng.uniform(-0.1, 0.15)
    for y, z, x in ((span, rise, -sweep), (span * 0.4, 0.05, -1.1)):  # wings, tailplane
        root = 0.15 if x != -1.1 else -1.0
        size = chord if x != -1.1 else chord * 0.6
        for side in (-1, 1):
            outline = [[root + size, 0, 0], [root - size, 0, 0], [x + size * 0.5, side * y, z]]
            canvas.hull(np.array([*outline, [x - size * 0.5, side * y, z]]), paint(rng.uniform(0.8, 1.1)))
    canvas.hull(_ellipsoid((0, 0, 0), (1.25, thickness, thickness)), paint(1.0))
    canvas.hull(np.array([[-0.9, 0, 0.05], [-1.25, 0, 0.05], [-1.25, 0, 0.45], [-1.1, 0, 0.45]]), paint(0.9))
    return _shade(rng, canvas.sprite())


def helicopter(rng: Rng) -> Sprite:
    """One main rotor above a cabin, a tail boom behind: what a multirotor is not."""
    paint = _paint(rng)
    canvas = _Canvas(rotation(rng, tilt=0.15))
    cabin = rng.uniform(0.2, 0.32)
    canvas.bar((-0.2, 0, 0.05), (-1.4, 0, 0.15), 0.09, paint(0.9))
    canvas.hull(np.array([[-1.3, 0, 0.1], [-1.5, 0, 0.1], [-1.55, 0, 0.45], [-1.45, 0, 0.45]]), paint(0.9))
    canvas.hull(_ellipsoid((0.1, 0, 0), (rng.uniform(0.4, 0.6), cabin, cabin)), paint(1.0))
    for side in (-1, 1):
        canvas.bar((-0.3, side * 0.2, -0.4), (0.4, side * 0.2, -0.4), 0.05, paint(0.7))
    canvas.bar((0.05, 0, cabin), (0.05, 0, 0.42), 0.08, paint(0.7))
    hub = np.array([0.05, 0.0, 0.42])
    if rng.random() < 0.6:
        canvas.hull(_disc(hub, 1.4), paint(1.2), rng.uniform(0.05, 0.25))
    for angle in rng.uniform(0, np.pi) + np.array([0, np.pi / 2])[: int(rng.integers(1, 3))]:
        blade = 1.4 * np.array([np.cos(angle), np.sin(angle), 0])
        canvas.bar(hub - blade, hub + blade, 0.06, paint(0.7), rng.uniform(0.4, 1.0))
    return _shade(rng, canvas.sprite())


def cloud(rng: Rng) -> Sprite:
    """A puff with soft edges, mostly bright, often faint: what a detector that never saw one takes for a drone."""
    lumps = np.clip(fractal_noise(rng, CANVAS, CANVAS, 5, 0.6) + rng.uniform(0.0, 0.6), 0, 1.5)
    u = np.linspace(-1, 1, CANVAS, dtype=np.float32)
    window = np.clip(1 - u[None] ** 2 - (u[:, None] * rng.uniform(1.0, 2.5)) ** 2, 0, 1)
    alpha = np.clip(lumps * window, 0, 1).astype(np.float32) * np.float32(
        np.exp(rng.uniform(np.log(0.08), 0))
    )
    light = np.linspace(rng.uniform(190, 255), rng.uniform(100, 240), CANVAS, dtype=np.float32)
    tint = rng.normal(0, 14, 3).astype(np.float32)
    colour = alpha[..., None] * np.clip(light[:, None, None] + tint, 0, 255)
    return crop_to_visible(Sprite(colour, alpha), 0.1 * float(alpha.max()))


def lump(rng: Rng) -> Sprite:
    """A round or oblong thing without parts: balloon, insect out of focus, dirt on the lens, a lamp."""
    paint = _paint(rng) if rng.random() < 0.7 else (lambda _: rng.uniform(0, 255, 3))
    canvas = _Canvas(rotation(rng, tilt=0.6))
    canvas.hull(_ellipsoid((0, 0, 0), rng.uniform(0.25, 1.3, 3)), paint(1.0))
    if rng.random() < 0.4:
        canvas.hull(_box(rng.normal(0, 0.4, 3), rng.uniform(0.1, 0.5, 3)), paint(0.7))
    return _shade(rng, canvas.sprite())


def flare(rng: Rng) -> Sprite:
    """One to three faint soft spots, a little tinted: ghosts of the sun in the lens, insects out of focus."""
    v, u = np.mgrid[-1 : 1 : CANVAS * 1j, -1 : 1 : CANVAS * 1j].astype(np.float32)
    alpha = np.zeros((CANVAS, CANVAS), np.float32)
    for _ in range(int(rng.integers(1, 4))):
        (x, y), (a, b) = rng.normal(0, 0.25, 2), rng.uniform(0.1, 0.35, 2)
        alpha += np.exp(-(((u - x) / a) ** 2) - ((v - y) / b) ** 2) * np.float32(rng.uniform(0.3, 1.0))
    alpha *= np.float32(rng.uniform(0.05, 0.5)) / alpha.max()
    light = np.clip(rng.uniform(60, 255) + rng.normal(0, 25, 3), 0, 255).astype(np.float32)
    return crop_to_visible(Sprite(alpha[..., None] * light, alpha), 0.01)


def pole(rng: Rng) -> Sprite:
    """Masts, antennas, branches: thin bars that meet, as a drone's arms do, but are no drone."""
    paint = _paint(rng)
    canvas = _Canvas(np.eye(3))
    x = rng.uniform(-0.3, 0.3)
    canvas.bar(
        (x, 0, -1.7), (x + rng.normal(0, 0.2), 0, rng.uniform(0.2, 1.6)), rng.uniform(0.03, 0.12), paint(1.0)
    )
    for _ in range(int(rng.integers(0, 5))):
        z, reach = rng.uniform(-1.2, 1.4), rng.uniform(0.2, 1.4)
        canvas.bar((x, 0, z), (x + rng.choice([-1, 1]) * reach, 0, z + rng.normal(0, 0.4)), 0.04, paint(1.0))
    return canvas.sprite()


def wires(rng: Rng) -> Sprite:
    """Lines that sag between poles, with what hangs on them: balls, insulators, birds at rest."""
    paint = _paint(rng)
    canvas = _Canvas(np.eye(3))
    x = np.linspace(-1.7, 1.7, 9)
    slope, sag, bearer = rng.normal(0, 0.25), rng.uniform(0.0, 0.35), rng.uniform(-1.5, 1.5)
    for height in rng.uniform(-0.7, 0.9, int(rng.integers(1, 6))):
        z = height + slope * x + sag * (x / 1.7) ** 2
        points = np.stack([x, np.zeros_like(x), np.clip(z, -1.7, 1.7)], axis=1)
        colour = paint(1.0)
        for start, end in pairwise(points):
            canvas.bar(start, end, 0.02, colour)
        if rng.random() < 0.4:
            canvas.hull(_ellipsoid(points[rng.integers(len(points))], rng.uniform(0.04, 0.14, 3)), paint(0.8))
    if rng.random() < 0.5:
        canvas.bar((bearer, 0, -1.7), (bearer, 0, rng.uniform(0.3, 1.5)), rng.uniform(0.04, 0.12), paint(0.8))
    return canvas.sprite()


def house(rng: Rng) -> Sprite:
    """A wall, a roof, windows in a row: from afar a body with dark parts at its sides."""
    wall, roof = _paint(rng), _paint(rng)
    canvas = _Canvas(np.eye(3))
    half, low, top = rng.uniform(0.5, 1.4), rng.uniform(-1.0, -0.5), rng.uniform(-0.2, 0.5)
    eaves, ridge, rise = half * rng.uniform(1.0, 1.15), half * rng.uniform(0.0, 0.9), rng.uniform(0.0, 0.8)
    canvas.hull(_upright(-half, half, low, top), wall(1.0))
    corners = [(-eaves, top), (eaves, top), (ridge, top + rise), (-ridge, top + rise)]
    canvas.hull(np.array([(x, 0.0, z) for x, z in corners]), roof(rng.uniform(0.5, 1.2)))
    if rng.random() < 0.5:
        x = rng.uniform(-ridge, ridge)
        canvas.hull(_upright(x - 0.06, x + 0.06, top, top + rise + 0.2), roof(0.8))
    pane, step, glass = rng.uniform(0.1, 0.3), rng.uniform(0.35, 0.8), wall(rng.uniform(0.2, 0.7))
    for storey in range(int(rng.integers(1, 3))):
        z = low + (0.25 + 0.45 * storey) * (top - low)
        for x in np.arange(-half + 0.1, half - pane, step):
            canvas.hull(_upright(x, x + pane, z, z + 0.25 * (top - low)), glass)
    return _shade(rng, canvas.sprite())


def tree(rng: Rng) -> Sprite:
    """A trunk, branches and a ragged crown, or bare branches that spread as arms do."""
    leaf, wood = _paint(rng), _paint(rng)
    canvas = _Canvas(np.eye(3))
    fork = rng.uniform(-0.8, 0.0)
    canvas.bar((0, 0, -1.6), (rng.normal(0, 0.1), 0, fork), rng.uniform(0.05, 0.2), wood(0.8))
    tips = np.stack(
        [rng.normal(0, 0.6, 9), np.zeros(9), np.clip(fork + rng.uniform(0.2, 1.7, 9), None, 1.4)], axis=1
    ).clip(-1.3, 1.4)
    for tip in tips:
        canvas.bar((0, 0, fork), tip, rng.uniform(0.02, 0.08), wood(0.9))
    if rng.random() < 0.75:
        for tip in tips:
            canvas.hull(_ellipsoid(tip, rng.uniform(0.15, 0.4, 3)), leaf(rng.uniform(0.7, 1.3)))
    return _shade(rng, canvas.sprite())


def car(rng: Rng) -> Sprite:
    """A vehicle from the side or from above it: body, cabin, glass, wheels at the ends."""
    paint = _paint(rng)
    canvas = _Canvas(rotation(rng, tilt=0.05))
    length, width, height = rng.uniform(1.0, 1.4), rng.uniform(0.4, 0.55), rng.uniform(0.15, 0.25)
    for x in (-0.6, 0.6):
        for y in (-1, 1):
            canvas.hull(
                _ellipsoid((x * length, y * width, -height), (0.22, 0.06, 0.22)), rng.uniform(0, 60, 3)
            )
    canvas.hull(_box((0, 0, 0), (length, width, height)), paint(1.0))
    back, front = rng.uniform(-1.0, -0.5) * length, rng.uniform(0.1, 0.6) * length
    middle, half = (back + front) / 2, (front - back) / 2
    cabin = _box((middle, 0, 1.7 * height), (half, 0.9 * width, 0.7 * height))
    canvas.hull(cabin, paint(rng.uniform(0.3, 0.8)))
    canvas.hull(_box((middle, 0, 2.5 * height), (0.8 * half, 0.8 * width, 0.02)), paint(1.2))
    return _shade(rng, canvas.sprite())


def _upright(left: float, right: float, low: float, high: float) -> NDArray[np.float64]:
    """Corners of a rectangle that faces the camera."""
    return np.array([(left, 0.0, low), (right, 0.0, low), (right, 0.0, high), (left, 0.0, high)])


DISTRACTORS: dict[str, Callable[[Rng], Sprite]] = {
    "bird": bird,
    "aeroplane": aeroplane,
    "helicopter": helicopter,
    "cloud": cloud,
    "lump": lump,
    "flare": flare,
    "pole": pole,
    "wires": wires,
    "house": house,
    "tree": tree,
    "car": car,
}


FLYING_DISTRACTORS = (
    "bird",
    "aeroplane",
    "helicopter",
    "lump",
)  # objects with a place of their own; the rest is scenery


def _shade(rng: Rng, sprite: Sprite) -> Sprite:
    """Light from above or below: a vertical ramp of brightness."""
    ramp = np.linspace(rng.uniform(0.7, 1.35), rng.uniform(0.6, 1.2), len(sprite.alpha), dtype=np.float32)
    colour = np.minimum(sprite.colour * ramp[:, None, None], 255 * sprite.alpha[..., None])
    return Sprite(colour, sprite.alpha)


def fractal_noise(rng: Rng, height: int, width: int, octaves: int, persistence: float) -> FloatImage:
    """Sum of smooth random fields, each twice as fine and `persistence` times as strong as the one before."""
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        coarse = rng.standard_normal((2 ** (octave + 1) + 1, 2 ** (octave + 1) + 2)).astype(np.float32)
        field = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        total += np.float32(persistence**octave) * field
    return total


def background(rng: Rng, height: int, width: int) -> FloatImage:
    """(height, width, 3) BGR 0…255: sky with or without clouds and horizon, or clutter."""
    return _sky(rng, height, width) if rng.random() < 0.65 else _clutter(rng, height, width)


def _sky(rng: Rng, height: int, width: int) -> FloatImage:
    top = np.array([rng.uniform(120, 255), rng.uniform(80, 235), rng.uniform(30, 230)])
    if rng.random() < 0.35:  # overcast
        top = rng.uniform(80, 245) + rng.normal(0, 6, 3)
    bottom = np.clip(top + rng.normal(15, 25, 3), 0, 255)
    down = np.linspace(0, 1, height)[:, None, None]
    image = (top * (1 - down) + bottom * down) * np.ones((1, width, 1))
    clouds = rng.random()
    if clouds < 0.4:
        cover = np.clip(
            fractal_noise(rng, height, width, 5, rng.uniform(0.4, 0.65)) + rng.uniform(-0.5, 0.5), 0, 2
        )
        image += cover[..., None] * rng.uniform(-25, 60)
    elif clouds < 0.7:
        image = _cumulus(rng, image)
    if rng.random() < 0.1:  # contrail
        start, end = rng.uniform(0, [width, height]), rng.uniform(0, [width, height])
        trail = np.zeros((height, width), np.float32)
        cv2.line(trail, _point(start), _point(end), 1.0, int(rng.integers(1, 5)), cv2.LINE_AA)
        image += cv2.GaussianBlur(trail, (0, 0), rng.uniform(0.5, 3))[..., None] * rng.uniform(20, 120)
    if rng.random() < 0.6:
        image = _ground(rng, image, int(height * rng.uniform(0.25, 1.0)))
    return np.clip(image, 0, 255).astype(np.float32)


def _cumulus(rng: Rng, image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heaps of cloud with edges and lit from one side; their tatters are what a detector takes for drones."""
    height, width = image.shape[:2]
    noise = fractal_noise(rng, height, width, 7, rng.uniform(0.5, 0.75))
    alpha = np.clip((noise + rng.uniform(-1.0, 0.7)) * rng.uniform(0.7, 4.0), 0, 1)
    shift = int(rng.integers(2, 12))
    relief = cv2.GaussianBlur(noise - np.roll(noise, shift, axis=int(rng.integers(0, 2))), (0, 0), 1.5)
    light = rng.uniform(150, 250) + relief * rng.uniform(-50, 50) - alpha * rng.uniform(-20, 60)
    colour = np.clip(light[..., None] + rng.normal(0, 6, 3), 0, 255)
    return np.asarray(image * (1 - alpha[..., None]) + colour * alpha[..., None])


def _ground(rng: Rng, image: NDArray[np.float64], horizon: int) -> NDArray[np.float64]:
    """Everything below an uneven ridge becomes textured ground, with trunks and masts standing on it."""
    height, width = image.shape[:2]
    ridge = (fractal_noise(rng, 2, width, 6, 0.7)[0] * rng.uniform(1, 14) + horizon).astype(int)
    texture = fractal_noise(rng, height, width, 8, rng.uniform(0.6, 1.0))[..., None]
    tree = np.clip(rng.uniform(10, 150) + rng.normal(0, 20, 3) + texture * rng.uniform(4, 28), 0, 255)
    below = np.arange(height)[:, None] > ridge[None]
    image = np.where(below[..., None], tree, image)
    for _ in range(int(rng.integers(0, 14))):
        x = int(rng.integers(0, width))
        top = (int(x + rng.normal(0, 4)), int(ridge[x] - rng.integers(0, 50)))
        colour = rng.uniform(0, 180) + rng.normal(0, 10, 3)
        cv2.line(image, (x, int(ridge[x]) + 20), top, colour.tolist(), int(rng.integers(1, 3)), cv2.LINE_AA)
    return image


def _clutter(rng: Rng, height: int, width: int) -> FloatImage:
    """Texture with rectangles, lines and discs on it: rooms, buildings, yards."""
    noise = fractal_noise(rng, height, width, 8, rng.uniform(0.5, 0.95))[..., None]
    image = rng.uniform(20, 230, 3) + noise * rng.uniform(3, 40) * rng.uniform(0.6, 1.2, 3)
    for _ in range(int(rng.integers(2, 25))):
        a, b = (_point(rng.uniform(-20, [width + 20, height + 20])) for _ in range(2))
        colour = rng.uniform(0, 255, 3).tolist()
        shape = rng.random()
        if shape < 0.5:
            cv2.rectangle(image, a, b, colour, -1 if rng.random() < 0.6 else 2)
        elif shape < 0.85:
            cv2.line(image, a, b, colour, int(rng.integers(1, 5)), cv2.LINE_AA)
        else:
            cv2.circle(image, a, int(rng.integers(2, 30)), colour, -1, cv2.LINE_AA)
    return np.clip(image, 0, 255).astype(np.float32)


def _point(xy: NDArray[np.float64]) -> tuple[int, int]:
    return int(xy[0]), int(xy[1])


def paste_into(
    rng: Rng,
    image: FloatImage,
    sprite: Sprite,
    centre: NDArray[np.float64],
    size: float,
    *,
    mirror: bool = True,
) -> NDArray[np.float64] | None:
    """Draw the sprite into `image`, its longer side `size` px, with haze, blur and maybe motion blur.

    centre (2,) px, pixel centres at integers. Returns the box of the sharp sprite as (4,) [u, v, w, h] with u, v
    its centre, or None where nothing of it is inside the image.
    """
    height, width = image.shape[:2]
    scale = size / max(sprite.alpha.shape)
    w, h = max(2, round(sprite.alpha.shape[1] * scale)), max(2, round(sprite.alpha.shape[0] * scale))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    layer: Any = cv2.resize(np.dstack([sprite.colour, sprite.alpha]), (w, h), interpolation=how)
    if mirror and rng.random() < 0.5:
        layer = layer[:, ::-1]
    margin = max(3, int(size * 0.2))
    layer = np.pad(layer, ((margin, margin), (margin, margin), (0, 0)))
    if rng.random() < 0.3:
        layer = cv2.filter2D(layer, -1, motion_kernel(rng, min(rng.exponential(size * 0.12), margin)))
    layer = cv2.GaussianBlur(layer, (0, 0), abs(rng.normal(0, 0.6)) + 0.2)
    layer *= np.float32(rng.uniform(0.55, 1.0))  # haze: the background shines through

    left, top = int(np.round(centre[0] - (w - 1) / 2)), int(np.round(centre[1] - (h - 1) / 2))
    x, y = left - margin, top - margin
    x0, y0 = max(0, x), max(0, y)
    x1, y1 = min(width, x + layer.shape[1]), min(height, y + layer.shape[0])
    if x1 - x0 < 2 or y1 - y0 < 2:
        return None
    part = layer[y0 - y : y1 - y, x0 - x : x1 - x]
    image[y0:y1, x0:x1] = np.clip(image[y0:y1, x0:x1] * (1 - part[..., 3:]) + part[..., :3], 0, 255)
    return np.array([left + (w - 1) / 2, top + (h - 1) / 2, w, h])


def motion_kernel(rng: Rng, length: float) -> FloatImage:
    """A line of `length` px in any direction, summing to one."""
    side = int(np.ceil(length)) // 2 * 2 + 3
    angle, half = rng.uniform(0, np.pi), length / 2
    along = np.array([np.cos(angle), np.sin(angle)]) * half
    middle = np.array([side // 2, side // 2], float)
    kernel = np.zeros((side, side), np.float32)
    a, b = (np.round((middle + k * along) * 8).astype(int).tolist() for k in (-1, 1))
    cv2.line(kernel, a, b, 1.0, 1, cv2.LINE_AA, SUBPIXEL_BITS)
    return np.asarray(kernel / max(float(kernel.sum()), 1e-3), np.float32)


def photograph(rng: Rng, image: FloatImage) -> NDArray[np.uint8]:
    """What a camera and its encoder do: colour balance, exposure, saturation, blur, sensor noise, JPEG, or grey."""
    light: Any = image * rng.uniform(0.85, 1.15, 3).astype(np.float32) * np.float32(rng.uniform(0.6, 1.25))
    light += np.float32(rng.normal(0, 12))
    grey = light.mean(axis=2, keepdims=True)
    saturation = 0.0 if rng.random() < 0.12 else rng.uniform(0.5, 1.4)
    light = grey + (light - grey) * np.float32(saturation)
    if rng.random() < 0.3:
        light = cv2.GaussianBlur(light, (0, 0), rng.uniform(0.3, 1.1))
    if rng.random() < 0.6:
        light = light + rng.standard_normal(light.shape, np.float32) * np.float32(rng.exponential(3.0))
    picture: Any = np.clip(light, 0, 255).astype(np.uint8)
    if rng.random() < 0.25:
        picture = cv2.LUT(picture, _gamma_table(rng.uniform(0.6, 1.6)))
    if rng.random() < 0.6:
        quality = int(rng.integers(35, 96))
        encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    return np.asarray(picture, np.uint8)


def _gamma_table(gamma: float) -> NDArray[np.uint8]:
    return (255 * (np.arange(256) / 255) ** gamma).astype(np.uint8)
