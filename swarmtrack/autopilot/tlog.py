"""A ground station's telemetry log: eight bytes of big-endian UTC microseconds in front of each frame.

These stamps are of the clock of the computer that wrote them, which is set in the middle of a flight where it has no
battery: by seconds, by days, or from 1970 on. The frames' own stamps are of the autopilot's clock, another time base.
Both count the time that passes, so where neighbouring records are far apart or go back, the frames around them tell how
long that took, and the rest is a step of the log's clock. It is taken out of all later stamps and reported. Where no
frame tells, going back is a step, and so is what is longer than any flight; the rest is a pause.

Stamps of another unit or byte order, or that stand still, do not advance as time does. Then the frames' own stamps tell
all times.
"""

from __future__ import annotations

import itertools
import mmap
import re
import statistics
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.framer import (
    CRC_LENGTH,
    FRAME_MAGIC,
    HEADER_V1,
    HEADER_V2,
    HEARTBEAT,
    HEARTBEAT_HEADER,
    LONGEST_FRAME,
    SIGNATURE_LENGTH,
    SIGNED_FRAME_FLAG,
    V1,
    Framer,
    MavlinkFrame,
)
from swarmtrack.autopilot.limits import (
    CLOCK_RESYNC_S,
    LONGEST_RECORDING_S,
    TLOG_BYTES_PER_TURN,
    TLOG_CLOCK_RATE,
    TLOG_JUDGED_RECORDS,
    TLOG_MOST_STEPS,
    TLOG_PAUSE_S,
    TLOG_WINDOW_RECORDS,
    TLOG_WINDOW_S,
)

STAMP_LENGTH = 8
# A stamp of the years 1970 … 2103 in microseconds with a magic byte behind it.
STAMP_AND_MAGIC = re.compile(rb"\x00[\x00-\x0e].{6}[\xfd\xfe]", re.DOTALL)
# Bytes that a program may have read at once.
LONGEST_RECORD = 4096
# Nobody spoke MAVLink before: a computer that says so has never had its clock set. s of UTC, 2004.
CLOCK_WAS_SET = 1.08e9
# Bytes of a file in which some frame is stamped.
FIRST_BYTES = 1 << 16


Bytes = mmap.mmap | bytes
# By message, of those that begin with a stamp: its length in the payload, and its unit [s].
STAMPED: dict[int, tuple[int, float]] = {
    id: {"time_usec": (8, 1e-6), "time_boot_ms": (4, 1e-3)}[message.ordered_fieldnames[0]]
    for id, message in common.mavlink_map.items()
    if message.ordered_fieldnames and message.ordered_fieldnames[0] in ("time_usec", "time_boot_ms")
}


class TimeBase(NamedTuple):
    """A clock by which frames are stamped, in a unit [s]."""

    system: int
    component: int
    unit: float


class LoggedBytes:
    """stamp: UTC [s] as the log says; data: a frame, and whatever else stands there; t: stamp without the steps of the
    log's clock."""

    __slots__ = ("_own_times", "data", "stamp", "t")

    def __init__(self, stamp: float, data: bytes) -> None:
        self.stamp = self.t = stamp
        self.data = data
        self._own_times: list[tuple[TimeBase, float]] | None = None

    @property
    def own_times(self) -> list[tuple[TimeBase, float]]:
        """The stamps [s] of its frames, each with its time base."""
        if self._own_times is None:
            framer = Framer()
            frames = framer.feed(self.data) + framer.flush()
            self._own_times = [stamp for frame in frames if (stamp := _own_time(frame)) is not None]
        return self._own_times


def _own_time(frame: MavlinkFrame) -> tuple[TimeBase, float] | None:
    if frame.id not in STAMPED:
        return None
    length, unit = STAMPED[frame.id]
    header = HEADER_V1 if frame.data[0] == V1 else HEADER_V2
    # Version 2 cuts zeros off its payloads.
    payload = frame.data[header : header + min(length, frame.data[1])]
    return TimeBase(frame.system, frame.component, unit), unit * int.from_bytes(payload, "little")


