"""The same network on fewer numbers, for deployment: exact algebra, a third of the multiplications and of the weights.

What is d wide in the paper's network (3520 values for its sensor) never fills that space. The convolutions are linear,
so a frame there is an affine map of its cells; attention and feed-forward block each add an affine map of their 256 and
128 values. So a frame is kept as a few hundred coordinates y with x = y @ basis + offset, and every layer that reads x
is folded with the basis. LayerNorm needs the variance of x alone: with an orthonormal basis of what is centred, from a
QR decomposition, that is the length of y.
"""

from __future__ import annotations

import copy

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from adaptfault.models.network import BLOCKS, HEAD_DIM, HEADS, HIDDEN, EncoderBlock, TactileTransformer, attend

_UPDATES = BLOCKS * (HEADS * HEAD_DIM + HIDDEN + 2)  # numbers that the blocks add to those of a frame's cells
_MOST = 20_000_000  # numbers in a basis; beyond that the decomposition costs more than it is worth
_DEPENDENT = 1e-5  # columns of which less is left beside the others are not decomposed by the quick way
_WORTH = 2000  # windows that take the network as long as it takes to be folded and to run the folded one, twice over


class _Wide:
    """Where x lies while a network is folded: ``x = y @ basis + offset``, ``[k, d]`` and ``[d]``, both double."""

    def __init__(self, basis: Tensor, offset: Tensor) -> None:
        self.basis, self.offset = basis, offset

    def fold(self, layer: nn.Linear) -> nn.Linear:
        """Return the layer that reads y as ``layer`` reads x."""
        return _linear(layer.weight @ self.basis.T, layer.weight @ self.offset + layer.bias)

    def add_and_norm(self, layer: nn.Linear, norm: nn.LayerNorm) -> tuple[CompactNorm, _Wide]:
        """Return what maps y and the values that ``layer`` reads to the new y, after ``norm(x + layer(values))``."""
        rows = torch.cat([self.basis, layer.weight.T, (self.offset + layer.bias)[None]])
        directions, lengths = _orthonormal((rows - rows.mean(1, keepdim=True)).T)  # (d, k'), (k', rows)
        folded = CompactNorm(_linear(lengths[:, :-1], lengths[:, -1]), rows.shape[1], norm.eps)
        return folded, _Wide(directions.T * norm.weight, norm.bias)


class CompactNorm(nn.Module):
    """Residual sum and LayerNorm of ``width`` values, on their coordinates."""

    def __init__(self, sum_: nn.Linear, width: int, eps: float) -> None:
        super().__init__()
        self.sum, self.width, self.eps = sum_, width, eps

    def forward(self, y: Tensor, update: Tensor) -> Tensor:
        """Map ``[N, T, k]`` and an update ``[N, T, u]`` to ``[N, T, k']``."""
        y = self.sum(torch.cat([y, update], dim=-1))
        return y * torch.rsqrt(y.square().sum(-1, keepdim=True) / self.width + self.eps)


class CompactBlock(nn.Module):
    """An encoder block on coordinates."""

    def __init__(self, qkv: nn.Linear, norm1: CompactNorm, up: nn.Linear, norm2: CompactNorm) -> None:
        super().__init__()
        self.qkv, self.norm1, self.up, self.norm2 = qkv, norm1, up, norm2

    @classmethod
    def fold(cls, block: EncoderBlock, wide: _Wide) -> tuple[CompactBlock, _Wide]:
        """Return a block for coordinates, and where x lies after it."""
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
    """Gives the features and logits of a :class:`TactileTransformer` in eval mode, to within rounding.

    Args:
        network: the network; it is copied, and its training mode does not matter.
    """

    present: Tensor

    @torch.no_grad()
    def __init__(self, network: TactileTransformer) -> None:
        super().__init__()
        self.layout, self.length, self.n_classes = network.layout, network.length, network.n_classes
        precise = copy.deepcopy(network).cpu().double()
        self.register_buffer("present", precise.present.nonzero().flatten())
        frames = torch.eye(self.layout.n_cells, dtype=torch.float64)[self.present]
        frames = torch.cat([frames, torch.zeros_like(frames[:1])]).reshape(-1, *self.layout.shape)
        seen = precise.conv2(precise.conv1(frames)).flatten(1)  # (cells + 1, d): of each cell at 1, and of none
        wide = _Wide(seen[:-1] - seen[-1], seen[-1])
        self.blocks = nn.ModuleList()
        for block in precise.blocks:
            assert isinstance(block, EncoderBlock)  # for the type checker: torch does not say
            compact, wide = CompactBlock.fold(block, wide)
            self.blocks.append(compact)
        self.dense, self.head = wide.fold(precise.dense), copy.deepcopy(network.head).cpu()
        self.float().eval()

    @staticmethod
    def suits(network: TactileTransformer) -> bool:
        """Whether the array is small enough for the decompositions to be worth it."""
        return network.dense.in_features * (network.layout.n_cells + _UPDATES) <= _MOST

    def features(self, x: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` to the values ``[N, 128]`` that the head weighs."""
        y = x[..., self.present]
        for block in self.blocks:
            y = block(y)
        return F.relu(self.dense(y.mean(1)))

    def forward(self, x: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` to logits ``[N, n_classes]``."""
        logits: Tensor = self.head(self.features(x))
        return logits


def compacted(network: TactileTransformer, n: int) -> CompactNetwork | None:
    """Return a network on fewer numbers, on its device, where making it is worth its while for ``n`` windows."""
    if n < _WORTH or not CompactNetwork.suits(network):
        return None
    return CompactNetwork(network).to(network.head.weight.device)


def _orthonormal(columns: Tensor) -> tuple[Tensor, Tensor]:
    """Return the QR decomposition of double ``columns [d, n]``; by Cholesky, half the time, where that is as exact."""
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
