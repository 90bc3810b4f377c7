"""Does the band hold what a filter that is right shows, and leave out what one that is wrong shows?"""

import numpy as np
import pytest
from scipy.stats import chi2

from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Detections
from swarmtrack.runtime.agent import make_health
from swarmtrack.runtime.assembly import assemble
from swarmtrack.tracking import TRACKERS, Scan, create_tracker
from swarmtrack.tracking.consistency import InnovationWindow, sure_pairs
from swarmtrack.tracking.priors import NIS_LEAST_DETECTIONS, NIS_WINDOW_DETECTIONS
from swarmtrack.wire import codec
from swarmtrack.wire.health import HealthMessage

ONE_MODEL = {"mbm": {"interacting": False}}  # that moves as the targets here; a mixture does not, by design
CAMERA = PinholeCamera(430.0, 430.0, 5000.0, 5000.0, 10_000, 10_000)
SIGMA, PSD, HZ = 2.0, 1000.0, 15.0


def drawn(rng, probability, shape):
    """χ² with two degrees of freedom, given that it lies below its quantile `probability`."""
    return chi2.ppf(rng.random(shape) * probability, 2)


def wander(rng, n, scans):
    """(scans, n, 2) px: constant velocity with white acceleration of density PSD, as the trackers believe."""
    dt = 1.0 / HZ
    Q = PSD * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    noise = rng.multivariate_normal(np.zeros(2), Q, (scans, n, 2))
    velocity = np.cumsum(noise[..., 1], axis=0)
    return np.cumsum(noise[..., 0] + dt * np.concatenate([np.zeros((1, n, 2)), velocity[:-1]]), axis=0)


def shown(name, seed, *, n=8, scans=60, clutter=0.0, spacing=1200.0, **told):
    """The consistency of a tracker of n targets that are well apart, its numbers right but for `told`."""
    rng = np.random.default_rng(seed)
    right = {
        "measurement_sigma": SIGMA,
        "acceleration_psd": PSD,
        "birth_speed_sigma": 1.0,
        "clutter_per_scan": 0.1,
    }
    tracker = create_tracker(name, camera=CAMERA, **right | ONE_MODEL.get(name, {}) | told)
    start = 600.0 + spacing * np.arange(n)[:, None] * [1.0, 0.9]
    truth = start + wander(rng, n, scans)
    tracker.initiate(0.0, start + rng.normal(0.0, SIGMA, start.shape))
    for k, points in enumerate(truth, start=1):
        seen = points[rng.random(n) < 0.9]
        false = rng.uniform(0.0, 10_000.0, (rng.poisson(clutter), 2))
        z = np.concatenate([seen + rng.normal(0.0, SIGMA, seen.shape), false])
        tracker.update(Scan(k / HZ, rng.permutation(z)))
    return tracker.consistency


@pytest.mark.parametrize("probability", [1.0, 0.999, 0.99, 0.9])
@pytest.mark.parametrize("n", [NIS_LEAST_DETECTIONS, NIS_WINDOW_DETECTIONS])
def test_the_band_leaves_out_one_in_a_hundred_whatever_the_gate(probability, n):
    rng = np.random.default_rng(0)
    outside = 0
    samples = drawn(rng, probability, (4000, n))
    for nis in samples.tolist():
        window = InnovationWindow(probability)
        window.add(nis)
        found = window.consistency()
        outside += not found.low < found.nis < found.high
    assert 0.005 < outside / 4000 < 0.015  # 1 %, and three of its sigmas


def test_a_band_that_knows_nothing_of_a_tight_gate_would_raise_false_alarms():
    rng = np.random.default_rng(0)
    alarms = 0
    for nis in drawn(rng, 0.9, (200, NIS_WINDOW_DETECTIONS)).tolist():
        window = InnovationWindow()
        window.add(nis)
        found = window.consistency()
        alarms += found.nis < found.low
    assert alarms > 80


@pytest.mark.parametrize(
    ("seeds", "outside"),
    [(12, 2), pytest.param(30, 3, marks=pytest.mark.long("more seeds, a narrower interval"))],
)
@pytest.mark.parametrize("name", TRACKERS)
def test_a_filter_told_the_truth_lies_in_its_band(name, seeds, outside):
    """99 % of the time: of 12, more than two outside would be one chance in 5000; of 30, more than three, in 4000."""
    found = [shown(name, seed) for seed in range(seeds)]
    assert sum(not each.low < each.nis < each.high for each in found) <= outside


@pytest.mark.parametrize(
    ("seeds", "outside"),
    [(6, 1), pytest.param(12, 2, marks=pytest.mark.long("more seeds, a narrower interval"))],
)
@pytest.mark.parametrize("name", TRACKERS)
def test_clutter_does_not_disturb_it(name, seeds, outside):
    told = {"clutter": 10.0, "clutter_per_scan": 10.0}
    found = [shown(name, seed, n=4, scans=70, spacing=2500.0, **told) for seed in range(seeds)]
    assert sum(not each.low < each.nis < each.high for each in found) <= outside


@pytest.mark.parametrize("name", TRACKERS)
@pytest.mark.parametrize(("factor", "side"), [(0.5, "above"), (2.0, "below")])
def test_a_measurement_noise_wrong_by_four_is_told(name, factor, side):
    for seed in range(4):
        found = shown(name, seed, measurement_sigma=factor * SIGMA)
        assert found.nis > found.high if side == "above" else found.nis < found.low


