"""Drone 1 and its tracks, which a test puts in the image by hand; no tracker, no camera."""

import math

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.news import NO_NEWS
from swarmtrack.identity.paper import PaperIdentities
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.messages import Announcement, MotionReport, Sighting, SightingReport, Track, TrackStatus
from swarmtrack.motion.ego import TeamPose
from swarmtrack.team.identities import Identities

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
FORWARD = Pose(rotation.BODY_FROM_FORWARD_CAMERA, np.zeros(3))
TO_THE_RIGHT = rotation.from_euler(0.0, 0.0, math.pi / 2)
RIGHTWARD = Pose(TO_THE_RIGHT @ rotation.BODY_FROM_FORWARD_CAMERA, np.array([0.0, 0.1, 0.0]))
SCAN_S = 0.1

LEFT, MIDDLE, RIGHT = (170.0, 240.0), (320.0, 240.0), (470.0, 240.0)


def at(pixel, metres=8.0):
    """The place (3,) in the team frame that the observer, at the origin and facing north, sees there."""
    u, v = pixel
    return metres * np.array([1.0, (u - 320.0) / 430.0, (v - 240.0) / 430.0])


def shifted(pixel, right=0.0, down=0.0):
    return (pixel[0] + right, pixel[1] + down)


class Observer:
    """Drone 1: it hears announcements, and its tracks are what a test says."""

    def __init__(self, cameras=(FORWARD,), lens=CAMERA, **parameters):
        lenses = [(lens, pose) for pose in cameras]
        self.identities = (
            PaperIdentities(1, cameras=lenses)
            if parameters.get("profile") == "paper"
            else Identities(1, cameras=lenses, parameters=IdentityParameters(**parameters))
        )
        self.t = 0.0
        self.attitude = np.eye(3)
        self.attitude_sigma = 0.01
        self.tracks = []
        self.coasting = {}
        self.news = NO_NEWS
        """Of the last scan."""
        self.wanted = []
        self.sizes = {}
        self.moving = 0.0
        """px/s, to the right, of all tracks."""
        self.reports = 0
        self.said = {}

    def hears(self, drone_id, pixel, sequence=1, boot="0000000a", metres=8.0, camera=FORWARD, sigma=0.1):
        place = camera.transform(FORWARD.inverse().transform(at(pixel, metres)))
        return self.hears_at(drone_id, place, sequence, boot, sigma)

    def hears_at(self, drone_id, place, sequence=1, boot="0000000a", sigma=0.1):
        """place (3,) ± sigma m: from the observer, which faces north."""
        return self.identities.announce(
            Announcement(drone_id, boot, sequence, self.t, 0.0, place, np.eye(3), sigma**2 * np.eye(3))
        )

    def is_told(self, drone_id, pixel, boot="0000000a", metres=8.0, sigma=0.1):
        """The drone reports whom it sees, and with it where it is, ± sigma m."""
        self.is_told_at(drone_id, at(pixel, metres), boot, sigma)

    def is_told_at(self, drone_id, place, boot="0000000a", sigma=0.1, sees=None, is_confirmed=True):
        """The same with the place (3,) m, team frame; sees: where the drone sees others, by drone (3,) m, and whether
        motion confirms whom."""
        self.reports += 1
        rays = tuple(
            Sighting(seen, 0.99, (there - place) / np.linalg.norm(there - place), 0.01, is_confirmed)
            for seen, there in (sees or {}).items()
        )
        self.identities.on_report(
            SightingReport(drone_id, boot, self.reports, self.t, 0.0, place, sigma, (), rays)
        )

    def pixel_of(self, place, heading):
        """Where a camera at the origin that looks along that heading [rad] sees a place (3,) m of the team frame."""
        x, y, z = rotation.from_euler(0.0, 0.0, heading).T @ place
        return (320.0 + 430.0 * y / x, 240.0 + 430.0 * z / x)

    def stands_still(self, drone_id, boot="0000000a"):
        """The drone says that it does not move."""
        still, cov = np.zeros(3), 0.01 * np.eye(3)
        self.identities.on_motion(MotionReport(drone_id, boot, 1, self.t, 0.0, still, cov, still, cov))

    def says_it_moved(self, drone_id, displacement, boot="0000000a"):
        """The drone says how far it is from where it was first, (3,) m; its velocity is as from the last time."""
        before, t = self.said.get(drone_id, (displacement, self.t - SCAN_S))
        velocity = (displacement - before) / max(self.t - t, 1e-3)
        self.said[drone_id] = displacement, self.t
        cov = 0.01 * np.eye(3)
        self.identities.on_motion(
            MotionReport(drone_id, boot, 1, self.t, 0.0, displacement, cov, velocity, cov)
        )

    def turn(self, degrees):
        """To the right; what it sees from now on is in its image as the test says."""
        self.attitude = rotation.from_euler(0.0, 0.0, math.radians(degrees)) @ self.attitude

    def sees(self, seconds, coasting=(), tentative=(), camera=0, elsewhere=(), **tracks):
        """`a=(u, v)` is track 1 there, b track 2 … ; the IDs by name after so many seconds of scans of a camera.
        elsewhere: those that are in the other camera's pixels."""
        for _ in range(max(round(seconds / SCAN_S), 1)):
            self.t = round(self.t + SCAN_S, 6)
            self.coasting = {name: self.coasting.get(name, self.t) for name in coasting}
            self.tracks = [
                self._track(name, pixel, name in tentative)._replace(camera=camera ^ (name in elsewhere))
                for name, pixel in tracks.items()
            ]
            self.news = self.identities.observe(
                self.tracks,
                TeamPose(
                    self.t,
                    np.zeros(3),
                    self.attitude,
                    0.05**2 * np.eye(3),
                    self.attitude_sigma**2 * np.eye(3),
                ),
                camera,
            )
            self.wanted += [(self.t, drone) for drone in self.news.wanted]
        return self.names()

    def names(self):
        """Who is who now, by the names of the tracks."""
        labels = self.identities.label(self.tracks)
        return {chr(ord("a") - 1 + entry.track.id): entry.identity for entry in labels}

    def _track(self, name, pixel, tentative):
        since = self.coasting.get(name)
        status = TrackStatus.CONFIRMED if since is None else TrackStatus.LOST
        return Track(
            id=ord(name) - ord("a") + 1,
            t=self.t,
            mean=np.array([pixel[0], self.moving, pixel[1], 0.0]),
            cov=np.diag([4.0, 25.0, 4.0, 25.0]),
            status=TrackStatus.TENTATIVE if tentative else status,
            probability=1.0,
            size=np.array(self.sizes.get(name, (20.0, 20.0))),
            coasting_since=since,
        )
