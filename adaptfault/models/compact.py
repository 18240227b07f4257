"""Exact low-rank form of the paper's network: a third of the multiplications and of the weights.

The residual stream of the paper's network has d = 3520 values for its sensor, but spans a subspace
of a few hundred dimensions. The convolutions are linear, so the stream starts as an affine map of
the cells. Attention and feed-forward block each add an affine map of 256 and 128 values. A frame is
therefore stored as coordinates y with x = y @ basis + offset, and each layer that reads x is
multiplied with the basis. LayerNorm needs only the variance of x. With an orthonormal basis of the
centred vectors (QR decomposition) the variance is the squared length of y over d.
"""

from __future__ import annotations

import copy

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from adaptfault.models.network import (
    BLOCKS,
    HEAD_DIM,
    HEADS,
    HIDDEN,
    EncoderBlock,
    TactileTransformer,
    attend,
)

# numbers that the blocks add to those of a frame's cells
_UPDATES = BLOCKS * (HEADS * HEAD_DIM + HIDDEN + 2)
_MOST = 20_000_000  # values in a basis; a larger decomposition costs more time than it saves
_ROWS = 128  # of a triangular matrix, multiplied at once
_DEPENDENT = 1e-5  # relative Cholesky diagonal below which the columns count as linearly dependent
_WORTH = 2000  # windows from which on the decomposition saves time: about twice its break-even


class _Wide:
    """Affine subspace of the residual stream: ``x = y @ basis + offset``, ``[k, d]`` and ``[d]``,
    both double."""

    def __init__(self, basis: Tensor, offset: Tensor) -> None:
        self.basis = basis
        self.offset = offset

    def fold(self, layer: nn.Linear) -> nn.Linear:
        """Return the layer whose output for y equals the output of ``layer`` for x."""
        return _linear(layer.weight @ self.basis.T, layer.weight @ self.offset + layer.bias)

    def add_and_norm(self, layer: nn.Linear, norm: nn.LayerNorm) -> tuple[CompactNorm, _Wide]:
        """Return the map from y and the inputs of ``layer`` to the new y of
        ``norm(x + layer(inputs))``."""
        rows = torch.cat([self.basis, layer.weight.T, (self.offset + layer.bias)[None]])
        # (d, k'), (k', rows)
        directions, lengths = _orthonormal((rows - rows.mean(1, keepdim=True)).T)
        folded = CompactNorm(lengths[:, :-1], lengths[:, -1], rows.shape[1], norm.eps)
        return folded, _Wide(directions.T * norm.weight, norm.bias)


class CompactNorm(nn.Module):
    """Residual sum and LayerNorm of ``width`` values, computed on coordinates.

    The matrix of the sum is upper triangular: blocks of its rows leave out the zeros below the
    diagonal.

    Args:
        matrix: ``[k', k + u]``, upper triangular.
        offset: ``[k']``.
        width: of the LayerNorm.
        eps: of the LayerNorm.
    """

    def __init__(self, matrix: Tensor, offset: Tensor, width: int, eps: float) -> None:
        super().__init__()
        self.width = width
        self.eps = eps
        self.rows = nn.ModuleList(
            _linear(matrix[i : i + _ROWS, i:], offset[i : i + _ROWS])
            for i in range(0, len(matrix), _ROWS)
        )

    def forward(self, y: Tensor, update: Tensor) -> Tensor:
        """Map ``[N, T, k]`` and an update ``[N, T, u]`` to ``[N, T, k']``."""
        y = torch.cat([y, update], dim=-1)
        y = torch.cat([rows(y[..., i * _ROWS :]) for i, rows in enumerate(self.rows)], dim=-1)
        return y * torch.rsqrt(y.square().sum(-1, keepdim=True) / self.width + self.eps)


