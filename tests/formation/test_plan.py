import math

import numpy as np
import pytest

from swarmtrack.config.formation import fields_of_view
from swarmtrack.formation.plan import (
    FormationPlan,
    HalfView,
    neighbours_at_one_height,
    plan_faults,
    range_faults,
    view_faults,
)
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA, from_euler
from swarmtrack.relative.box_width import BoxWidth

VIEW = HalfView(math.radians(45.0), math.radians(37.0), 0.0)
ARC = {2: (-4.0, 3.0, -1.0), 3: (-4.0, -3.0, 1.0)}


def plan(slots=ARC, references=None, height=6.0, least_height=2.0):
    return FormationPlan(
        leader=1,
        slots={1: (0.0, 0.0, 0.0), **slots},
        references={drone: (references or {}).get(drone, (1,)) for drone in slots},
        height=height,
        least_height=least_height,
    )


def faults(*args, **kwargs):
    return [(fault.key, fault.text) for fault in plan_faults(plan(*args, **kwargs), 0.5)]


def test_a_star_on_an_arc_with_layers_is_sound():
    assert faults() == []
    assert view_faults(plan(), 2, [VIEW]) == []
    assert list(neighbours_at_one_height(plan())) == []


def test_slots_that_are_too_near_are_refused():
    [(key, text)] = faults({2: (-4.0, 1.0, 0.0), 3: (-4.0, -0.5, 0.0)})
    assert key == ("slots", "3")
    assert text == "1.5 m from the slot of drone 2, expected 2 m or more"


def test_a_slot_that_hides_a_reference_is_refused():
    found = faults({2: (-3.0, 0.0, 0.0), 3: (-6.0, 0.4, 0.0)})
    assert [key for key, _ in found] == [("slots", "3")]
    assert found[0][1].startswith("drone 2 hides drone 1: 0.20 m off the line of sight")
    # Who is behind one, or behind the reference, hides nobody.
    assert faults({2: (-3.0, 0.0, 0.0), 3: (3.0, 0.0, 0.0)}) == []


def test_a_slot_below_the_least_height_is_refused():
    assert faults(height=2.5) == [
        (
            ("slots", "3"),
            "1.5 m high, expected limits.least_height_m = 2 or more above the team frame's origin",
        )
    ]


def test_chains_of_more_than_three_and_circles_are_refused():
    line = {k: (-4.0 * (k - 1), 2.0 * (k - 1) ** 2, 0.0) for k in (2, 3, 4)}
    assert faults(line, {3: (2,)}) == []
    [(key, text)] = faults(line, {3: (2,), 4: (3,)})
    assert (key, text) == (
        ("references", "4"),
        "drone 4 is the 4th of a chain, expected 3 with the leader",
    )
    assert {key for key, _ in faults(ARC, {2: (3,), 3: (2,)})} == {("references", "2"), ("references", "3")}


@pytest.mark.parametrize(
    ("slots", "references", "said"),
    [
        # Two references are at the borders of the view between them.
        ({2: (-3.0, 0.0, 0.0), 3: (0.0, 6.0, 0.0)}, {2: (1, 3)}, []),
        (
            {2: (-1.0, 3.0, 0.0), 3: (0.0, 6.0, 0.0)},
            {2: (1, 3)},
            ["drone 1 is 72° beside", "drone 3 is 72° beside"],
        ),
        ({2: (-3.0, 0.0, -3.0)}, None, ["drone 1 is 45° below"]),
        ({2: (-3.0, 0.0, 3.0)}, None, ["drone 1 is 45° above"]),
    ],
)
def test_references_beyond_the_view_are_refused(slots, references, said):
    found = [fault.text for fault in view_faults(plan(slots, references), 2, [VIEW])]
    assert len(found) == len(said)
    assert all(text.startswith(start) for text, start in zip(found, said, strict=True))


def test_a_drone_that_tilts_for_its_acceleration_needs_a_higher_view():
    steep = plan({2: (-4.0, 0.0, -2.0)})  # 27° below the axis, of 37°
    assert view_faults(steep, 2, [VIEW]) == []
    [fault] = view_faults(steep, 2, [VIEW], acceleration=3.0)
    assert "27° below the camera's axis, expected at most 20°" in fault.text


def test_a_camera_that_looks_up_sees_a_leader_that_is_higher():
    steep = plan({2: (-3.0, 0.0, 3.0)})
    assert view_faults(steep, 2, [VIEW._replace(up=math.radians(30.0))]) == []


