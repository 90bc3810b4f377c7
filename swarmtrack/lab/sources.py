"""`sim://`: a camera and an autopilot that look into a simulated world, in real time.

    sim://hover-triangle?seed=1&fps=15&drone=1&latency_ms=30
    sim:///path/to/scenario.toml

It names a scenario that is shipped, or the file of one; every key has a default (`SimulationAddress`). World
time 0 is `epoch_s` on the agent's monotonic clock, or the moment of opening: give several agents of one machine
the same epoch, and they fly together. Frames and samples are functions of the seed and their index, so two runs
see the same; only which frames a busy consumer misses depends on the machine. Truth stays in here: what leaves
are frames, IMU samples, ego poses and the teammates' announcements.
"""

from __future__ import annotations

import asyncio
import dataclasses
import difflib
import math
import zlib
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from urllib.parse import parse_qsl, unquote, urlsplit

import numpy as np

from swarmtrack.clock import Clock
from swarmtrack.errors import ConfigError, SourceError
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.lab.world.sensors import Imu, ImuParameters
from swarmtrack.messages import Announcement, FlightState, Frame, LinkStatus, StampKind
from swarmtrack.sources import AutopilotListener

Sleep = Callable[[float], Awaitable[None]]

STAMP_SIGMA = 1e-4  # s: our own stamps are exact, but a filter must not be told so
ANNOUNCED_POSITION_SIGMA = 0.05  # m per axis: a start measured with care
ANNOUNCED_ATTITUDE_SIGMA = 0.01  # rad per axis
RESOLUTION = 1e-6  # s
SIMULATED_SAMPLES_PER_TURN = 256  # samples handed over before others on the event loop get their turn


@dataclass(frozen=True, slots=True)
class SimulationAddress:
    """A `sim://` address, taken apart."""

    scenario: str  # a name, or the path of a file
    seed: int = 1
    drones: int | None = None  # how many fly; None: as many as the scenario says
    drone: int | None = None  # None: the ID in the config
    camera: int = 0  # which of the drone's, in the order of the scenario
    fps: float = 15.0
    latency_ms: float = 30.0  # from exposure to delivery
    imu_hz: float = 200.0
    seconds: float | None = None  # length of the flight; None: without end
    epoch_s: float | None = None  # when the flight began, on the machine's monotonic clock


def parse_address(address: str) -> SimulationAddress:
    """Raises SourceError, with a sentence, for whatever is not a simulation that can be opened."""
    parts = urlsplit(address)
    scenario = unquote(parts.netloc + parts.path).rstrip("/")
    if parts.scheme != "sim":
        raise SourceError(f"{address}: scheme '{parts.scheme}', expected sim://SCENARIO")
    known = [field.name for field in dataclasses.fields(SimulationAddress) if field.name != "scenario"]
    numbers: dict[str, float] = {}
    for key, text in parse_qsl(parts.query, keep_blank_values=True):
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)[0]
            raise SourceError(
                f"{address}: unknown key '{key}', did you mean '{near}'? Known: {', '.join(known)}"
            )
        try:
            numbers[key] = float(text)
        except ValueError:
            raise SourceError(f"{address}: {key}: '{text}', expected a number") from None
        if not math.isfinite(numbers[key]):
            raise SourceError(f"{address}: {key}: '{text}', expected a finite number")

    for key, low, high in (("fps", 0.1, 1000.0), ("imu_hz", 1.0, 10000.0), ("latency_ms", 0.0, 60000.0)):
        if key in numbers and not low <= numbers[key] <= high:
            raise SourceError(f"{address}: {key}: {numbers[key]:g}, expected {low:g} to {high:g}")
    for key in ("seed", "drone", "drones", "camera"):
        if key in numbers and (numbers[key] != int(numbers[key]) or numbers[key] < 0):
            raise SourceError(f"{address}: {key}: {numbers[key]:g}, expected a whole number from 0")
    if numbers.get("seconds", 1.0) <= 0.0:
        raise SourceError(f"{address}: seconds: {numbers['seconds']:g}, expected more than 0")
    return SimulationAddress(
        scenario=scenario,
        seed=int(numbers.get("seed", 1)),
        drones=int(numbers["drones"]) if "drones" in numbers else None,
        drone=int(numbers["drone"]) if "drone" in numbers else None,
        camera=int(numbers.get("camera", 0)),
        fps=numbers.get("fps", 15.0),
        latency_ms=numbers.get("latency_ms", 30.0),
        imu_hz=numbers.get("imu_hz", 200.0),
        seconds=numbers.get("seconds"),
        epoch_s=numbers.get("epoch_s"),
    )


