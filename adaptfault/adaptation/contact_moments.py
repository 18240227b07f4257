"""Where the contact on each pad lies, how large and how strong it is: image moments (Hu 1962) of a
tactile frame."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from adaptfault.data.windows import CONVERTER_STEP
from diagnostics import SensorLayout

_CELL = 1 / 12  # variance of a load that is spread evenly over the width of a cell


class ContactMoments(nn.Module):
    """Maps whole windows to a few numbers for each pad.

    They are the total of the readings, the centroid (row and column), the standard deviation along
    rows and columns, the covariance of the two, the root of the highest reading, and the root of
    the effective number of loaded cells, (sum of x)^2 / sum of x^2. A window has those of its mean
    frame, and their change from the first frame to the last.

    Args:
        layout: the array.
    """

    present: Tensor
    products: Tensor

    def __init__(self, layout: SensorLayout) -> None:
        super().__init__()
        self.pads, rows, cols = layout.shape
        y, x = np.mgrid[:rows, :cols].reshape(2, -1) - np.array(
            [[(rows - 1) / 2], [(cols - 1) / 2]]
        )
        products = np.stack([np.ones_like(x), y, x, y * y, x * x, y * x], axis=1).astype(np.float32)
        self.register_buffer("present", torch.from_numpy(layout.is_cell.copy()), persistent=False)
        self.register_buffer("products", torch.from_numpy(products), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` to ``[N, 16 pads]``; positions without a cell may hold
        anything."""
        x = torch.where(self.present, x, 0.0)
        frames = torch.stack([x.mean(1), x[:, 0], x[:, -1]], dim=1).clamp_min(0.0)
        mean, first, last = self._of(torch.unflatten(frames, 2, (self.pads, -1))).unbind(1)
        return torch.cat([mean, last - first], dim=2).flatten(1)

    def _of(self, pads: Tensor) -> Tensor:
        """Map readings ``[..., cells]`` of pads to ``[..., 8]``."""
        moments = pads @ self.products
        total = moments[..., 0]
        shares = moments[..., 1:] / (total + CONVERTER_STEP).unsqueeze(-1)
        y, x, yy, xx, yx = shares.unbind(-1)
        along = [
            (square - mean * mean).clamp_min(0.0).add(_CELL).sqrt()
            for square, mean in ((yy, y), (xx, x))
        ]
        size = total / (pads.square().sum(-1).sqrt() + CONVERTER_STEP)
        return torch.stack([total, y, x, *along, yx - y * x, pads.amax(-1).sqrt(), size], dim=-1)