def turned(right_deg: float, **more: float) -> HalfView:
    return VIEW._replace(right=math.radians(right_deg), **more)


def test_a_reference_is_in_view_if_any_camera_has_it():
    """Two references 144° apart, their middle ahead of the first camera: of three cameras the other two have them."""
    wide = plan({2: (-1.0, 3.0, 0.0), 3: (0.0, 6.0, 0.0)}, {2: (1, 3)})
    assert [look.right for look in wide.looks(2)] == pytest.approx(
        [-math.radians(72), math.radians(72)], abs=0.01
    )
    assert view_faults(wide, 2, [VIEW, turned(90), turned(-90)]) == []
    [fault] = view_faults(wide, 2, [VIEW, turned(90)])
    assert fault.text.startswith(
        "drone 1 is 72° beside the axis of camera 1, the nearest, expected at most 36°"
    )
    [fault] = view_faults(wide, 2, [VIEW, turned(-60), turned(30)])
    assert fault.text.startswith("drone 3 is 42° beside the axis of camera 3, the nearest")


def test_views_are_those_of_a_drone_that_turns_its_first_camera_to_its_references():
    lens = PinholeCamera(320.0, 320.0, 319.5, 239.5, 640, 480)

    def views(*yaw_deg: float) -> list[HalfView]:
        turned = (from_euler(0.0, 0.0, math.radians(yaw)) @ BODY_FROM_FORWARD_CAMERA for yaw in yaw_deg)
        return fields_of_view((lens, Pose(rotation, np.zeros(3))) for rotation in turned)

    assert view_faults(plan({2: (-4.0, 0.0, 0.0)}), 2, views(90.0)) == []
    assert [view.right for view in views(30.0, -30.0)] == pytest.approx([0.0, math.radians(-60.0)])
    # Both would be in view if the nose were turned to their middle, and it is not.
    aside = plan({2: (-3.0, 3.0, 0.0), 3: (0.0, 6.0, 0.0)}, {2: (1, 3)})
    [fault] = view_faults(aside, 2, views(30.0, -30.0))
    assert fault.text.startswith("drone 3 is 45° beside the axis of camera 1, the nearest")
    assert view_faults(aside, 2, views(0.0, 60.0, -60.0)) == []


def test_there_must_be_somewhere_to_turn_to():
    """One reference ahead and one behind: all-round cameras see both, and no heading is the better one."""
    between = plan({2: (-4.0, 0.0, 0.0), 3: (-8.0, 0.3, 0.0)}, {2: (1, 3)})
    all_round = [turned(90 * k, half_width=math.radians(60)) for k in range(4)]
    [fault] = view_faults(between, 2, all_round)
    assert fault.key == ("references", "2")
    assert "opposite directions" in fault.text
    aside = plan({2: (-4.0, 0.0, 0.0), 3: (-5.0, 4.0, 0.0)}, {2: (1, 3)})
    assert view_faults(aside, 2, all_round) == []


def test_a_camera_on_its_side_sees_higher_than_wide():
    high = plan({2: (-4.0, 0.0, 2.8)})  # 35° above
    narrow = HalfView(math.radians(45.0), math.radians(20.0), 0.0)
    assert view_faults(high, 2, [narrow]) != []
    assert view_faults(high, 2, [narrow._replace(roll=math.radians(90.0))]) == []


def test_ranges_by_size_alone_need_boxes_that_tell_them():
    assert range_faults(BoxWidth(), told=True) == []
    assert range_faults(BoxWidth(drone_sigma=0.10, wander_sigma=0.05), told=False) == []
    [fault] = range_faults(BoxWidth(), told=False)
    assert "give a range to 23%, expected 12% or better" in fault.text


def test_neighbours_at_one_height_are_told_of():
    flat = plan({2: (-4.0, 2.0, 0.0), 3: (-4.0, -2.0, 0.0), 4: (-4.0, 20.0, 0.0)})
    assert list(neighbours_at_one_height(flat)) == [(2, 3, 4.0)]
    assert list(neighbours_at_one_height(plan(flat.slots, {2: (1, 3)}))) == []


def test_the_leader_is_as_fast_as_the_nearest_follower_can_bear():
    assert plan().most_speed() == pytest.approx(math.sqrt(26.0) / 3.0)