class Simulation:
    """One drone's place in a simulated flight: its camera, its autopilot, and what its teammates announce."""

    def __init__(
        self, scenario: Scenario, drone_id: int, address: SimulationAddress, clock: Clock, sleep: Sleep
    ) -> None:
        self._scenario = scenario
        self._drone_id = drone_id
        self._seed = address.seed
        # Drawing needs textures, which take a while to make: the flight must not begin unseen meanwhile.
        mounted = scenario.cameras[address.camera]
        renderer = Renderer(scenario.world, mounted.lens, mounted.body_from_camera, number=address.camera)
        self.epoch = clock.now() if address.epoch_s is None else address.epoch_s
        timing = _Timing(clock, sleep, self.epoch, math.inf if address.seconds is None else address.seconds)
        self.camera = SimulatedCamera(
            renderer,
            drone_id,
            timing,
            fps=address.fps,
            phase=mounted.phase,
            latency=address.latency_ms / 1000.0,
            stamps_late=scenario.camera_offset_s.get(drone_id, 0.0),
        )
        self.autopilot = SimulatedAutopilot(scenario, drone_id, timing, ImuParameters(rate_hz=address.imu_hz))

    @property
    def initial_pose(self) -> Pose:
        """Where this drone starts, in the team frame: what its config would say. world_from_body."""
        return self._scenario.initial_poses[self._drone_id]

    @property
    def start_sigma_m(self) -> float:
        """How well its config would say that it was measured, m per axis: as well as its teammates' starts."""
        return ANNOUNCED_POSITION_SIGMA

    def teammates_announcements(self) -> list[Announcement]:
        """What the other drones of this world broadcast: their poses at world time 0, as well as they know them."""
        announcements = []
        for drone_id, pose in self._scenario.initial_poses.items():
            if drone_id == self._drone_id:
                continue
            error = self._scenario.world.chance("announcement", drone_id).standard_normal((2, 3))
            announcements.append(
                Announcement(
                    drone_id=drone_id,
                    boot=f"{zlib.crc32(f'{self._seed}/{drone_id}'.encode()):08x}",
                    sequence=1,
                    t=self.epoch,
                    t_sigma=1e-3,
                    position=pose.position + ANNOUNCED_POSITION_SIGMA * error[0],
                    world_from_body=pose.rotation @ rotation.exp(ANNOUNCED_ATTITUDE_SIGMA * error[1]),
                    position_cov=ANNOUNCED_POSITION_SIGMA**2 * np.eye(3),
                )
            )
        return announcements


def open_simulation(
    address: str, drone_id: int | None, clock: Clock, sleep: Sleep = asyncio.sleep
) -> Simulation:
    """The place of `drone_id` (None: the one in the address, or 1) in the flight that `address` describes.

    sleep: what passes the time on `clock`; another one lets a test fly as fast as it computes.
    """
    parsed = parse_address(address)
    if drone_id is not None and parsed.drone not in (None, drone_id):
        raise SourceError(
            f"{address}: drone: {parsed.drone}, expected {drone_id} as in the config, or no such key"
        )
    chosen = drone_id if drone_id is not None else parsed.drone if parsed.drone is not None else 1
    try:
        scenario = load_scenario(parsed.scenario, seed=parsed.seed, drones=parsed.drones)
    except ConfigError as error:
        raise SourceError(f"{address}: {error}") from error
    if chosen not in scenario.world.drones:
        flying = ", ".join(str(drone) for drone in scenario.world.drones)
        raise SourceError(f"{address}: drone {chosen} does not fly in it, expected one of {flying}")
    if parsed.camera >= len(scenario.cameras):
        known = len(scenario.cameras) - 1
        raise SourceError(f"{address}: camera: {parsed.camera}, expected 0 to {known}")
    return Simulation(scenario, chosen, parsed, clock, sleep)


@dataclass(frozen=True, slots=True)
class _Timing:
    """World time on the agent's clock."""

    clock: Clock
    sleep: Sleep
    epoch: float
    seconds: float

    def world_time(self) -> float:
        return self.clock.now() - self.epoch

    async def until(self, world_time: float) -> None:
        # A rest below the clock's resolution cannot be slept away, so it counts as passed.
        while (wait := world_time - self.world_time()) > RESOLUTION:
            await self.sleep(wait)


