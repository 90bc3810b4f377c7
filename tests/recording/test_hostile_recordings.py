"""Recordings from elsewhere: bombs, lies and bit rot. What is whole comes out, what is not is told, nothing else."""

from __future__ import annotations

import json
import struct
import zlib

import pytest
import zstandard

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")

from support.mutants import MUTANTS, mutants
from swarmtrack.agents import main as swarmtrack
from swarmtrack.errors import RecordingError, SwarmtrackError
from swarmtrack.recording import records
from swarmtrack.recording.info import summarise
from swarmtrack.recording.limits import (
    LARGEST_ATTACHMENT_BYTES,
    LARGEST_CHUNK_BYTES,
    LARGEST_NOTE_BYTES,
    MOST_DECLARED_CHANNELS,
)
from swarmtrack.recording.reader import MCAP_MAGIC, Segment, recordings_below
from swarmtrack.recording.repair import repair
from swarmtrack.recording.settings import read_settings
from swarmtrack.recording.writer import Attachment as Attached
from swarmtrack.recording.writer import Bounds, Preface, RecordingWriter, Topic

KNOWN = {
    **{"format": "1", "kind": "drone", "drone_id": "7", "boot": "0000000a", "team": "t"},
    **{"monotonic_s": "12.5", "utc_s": "1700000000.0"},
}
TOPICS = [Topic.of_json(f"/{name}", {"title": name, "type": "object"}) for name in "xyz"]


def written(folder, seconds=5.0, *, known=KNOWN, attachments=()):
    """A file of numbered messages."""
    writer = RecordingWriter(folder, Preface(known, attachments), Bounds(folder.parent))
    for k in range(round(seconds * 20)):
        now = k / 20
        writer.write(TOPICS[k % 3], round(now * 1e9), b'{"k":%d}' % k, now)
        writer.tick(now)
    writer.close(seconds)
    return folder / "0001.mcap"


def record(opcode, body):
    return struct.pack("<BQ", opcode, len(body)) + body


def text(words):
    return struct.pack("<I", len(words)) + words


def chunk(data, *, size=None, compression=b"zstd", packed=None, checksum=0):
    packed = zstandard.compress(data) if packed is None else packed
    head = struct.pack("<QQQI", 0, 0, len(data) if size is None else size, checksum)
    return record(6, head + text(compression) + struct.pack("<Q", len(packed)) + packed)


def metadata(known):
    inner = b"".join(text(key.encode()) + text(value.encode()) for key, value in known.items())
    return record(12, text(b"swarmtrack.recording") + text(inner))


def attachment(name, data):
    return record(
        9, bytes(16) + text(name) + text(b"application/json") + struct.pack("<Q", len(data)) + data + bytes(4)
    )


SCHEMA = record(3, struct.pack("<H", 1) + text(b"x") + text(b"jsonschema") + text(b"{}"))
CHANNEL = record(4, struct.pack("<HH", 1, 1) + text(b"/x") + text(b"json") + text(b""))
WHOLE = record(5, struct.pack("<HIQQ", 1, 0, 5, 5) + b'{"k":0}')


def hand_made(path, *parts):
    path.write_bytes(MCAP_MAGIC + metadata({**KNOWN, "segment": "1"}) + b"".join(parts))
    return path


def damage_of(path):
    """How many messages came out, and what is told of the rest."""
    segment = Segment(path)
    return len(list(segment.messages())), segment.damage or ""


# --- bombs and lies ---------------------------------------------------------------------------------------------------


def bomb(seconds_of_zeros=4096):
    """Gigabytes of nothing in some hundred kilobytes, in one frame that does not say how much."""
    packer = zstandard.ZstdCompressor().compressobj()
    zeros = bytes(1 << 20)
    return b"".join(packer.compress(zeros) for _ in range(seconds_of_zeros)) + packer.flush()


@pytest.mark.parametrize("claimed", [100, 1 << 20, LARGEST_CHUNK_BYTES, 4 << 30, 2**64 - 1])
def test_a_chunk_of_gigabytes_is_unpacked_no_further_than_it_claims_and_may(tmp_path, claimed):
    packed = bomb(256)
    file = hand_made(
        tmp_path / "a.mcap", SCHEMA, CHANNEL, WHOLE, chunk(b"", size=claimed, packed=packed), WHOLE
    )
    count, said = damage_of(file)
    assert count == 1
    assert "a chunk of" in said


def test_what_is_unpacked_is_bounded_whatever_a_frame_says_of_itself():
    assert len(records._decompressed(bomb(256), 1000)) == 1001
    frame = bytearray(zstandard.compress(bytes(1000)))
    frame[4:6] = b"\xe0\xff"  # single segment, eight bytes of size: the next ones
    with pytest.raises((ValueError, zstandard.ZstdError)):
        records.unpacked_chunk(chunk(b"", size=1000, packed=bytes(frame))[9:])


def test_more_channels_than_any_swarm_has_are_not_read_on(tmp_path):
    file = hand_made(
        tmp_path / "a.mcap", SCHEMA, CHANNEL, WHOLE, CHANNEL * (MOST_DECLARED_CHANNELS + 1), WHOLE
    )
    assert damage_of(file) == (1, damage_of(file)[1])
    assert f"more than {MOST_DECLARED_CHANNELS} schemas and channels" in damage_of(file)[1]


