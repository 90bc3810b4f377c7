"""Whether an autopilot takes the place that it is fed: judged by its parameters, which are read, never written."""

import pytest
from pymavlink.dialects.v20 import common

from support.asked_autopilot import check_asks
from support.fake_autopilot import FakeAutopilot, FakePx4
from swarmtrack.config.drone import load_config
from swarmtrack.diagnosis.autopilot_feed import asked_of_feed, check_feed
from swarmtrack.diagnosis.autopilot_limits import ARDUPILOT_KIND, PX4_KIND
from swarmtrack.diagnosis.findings import Level
from swarmtrack.errors import ConfigError

GOOD = {
    ARDUPILOT_KIND: {
        "VISO_TYPE": 1, "VISO_QUAL_MIN": 0, "EK3_SRC1_POSXY": 3, "EK3_SRC1_YAW": 1, "EK3_SRC2_POSXY": 6,
        "EK3_SRC2_YAW": 1, "EK3_SRC3_POSXY": 0, "EK3_SRC3_YAW": 0,
    },
    PX4_KIND: {"EKF2_EV_CTRL": 1, "EKF2_EV_NOISE_MD": 0},
}  # fmt: skip
BAD = [
    (ARDUPILOT_KIND, "VISO_TYPE", 0, "feed.ignored", "VISO_TYPE is 0", "set 1 (MAVLink)"),
    (ARDUPILOT_KIND, "EK3_SRC2_POSXY", 3, "feed.ignored", "EK3_SRC3_POSXY is 3, 3, 0", "set 6 in one set"),
    (ARDUPILOT_KIND, "EK3_SRC2_YAW", 6, "feed.circle", "EK3_SRC2_YAW is 6", "set 1 (compass)"),
    (ARDUPILOT_KIND, "VISO_QUAL_MIN", -1, "feed.unusable", "VISO_QUAL_MIN is -1", "set 0"),
    (PX4_KIND, "EKF2_EV_CTRL", 0, "feed.ignored", "EKF2_EV_CTRL is 0", "set 1 (horizontal position)"),
    (PX4_KIND, "EKF2_EV_CTRL", 15, "feed.circle", "EKF2_EV_CTRL is 15", "set 1 (no yaw)"),
    (PX4_KIND, "EKF2_EV_NOISE_MD", 1, "feed.covariance", "EKF2_EV_NOISE_MD is 1", "set 0"),
]


@pytest.mark.parametrize("kind", GOOD)
def test_an_autopilot_that_takes_it_is_ok(kind):
    (finding,) = check_feed(kind, GOOD[kind])
    assert finding.level is Level.OK
    assert set(asked_of_feed(kind)) == set(GOOD[kind])


@pytest.mark.parametrize(("kind", "name", "value", "fault", "found", "remedy"), BAD)
def test_what_keeps_it_from_that_is_said_with_the_value_to_set(kind, name, value, fault, found, remedy):
    (finding,) = check_feed(kind, GOOD[kind] | {name: value})
    assert (finding.level, finding.fault) == (Level.WARNING, fault)
    assert found in finding.found
    assert remedy in finding.remedy


@pytest.mark.parametrize("kind", GOOD)
def test_what_is_not_told_is_said(kind):
    (finding,) = check_feed(kind, {})
    assert finding.fault == "feed.unknown"
    assert all(name in finding.found for name in asked_of_feed(kind))


def test_of_other_autopilots_and_of_none_nothing_is_demanded():
    assert check_feed(common.MAV_AUTOPILOT_GENERIC, {}) == []
    assert check_feed(None, {}) == []


CONFIG = """
drone.id = 2
camera.source = "detections://127.0.0.1:9/1"
camera.intrinsics = {{ fx = 600.0, fy = 600.0, cx = 31.5, cy = 23.5, width = 64, height = 48 }}
autopilot.link = "{link}"
autopilot.feed = "odometry"
"""


@pytest.mark.parametrize(
    ("make", "said"), [(FakeAutopilot, "VISO_TYPE is 0"), (FakePx4, "EKF2_EV_CTRL is 15")]
)
async def test_config_check_asks_a_fed_autopilot_and_writes_nothing(tmp_path, capsys, make, said):
    assert await check_asks(make, CONFIG, tmp_path) == 0
    assert said in capsys.readouterr().out


def test_a_feed_without_an_autopilot_is_an_error_of_the_config(tmp_path):
    config = tmp_path / "drone.toml"
    config.write_text(CONFIG.format(link="none"))
    with pytest.raises(ConfigError, match=r"autopilot\.feed"):
        load_config(config)
