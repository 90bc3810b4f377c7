"""Construction of a drone's perception from a config: the same in flight, in a replay, and in every analysis of a
flight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from swarmtrack.clock import Clock
from swarmtrack.config.drone import DetectorSection, DroneConfig, MountedCamera
from swarmtrack.follower import Follower
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.mounting import Mounting
from swarmtrack.onboard import Onboard, OnboardCamera
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.tracking import AGENT_PARAMETERS, create_trackers

# What sees pictures needs OpenCV and ONNX Runtime: 80 MB and half a second, which an agent whose camera detects by
# itself does not pay.
if TYPE_CHECKING:
    from swarmtrack.detection.detector import Detector
    from swarmtrack.detection.visual_gyro import VisualGyro

GUIDED_SCALE = 0.5  # of the whole frame, where windows see the rest


def make_onboard(
    config: DroneConfig,
    mounted: Sequence[MountedCamera],
    start: Pose | None,
    box_width: BoxWidth | None = None,
) -> Onboard:
    """The drone's perception: the same in flight and in a replay. mounted: the cameras, in the order of the config;
    box_width: what the detector says of its boxes."""
    motion = config.motion
    x, y, z = (mounted[0].body_from_camera.rotation.T @ motion.gyro_bias_rad_s).tolist()
    trackers = create_trackers(
        config.tracker.name,
        cameras=[each.camera for each in mounted],
        **AGENT_PARAMETERS | config.tracker.parameters,
    )
    return Onboard(
        config.drone.id,
        cameras=[
            OnboardCamera(
                each.camera,
                Mounting(
                    each.body_from_camera,
                    each.time_offset_s,
                    section.estimate_time_offset,
                    # One camera has nobody to disagree with.
                    section.mounting_sigma if len(mounted) > 1 else 0.0,
                ),
                tracker,
            )
            for each, section, tracker in zip(mounted, config.cameras, trackers, strict=True)
        ],
        gyro=GyroHistory(
            history_s=motion.history_s,
            noise_density=motion.gyro_noise_density_rad_s_sqrt_hz,
            angular_acceleration_psd=motion.angular_acceleration_psd_rad2_s3,
            bias=(x, y, z),
        ),
        ego=make_ego_history(config, start, history_s=motion.history_s),
        identity=IdentityParameters(**config.identity.parameters),
        relative=RelativeParameters(
            airframe_span_m=config.team.airframe_span_m,
            box_width=config.detector.box_width.over(box_width or BoxWidth()),
            tilt_sigma=config.autopilot.tilt_sigma,
        ),
        start_sigma_m=config.drone.start.frame_sigma_m,
        estimate_gyro_bias=motion.estimate_gyro_bias,
        places_anybody=config.flies_in_formation,
        uses_gyro=config.turn_from in ("gyro", "both"),
    )


def make_follower(config: DroneConfig) -> Follower | None:
    """None where the drone does not fly in formation: it leads, or it is not enabled."""
    parameters = config.formation.parameters(config.drone.id)
    return Follower(parameters) if parameters is not None and config.flies_in_formation else None


def make_ego_history(config: DroneConfig, start: Pose | None, *, history_s: float) -> EgoHistory:
    """Where the drone itself is in the team frame, over so many seconds."""
    return EgoHistory(
        start=start,
        origin=np.array(config.drone.start.offset_m),
        origin_yaw=math.radians(config.drone.start.offset_yaw_deg),
        absolute=config.drone.start.source == "gps",
        history_s=history_s,
        heading=config.autopilot.heading_sigma,
    )


def make_visual_gyro(config: DroneConfig, lens: PinholeCamera) -> VisualGyro | None:
    """Visual gyro of the first camera, with this lens; None where the config does not ask for one."""
    if config.camera.detects_by_itself or config.turn_from not in ("images", "both"):
        return None
    from swarmtrack.detection.visual_gyro import VisualGyro  # noqa: PLC0415

    return VisualGyro(lens)


def make_detector(config: DroneConfig, clock: Clock) -> Detector | None:
    """None for a camera that detects by itself. clock: of how long it takes."""
    if config.camera.detects_by_itself:
        return None
    return detector_of(config.detector, clock)


def detector_of(section: DetectorSection, clock: Clock) -> Detector:
    """As [detector] of a config describes it. clock: of how long it takes."""
    from swarmtrack.detection.attention import AttentionParameters  # noqa: PLC0415
    from swarmtrack.detection.description import Declared  # noqa: PLC0415
    from swarmtrack.detection.detector import Detector  # noqa: PLC0415

    usual_scale = 1.0 if section.look == "whole" else GUIDED_SCALE
    return Detector(
        section.model,
        score_threshold=section.score_threshold,
        second_stage=section.second_stage,
        input_scale=section.input_scale or usual_scale,
        threads=section.threads,
        providers=section.providers,
        cache=section.engine_cache,
        look=section.look,
        motion=section.motion,
        share=section.share,
        attention=AttentionParameters(
            whole_every=section.whole_every, target_px=section.target_px, tiles=section.tiles
        ),
        declared=Declared(
            head=None if section.head == "auto" else section.head,
            names=section.names,
            classes=section.classes,
            veto=section.veto,
            channel_order=section.channel_order,
            scale=section.scale,
            mean=section.mean,
        ),
        clock=clock,
    )
