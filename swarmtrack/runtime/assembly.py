"""Construction of an agent from a config: the one place that maps entries to classes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

import numpy as np

from swarmtrack.autopilot.address import is_recording
from swarmtrack.autopilot.address import parse_address as parse_link
from swarmtrack.autopilot.engagement import PilotEngagement
from swarmtrack.autopilot.fed_position import FedPosition
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.pilot_switch import PilotSwitch
from swarmtrack.camera_sources.address import parse_address
from swarmtrack.camera_sources.detection_stream import DetectionStream
from swarmtrack.clock import Clock, ManualClock
from swarmtrack.config.drone import CameraSection, DroneConfig, MountedCamera, Start, mount_camera
from swarmtrack.config.formation import fields_of_view
from swarmtrack.config.team import SwitchSection
from swarmtrack.errors import ConfigError, SourceError
from swarmtrack.formation.plan import range_faults, view_faults
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import AgreedMotion, Announcement
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.runtime.door import Door
from swarmtrack.runtime.filed import agreed_motions, filed_announcements
from swarmtrack.runtime.perception import make_detector, make_follower, make_onboard
from swarmtrack.security import names
from swarmtrack.security.credentials import Credentials
from swarmtrack.sources import (
    SIMULATIONS,
    Autopilot,
    Camera,
    DetectionSource,
    OpenSimulation,
    SimulatedSources,
)
from swarmtrack.transport import topology
from swarmtrack.transport.addresses import check_addresses
from swarmtrack.transport.base import Transport
from swarmtrack.transport.keys import new_boot
from swarmtrack.transport.memory import MemoryHub, MemoryTransport
from swarmtrack.transport.zenoh_transport import ZenohTransport

# What sees pictures needs OpenCV and ONNX Runtime: 80 MB and half a second, which an agent whose camera detects by
# itself does not pay. So these modules are imported by the functions that make their objects.
if TYPE_CHECKING:
    from swarmtrack.detection.detector import Detector
    from swarmtrack.runtime.flight_recorder import FlightRecorder
    from swarmtrack.runtime.key_renewal import KeyRenewal
    from swarmtrack.runtime.ros2_output import Ros2Output


@dataclass(slots=True)
class Parts:
    """Parts of an agent."""

    config: DroneConfig
    clock: Clock
    """The flight's: that of every message."""
    wall: Clock
    """The machine's, which passes while we work: of durations, and of what is said how often."""
    paced: ManualClock | None
    """The flight's clock where its frames set it: a recording, processed as fast as it goes. None: it is the wall's."""
    boot: str
    lenses: tuple[PinholeCamera, ...]
    cameras: list[Camera | DetectionSource]
    """In the order of the config, as `lenses` and `Detections.camera`."""
    autopilot: Autopilot | None
    detector: Detector | None
    """None where the camera detects by itself."""
    door: Door
    """The way into its Onboard, and what may be read of it."""
    engagement: PilotEngagement | None
    """Whether the pilot wants to be flown; None: nobody may fly it."""
    fed: FedPosition | None
    """Whether the autopilot's position rests on ours; None: it is fed none."""
    recorder: FlightRecorder | None
    ros2: Ros2Output | None
    transport: Transport
    renewal: KeyRenewal | None
    """None: there are no keys."""
    start: Pose | None
    """Where the drone says it starts, in the team frame; None: wherever its autopilot says it is."""
    simulated_teammates: list[tuple[Transport, Announcement]]
    filed: list[Announcement]
    """Where teammates start, by the team's file."""
    agreed: list[AgreedMotion]
    """How they move without saying it: by codes and by a plan."""

    @property
    def lens(self) -> PinholeCamera:
        """The first camera's."""
        return self.lenses[0]

    @property
    def camera(self) -> Camera | DetectionSource:
        """The first one."""
        return self.cameras[0]

    @camera.setter
    def camera(self, instead: Camera | DetectionSource) -> None:
        self.cameras[0] = instead


