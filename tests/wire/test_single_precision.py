"""Tracks for a narrow radio: floats of 32 bits, which every reader of MessagePack knows."""

from __future__ import annotations

import msgpack  # type: ignore[import-untyped]
import msgspec
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from support.seen_swarm import seen
from swarmtrack.wire import codec
from swarmtrack.wire.tracks import TracksMessage


def test_the_short_form_is_a_third_shorter_and_says_the_same():
    message = seen()
    short = codec.encode(message, short=True)
    assert len(short) < 0.67 * len(codec.encode(message))
    for read in (codec.decode(TracksMessage, short), msgspec.convert(msgpack.unpackb(short), TracksMessage)):
        assert (read.t_utc_s, read.sequence, read.scan_age_s) == (
            message.t_utc_s,
            message.sequence,
            message.scan_age_s,
        )
        for track, said in zip(read.tracks, message.tracks, strict=True):
            assert (track.id, track.identity, track.status) == (said.id, said.identity, said.status)
            np.testing.assert_allclose((track.u_px, track.v_px), (said.u_px, said.v_px), rtol=1e-6)
        for relative, said in zip(read.relatives, message.relatives, strict=True):
            np.testing.assert_allclose(relative.position_m, said.position_m, rtol=1e-6)
            np.testing.assert_allclose(relative.cov, said.cov, rtol=1e-5, atol=1e-5 * max(said.cov))
            assert relative.sources == said.sources


def test_no_tracks_and_more_than_fifteen_have_a_short_form_too():
    message = seen()
    for tracks in ((), message.tracks[:1] * 40):
        many = msgspec.structs.replace(message, tracks=tracks, proofs=(), relatives=())
        assert len(codec.decode(TracksMessage, codec.encode(many, short=True)).tracks) == len(tracks)


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.floats(-8.0, 8.0))
def test_rounding_leaves_every_covariance_one_also_where_it_is_singular(seed: int, rank: int, scale: float):
    A = np.random.default_rng(seed).standard_normal((6, rank)) * 10.0 ** (scale / 2.0)
    cov = tuple((A @ A.T)[np.triu_indices(6)].tolist())
    message = seen()
    relative = msgspec.structs.replace(message.relatives[0], cov=cov)
    read = codec.decode(
        TracksMessage, codec.encode(msgspec.structs.replace(message, relatives=(relative,)), short=True)
    )
    diagonal = [0, 6, 11, 15, 18, 20]
    assert all(read.relatives[0].cov[k] >= cov[k] for k in diagonal)
