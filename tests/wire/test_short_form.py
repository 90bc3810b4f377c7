"""Tracks for a narrow radio: half of the bytes, and covariances that no direction is surer in."""

from __future__ import annotations

import struct

import msgpack  # type: ignore[import-untyped]
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.seen_swarm import seen
from swarmtrack.wire import codec
from swarmtrack.wire.checks import DecodeError, symmetric
from swarmtrack.wire.short_form import pack_covariance, unpack_covariance
from swarmtrack.wire.tracks import TracksMessage


def test_the_short_form_takes_half_of_the_bytes_and_says_the_same():
    message = seen()
    short = codec.encode(message, short=True)
    assert len(short) < 0.55 * len(codec.encode(message))
    read = codec.decode(TracksMessage, short)
    assert (read.t_utc_s, read.sequence) == (message.t_utc_s, message.sequence)
    assert read.scan_age_s == pytest.approx(message.scan_age_s)
    for track, said in zip(read.tracks, message.tracks, strict=True):
        assert (track.id, track.identity, track.status) == (said.id, said.identity, said.status)
        np.testing.assert_allclose((track.u_px, track.v_px), (said.u_px, said.v_px), rtol=1e-6)
        np.testing.assert_allclose(track.cov_upper, said.cov_upper, rtol=4e-3)
    for relative, said in zip(read.relatives, message.relatives, strict=True):
        np.testing.assert_allclose(relative.position_m, said.position_m, rtol=1e-6)
        np.testing.assert_allclose(relative.cov, said.cov, rtol=4e-3, atol=1e-4 * max(said.cov))
        assert relative.sources == said.sources


def test_plain_msgpack_reads_it_by_what_the_docs_say():
    message = seen()
    fields = msgpack.unpackb(codec.encode(message, short=True))
    assert fields[1] == message.t_utc_s
    packed = struct.unpack(">21h", fields[7][0][3])
    variance = np.exp(packed[0] / 1024.0) ** 2
    assert 1.0 <= variance / message.relatives[0].cov[0] < 1.003
    assert fields[7][0][5] == list(message.relatives[0].sources)


def test_no_tracks_and_more_than_fifteen_have_a_short_form_too():
    message = seen()
    for tracks in ((), message.tracks[:1] * 40):
        many = msgspec.structs.replace(message, tracks=tracks, proofs=(), relatives=())
        assert len(codec.decode(TracksMessage, codec.encode(many, short=True)).tracks) == len(tracks)


@given(st.integers(0, 2**32 - 1), st.sampled_from([4, 6]), st.integers(0, 6), st.floats(-8.0, 8.0))
def test_the_covariance_that_is_read_is_nowhere_smaller(seed: int, n: int, rank: int, scale: float):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, rank)) * 10.0 ** rng.uniform(-2.0, 2.0, (n, 1)) * 10.0 ** (scale / 2.0)
    cov = A @ A.T
    upper = tuple(cov[np.triu_indices(n)].tolist())
    read = symmetric(np.array([unpack_covariance(pack_covariance(upper))]), n)[0]
    sigma = np.sqrt(np.where(np.diagonal(cov) > 0.0, np.diagonal(cov), 1.0))
    more = np.linalg.eigvalsh((read - cov) / np.outer(sigma, sigma))
    assert more[0] >= -1e-12
    assert more[-1] < 3e-3


def with_covariance(packed: object) -> bytes:
    fields = msgpack.unpackb(codec.encode(seen(), short=True))
    fields[7][0][3] = packed
    return bytes(msgpack.packb(fields))


@pytest.mark.parametrize(
    ("packed", "why"),
    [
        (b"", "relatives"),
        (bytes(40), "relatives"),
        (bytes(20), "relatives"),  # of a track
        (struct.pack(">21h", *[32767] * 21), "relatives"),  # e^64
        (struct.pack(">21h", 0, -32768, *[0] * 19), "eigenvalue"),
        (struct.pack(">21h", 0, 32767, 32767, *[0] * 3, 0, -32767, *[0] * 13), "eigenvalue"),
        ("text", "relatives"),
        (None, "relatives"),
    ],
)
def test_a_packed_covariance_that_cannot_be_is_refused(packed: object, why: str):
    with pytest.raises(DecodeError, match=why):
        codec.decode(TracksMessage, with_covariance(packed))


@pytest.mark.parametrize("variance", [-1.0, float("nan"), float("inf")])
def test_a_variance_that_cannot_be_is_not_sent(variance: float):
    message = seen()
    relative = msgspec.structs.replace(message.relatives[0], cov=(variance, *message.relatives[0].cov[1:]))
    with pytest.raises(ValueError, match="variances"):
        codec.encode(msgspec.structs.replace(message, relatives=(relative,)), short=True)