def records(
    data: Bytes,
    on_step: Callable[[float, float], None] = lambda at, by: None,
    on_useless: Callable[[], None] = lambda: None,
) -> Iterator[tuple[float, bytes]]:
    """(UTC [s] by the first record's clock, bytes) of each record of a telemetry log; times never go back.

    on_step: told of each step of the log's clock: s since the first record, and by how much [s]; on_useless: told that
    the stamps do not advance as time does, so that times count from 0, or that its clock steps all the time.
    """
    base = _base_instead(data)
    if base is None:
        yield from _by_stamps(data, on_step, on_useless)
    else:
        on_useless()
        pieces = (data[begin : begin + FIRST_BYTES] for begin in range(0, len(data), FIRST_BYTES))
        yield from _by_frames(pieces, base, 0.0)


def heartbeats(data: Bytes) -> Iterator[list[MavlinkFrame]]:
    """The frames of HEARTBEAT in each piece of a log. They are looked up: to frame all costs twenty times as much."""
    found = False
    for begin in range(0, len(data), TLOG_BYTES_PER_TURN):
        frames = list(_heartbeats(data, begin, begin + TLOG_BYTES_PER_TURN))
        found = found or bool(frames)
        yield frames
    if found:
        return
    # Stamps of a program that writes what it has read may stand in the middle of every frame.
    framer = Framer()
    for _, record in records(data):
        yield [frame for frame in framer.feed(record) if frame.id == HEARTBEAT]


def _heartbeats(data: Bytes, begin: int, end: int) -> Iterator[MavlinkFrame]:
    """Those that begin between these offsets."""
    at = begin
    while (header := HEARTBEAT_HEADER.search(data, at, end + HEADER_V2)) is not None:
        if (start := header.start()) >= end:
            return
        frame = _frame(data, start)
        if frame is not None and not _is_within_another(data, start):
            yield frame
        at = start + 1


def _frame(data: Bytes, start: int) -> MavlinkFrame | None:
    """The one that begins exactly there."""
    claimed = data[start : _frame_end(data, start)]
    frames = Framer().datagram(claimed)
    return frames[0] if frames and len(frames[0].data) == len(claimed) else None


def _is_within_another(data: Bytes, start: int) -> bool:
    """Whether it is part of a frame's payload, as of a tunnel's: who sends that is not on this link."""
    around = FRAME_MAGIC.finditer(data, max(0, start - LONGEST_FRAME), start)
    return any(_frame_end(data, m.start()) > start and _frame(data, m.start()) is not None for m in around)


def _base_instead(data: Bytes) -> TimeBase | None:
    """By which the frames tell the time, where the stamps in front of them do not; None where they do or none does."""
    second = _end(data, 0)
    if all(_is_magic(data, at + STAMP_LENGTH) and not STAMP_AND_MAGIC.match(data, at) for at in (0, second)):
        framer = Framer()
        return _main_base(
            [(own, 0.0) for frame in framer.feed(data[:FIRST_BYTES]) if (own := _own_time(frame)) is not None]
        )[0]
    stamped: list[tuple[tuple[TimeBase, float], float]] = []
    for record in itertools.islice(_stamped_records(data), TLOG_JUDGED_RECORDS):
        stamped += [(own, record.stamp) for own in record.own_times]
    base, times = _main_base(stamped)
    seconds = times[:1]
    for each in times:
        if each[0] - seconds[-1][0] >= 1.0:
            seconds.append(each)
    if len(seconds) < 3:
        return None
    # A single step spoils the whole, and what a radio had held back some of the parts.
    whole = _rate(seconds[0], seconds[-1])
    parts = statistics.median(itertools.starmap(_rate, itertools.pairwise(seconds)))
    return None if any(1.0 / TLOG_CLOCK_RATE < rate < TLOG_CLOCK_RATE for rate in (whole, parts)) else base


def _rate(begin: tuple[float, float], end: tuple[float, float]) -> float:
    """s of the log's per second of the autopilot's, between two (own time, stamp)."""
    return (end[1] - begin[1]) / (end[0] - begin[0])


def _is_magic(data: Bytes, at: int) -> bool:
    return data[at : at + 1] in (b"\xfd", b"\xfe")


def _main_base(
    stamped: Iterable[tuple[tuple[TimeBase, float], float]],
) -> tuple[TimeBase | None, list[tuple[float, float]]]:
    """The autopilot's busiest time base, or None; and of its frames, own time [s] and log's stamp [s]. stamped: the
    same of all frames."""
    found: dict[TimeBase, list[tuple[float, float]]] = defaultdict(list)
    for (base, own), stamp in stamped:
        found[base].append((own, stamp))
    best = max(found, key=lambda base: _rank(base, len(found[base])), default=None)
    return best, [] if best is None else found[best]