@pytest.mark.parametrize(
    ("part", "said"),
    [
        (
            record(4, struct.pack("<HH", 2, 1) + struct.pack("<I", 2**32 - 1) + b"/x"),
            "a field that ends beyond",
        ),
        (record(3, b"\x02\x00" + text(bytes(LARGEST_NOTE_BYTES))), "expected 1048576 at most"),
        (record(12, text(b"a") + text(text(b"\xff\xfe") * 2)), "can't decode"),
        (attachment(b"big.json", bytes(LARGEST_ATTACHMENT_BYTES)), "expected 8388608 at most"),
        (b"".join(attachment(b"%d" % i, b"") for i in range(100)), "more than 64 notes"),
        (record(5, struct.pack("<HIQQ", 9, 0, 5, 5)), "channel 9, which was not declared"),
        (record(5, b"short"), "holds what cannot be read"),
        (chunk(WHOLE, compression=b"lz4"), "compressed by 'lz4'"),
        (chunk(WHOLE, checksum=1), "its checksum differs"),
        (chunk(WHOLE, checksum=zlib.crc32(WHOLE), size=len(WHOLE) + 1), "other than the"),
        (chunk(WHOLE[:-3]), "holds what cannot be read"),
        (record(0x33, b"?"), "no known kind"),
        (record(15, b"\1\0\0\0"), "bytes before it are not what was written"),
        (record(2, bytes(20)), "no known kind"),
        (struct.pack("<BQ", 5, 2**60), "has no record"),
        (struct.pack("<BQ", 5, 1000) + b"half", "is cut off"),
    ],
)
def test_every_lie_is_told_and_what_stood_before_it_comes_out(tmp_path, part, said):
    count, damage = damage_of(hand_made(tmp_path / "a.mcap", SCHEMA, CHANNEL, WHOLE, part, WHOLE))
    assert count == 1
    assert said in damage
    assert damage.isprintable()


def test_records_of_an_applications_own_are_passed_over(tmp_path):
    file = hand_made(tmp_path / "a.mcap", SCHEMA, CHANNEL, record(0x90, b"?"), WHOLE, record(15, bytes(4)))
    assert damage_of(file) == (1, "")


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("kind", None, "kind: missing, expected drone or swarm"),
        ("drone_id", "x", 'drone_id: "x", expected 1 … 65535'),
        ("drone_id", "-3", "expected 1 … 65535"),
        ("team", None, "team: missing"),
        ("segment", "0", "segment"),
        ("utc_s", "nan", "utc_s"),
        ("monotonic_s", "1e400", "monotonic_s"),
    ],
)
def test_a_preface_that_nobody_could_use_is_refused_where_it_is_opened(tmp_path, capsys, key, value, said):
    known = {**KNOWN, "segment": "1"} | ({} if value is None else {key: value})
    if value is None:
        del known[key]
    path = tmp_path / "a.mcap"
    path.write_bytes(MCAP_MAGIC + metadata(known) + SCHEMA + CHANNEL + WHOLE)
    for command in (["log", "info"], ["replay"]):
        assert swarmtrack.main([*command, str(path)]) == 2
        assert said in capsys.readouterr().err


def test_what_is_printed_of_a_recording_commands_no_terminal(tmp_path, capsys):
    channel = record(4, struct.pack("<HH", 1, 1) + text(b"/x\x1b[2J\nforged") + text(b"json") + text(b""))
    path = tmp_path / "a.mcap"
    known = {**KNOWN, "segment": "1", "team": "red\x1b]0;pwned\x07"}
    path.write_bytes(MCAP_MAGIC + metadata(known) + SCHEMA + channel + WHOLE + record(15, bytes(4)))
    assert swarmtrack.main(["log", "info", str(path)]) == 0
    said = capsys.readouterr().out
    assert all(line.isprintable() for line in said.splitlines())
    assert "forged" in said.splitlines()[-1]


def test_an_attachment_of_brackets_is_no_json(tmp_path):
    file = written(
        tmp_path / "life", 1.0, attachments=(Attached("config.json", "application/json", b"[" * 200_000),)
    )
    (recording,) = recordings_below(file)
    with pytest.raises(RecordingError, match=r"config\.json is missing or not JSON"):
        read_settings(recording)


def test_a_channel_without_its_schema_is_repaired_without(tmp_path):
    file = hand_made(tmp_path / "a.mcap", CHANNEL, WHOLE, WHOLE)
    assert repair(file).messages == 2
    assert damage_of(file) == (2, "")


# --- mutants ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "count",
    [300, pytest.param(MUTANTS, marks=pytest.mark.long("thousands of mutants, not 300"))],
    ids=["short", "long"],
)
def test_any_mutation_of_a_good_file_is_read_as_far_as_it_is_whole_and_told(tmp_path, count):
    good = written(tmp_path / "life")
    data = good.read_bytes()
    whole = [(message.topic, message.data) for message in Segment(good).messages()]
    end = data.index(record(15, b"")[:1] + struct.pack("<Q", 4), len(data) - 4000)
    path = tmp_path / "mutant.mcap"
    for number, mutant in enumerate(mutants(data, count, seed=5)):
        path.write_bytes(mutant)
        segment = Segment(path)
        try:
            found = [(message.topic, message.data) for message in segment.messages()]
        except RecordingError:
            intact = mutant[:8] == MCAP_MAGIC
            assert not intact, number
            continue
        ahead = iter(whole)
        assert all(message in ahead for message in found), number  # each of them whole, and in their order
        assert segment.damage or found == whole, number
        assert segment.damage or mutant[:end] == data[:end], number
        try:
            for recording in recordings_below(path):
                json.dumps(summarise(recording).as_record())
            repaired = repair(path)
        except SwarmtrackError:
            continue
        assert repaired is None or repaired.messages == len(found), number
        if repaired is not None:
            path.with_name("mutant.mcap.cut").unlink()
