"""A verdict on a machine without time to spare says so."""

import math

import pytest

from swarmtrack.localswarm.machine_load import MachineLoad, lighter_flights


def stat(path, user, idle, waiting=0):
    path.write_text(f"cpu  {user} 0 0 {idle} {waiting} 0 0 0 0 0\ncpu0 0 0 0 0 0 0 0 0 0 0\n")


def test_the_share_is_that_of_the_time_since_it_was_made(tmp_path):
    stat(tmp_path / "stat", user=1000, idle=9000)
    load = MachineLoad(tmp_path / "stat")
    stat(tmp_path / "stat", user=1090, idle=9005, waiting=5)
    assert load.share() == pytest.approx(0.9)


@pytest.mark.parametrize("content", ["", "cpu one two", "nonsense"])
def test_where_the_kernel_does_not_say_it_is_unknown(tmp_path, content):
    assert math.isnan(MachineLoad(tmp_path / "missing").share())
    (tmp_path / "stat").write_text(content)
    assert math.isnan(MachineLoad(tmp_path / "stat").share())


def test_only_what_was_not_flown_yet_is_advised():
    assert lighter_flights(3, "onnx") == (
        "with fewer --drones or with --detector oracle or when nothing else runs on it"
    )
    assert lighter_flights(2, "oracle") == "when nothing else runs on it"


def test_this_machine_is_somewhere_between_idle_and_busy():
    load = MachineLoad()
    sum(range(3_000_000))
    share = load.share()
    assert math.isnan(share) or 0.0 <= share <= 1.0