def _rank(base: TimeBase, number: int) -> tuple[bool, int]:
    """The best time base has the largest: an autopilot's, and of several the busiest. number: of its frames."""
    return base.component == common.MAV_COMP_ID_AUTOPILOT1, number


def _by_frames(pieces: Iterable[bytes], base: TimeBase, t: float) -> Iterator[tuple[float, bytes]]:
    """(time, frame), by this time base from t [s] on; what stands between frames is lost."""
    framer, last = Framer(), None
    for piece in pieces:
        for frame in framer.feed(piece):
            own = _own_time(frame)
            if own is not None and own[0] == base:
                # Not on where the autopilot begins again.
                elapsed = 0.0 if last is None else own[1] - last
                t += elapsed if 0.0 < elapsed < LONGEST_RECORDING_S else 0.0
                last = own[1]
            yield t, frame.data


def _by_stamps(
    data: Bytes, on_step: Callable[[float, float], None], on_useless: Callable[[], None]
) -> Iterator[tuple[float, bytes]]:
    found = _stamped_records(data)
    past: deque[LoggedBytes] = deque(maxlen=TLOG_WINDOW_RECORDS)
    ahead: deque[LoggedBytes] = deque()
    first = last = None
    shift, steps = 0.0, 0
    while (record := _next(ahead, found)) is not None:
        first = first or record
        record.t = record.stamp + shift
        if last is not None and not -CLOCK_RESYNC_S <= record.stamp - last.stamp <= TLOG_PAUSE_S:
            _look_ahead(ahead, found, record)
            if _is_alone(last, record, ahead):
                # Its stamp is damaged: the next ones go on where the last was.
                yield last.t, record.data
                continue
            step = _step(past, (record, *ahead), shift)
            if step:
                shift -= step
                record.t = record.stamp + shift
                on_step(record.t - first.t, step)
                steps += 1
                # Where no frame near it is stamped, a later one may be.
                is_looked_for = steps % TLOG_MOST_STEPS == 0
                if is_looked_for and (base := _base_of((*past, record, *ahead))) is not None:
                    on_useless()
                    rest = (each.data for each in itertools.chain((record, *ahead), found))
                    yield from _by_frames(rest, base, record.t)
                    return
        if last is not None:
            record.t = max(record.t, last.t)
        last = record
        past.append(record)
        yield record.t, record.data


def _base_of(around: Iterable[LoggedBytes]) -> TimeBase | None:
    """By which the frames of these records tell the time; None where none does."""
    return _main_base((own, 0.0) for each in around for own in each.own_times)[0]


def _next(ahead: deque[LoggedBytes], found: Iterator[LoggedBytes]) -> LoggedBytes | None:
    return ahead.popleft() if ahead else next(found, None)


def _look_ahead(ahead: deque[LoggedBytes], found: Iterator[LoggedBytes], record: LoggedBytes) -> None:
    while len(ahead) < TLOG_WINDOW_RECORDS and (not ahead or ahead[-1].stamp - record.stamp < TLOG_WINDOW_S):
        another = next(found, None)
        if another is None:
            return
        ahead.append(another)


def _is_alone(last: LoggedBytes, record: LoggedBytes, ahead: deque[LoggedBytes]) -> bool:
    """Whether the record after this one goes on where the last one was."""
    if not ahead:
        return False
    elapsed = ahead[0].stamp - last.stamp
    goes_back = ahead[0].stamp < record.stamp - CLOCK_RESYNC_S
    return -CLOCK_RESYNC_S <= elapsed <= (TLOG_WINDOW_S if goes_back else CLOCK_RESYNC_S)


def _step(past: deque[LoggedBytes], after: Iterable[LoggedBytes], shift: float) -> float:
    """s by which the log's clock was set in front of `after`, whose first stamp is far from the past's last; 0 for a
    pause."""
    after = tuple(after)
    begin, end = past[-1].stamp, after[0].stamp
    following = [each for each in after if 0.0 <= each.stamp - end < TLOG_WINDOW_S]
    before = _delays((each.t, each) for each in past if past[-1].t - each.t < TLOG_WINDOW_S)
    since = _delays((each.stamp + shift, each) for each in following)
    # By one clock that went on meanwhile, an autopilot's rather than that of another program on the same computer.
    bases = [base for base in before.keys() & since.keys() if since[base].first >= before[base].last]
    if bases:
        base = max(bases, key=lambda base: _rank(base, min(before[base].number, since[base].number)))
        step = since[base].least - before[base].least
        # A burst after a pause makes some delays longer, and none shorter.
        return step if step < -CLOCK_RESYNC_S or step > TLOG_PAUSE_S else 0.0
    return 0.0 if 0.0 <= end - begin < LONGEST_RECORDING_S else end - begin