class SimulatedCamera:
    """Implements `Camera`. `camera` and `body_from_camera` are its true calibration."""

    def __init__(
        self,
        renderer: Renderer,
        drone_id: int,
        timing: _Timing,
        *,
        fps: float,
        phase: float,
        latency: float,
        stamps_late: float = 0.0,
    ) -> None:
        self.camera: PinholeCamera = renderer.camera
        self.body_from_camera: Pose = renderer.body_from_camera
        self._renderer = renderer
        self._drone_id = drone_id
        self._timing = timing
        self._fps = fps
        self._phase = phase
        self._latency = latency
        self._stamps_late = stamps_late
        self._delivered: deque[float] = deque(maxlen=31)  # times of exposure
        self._opened = timing.clock.now()
        self._dropped = 0
        self._closed = False

    async def frames(self) -> AsyncIterator[Frame]:
        """The newest frame whose latency has passed, or else the next. Skipped ones are never drawn."""
        timing = self._timing
        # As of a camera that was just switched on: the exposures before are not ours.
        last = max(math.ceil((timing.world_time() - RESOLUTION) * self._fps - self._phase), 0) - 1
        while not self._closed:
            due = math.floor((timing.world_time() - self._latency + RESOLUTION) * self._fps - self._phase)
            index = max(last + 1, due)
            t = (index + self._phase) / self._fps
            if t >= timing.seconds:
                return
            self._dropped += index - last - 1
            last = index
            # Drawing begins at exposure, so its own time hides in the latency where that is long enough.
            await timing.until(t)
            image = await asyncio.to_thread(self._renderer.image, self._drone_id, t, index)
            await timing.until(t + self._latency)
            if self._closed:
                return
            self._delivered.append(timing.epoch + t)
            yield Frame(timing.epoch + t + self._stamps_late, STAMP_SIGMA, index, image, StampKind.EXPOSURE)

    def status(self) -> LinkStatus:
        times = self._delivered
        span = times[-1] - times[0] if times else 0.0
        fps = (len(times) - 1) / span if span > 0.0 else 0.0
        age = self._timing.clock.now() - (times[-1] if times else self._opened)
        ok = age < 1.0 + self._latency + 2.0 / self._fps and not self._closed
        counters: dict[str, float] = {
            "fps": fps,
            "dropped": self._dropped,
            "stale": 0,
            "reconnects": 0,
            "age": age,
        }
        text = (
            f"simulated, {fps:.1f} of {self._fps:g} frames a second" if times else "simulated, no frame yet"
        )
        return LinkStatus("camera", ok, text, tuple(counters.items()))

    async def close(self) -> None:
        self._closed = True


class SimulatedAutopilot:
    """Implements `Autopilot`: IMU samples at their rate, ego poses at 50 Hz, on time and in order."""

    def __init__(self, scenario: Scenario, drone_id: int, timing: _Timing, imu: ImuParameters) -> None:
        self._imu = Imu(scenario.world, drone_id, imu)
        self._ego = scenario.ego(drone_id)
        self._timing = timing
        self._imu_delivered = 0
        self._poses_delivered = 0
        self._last = timing.world_time()  # of the newest sample, or of opening

    async def run(self, listener: AutopilotListener) -> None:
        """After a late wake-up, everything that became due is delivered in order: a gyro sample is never dropped."""
        timing, imu_hz, pose_hz = self._timing, self._imu.parameters.rate_hz, self._ego.parameters.rate_hz
        begin = max(timing.world_time(), 0.0)
        sample_index, pose_index = math.ceil(begin * imu_hz), math.ceil(begin * pose_hz)
        while True:
            for _ in range(SIMULATED_SAMPLES_PER_TURN):
                t_imu, t_pose = sample_index / imu_hz, pose_index / pose_hz
                t = min(t_imu, t_pose)
                if t >= timing.seconds:
                    return
                if t > timing.world_time() + RESOLUTION:
                    break
                if t_imu <= t_pose:
                    self._deliver_imu(listener, sample_index)
                    sample_index += 1
                else:
                    self._deliver_pose(listener, pose_index)
                    pose_index += 1
            await timing.until(min(sample_index / imu_hz, pose_index / pose_hz))
            await asyncio.sleep(0)  # a consumer slower than the samples must not keep the loop to itself

    def _deliver_imu(self, listener: AutopilotListener, index: int) -> None:
        sample = self._imu.sample(index)
        self._last = sample.t
        self._imu_delivered += 1
        listener.on_imu(dataclasses.replace(sample, t=self._timing.epoch + sample.t))

    def _deliver_pose(self, listener: AutopilotListener, index: int) -> None:
        epoch, pose = self._timing.epoch, self._ego.pose(index)
        if index % int(self._ego.parameters.rate_hz) == 0:
            state = self._ego.flight_state(pose.t)
            since = None if state.airborne_since is None else epoch + state.airborne_since
            listener.on_flight_state(FlightState(epoch + pose.t, since))
        self._poses_delivered += 1
        listener.on_pose(dataclasses.replace(pose, t=epoch + pose.t))

    def status(self) -> LinkStatus:
        age = self._timing.world_time() - self._last
        counters: dict[str, float] = {
            "imu": self._imu_delivered,
            "poses": self._poses_delivered,
            "imu_hz": self._imu.parameters.rate_hz,
            "age": age,
        }
        text = f"simulated, {self._imu.parameters.rate_hz:g} IMU samples a second"
        return LinkStatus("autopilot", age < 1.0, text, tuple(counters.items()))
