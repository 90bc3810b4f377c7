"""What is read by `struct` alone is what pymavlink reads, message for message."""

import random

import pytest
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.framer import Framer
from swarmtrack.autopilot.rapid_messages import RAPID, read_rapidly
from swarmtrack.autopilot.signing import Codec
from swarmtrack.clock import ManualClock

KEY = bytes(range(32))
KINDS = pytest.mark.parametrize("message_id", sorted(RAPID))


def messages(message_id, count, seed=0):
    """Random ones; in every second the last bytes are zeros, which MAVLink 2 cuts off."""
    rng, kind = random.Random(seed + message_id), common.mavlink_map[message_id]
    for i in range(count):
        payload = rng.randbytes(kind.unpacker.size)
        if i % 2:
            zeros = rng.randrange(1, len(payload))
            payload = payload[:-zeros] + bytes(zeros)
        wire = kind.unpacker.unpack(payload)
        fields, at = [], 0
        for length in kind.lengths:
            fields.append(wire[at] if length == 1 else list(wire[at : at + length]))
            at += length
        yield kind(*(fields[order] for order in kind.orders))


def packed(message_id, count, *, version_1=False, key=None):
    sender = common.MAVLink(None, srcSystem=7, srcComponent=1)
    if key is not None:
        sender.signing.secret_key, sender.signing.sign_outgoing, sender.signing.timestamp = key, True, 1
    for number, message in enumerate(messages(message_id, count)):
        sender.seq = number % 256
        yield bytes(message.pack(sender, force_mavlink1=version_1))


def assert_same(found, frame):
    expected = common.MAVLink(None).decode(bytearray(frame.data))
    assert found.get_msgId() == expected.get_msgId() == frame.id
    assert found.get_seq() == expected.get_seq() == frame.sequence
    assert bytes(found.get_msgbuf()) == bytes(expected.get_msgbuf()) == frame.data
    for name in expected.fieldnames:
        # NaN is no number that equals itself.
        assert repr(getattr(found, name)) == repr(getattr(expected, name)), name


@KINDS
@pytest.mark.parametrize("kind", ["version 1", "version 2", "signed"])
def test_each_field_is_the_one_that_pymavlink_reads(message_id, kind):
    if kind == "version 1" and message_id > 255:
        pytest.skip("version 1 has one byte for the message")
    key = KEY if kind == "signed" else None
    for data in packed(message_id, 60, version_1=kind == "version 1", key=key):
        (frame,) = Framer().feed(data)
        assert_same(read_rapidly(frame), frame)


@KINDS
def test_what_a_newer_sender_has_appended_is_left_out(message_id):
    """Of MAVLink 2, whose payloads may grow."""
    kind = common.mavlink_map[message_id]
    payload = random.Random(1).randbytes(kind.unpacker.size + 9)
    head = bytes((len(payload), 0, 0, 5, 7, 1)) + message_id.to_bytes(3, "little")
    checksum = common.x25crc(bytearray(head + payload + bytes((kind.crc_extra,)))).crc
    (frame,) = Framer().feed(b"\xfd" + head + payload + checksum.to_bytes(2, "little"))
    assert_same(read_rapidly(frame), frame)


@KINDS
def test_a_key_refuses_what_is_unsigned_forged_or_replayed(message_id):
    codec = Codec(ManualClock(), system=7, component=191, key=KEY)
    codec._mav.signing.timestamp = 1
    signed = list(packed(message_id, 3, key=KEY))
    unsigned = next(packed(message_id, 1))
    forged = next(packed(message_id, 1, key=bytes(32)))
    frames = [Framer().feed(data)[0] for data in (*signed, signed[0], unsigned, forged)]
    assert [codec.decode(frame) is not None for frame in frames] == [True] * 3 + [False] * 3
    assert (codec.signed_good, codec.signed_old, codec.unsigned, codec.signed_bad) == (3, 1, 1, 1)


def counts(framer):
    return framer.good, framer.good_bytes, framer.bad_bytes, framer.crc_failures, framer.unknown


def test_a_datagram_that_is_one_frame_counts_as_it_does_among_garbage():
    """The same bytes, datagram by datagram, and as one stream: with garbage, damage and unknown messages between."""
    rng = random.Random(3)
    pieces = []
    for message_id in sorted(RAPID):
        for data in (
            *packed(message_id, 20),
            *packed(message_id, 5, version_1=message_id < 256),
            *packed(message_id, 5, key=KEY),
        ):
            damaged = data[:-3] + bytes((data[-3] ^ 0xFF,)) + data[-2:]
            unknown = bytes((0xFD, 4, 0, 0, 0, 1, 1)) + (12345).to_bytes(3, "little") + rng.randbytes(6)
            pieces += rng.choice(([data], [data], [b"\xfd\x00", data], [damaged], [unknown, data]))
    by_piece, as_stream = Framer(), Framer()
    found = [frame for piece in pieces for frame in by_piece.feed(piece)] + by_piece.flush()
    assert found == as_stream.feed(b"".join(pieces)) + as_stream.flush()
    assert counts(by_piece) == counts(as_stream)
    assert by_piece.crc_failures > 10 < by_piece.unknown