class _Delays(NamedTuple):
    """Of frames by one time base: how many, the first and last stamp [s], and how far the log's clock is ahead of them
    at least [s]."""

    number: int
    first: float
    last: float
    least: float


def _delays(records: Iterable[tuple[float, LoggedBytes]]) -> dict[TimeBase, _Delays]:
    found: dict[TimeBase, list[tuple[float, float]]] = {}
    for t, record in records:
        for base, stamp in record.own_times:
            found.setdefault(base, []).append((stamp, t - stamp))
    return {
        base: _Delays(
            len(each), min(s for s, _ in each), max(s for s, _ in each), min(delay for _, delay in each)
        )
        for base, each in found.items()
    }


def _stamped_records(data: Bytes) -> Iterator[LoggedBytes]:
    """The records as they stand there, whatever they hold: the framer judges that.

    One ends where its frame's own header says if the next stamp stands there, and else at the next plausible stamp: so
    a damaged one costs no other, and neither does one that some program has filled with a piece of a stream.
    """
    start = next(
        (m.start() for m in STAMP_AND_MAGIC.finditer(data) if _is_record(data, m.start(), None)), None
    )
    while start is not None:
        stamp = _stamp(data, start)
        end = _end(data, start)
        begins = STAMP_AND_MAGIC.match(data, start) is not None
        found = begins and (_is_near(data, end, stamp) or _is_record(data, end, stamp))
        following = end if found else _search(data, start + STAMP_LENGTH, stamp)
        yield LoggedBytes(stamp, data[start + STAMP_LENGTH : following])
        start = following


def _stamp(data: Bytes, start: int) -> float:
    return int.from_bytes(data[start : start + STAMP_LENGTH], "big") * 1e-6


def _end(data: Bytes, start: int) -> int:
    """Where the record that starts there ends by its frame's own header."""
    return _frame_end(data, start + STAMP_LENGTH)


def _frame_end(data: Bytes, start: int) -> int:
    """Where the frame that starts there ends by its own header."""
    magic, length, flags = [*data[start : start + 3], 0, 0, 0][:3]
    header = HEADER_V1 if magic == V1 else HEADER_V2
    signature = SIGNATURE_LENGTH if magic != V1 and flags & SIGNED_FRAME_FLAG else 0
    return int(start + header + length + CRC_LENGTH + signature)


def _is_near(data: Bytes, start: int, stamp: float) -> bool:
    """Whether a stamp stands there that is hardly later: nothing else looks like that."""
    return -TLOG_PAUSE_S < _stamp(data, start) - stamp < TLOG_WINDOW_S


def _is_record(data: Bytes, start: int, last: float | None) -> bool:
    """Whether a stamp of any time stands there, with a magic byte behind it. last: the stamp before."""
    if STAMP_AND_MAGIC.match(data, start) is None:
        return False
    stamp, end = _stamp(data, start), _end(data, start)
    # A payload of zeros looks like 1970, and damage like any year: then the next record must agree.
    if stamp > CLOCK_WAS_SET and (last is None or abs(stamp - last) < LONGEST_RECORDING_S):
        return True
    follows = (
        STAMP_AND_MAGIC.match(data, end) is not None and abs(_stamp(data, end) - stamp) < LONGEST_RECORDING_S
    )
    return follows or end == len(data)


def _search(data: Bytes, begin: int, stamp: float) -> int | None:
    """Where the next record starts; None where there is no other."""
    # The first bytes of a stamp change once in an hour.
    same = round(1e6 * stamp).to_bytes(STAMP_LENGTH, "big")[:4]
    near = begin
    while (near := data.find(same, near, begin + LONGEST_RECORD)) >= 0:
        if _is_near(data, near, stamp):
            return near
        near += 1
    found = STAMP_AND_MAGIC.finditer(data, begin)
    return next((m.start() for m in found if _is_record(data, m.start(), stamp)), None)
