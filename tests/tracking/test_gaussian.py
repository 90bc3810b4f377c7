"""Innovations and updates of many tracks at once against the textbook's, one at a time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from swarmtrack.tracking.gaussian import innovations, update

H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
seeds = st.integers(0, 2**32 - 1)


def some(rng, count, size, scale):
    L = scale * rng.normal(size=(count, size, size))
    return L @ L.swapaxes(1, 2) + 0.1 * scale**2 * np.eye(size)


@given(seeds, st.integers(0, 4), st.integers(0, 4))
@settings(max_examples=50, deadline=None)
def test_innovations_are_those_of_the_normal_distribution(seed, n, m):
    rng = np.random.default_rng(seed)
    mean, cov = rng.normal(0.0, 10.0, (n, 4)), some(rng, n, 4, 5.0)
    z, R = rng.normal(0.0, 10.0, (m, 2)), some(rng, m, 2, 2.0)
    distance, log_density = innovations(mean, cov, z, R)
    assert distance.shape == log_density.shape == (n, m)
    for i in range(n):
        for j in range(m):
            y, S = z[j] - H @ mean[i], H @ cov[i] @ H.T + R[j]
            assert distance[i, j] == pytest.approx(y @ np.linalg.solve(S, y), rel=1e-9)
            assert log_density[i, j] == pytest.approx(multivariate_normal.logpdf(y, cov=S), rel=1e-9)


@given(seeds, st.integers(0, 4))
@settings(max_examples=50, deadline=None)
def test_an_update_adds_the_information_of_its_measurement(seed, n):
    rng = np.random.default_rng(seed)
    mean, cov = rng.normal(0.0, 10.0, (n, 4)), some(rng, n, 4, 5.0)
    z, R = rng.normal(0.0, 10.0, (n, 2)), some(rng, n, 2, 2.0)
    corrected, P = update(mean, cov, z, R)
    for i in range(n):
        information = np.linalg.inv(cov[i]) + H.T @ np.linalg.solve(R[i], H)
        vector = np.linalg.solve(cov[i], mean[i]) + H.T @ np.linalg.solve(R[i], z[i])
        np.testing.assert_allclose(P[i] @ information, np.eye(4), atol=1e-7)
        np.testing.assert_allclose(information @ corrected[i], vector, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("sigma", [1e-6, 1e-3])
def test_a_nearly_exact_measurement_leaves_a_positive_covariance(sigma):
    rng = np.random.default_rng(5)
    cov, R = some(rng, 50, 4, 100.0), np.tile(sigma**2 * np.eye(2), (50, 1, 1))
    _, P = update(np.zeros((50, 4)), cov, np.zeros((50, 2)), R)
    np.testing.assert_array_equal(P, P.swapaxes(1, 2))
    scale = np.sqrt(np.einsum("nii->ni", P))
    assert np.linalg.eigvalsh(P / (scale[:, :, None] * scale[:, None])).min() > 0.0
