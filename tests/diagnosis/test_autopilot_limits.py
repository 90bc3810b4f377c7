"""What an autopilot does by itself where its agent fails: judged by its parameters, which are read, never written."""

import asyncio
import math
import struct

import pytest
from pymavlink.dialects.v20 import common

from support.asked_autopilot import check_asks
from support.autopilot_flight import Flight
from support.fake_autopilot import FakeAutopilot, FakePx4
from support.ports import free_port
from swarmtrack.agents.main import main
from swarmtrack.autopilot.parameters import ParameterReader
from swarmtrack.diagnosis.autopilot_limits import (
    ARDUPILOT_KIND,
    DEMANDS,
    PX4_KIND,
    Asked,
    asked_of,
    check_limits,
)
from swarmtrack.diagnosis.findings import Level
from swarmtrack.formation.parameters import FlightLimits

ASKED = Asked(FlightLimits(), 6.0)
GOOD = {
    ARDUPILOT_KIND: {
        "GUID_TIMEOUT": 1.0, "FENCE_ENABLE": 1, "FENCE_ACTION": 1, "FENCE_TYPE": 7, "FENCE_RADIUS": 60.0,
        "FENCE_ALT_MAX": 30.0, "WPNAV_SPEED": 400.0,
    },
    PX4_KIND: {
        "COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 0, "COM_RC_OVERRIDE": 3, "GF_ACTION": 2, "GF_MAX_HOR_DIST": 60.0,
        "GF_MAX_VER_DIST": 30.0, "MPC_XY_VEL_MAX": 4.0, "MPC_Z_VEL_MAX_UP": 2.0, "MPC_Z_VEL_MAX_DN": 1.5,
    },
}  # fmt: skip
BAD = [
    (ARDUPILOT_KIND, "GUID_TIMEOUT", 3.0, "set GUID_TIMEOUT to 1"),
    (ARDUPILOT_KIND, "GUID_TIMEOUT", 0.0, "set GUID_TIMEOUT to 1"),
    (ARDUPILOT_KIND, "FENCE_ENABLE", 0, "set FENCE_ENABLE to 1"),
    (ARDUPILOT_KIND, "FENCE_ACTION", 0, "only reports"),
    (ARDUPILOT_KIND, "FENCE_TYPE", 4, "set FENCE_TYPE to 3"),
    (ARDUPILOT_KIND, "FENCE_RADIUS", 300.0, "set FENCE_RADIUS to 70"),
    (ARDUPILOT_KIND, "WPNAV_SPEED", 1000.0, "set WPNAV_SPEED to 500"),
    (ARDUPILOT_KIND, "WP_SPD", 10.0, "set WP_SPD to 5"),
    (ARDUPILOT_KIND, "FENCE_ALT_MAX", 100.0, "set FENCE_ALT_MAX to 36"),
    (ARDUPILOT_KIND, "FENCE_TYPE", -1.0, "set FENCE_TYPE to 3"),
    (ARDUPILOT_KIND, "FENCE_TYPE", 7.5, "set FENCE_TYPE to 3"),
    (ARDUPILOT_KIND, "FENCE_ENABLE", 1e30, "set FENCE_ENABLE to 1"),
    (PX4_KIND, "COM_OBL_RC_ACT", 0.7, "set COM_OBL_RC_ACT to 0"),
    (PX4_KIND, "COM_RC_OVERRIDE", -1.0, "sticks"),
    (PX4_KIND, "GF_MAX_VER_DIST", 0.0, "set GF_MAX_VER_DIST to 36"),
    (PX4_KIND, "COM_OF_LOSS_T", 5.0, "set COM_OF_LOSS_T to 1"),
    (PX4_KIND, "COM_OBL_RC_ACT", 7, "7 (Disarm)"),
    (PX4_KIND, "COM_OBL_RC_ACT", 3, "3 (Return)"),
    (PX4_KIND, "COM_RC_OVERRIDE", 1, "sticks"),
    (PX4_KIND, "GF_ACTION", 4, "set GF_ACTION to 2"),
    (PX4_KIND, "GF_MAX_HOR_DIST", 0.0, "set GF_MAX_HOR_DIST to 70"),
    (PX4_KIND, "MPC_XY_VEL_MAX", 12.0, "set MPC_XY_VEL_MAX to 5"),
]


@pytest.mark.parametrize("kind", GOOD)
def test_an_autopilot_that_is_set_well_is_ok(kind):
    (finding,) = check_limits(kind, GOOD[kind], ASKED)
    assert finding.level is Level.OK


@pytest.mark.parametrize(("kind", "name", "value", "said"), BAD)
def test_what_is_set_badly_is_said_with_the_value_to_set(kind, name, value, said):
    (finding,) = check_limits(kind, GOOD[kind] | {name: value}, ASKED)
    assert finding.level is Level.WARNING
    assert finding.found.startswith(f"{name} is {value:g}")
    assert said in f"{finding.found} -> {finding.remedy}"