def assemble(config: DroneConfig, wall: Clock, imported: ManualClock | None = None) -> Parts:
    """Make the parts; nothing is opened or connected yet.

    wall: the machine's clock. imported: the clock of a flight that is over, which the importer sets. Raises
    ConfigError at the entry that leads to something that can never work.
    """
    boot = new_boot()
    with config.blamed("camera", "source"):
        paced = imported
        if paced is None and _as_fast_as_it_goes(config):
            paced = ManualClock(wall.now(), wall.utc())
        clock: Clock = paced or wall
        simulation = make_simulation(config, clock)
    config = _with_start(config, simulation)
    mounted, cameras = [], []
    for number, section in enumerate(config.cameras):
        with config.blamed(*config.camera_key(number, "calibration")):
            one = mount(section, simulation)
        with config.blamed(*config.camera_key(number, "source")):
            cameras.append(make_camera(section, one, clock, simulation))
        mounted.append(one)
    _refuse_unseen_video(config)
    with config.blamed("autopilot", "link"):
        in_step = imported is None and paced is not None
        switch = _pilot_switch(config.formation.switch)
        engagement = PilotEngagement(switch) if config.flies_in_formation else None
        fed = FedPosition() if config.autopilot.feed == "odometry" else None
        autopilot = make_autopilot(config, clock, simulation, in_step=in_step, engagement=engagement, fed=fed)
    with config.blamed("detector", "model"):
        detector = make_detector(config, wall)
    hub = MemoryHub()
    with config.blamed("network"):
        transport, renewal = _transport(config, boot, clock, hub)
    start = None if config.drone.start.source is not None else config.drone.start.pose()
    check_formation(config, mounted, detector)
    box_width = None if detector is None else detector.box_width
    recorder = _recorder(
        config, mounted, start, box_width, boot, clock=clock, wall=wall, waits=paced is not None
    )
    door = Door(make_onboard(config, mounted, start, box_width), make_follower(config))
    return Parts(
        config=config,
        clock=clock,
        wall=wall,
        paced=paced,
        boot=boot,
        lenses=tuple(one.camera for one in mounted),
        cameras=cameras,
        autopilot=autopilot,
        detector=detector,
        door=door,
        engagement=engagement,
        fed=fed,
        recorder=recorder,
        ros2=_ros2_output(config, door, boot, clock),
        transport=transport,
        renewal=renewal,
        start=start,
        simulated_teammates=_teammates(config, simulation, hub, clock),
        filed=filed_announcements(config, clock.now()),
        agreed=agreed_motions(config, clock.now() - clock.utc()),
    )


def check_formation(config: DroneConfig, mounted: Sequence[MountedCamera], detector: Detector | None) -> None:
    """What a formation has against this drone's cameras and detector. Raises ConfigError."""
    section, drone_id = config.formation, config.drone.id
    plan = section.plan()
    if plan is None or drone_id == plan.leader:
        return
    views = fields_of_view((one.camera, one.body_from_camera) for one in mounted)
    faults = view_faults(plan, drone_id, views, section.limits.acceleration_m_s2)
    told = config.team.share == "velocity" or section.ranging
    described = BoxWidth() if detector is None else detector.box_width or BoxWidth()
    faults += range_faults(config.detector.box_width.over(described), told=told)
    if faults:
        raise ConfigError([config.problem(("formation", *fault.key), fault.text) for fault in faults])


def _as_fast_as_it_goes(config: DroneConfig) -> bool:
    fast = [("pace", "fast") in parse_address(camera.source).query for camera in config.cameras]
    if len(set(fast)) > 1:
        number = fast.index(not fast[0])
        key, wanted = config.camera_key(number, "source"), "pace=fast" if fast[0] else "no pace=fast"
        text = f"found {config.cameras[number].source}, expected {wanted}, as of the first camera"
        raise ConfigError([config.problem(key, text)])
    return fast[0]


def make_simulation(config: DroneConfig, clock: Clock) -> SimulatedSources | None:
    """Opened by whatever is registered for `sim`; an agent in the air never loads it."""
    if not config.camera.simulated:
        return None
    source = config.camera.source
    registered = entry_points(group=SIMULATIONS, name="sim")
    if not registered:
        raise SourceError(
            f"camera.source {source}: no simulator is registered for sim://, expected swarmtrack's own: install "
            "swarmtrack again"
        )
    open_simulation: OpenSimulation = next(iter(registered)).load()
    return open_simulation(source, config.drone.id, clock)


def mount(section: CameraSection, simulation: SimulatedSources | None) -> MountedCamera:
    """The calibrated camera that a table [camera] describes, or that is simulated."""
    if simulation is None:
        return mount_camera(section)
    camera = simulation.camera
    return MountedCamera(camera.camera, camera.body_from_camera, section.time_offset_s or 0.0)


def make_camera(
    section: CameraSection, mounted: MountedCamera, clock: Clock, simulation: SimulatedSources | None
) -> Camera | DetectionSource:
    if simulation is not None:
        return simulation.camera
    if section.detects_by_itself:
        return DetectionStream(parse_address(section.source), clock=clock)
    from swarmtrack.camera_sources.opening import open_camera  # noqa: PLC0415

    return open_camera(section.source, clock=clock, size=(mounted.camera.width, mounted.camera.height))


def _refuse_unseen_video(config: DroneConfig) -> None:
    """A camera that sends detections has no picture for a video."""
    if not config.camera.detects_by_itself or config.output.video is None:
        return
    with config.blamed("output", "video"):
        raise SourceError(
            f"found {config.output.video}, expected no video: camera.source {config.camera.source} sends "
            "detections, no pictures (jsonl does work)"
        )


def _with_start(config: DroneConfig, simulation: SimulatedSources | None) -> DroneConfig:
    """The same with the start that a simulation gives, where the config states none."""
    if simulation is None or "start" in config.drone.model_fields_set:
        return config
    pose = simulation.initial_pose
    start = Start(
        position_m=tuple(pose.position.tolist()),
        yaw_deg=float(np.degrees(rotation.to_euler(pose.rotation)[2])),
        position_sigma_m=simulation.start_sigma_m,
    )
    return config.starting(start)


