"""The framer and the signing check, against the disturbances that cost pymavlink's own parser its frames."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.framer import CRC_EXTRA_OF_MESSAGE, Framer, _crc
from swarmtrack.autopilot.signing import EPOCH, TICKS_PER_SECOND, Codec, read_key
from swarmtrack.clock import ManualClock
from swarmtrack.errors import SourceError

KEY = bytes(range(32))
FRAMES = 2000


def highres(i: int) -> object:
    return common.MAVLink_highres_imu_message(
        1_000_000 + 5000 * i,
        0.1,
        0.2,
        -9.8,
        0.01 * i,
        0.02,
        0.03,
        0.2,
        0.1,
        0.4,
        1013.0,
        0.0,
        100.0,
        25.0,
        0xFFF,
    )


def packed(n: int = FRAMES, version: int = 2) -> list[bytes]:
    sender = common.MAVLink(None, 1, 1)
    frames = []
    for i in range(n):
        sender.seq = i % 256
        frames.append(bytes(highres(i).pack(sender, force_mavlink1=version == 1)))  # type: ignore[attr-defined]
    return frames


def feed_in_pieces(framer: Framer, stream: bytes, size: int = 64) -> list[bytes]:
    found = [f.data for i in range(0, len(stream), size) for f in framer.feed(stream[i : i + size])]
    return found + [f.data for f in framer.flush()]


def unknown_frame(payload: bytes) -> bytes:
    """A frame of message 12345, which the dialect lacks, with a CRC that nobody can check."""
    return bytes((0xFD, len(payload), 0, 0, 0, 1, 1)) + (12345).to_bytes(3, "little") + payload + b"\x12\x34"


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("kind", ["random bytes", "stray magic bytes"])
def test_garbage_between_frames_costs_none_of_them(kind, version):
    rng = random.Random(1)
    garbage = {
        "random bytes": lambda: rng.randbytes(rng.randint(0, 20)),
        "stray magic bytes": lambda: b"\xfd" * rng.randint(0, 3),
    }[kind]
    frames = packed(version=version)
    junk = [garbage() for _ in frames]
    framer = Framer()
    found = feed_in_pieces(framer, b"".join(j + f for j, f in zip(junk, frames, strict=True)))
    assert found == frames
    assert framer.good == FRAMES
    assert framer.bad_bytes == sum(map(len, junk))


def test_a_truncated_frame_costs_only_itself():
    rng = random.Random(2)
    frames = packed()
    whole = [f for i, f in enumerate(frames) if i % 10]
    sent = [f if i % 10 else f[: rng.randint(1, len(f) - 1)] for i, f in enumerate(frames)]
    assert feed_in_pieces(Framer(), b"".join(sent)) == whole
    datagrams = Framer()
    assert [f.data for d in sent for f in datagrams.datagram(d)] == whole


def test_two_megabytes_of_noise_yield_no_frame():
    noise = random.Random(3).randbytes(2_000_000)
    framer = Framer()
    assert feed_in_pieces(framer, noise, 512) == []
    assert framer.bad_bytes == len(noise)


@given(
    st.lists(st.one_of(st.binary(max_size=40), st.sampled_from(packed(4) + packed(4, version=1)))),
    st.integers(1, 50),
)
def test_every_byte_is_in_a_frame_or_counted_and_pieces_do_not_matter(parts, size):
    stream = b"".join(parts)
    whole, pieces = Framer(), Framer()
    found = feed_in_pieces(whole, stream, len(stream) + 1)
    assert feed_in_pieces(pieces, stream, size) == found
    assert pieces.bad_bytes == whole.bad_bytes
    if whole.unknown == 0:
        assert sum(map(len, found)) + whole.bad_bytes == len(stream)


@given(st.binary(max_size=400))
def test_any_bytes_are_survived(data):
    framer, codec = Framer(), Codec(ManualClock(), 1, 191)
    for frame in framer.feed(data) + framer.flush() + framer.datagram(data):
        codec.decode(frame)
    assert not framer.pending


def test_a_frame_held_back_by_a_false_header_comes_with_the_flush():
    (frame,) = packed(1)
    framer = Framer()
    false_header = b"\xfd\xff\x00\x00\x00\x01\x01\x1e\x00\x00"  # an ATTITUDE that claims 267 bytes
    assert framer.feed(false_header + frame) == []
    assert framer.pending
    assert [f.data for f in framer.flush()] == [frame]
    assert framer.bad_bytes == len(false_header)


def test_longer_payloads_than_our_dialect_knows_are_accepted_if_their_crc_is_right():
    (frame,) = packed(1)
    body = bytes((len(frame) - 12 + 5,)) + frame[2:-2] + b"newer"
    newer = b"\xfd" + body + _crc(body + CRC_EXTRA_OF_MESSAGE[105]).to_bytes(2, "little")
    (found,) = Framer().feed(newer)
    message = Codec(ManualClock(), 1, 191).decode(found)
    assert message.time_usec == 1_000_000


def test_frames_with_flags_nobody_defined_are_refused():
    (frame,) = packed(1)
    assert feed_in_pieces(Framer(), frame[:2] + b"\x02" + frame[3:]) == []


def test_unknown_messages_are_told_from_garbage_and_never_delivered():
    frames = packed(20)
    stream = b"".join(f + unknown_frame(b"\xfe\x05abc" * 5) + unknown_frame(b"x") for f in frames)
    framer = Framer()
    assert feed_in_pieces(framer, stream) == frames
    assert (framer.unknown, framer.bad_bytes) == (40, 0)


def sender(key: bytes | None, utc: float = 1.7e9) -> Codec:
    return Codec(ManualClock(utc=utc), 1, 1, key)


def received(codec: Codec, data: bytes) -> object | None:
    (frame,) = Framer().datagram(data)
    return codec.decode(frame)


def test_with_a_key_only_honest_fresh_signatures_are_believed():
    us, honest = Codec(ManualClock(), 1, 191, KEY), sender(KEY)
    frame = honest.encode(highres(0))
    assert len(frame) == len(packed(1)[0]) + 13
    assert received(us, frame) is not None
    assert received(us, frame) is None  # replayed
    assert received(us, sender(bytes(32)).encode(highres(1))) is None  # another key
    assert received(us, packed(1)[0]) is None  # unsigned
    assert received(us, packed(1, version=1)[0]) is None
    assert (us.signed_good, us.signed_old, us.signed_bad, us.unsigned) == (1, 1, 1, 2)


def test_a_forged_signature_from_the_future_does_not_silence_the_honest_sender():
    us, honest, forger = Codec(ManualClock(), 1, 191, KEY), sender(KEY), sender(bytes(32), utc=EPOCH + 2.8e9)
    assert received(us, honest.encode(highres(0))) is not None
    assert received(us, forger.encode(highres(1))) is None
    assert received(us, honest.encode(highres(2))) is not None
    assert us.signed_bad == 1


def test_unknown_messages_do_not_pass_by_the_signature_check():
    assert feed_in_pieces(Framer(), unknown_frame(b"anything")) == []


def test_outgoing_signatures_follow_wall_time():
    clock = ManualClock()
    codec = Codec(clock, 1, 191, KEY)
    before = codec.encode(highres(0))
    clock.set(clock.now() + 600.0)
    after = codec.encode(highres(1))
    ticks = [int.from_bytes(data[-12:-6], "little") for data in (before, after)]
    assert ticks[1] - ticks[0] == pytest.approx(600.0 * TICKS_PER_SECOND, abs=2)


def test_signing_keys_are_read_from_private_files_only(tmp_path: Path):
    path = tmp_path / "key"
    path.write_bytes(KEY)
    path.chmod(0o600)
    assert read_key(path) == KEY
    path.write_text(KEY.hex() + "\n")
    assert read_key(path) == KEY
    path.chmod(0o640)
    with pytest.raises(SourceError, match=r"mode is 0640, expected 0600.*chmod 600"):
        read_key(path)
    path.chmod(0o600)
    path.write_bytes(b"short")
    with pytest.raises(SourceError, match="holds 5 bytes, expected 32"):
        read_key(path)
    with pytest.raises(SourceError, match="No such file"):
        read_key(tmp_path / "missing")