@pytest.mark.parametrize("kind", DEMANDS)
def test_what_is_not_told_is_said(kind):
    (finding,) = check_limits(kind, {}, ASKED)
    assert all(name in finding.found for name in asked_of(kind))


def test_of_other_autopilots_and_of_none_nothing_is_demanded():
    assert check_limits(common.MAV_AUTOPILOT_GENERIC, {}, ASKED) == []
    assert check_limits(None, {}, ASKED) == []


def value(name, number, kind=common.MAV_PARAM_TYPE_REAL32):
    return common.MAVLink_param_value_message(name.encode(), number, kind, 9, 0)


def test_a_whole_number_of_px4_is_read_from_its_bits_and_that_of_ardupilot_is_a_number():
    bits = struct.unpack("<f", struct.pack("<i", 3))[0]
    for kind, name, sent in ((PX4_KIND, "COM_RC_OVERRIDE", bits), (ARDUPILOT_KIND, "FENCE_TYPE", 3.0)):
        reader = ParameterReader(asked_of)
        reader.meet(kind)
        reader.on_value(0.0, value(name, sent, common.MAV_PARAM_TYPE_INT32))
        assert reader.values == {name: 3.0}


def test_what_nobody_asked_for_and_what_is_no_number_is_passed_over():
    reader = ParameterReader(asked_of)
    reader.on_value(0.0, value("GUID_TIMEOUT", 1.0))
    reader.meet(ARDUPILOT_KIND)
    reader.on_value(0.0, value("GUID_TIMEOUT", math.nan))
    reader.on_value(0.0, value("GUID_TIMEOUT", math.inf))
    reader.on_value(0.0, value("ARMING_CHECK", 1.0))
    assert reader.values == {}


async def test_each_is_asked_for_until_it_is_told_or_was_asked_for_often_enough():
    """The first answers are lost, and one parameter does not exist."""
    autopilot = FakeAutopilot()
    del autopilot.parameters.values["FENCE_TYPE"]
    asked = []
    answers = autopilot.parameters.answers

    def lossy(message):
        if message.get_type() == "PARAM_REQUEST_READ":
            asked.append(message.param_id)
        # The first answer to each question is lost.
        return answers(message) if asked.count(message.param_id) > 1 else iter(())

    autopilot.parameters.answers = lossy
    flight = Flight(autopilot)
    reader = ParameterReader(asked_of, attempts=5)
    flight.unit.read_parameters(reader)
    async with flight:
        flight.fly(6.0)
        async with asyncio.timeout(1.0):
            await reader.done()
    assert set(reader.values) >= {"GUID_TIMEOUT", "FENCE_ENABLE"}
    assert "FENCE_TYPE" not in reader.values
    assert asked.count("FENCE_TYPE") == 5
    assert autopilot.parameters.written == 0


CONFIG = """
[team]
airframe_span_m = 0.5
share = "velocity"
[drone]
id = {id}
start = {{ position_m = [0.0, 0.0, 0.0], position_sigma_m = 0.3 }}
[camera]
source = "detections://127.0.0.1:9/2"
intrinsics = {{ fx = 430.0, fy = 430.0, cx = 319.5, cy = 239.5, width = 640, height = 480 }}
[autopilot]
link = "{link}"
[network]
transport = "memory"
[formation]
leader = 1
[formation.slots]
2 = [-4.0, 3.0, -1.0]
"""


@pytest.mark.parametrize(
    ("make", "said"), [(FakeAutopilot, "set GUID_TIMEOUT to 1"), (FakePx4, "set COM_RC_OVERRIDE to 3")]
)
async def test_config_check_asks_the_autopilot_over_its_link_and_writes_nothing(tmp_path, capsys, make, said):
    assert await check_asks(make, CONFIG.replace("{id}", "2"), tmp_path) == 0
    assert said in capsys.readouterr().out


def test_a_recording_is_asked_nothing(tmp_path, capsys):
    config = tmp_path / "drone.toml"
    (tmp_path / "flight.tlog").write_bytes(b"")
    config.write_text(CONFIG.format(id=2, link="tlog:flight.tlog"))
    assert main(["config", "check", str(config), "--autopilot"]) == 0
    assert "no autopilot to ask" in capsys.readouterr().out


@pytest.mark.parametrize(("drone", "said"), [(1, "follows no other"), (2, "no autopilot to ask")])
def test_where_nobody_is_to_be_asked_it_says_so(tmp_path, capsys, drone, said):
    config = tmp_path / "drone.toml"
    config.write_text(CONFIG.format(id=drone, link="none"))
    assert main(["config", "check", str(config), "--autopilot"]) == 0
    assert said in capsys.readouterr().out


def test_an_autopilot_that_is_not_there_is_a_failure_with_a_remedy(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("swarmtrack.doctor.limits.read_limits.__defaults__", (0.3,))
    config = tmp_path / "drone.toml"
    config.write_text(CONFIG.format(id=2, link=f"udpin:127.0.0.1:{free_port()}"))
    assert main(["config", "check", str(config), "--autopilot"]) == 1
    assert "no autopilot answers" in capsys.readouterr().out