def make_autopilot(
    config: DroneConfig,
    clock: Clock,
    simulation: SimulatedSources | None,
    *,
    in_step: bool = False,
    engagement: PilotEngagement | None = None,
    fed: FedPosition | None = None,
) -> Autopilot | None:
    """None where the config names no link. in_step: a log is played in step with the frames. engagement: is told of the
    flight mode; fed: whether its position rests on ours, where it is fed."""
    section = config.autopilot
    if section.link == "none":
        return None
    if section.link == "sim":
        if simulation is None:
            raise SourceError('autopilot.link: found "sim", expected it only with a camera.source of sim://')
        return simulation.autopilot
    return MavlinkAutopilot(
        _in_step(section.link) if in_step else section.link,
        clock=clock,
        imu_rate_hz=section.imu_rate_hz,
        system_id=section.system_id,
        component_id=section.component_id,
        signing_key=section.signing_key,
        gps=_gps(config),
        gyro_delay_s=config.motion.gyro_delay_s,
        switch=_pilot_switch(config.team.code.switch if config.team.code else None),
        engagement=engagement,
        origin=None if config.team.origin is None else config.team.origin.place(),
        fed=fed,
    )


def _pilot_switch(section: SwitchSection | None) -> PilotSwitch | None:
    return None if section is None else PilotSwitch(section.channel, section.above_us)


def _gps(config: DroneConfig) -> GlobalPosition | None:
    start, origin = config.drone.start, config.team.origin
    if start.source != "gps" or origin is None:
        return None
    return GlobalPosition(origin.place(), start.stated_sigma_m)


def _in_step(link: str) -> str:
    """A recording beside frames at pace `fast` goes at their speed: else the gyro's history runs away from them."""
    address = parse_link(link)
    return str(replace(address, speed=1.0)) if is_recording(link) else link


def _transport(
    config: DroneConfig, boot: str, clock: Clock, hub: MemoryHub
) -> tuple[Transport, KeyRenewal | None]:
    network, drone_id, cameras = config.network, config.drone.id, len(config.cameras)
    if network.transport == "memory":
        return MemoryTransport(hub, network.team, drone_id, boot, clock), None
    credentials = credentials_of(config, clock)
    check_addresses(network, secured=credentials is not None, drone_id=drone_id)
    settings = topology.of_drone(network, drone_id, credentials)
    if credentials is None:
        return ZenohTransport(settings, drone_id, boot, clock, cameras=cameras), None
    from swarmtrack.runtime.key_renewal import KeyRenewal  # noqa: PLC0415
    from swarmtrack.security.roster_watch import RosterWatch  # noqa: PLC0415

    sign, verify = credentials.sign, credentials.verify
    transport = ZenohTransport(settings, drone_id, boot, clock, sign=sign, verify=verify, cameras=cameras)
    return transport, KeyRenewal(RosterWatch(credentials.ca.parent, credentials, clock), transport)


def credentials_of(config: DroneConfig, clock: Clock) -> Credentials | None:
    folder = config.network.keys_of(config.drone.id)
    if folder is None:
        return None
    # Not above: agents without keys need no cryptography, and its 10 MB.
    from swarmtrack.security.loading import load_credentials  # noqa: PLC0415

    with config.blamed("network", "keys"):
        return load_credentials(folder, names.drone(config.drone.id), clock.utc())


def _recorder(
    config: DroneConfig,
    mounted: Sequence[MountedCamera],
    start: Pose | None,
    box_width: BoxWidth | None,
    boot: str,
    *,
    clock: Clock,
    wall: Clock,
    waits: bool,
) -> FlightRecorder | None:
    if config.recording.dir is None:
        return None
    from swarmtrack.recording.settings import FlightSettings  # noqa: PLC0415
    from swarmtrack.runtime.flight_recorder import FlightRecorder  # noqa: PLC0415

    settings = FlightSettings(config, tuple(mounted), start, box_width)
    return FlightRecorder(settings, boot, clock, wall, waits=waits)


def _ros2_output(config: DroneConfig, door: Door, boot: str, clock: Clock) -> Ros2Output | None:
    section = config.output.ros2
    if section is None:
        return None
    from swarmtrack.runtime.ros2_output import Ros2Output  # noqa: PLC0415

    with config.blamed("output", "ros2", "router"):
        return Ros2Output(section, door.perceived, clock, drone_id=config.drone.id, boot=boot)


def _teammates(
    config: DroneConfig, simulation: SimulatedSources | None, hub: MemoryHub, clock: Clock
) -> list[tuple[Transport, Announcement]]:
    """In a simulation within one process the teammates have no agents: their announcements are made for them."""
    if simulation is None or config.network.transport != "memory":
        return []
    return [
        (MemoryTransport(hub, config.network.team, a.drone_id, a.boot, clock), a)
        for a in simulation.teammates_announcements()
    ]
