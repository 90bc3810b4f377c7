"""Drones that sway before an observer, and say how."""

import math

import numpy as np

from support.observer import SCAN_S, Observer, at
from swarmtrack.geometry import rotation
from swarmtrack.messages import MotionReport, SightingReport

SIZE = (24.0, 24.0)


class Sway:
    """Drones at 8 m that sway; each says how, or something else, and once a second where it thinks that it is. The
    observer's north is off by so many degrees. missed: the tracks that are not detected from now on."""

    def __init__(self, places, sways, thinks, said=None, observer=None, north_deg=0.0):
        self.places, self.sways, self.said = places, sways, sways if said is None else said
        self.observer = observer or Observer()
        self.observer.sizes = dict.fromkeys(places, SIZE)
        self.sequence = 0
        self.told = []
        self.missed = ()
        self.thinks = thinks
        self.turn = rotation.from_euler(0.0, 0.0, math.radians(north_deg))
        for drone, pixel in thinks.items():
            self.observer.hears_at(drone, self.turn @ at(pixel))

    def flies(self, seconds):
        """The names after so long."""
        end = self.observer.t + seconds - 1e-9
        while self.observer.t < end:
            t = self.observer.t + SCAN_S
            if self.sequence % 2 == 0:
                for drone, sway in self.said.items():
                    self._say(drone, sway, t)
            self.sequence += 1
            if self.sequence % 10 == 0:
                for drone, pixel in self.thinks.items():
                    self._report(drone, at(pixel) + swaying(self.said[drone], t), t)
            pixels = {name: self._pixel(name, t) for name in self.places}
            names = self.observer.sees(SCAN_S, coasting=self.missed, **pixels)
            self.told += self.observer.news.astray
        return names

    def _say(self, drone, sway, t):
        velocity = (swaying(sway, t + 0.01) - swaying(sway, t - 0.01)) / 0.02
        self.observer.identities.on_motion(
            MotionReport(
                drone,
                "0000000a",
                self.sequence,
                t,
                0.0,
                self.turn @ swaying(sway, t),
                0.01 * np.eye(3),
                self.turn @ velocity,
                np.eye(3),
            )
        )

    def _report(self, drone, place, t):
        self.observer.identities.on_report(
            SightingReport(drone, "0000000a", self.sequence, t, 0.0, self.turn @ place, 0.1, (), ())
        )

    def _pixel(self, name, t):
        sway = self.sways[{"a": 2, "b": 3, "c": 4, "d": 2, "e": 3}[name]]
        place = at(self.places[name]) + swaying(sway, t)
        return (320.0 + 430.0 * place[1] / place[0], 240.0 + 430.0 * place[2] / place[0])

    def proofs(self):
        labels = self.observer.identities.label(self.observer.tracks)
        return {entry.identity: entry.proof for entry in labels}


def swaying(seed, t):
    """(3,) m: a few slow sines by chance."""
    rng = np.random.default_rng(seed)
    rate, angle = rng.uniform(0.4, 2.5, (4, 3)), rng.uniform(0.0, 2.0 * math.pi, (4, 3))
    return 0.15 * np.sin(rate * t + angle).sum(axis=0)
