"""How the missing cells of one tile of a large array are imputed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class TilePart:
    """Imputation of the missing cells of one tile.

    Attributes:
        known: int ``[h]``, predictors, as positions in [healthy cells, pad means].
        missing: int ``[m]``, positions in F.
        weight, bias: ``[m, h]`` and ``[m]`` of the affine map.
        deviation: ``[m]``, standard deviation of the error, 0..1 scale.
        roots, residuals, width: ``[M, h]``, ``[M, m]`` and the bandwidth of the kernel regression.
    """

    known: NDArray[np.intp]
    missing: NDArray[np.intp]
    weight: Floats
    bias: Floats
    deviation: Floats
    roots: Floats
    residuals: Floats
    width: float
