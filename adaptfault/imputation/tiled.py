"""The front end of large arrays: conditional mean and kernel regression tile by tile, as one torch
module."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.imputation.kernel import WIDTH
from adaptfault.imputation.tile_part import TilePart
from diagnostics import FaultSet

_VALUES = 1 << 24  # processed at once
_NEVER = 1e9  # squared distance of an unused slot


class TiledFill(nn.Module):
    """Front end from the healthy cells to all, tile by tile; healthy cells pass unchanged.

    Args:
        fault_set: F.
        sizes: number of tiles; the largest number of predictors, missing cells and kernel frames of
            a tile; number of pads whose mean loads are predictors.
    """

    index: Tensor
    valid: Tensor
    slot: Tensor
    order: Tensor
    average: Tensor
    roots: Tensor
    squares: Tensor
    residuals: Tensor
    width: Tensor

    def __init__(self, fault_set: FaultSet, sizes: Sequence[int]) -> None:
        super().__init__()
        p, h, m, n, pads = self.sizes = tuple(int(size) for size in sizes)
        self.weight = nn.Parameter(torch.zeros(p, m, h))
        self.bias = nn.Parameter(torch.zeros(p, m))
        self.register_buffer("index", torch.zeros(p, h, dtype=torch.long))
        self.register_buffer("valid", torch.zeros(p, h))
        self.register_buffer("slot", torch.zeros(len(fault_set), dtype=torch.long))
        self.register_buffer("average", torch.zeros(fault_set.n_cells - len(fault_set), pads))
        self.register_buffer("roots", torch.zeros(p, n, h))
        self.register_buffer("squares", torch.full((p, n), _NEVER))
        self.register_buffer("residuals", torch.zeros(p, n, m))
        self.register_buffer("width", torch.ones(p))
        # Position of each cell in [healthy, missing].
        order = np.argsort(np.concatenate([fault_set.healthy, np.flatnonzero(fault_set.mask)]))
        self.register_buffer("order", torch.from_numpy(order), persistent=False)

    @classmethod
    def of(
        cls, fault_set: FaultSet, parts: Sequence[TilePart], average: NDArray[np.float32]
    ) -> TiledFill:
        """Build the front end from the imputation of each tile and the map to pad means."""
        most = [
            max((len(x) for x in each), default=0)
            for each in zip(*((p.known, p.missing, p.roots) for p in parts), strict=True)
        ]
        fill = cls(fault_set, (len(parts), *(most or (0, 0, 0)), average.shape[1]))
        fill.set_parts(parts, average)
        return fill

    def set_parts(self, parts: Sequence[TilePart], average: NDArray[np.float32]) -> None:
        """Copy weights and kernel frames of all tiles."""
        _, _, m, _, _ = self.sizes
        with torch.no_grad():
            self.average.copy_(torch.from_numpy(average))
            for i, part in enumerate(parts):
                h = len(part.known)
                k = len(part.missing)
                n = len(part.roots)
                self.weight[i, :k, :h] = torch.from_numpy(part.weight)
                self.bias[i, :k] = torch.from_numpy(part.bias)
                self.index[i, :h] = torch.from_numpy(part.known)
                self.valid[i, :h] = 1.0
                self.slot[torch.from_numpy(part.missing)] = i * m + torch.arange(k)
                self.roots[i, :n, :h] = torch.from_numpy(part.roots)
                self.squares[i, :n] = self.roots[i, :n].square().sum(1)
                self.residuals[i, :n, :k] = torch.from_numpy(part.residuals)
                self.width[i] = part.width

    def forward(self, x: Tensor) -> Tensor:
        """Map ``[N, T, D-k]`` to ``[N, T, D]``; imputed readings are clipped to 0..1."""
        p, h, m, n, _ = self.sizes
        frames = x.reshape(-1, x.shape[-1])
        at_once = max(1, _VALUES // max(1, p * (h + n + m)))
        filled = torch.cat([self._missing(some) for some in torch.split(frames, at_once)])
        return torch.cat([frames, filled.clamp(0.0, 1.0)], dim=-1)[:, self.order].reshape(
            *x.shape[:-1], -1
        )

    def _missing(self, x: Tensor) -> Tensor:
        """Map ``[B, D-k]`` to the imputed readings ``[B, k]``, not clipped."""
        # (P, B, h)
        around = (torch.cat([x, x @ self.average], dim=1)[:, self.index] * self.valid).transpose(
            0, 1
        )
        filled = torch.baddbmm(self.bias[:, None], around, self.weight.transpose(1, 2))  # (P, B, m)
        if self.sizes[3]:
            loads = around.clamp_min(0.0)
            width = self.width[:, None, None]
            # (P, B, M)
            nearness = 2 * loads.sqrt() @ self.roots.transpose(1, 2) - self.squares[:, None]
            # One more reference at the typical distance of a near neighbour, with residual 0.
            usual = loads.sum(-1, keepdim=True) - width / WIDTH
            weights = torch.softmax(torch.cat([nearness, usual], dim=-1) / width, dim=-1)[..., :-1]
            filled = filled + weights @ self.residuals
        return filled.transpose(0, 1).reshape(len(x), -1)[:, self.slot]
