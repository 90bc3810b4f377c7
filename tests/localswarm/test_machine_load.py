"""A verdict on a machine without time to spare says so."""

import math

import pytest

from swarmtrack.localswarm.machine_load import MachineLoad, lighter_flights, too_large


def stat(path, user, idle, waiting=0):
    path.write_text(f"cpu  {user} 0 0 {idle} {waiting} 0 0 0 0 0\ncpu0 0 0 0 0 0 0 0 0 0 0\n")


def test_the_share_is_that_of_the_time_since_it_was_made(tmp_path):
    stat(tmp_path / "stat", user=1000, idle=9000)
    load = MachineLoad(tmp_path / "stat")
    stat(tmp_path / "stat", user=1090, idle=9005, waiting=5)
    assert load.share() == pytest.approx(0.9)


def test_the_share_of_some_seconds_is_theirs_alone(tmp_path):
    file = tmp_path / "stat"
    stat(file, user=0, idle=0)
    load = MachineLoad(file)
    for second, (user, idle) in enumerate([(0, 0), (50, 150), (250, 150), (440, 160), (460, 340)]):
        stat(file, user=user, idle=idle)
        load.look(float(second))
    assert load.share_in([(1.2, 1.9)]) == pytest.approx(1.0)
    assert load.share_in([(1.5, 2.5)]) == pytest.approx(390 / 400)
    assert load.share() == pytest.approx(0.575)
    assert math.isnan(load.share_in([]))
    assert math.isnan(load.share_in([(10.0, 11.0)]))


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


def test_a_flight_that_does_not_fit_into_memory_says_how_large_one_may_be(tmp_path):
    memory = tmp_path / "meminfo"
    memory.write_text("MemTotal:       8000000 kB\nMemAvailable:   2097152 kB\n")
    assert too_large(24, "onnx", memory) == ""
    assert too_large(25, "onnx", memory) == (
        "25 drones: 25 agents need 2.1 GB of memory, 2.0 GB are free, expected 24 drones at most on this machine"
    )
    assert too_large(25, "oracle", memory) == ""
    assert too_large(1000, "oracle", tmp_path / "none") == ""
