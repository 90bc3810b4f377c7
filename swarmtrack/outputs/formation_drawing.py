"""Drawing of a formation: slots from above, heights from the side, and lines of sight; as text and as SVG."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from swarmtrack.formation.margins import REFERENCE_VIEW_SHARE
from swarmtrack.formation.plan import FormationPlan, HalfView, nearest_view, neighbours_at_one_height

# Signs of the text's drawing, at most; a sign is twice as high as wide.
DRAWING_COLUMNS, DRAWING_ROWS = 61, 21
# px of the SVG: one drawing's width, and the margin around it.
PANEL, DRAWING_MARGIN = 440.0, 76.0
ARC_STEPS = 8  # of the border of half a view
DRAWING_COLOURS = {
    "leader": "#c2410c",
    "follower": "#1d4ed8",
    "line": "#94a3b8",
    "view": "#dbeafe",
    "text": "#0f172a",
}


def as_text(plan: FormationPlan, drone: int, views: Sequence[HalfView]) -> str:
    """View from above, and a line for each slot. drone: the config's own, with the views of its cameras."""
    lines = [*_grid(plan), *_slot_lines(plan, drone, views)]
    lines.append(
        f"the leader flies at most {plan.most_speed():.1f} m/s, and turns by 20°/s or less: else they fall behind"
    )
    lines += [
        f"warning: drones {one} and {other} are {apart:.1f} m apart at one height and do not see each other: give them "
        "heights 1 m apart"
        for one, other, apart in neighbours_at_one_height(plan)
    ]
    return "\n".join(lines)


def _grid(plan: FormationPlan) -> Iterator[str]:
    """North is up."""
    places = {drone: (east, north) for drone, (north, east, _) in plan.slots.items()}
    left, right = min(x for x, _ in places.values()), max(x for x, _ in places.values())
    low, high = min(y for _, y in places.values()), max(y for _, y in places.values())
    # m per row: the smallest round one with which all fit.
    step = next(
        (
            m
            for m in (0.5, 1.0, 2.0, 5.0, 10.0)
            if (right - left) / m * 2 < DRAWING_COLUMNS - 6 and (high - low) / m < DRAWING_ROWS
        ),
        20.0,
    )
    rows = round((high - low) / step) + 1
    signs = [[" "] * (round(2 * (right - left) / step) + 6) for _ in range(rows)]
    for drone, (x, y) in sorted(places.items(), reverse=True):
        row, column = round((high - y) / step), round(2 * (x - left) / step)
        for k, sign in enumerate(f"[{drone}]" if drone == plan.leader else str(drone)):
            signs[row][column + k] = sign
    yield f"from above, north up, a line is {step:g} m:"
    yield from ("    " + "".join(row).rstrip() for row in signs)


def _slot_lines(plan: FormationPlan, drone: int, views: Sequence[HalfView]) -> Iterator[str]:
    yield f"{plan.leader:5d}  leads, {plan.height_of(plan.leader):.1f} m high"
    for follower in plan.followers:
        north, east, _ = plan.slots[follower]
        looks = []
        for look in plan.looks(follower):
            number, share = nearest_view(look, views)
            which = f" of camera {number + 1}" if len(views) > 1 else ""
            seen = f", at {share:.0%} of the half view{which}" if follower == drone else ""
            looks.append(f"drone {look.reference} {look.distance:.1f} m away{seen}")
        mine = "  (this drone)" if follower == drone else ""
        yield (
            f"{follower:5d}  {north:+.1f} m north, {east:+.1f} m east, {plan.height_of(follower):.1f} m high; looks at "
            f"{' and '.join(looks)}{mine}"
        )


