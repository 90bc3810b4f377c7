"""What the noise of bearings says of a distance: nothing.

The error of a bearing is compared in metres across it (`evidence.py`), where it grows with the distance that is
assumed. With one variance for all distances, a nearer teammate would fit better, the more so the noisier bearings are,
and with every bearing: the bias of errors in variables (Fuller, "Measurement error models", 1987, section 1.1). A drone
that hovers before its team came to be sure within 20 s that its start is 5 m nearer to it.

So M loses what noise adds to it along the bearings. What is left are directions that did change, by the ways of both.
"""

from __future__ import annotations

import numpy as np

from swarmtrack.messages import Array

# Of its own diagonal, and at least, a matrix's diagonal grows: so it can be inverted where nothing was measured.
_SHARE, _LEAST = 1e-9, 1e-12


def without_noise(M: Array, distance: Array, count: Array) -> tuple[Array, Array]:
    """Matrices (…, 8, 8) of `count` (…,) bearings, without what is noise; and log evidence (…,) that the noise is
    instead, at any distance. distance (…, 8): the sum of their distances, of z, each as a share of that at which errors
    are compared.

    Noise is the least that zᵀ M z can be at the mean distance, up to as much as is expected of so many bearings.
    """
    mean = distance / np.maximum(count, _LEAST)[..., None]
    more = _SHARE * np.diagonal(M, axis1=-2, axis2=-1) + _LEAST
    solved = np.linalg.solve(M + more[..., None] * np.eye(8), mean[..., None])
    noise = 1.0 / np.maximum((mean * solved[..., 0]).sum(axis=-1), _LEAST)
    # Of nonsense from a peer there is none.
    noise = np.nan_to_num(np.minimum(noise, 2.0 * count))
    return M - noise[..., None, None] * (mean[..., :, None] * mean[..., None, :]), -0.5 * noise
