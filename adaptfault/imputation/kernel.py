"""The bandwidth of the kernel regression of residuals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.windows import evenly

WIDTH = 0.05  # of the kernel, in units of the typical squared distance of a near neighbour
_PROBES = 100  # frames whose neighbour distances are measured
_NEAR = 0.01  # share of frames that count as near neighbours


def bandwidth(roots: NDArray[np.float32]) -> float:
    """Return the bandwidth for frames ``[M, R]``: a share of the median squared distance to a near
    neighbour; never 0."""
    from sklearn.metrics.pairwise import euclidean_distances

    distance = euclidean_distances(roots[evenly(len(roots), _PROBES)], roots, squared=True)
    rank = min(1 + round(_NEAR * len(roots)), len(roots) - 1)  # the nearest is the frame itself
    near = np.partition(distance, rank, axis=1)[:, rank]
    return WIDTH * float(np.median(near[near > 0])) if (near > 0).any() else WIDTH