class CompactBlock(nn.Module):
    """Encoder block computed on coordinates."""

    def __init__(
        self, qkv: nn.Linear, norm1: CompactNorm, up: nn.Linear, norm2: CompactNorm
    ) -> None:
        super().__init__()
        self.qkv = qkv
        self.norm1 = norm1
        self.up = up
        self.norm2 = norm2

    @classmethod
    def fold(cls, block: EncoderBlock, wide: _Wide) -> tuple[CompactBlock, _Wide]:
        """Return the block on coordinates, and the subspace of its output."""
        qkv = wide.fold(block.qkv)
        norm1, wide = wide.add_and_norm(block.out, block.norm1)
        up = wide.fold(block.up)
        norm2, wide = wide.add_and_norm(block.down, block.norm2)
        return cls(qkv, norm1, up, norm2), wide

    def forward(self, y: Tensor) -> Tensor:
        """Map ``[N, T, k]`` to ``[N, T, k']``."""
        y = self.norm1(y, attend(self.qkv(y)))
        summed: Tensor = self.norm2(y, F.relu(self.up(y)))
        return summed


class CompactNetwork(nn.Module):
    """Low-rank form of a :class:`TactileTransformer`: the same features and logits in eval mode, up
    to rounding.

    Args:
        network: the network; it is copied. Dropout is left out.
    """

    present: Tensor

    @torch.no_grad()
    def __init__(self, network: TactileTransformer) -> None:
        super().__init__()
        self.layout = network.layout
        self.length = network.length
        self.n_classes = network.n_classes
        precise = copy.deepcopy(network).cpu().double()
        self.register_buffer("present", precise.present.nonzero().flatten())
        frames = torch.eye(self.layout.n_cells, dtype=torch.float64)[self.present]
        frames = precise.standardised(torch.cat([frames, torch.zeros_like(frames[:1])]))
        frames = frames.reshape(-1, *self.layout.shape)
        # (cells + 1, d): one cell at 1 each, and no cell
        seen = precise.conv2(precise.conv1(frames)).flatten(1)
        wide = _Wide(seen[:-1] - seen[-1], seen[-1])
        self.blocks = nn.ModuleList()
        for block in precise.blocks:
            assert isinstance(block, EncoderBlock)  # for the type checker
            compact, wide = CompactBlock.fold(block, wide)
            self.blocks.append(compact)
        self.dense = wide.fold(precise.dense)
        self.head = copy.deepcopy(network.head).cpu()
        self.float().eval()

    @staticmethod
    def suits(network: TactileTransformer) -> bool:
        """Return whether the basis is small enough for the decomposition to save time."""
        return network.dense.in_features * (network.layout.n_cells + _UPDATES) <= _MOST

    def features(self, x: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` to features ``[N, 128]``, the input of the head."""
        y = x[..., self.present]
        for block in self.blocks:
            y = block(y)
        return F.relu(self.dense(y.mean(1)))

    def forward(self, x: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` to logits ``[N, n_classes]``."""
        logits: Tensor = self.head(self.features(x))
        return logits


def compacted(network: TactileTransformer, n: int) -> CompactNetwork | None:
    """Return the low-rank network on the same device if it saves time for ``n`` windows, else
    None."""
    if n < _WORTH or not CompactNetwork.suits(network):
        return None
    return CompactNetwork(network).to(network.head.weight.device)


def _orthonormal(columns: Tensor) -> tuple[Tensor, Tensor]:
    """Return the QR decomposition of double ``columns [d, n]``; Cholesky QR where the columns are
    well conditioned."""
    root, failed = torch.linalg.cholesky_ex(columns.T @ columns)
    left = root.diagonal()
    if failed or left.min() < _DEPENDENT * left.max():
        directions, lengths = torch.linalg.qr(columns)
        return directions, lengths
    return torch.linalg.solve_triangular(root, columns.T, upper=False).T, root.T


def _linear(weight: Tensor, bias: Tensor) -> nn.Linear:
    layer = nn.Linear(weight.shape[1], weight.shape[0], dtype=weight.dtype)
    layer.weight.copy_(weight)
    layer.bias.copy_(bias)
    return layer