def as_svg(plan: FormationPlan, drone: int, views: Sequence[HalfView]) -> str:
    """Views from above and from the south, with this drone's views; for a browser."""
    span = max(
        [2.0] + [abs(a - b) for axis in range(3) for a in _axis(plan, axis) for b in _axis(plan, axis)]
    )
    scale = (PANEL - 2.0 * DRAWING_MARGIN) / span
    width, height = 2.0 * PANEL, PANEL + 40.0
    metres = 1 if scale > 12.0 else 5
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
        f'viewBox="0 0 {width:.0f} {height:.0f}" font-family="sans-serif" font-size="14" '
        f'fill="{DRAWING_COLOURS["text"]}">',
        '<rect width="100%" height="100%" fill="white"/>',
        *_panel(plan, drone, views, scale, 0.0, above=True),
        *_panel(plan, drone, views, scale, PANEL, above=False),
        f'<text x="{0.5 * DRAWING_MARGIN:.0f}" y="{PANEL + 24.0:.0f}">grid of {metres} m; heights above the team '
        f"frame's origin; shaded: {REFERENCE_VIEW_SHARE:.0%} of "
        f"{'the view' if len(views) == 1 else 'each view'} of drone "
        f"{drone}</text>",
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _axis(plan: FormationPlan, axis: int) -> list[float]:
    return [place[axis] for place in plan.slots.values()]


def _panel(
    plan: FormationPlan, drone: int, views: Sequence[HalfView], scale: float, offset: float, *, above: bool
) -> Iterator[str]:
    """From above: north up, east to the right. From the south: up is up."""
    across, upward = 1, 0 if above else 2
    middle = [0.5 * (min(_axis(plan, k)) + max(_axis(plan, k))) for k in range(3)]
    sign = 1.0 if above else -1.0

    def at(place: tuple[float, float, float]) -> tuple[float, float]:
        x = offset + 0.5 * PANEL + scale * (place[across] - middle[across])
        return x, 0.5 * PANEL - scale * sign * (place[upward] - middle[upward])

    yield f'<text x="{offset + 0.5 * PANEL:.0f}" y="22" text-anchor="middle">'
    yield f"{'from above, north up' if above else 'from the south'}</text>"
    yield from _metres(scale, offset)
    if above and drone in plan.references:
        yield from (_wedge(plan, drone, view, scale, at(plan.slots[drone])) for view in views)
    for follower in plan.followers:
        for reference in plan.references[follower]:
            (x1, y1), (x2, y2) = at(plan.slots[follower]), at(plan.slots[reference])
            yield (
                f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{DRAWING_COLOURS["line"]}" '
                'stroke-dasharray="5 4"/>'
            )
    for each, place in plan.slots.items():
        x, y = at(place)
        colour = DRAWING_COLOURS["leader" if each == plan.leader else "follower"]
        label = f"{each}" if above else f"{each}: {plan.height_of(each):.1f} m"
        yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" fill="{colour}"/>'
        yield f'<text x="{x + 11.0:.1f}" y="{y - 8.0:.1f}">{label}</text>'


def _metres(scale: float, offset: float) -> Iterator[str]:
    """A grid of 1 m behind everything, or of 5 m where it would be too dense."""
    step = scale if scale > 12.0 else 5.0 * scale
    low, high = 0.5 * DRAWING_MARGIN, PANEL - 0.5 * DRAWING_MARGIN
    for k in range(int((high - low) / step) + 1):
        z = low + k * step
        yield f'<path d="M{offset + z:.1f} {low:.1f}V{high:.1f}" stroke="#e2e8f0" fill="none"/>'
        yield f'<path d="M{offset + low:.1f} {z:.1f}H{offset + high:.1f}" stroke="#e2e8f0" fill="none"/>'


def _wedge(plan: FormationPlan, drone: int, view: HalfView, scale: float, corner: tuple[float, float]) -> str:
    """What a camera sees level, the first one towards the middle of the references."""
    look = plan.looks(drone)[0]
    there, here = plan.slots[look.reference], plan.slots[drone]
    middle = math.atan2(there[1] - here[1], there[0] - here[0]) - look.right + view.right
    half, x, y = REFERENCE_VIEW_SHARE * view.half_width, *corner
    length = scale * (max(look.distance for look in plan.looks(drone)) + 0.5)
    turns = [middle + half * (k / ARC_STEPS - 1.0) for k in range(2 * ARC_STEPS + 1)]
    border = "".join(f"L{x + length * math.sin(a):.1f} {y - length * math.cos(a):.1f}" for a in turns)
    return f'<path d="M{x:.1f} {y:.1f}{border}Z" fill="{DRAWING_COLOURS["view"]}"/>'