@pytest.mark.parametrize("name", TRACKERS)
def test_targets_more_agile_than_believed_are_told(name):
    for seed in range(4):
        found = shown(name, seed, acceleration_psd=PSD / 50.0)
        assert found.nis > found.high


def test_too_few_detections_tell_nothing():
    window = InnovationWindow()
    window.add([2.0] * (NIS_LEAST_DETECTIONS - 1))
    assert window.consistency() is None
    window.add([2.0])
    assert window.consistency().nis == 2.0


def test_only_pairs_without_a_rival_of_tracks_that_surely_exist_count():
    gated = np.array(
        [
            [1, 0, 0, 0],  # alone with its detection
            [0, 1, 1, 0],  # two detections
            [0, 0, 1, 0],  # disputed with the track above
            [0, 0, 0, 1],  # may not exist
        ]
    )
    log_ratio = np.where(gated, 1.0, -np.inf)

    def pairs(existence):
        return [tuple(pair) for pair in np.transpose(sure_pairs(log_ratio, existence)).tolist()]

    assert pairs(np.array([0.99, 0.99, 0.99, 0.5])) == [(0, 0)]
    assert pairs(np.full(4, 0.99)) == [(0, 0), (3, 3)]
    assert sure_pairs(np.empty((0, 3)), np.empty(0))[0].tolist() == []


AGENT = """
drone.id = 1
network.transport = "memory"
autopilot.link = "none"
tracker = { name = "kalman", measurement_sigma = 1.0, learn_noise = "upwards" }
[camera]
source = "http://127.0.0.1:9/"
intrinsics = { fx = 600.0, fy = 600.0, cx = 320.0, cy = 256.0, width = 640, height = 512 }
"""


def test_health_tells_it_and_all_that_the_tracker_and_onboard_refused(tmp_path):
    config = tmp_path / "drone.toml"
    config.write_text(AGENT, encoding="utf-8")
    parts = assemble(load_config(config), SystemClock())
    health = make_health(parts)
    assert codec.decode(HealthMessage, codec.encode(health.message())).consistency is None
    rng = np.random.default_rng(0)
    for k in range(200):
        centre = np.array([[300.0, 200.0], [9e9, 0.0]]) + rng.normal(0.0, 4.0, (2, 2))
        for t in (k / 15, 0.0):  # each is followed by a late one
            seen = Detections(t, k, centre, np.full((2, 2), 30.0), np.full(2, 0.9))
            parts.door.tell(seen)
    told = codec.decode(HealthMessage, codec.encode(health.message()))
    assert told.consistency.nis > told.consistency.high
    assert told.drops["unusable_detections"] == 200
    assert told.drops["late_scans"] == 200


def test_what_tracks_misjudge_is_said_once_it_has_lasted(tmp_path):
    """Told a fifth of the scatter and not to learn: said after 20 messages in a row, in one event."""
    config = tmp_path / "drone.toml"
    config.write_text(AGENT.replace("measurement_sigma = 1.0", "measurement_sigma = 0.8"), encoding="utf-8")
    parts = assemble(load_config(config), SystemClock())
    health, rng = make_health(parts), np.random.default_rng(0)
    for k in range(200):
        centre = np.array([[300.0, 200.0]]) + rng.normal(0.0, 4.0, (1, 2))
        parts.door.tell(Detections(k / 15, k, centre, np.full((1, 2), 30.0), np.full(1, 0.9)))
    told = [codec.decode(HealthMessage, codec.encode(health.message())) for _ in range(25)]
    assert [bool(message.noise.found) for message in told] == [False] * 19 + [True] * 6
    assert "times further off than the tracks expect" in told[-1].noise.found
    assert told[-1].noise.remedy
    assert len([line for line in told[-1].events if "tracks expect" in line]) == 1


def test_of_several_cameras_health_tells_of_the_worst_which_one_it_is_and_of_each(tmp_path):
    """The first camera's detections scatter as was told, the second one's five times as much."""
    config = tmp_path / "drone.toml"
    told = AGENT.replace("measurement_sigma = 1.0", "measurement_sigma = 0.8").replace(
        "[camera]", "[[camera]]"
    )
    aside = told[told.index("[[camera]]") :] + "body_from_camera = { rpy_deg = [0.0, 0.0, 120.0] }\n"
    config.write_text(told + aside.replace(":9/", ":9/2"), encoding="utf-8")
    parts = assemble(load_config(config), SystemClock())
    health, rng = make_health(parts), np.random.default_rng(0)
    for k in range(400):
        sigma = (0.8, 4.0)[k % 2]
        centre = np.array([[300.0, 200.0]]) + rng.normal(0.0, sigma, (1, 2))
        seen = Detections(k / 30, k, centre, np.full((1, 2), 30.0), np.full(1, 0.9), camera=k % 2)
        parts.door.tell(seen)
    messages = [codec.decode(HealthMessage, codec.encode(health.message())) for _ in range(25)]
    last = messages[-1]
    assert last.consistency.nis > last.consistency.high
    assert last.noise.found.startswith("camera 2: ")
    assert [line for line in last.events if line.startswith("camera 2: ")]
    nis = {link.name: link.counters.get("nis") for link in last.links}
    assert nis["camera 1"] < 2.0
    assert nis["camera 2"] > 4.0
