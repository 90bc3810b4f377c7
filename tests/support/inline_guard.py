"""A guard without a process: the real `Guard` and its MAVLink, in simulated time, on a simulated link."""

from swarmtrack import guard
from swarmtrack.runtime.guard_process import GuardNews, Release, guard_limits


class InlineGuard:
    """A `GuardLine`. flight: whose clock and link it uses; `tick` as often as time passes."""

    def __init__(self, limits, flight):
        self.limits, self.flight = limits, flight
        self.alive = self.frozen = False
        """frozen: as by SIGSTOP. What it is told waits until it goes on."""
        self._waiting = []
        self.sent = self.stale = self.refused = self.starts = 0
        self.pid = None
        self._guard, self._speaker = guard.Guard(guard_limits(limits)), guard.Speaker(1, 192)
        self._releases, self._died, self._reachable = [], False, False

    def start(self):
        if not self.alive:
            self.alive, self.starts = True, self.starts + 1
            self._guard = guard.Guard(guard_limits(self.limits))

    def die(self):
        """As by SIGKILL."""
        self.alive, self._died = False, True

    def reach(self, way):
        self._reachable = way is not None
        if way is not None:
            self._speaker.system = way.system
            self._speaker.key = self.flight.unit.signing_key or b""

    def decide(self, decision):
        self._hear(lambda: self._guard.decided(decision, self.now) and self._send())

    def stand(self):
        self._hear(lambda: self._guard.stands(self.now) or self._send())

    def end(self, number):
        self._hear(lambda: self._guard.end(number))

    def _hear(self, word):
        if self.frozen:
            self._waiting.append(word)
        elif self.alive:
            while self._waiting:
                self._waiting.pop(0)()
            word()

    def news(self):
        releases, self._releases = tuple(self._releases), []
        died, self._died = self._died, False
        return GuardNews(releases, died)

    def stop(self):
        self._send(gone=True)
        self.alive = self.frozen = False
        """frozen: as by SIGSTOP. What it is told waits until it goes on."""
        self._waiting = []

    def tick(self):
        """Time has passed."""
        if self.alive and not self.frozen and self.now >= self._guard.due():
            self._send()

    @property
    def now(self):
        return self.flight.clock.now()

    def _send(self, *, gone=False):
        point = self._guard.command(self.now, gone=gone)
        if point is not None and self._reachable:
            self.sent += 1
            self.flight.link.sent.append(self._speaker.frame(point, self.now, self.flight.clock.utc()))
        self.stale, self.refused = self._guard.stale, self._guard.refusals
        why = self._guard.take_release()
        if why:
            self._releases.append(Release(self._guard.over, why))
