"""Low-rank form of the paper's network: exact, or cut to what known windows need.

The residual stream of the paper's network has d = 3520 values for its sensor, but spans a subspace
of a few hundred dimensions. The convolutions are linear, so the stream starts as an affine map of
the cells. Attention and feed-forward block each add an affine map of 256 and 128 values. A frame is
therefore stored as coordinates y with x = y @ basis + offset, and each layer that reads x is
multiplied with the basis. LayerNorm needs only the variance of x. With an orthonormal basis of the
centred vectors (QR decomposition) the variance is the squared length of y over d.

The exact form has a third of the multiplications and of the weights. Where windows are given, each
subspace is cut to their principal directions (Pearson 1901): a twentieth of the multiplications.
The features of such windows then differ by about 4 % of their standard deviation.
"""

from __future__ import annotations

import copy

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from adaptfault.data.windows import evenly
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
_WORTH = 400  # windows from which on the cut form saves time: about twice its break-even
_KNOWN = 200  # windows whose principal directions are kept
_LOST = 1e-3  # share of their variance that each cut leaves out


class _Wide:
    """Affine subspace of the residual stream: ``x = y @ basis + offset``, ``[k, d]`` and ``[d]``,
    both double; and y of known windows ``[N, T, k]``, if there are any."""

    def __init__(self, basis: Tensor, offset: Tensor, known: Tensor | None = None) -> None:
        self.basis = basis
        self.offset = offset
        self.known = known

    def fold(self, layer: nn.Linear) -> nn.Linear:
        """Return the layer whose output for y equals the output of ``layer`` for x."""
        weight = layer.weight.cpu().double()
        return _linear(weight @ self.basis.T, weight @ self.offset + layer.bias.cpu().double())

    def add_and_norm(
        self, layer: nn.Linear, norm: nn.LayerNorm, inputs: Tensor | None
    ) -> tuple[CompactNorm, _Wide]:
        """Return the map from y and the inputs of ``layer`` to the new y of
        ``norm(x + layer(inputs))``."""
        shift = self.offset + layer.bias.cpu().double()
        rows = torch.cat([self.basis, layer.weight.cpu().double().T, shift[None]])
        rows -= rows.mean(1, keepdim=True)
        # (d, k'), (k', rows)
        directions, lengths = _orthonormal(rows.T)
        known = None
        if inputs is not None and self.known is not None:
            known = torch.cat([self.known, inputs], dim=-1) @ lengths[:, :-1].T + lengths[:, -1]
            scale = known.square().sum(-1, keepdim=True) / rows.shape[1] + norm.eps
            known *= torch.rsqrt(scale)
            kept = _principal(known)
            known = known @ kept
            directions = directions @ kept
            lengths = kept.T @ lengths
        folded = CompactNorm(lengths[:, :-1], lengths[:, -1], rows.shape[1], norm.eps)
        weight = norm.weight.cpu().double()
        return folded, _Wide(directions.T * weight, norm.bias.cpu().double(), known)


def _principal(known: Tensor) -> Tensor:
    """Return orthonormal directions ``[k, r]``: the mean of ``[..., k]``, and those that hold all
    but a small share of the variance."""
    flat = known.flatten(0, -2)
    mean = flat.mean(0)
    mean = mean / mean.norm().clamp_min(torch.finfo(mean.dtype).tiny)
    flat = flat - (flat @ mean)[:, None] * mean
    squares, directions = torch.linalg.eigh(flat.T @ flat)
    lost = squares.clamp_min(0).cumsum(0) <= _LOST * squares.sum()
    return torch.cat([mean[:, None], directions[:, ~lost]], dim=1)


class CompactNorm(nn.Module):
    """Residual sum and LayerNorm of ``width`` values, computed on coordinates.

    The matrix of the exact sum is upper triangular: blocks of its rows leave out the zeros below
    the diagonal.

    Args:
        matrix: ``[k', k + u]``.
        offset: ``[k']``.
        width: of the LayerNorm.
        eps: of the LayerNorm.
    """

    def __init__(self, matrix: Tensor, offset: Tensor, width: int, eps: float) -> None:
        super().__init__()
        self.width = width
        self.eps = eps
        triangular = not matrix.tril(-1).any()
        self.step = _ROWS if triangular else len(matrix)
        self.rows = nn.ModuleList(
            _linear(matrix[i : i + self.step, i:], offset[i : i + self.step])
            for i in range(0, len(matrix), self.step)
        )

    def forward(self, y: Tensor, update: Tensor) -> Tensor:
        """Map ``[N, T, k]`` and an update ``[N, T, u]`` to ``[N, T, k']``."""
        y = torch.cat([y, update], dim=-1)
        parts = [rows(y[..., i * self.step :]) for i, rows in enumerate(self.rows)]
        y = torch.cat(parts, dim=-1)
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
        attended = None if wide.known is None else attend(qkv(wide.known))
        norm1, wide = wide.add_and_norm(block.out, block.norm1, attended)
        up = wide.fold(block.up)
        fed = None if wide.known is None else F.relu(up(wide.known))
        norm2, wide = wide.add_and_norm(block.down, block.norm2, fed)
        return cls(qkv, norm1, up, norm2), wide

    def forward(self, y: Tensor) -> Tensor:
        """Map ``[N, T, k]`` to ``[N, T, k']``."""
        y = self.norm1(y, attend(self.qkv(y)))
        summed: Tensor = self.norm2(y, F.relu(self.up(y)))
        return summed


class CompactNetwork(nn.Module):
    """Low-rank form of a :class:`TactileTransformer`: the same features and logits in eval mode.

    They are the same up to rounding, or, with ``windows``, up to what these do not need.

    Args:
        network: the network; it is copied. Dropout is left out.
        windows: ``[N, T, D]``; None: any window counts.
    """

    present: Tensor
    entered: Tensor

    @torch.no_grad()
    def __init__(self, network: TactileTransformer, windows: Tensor | None = None) -> None:
        super().__init__()
        self.layout = network.layout
        self.length = network.length
        self.n_classes = network.n_classes
        self.register_buffer("present", network.present.cpu().nonzero().flatten())
        wide = self._enter(network, windows)
        self.blocks = nn.ModuleList()
        for block in network.blocks:
            assert isinstance(block, EncoderBlock)  # for the type checker
            compact, wide = CompactBlock.fold(block, wide)
            self.blocks.append(compact)
        self.dense = wide.fold(network.dense)
        self.head = copy.deepcopy(network.head).cpu()
        self.float().eval()

    def _enter(self, network: TactileTransformer, windows: Tensor | None) -> _Wide:
        """Return the subspace of the output of the convolutions; the cells are its coordinates, or
        their principal directions."""
        first = copy.deepcopy(nn.ModuleList([network.conv1, network.conv2])).cpu().double()
        frames = torch.eye(self.layout.n_cells, dtype=torch.float64)[self.present]
        frames = torch.cat([frames, torch.zeros_like(frames[:1])])
        frames = network.standardised(frames.to(network.mean.device)).cpu()
        frames = frames.double().reshape(-1, *self.layout.shape)
        # (cells + 1, d): one cell at 1 each, and no cell
        seen = first[1](first[0](frames)).flatten(1)
        cells = seen[:-1] - seen[-1]
        entered = torch.eye(len(cells), dtype=torch.float64)
        if windows is None:
            self.register_buffer("entered", entered[:0])
            return _Wide(cells, seen[-1])
        directions, lengths = _orthonormal(cells.T)
        known = windows[..., self.present].double()
        kept = _principal(known @ lengths.T)
        entered = lengths.T @ kept
        self.register_buffer("entered", entered)
        return _Wide((directions @ kept).T, seen[-1], known @ entered)

    @staticmethod
    def suits(network: TactileTransformer) -> bool:
        """Return whether the basis is small enough for the decomposition to save time."""
        return network.dense.in_features * (network.layout.n_cells + _UPDATES) <= _MOST

    def features(self, x: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` to features ``[N, 128]``, the input of the head."""
        y = x[..., self.present]
        if len(self.entered):
            y = y @ self.entered
        for block in self.blocks:
            y = block(y)
        return F.relu(self.dense(y.mean(1)))

    def forward(self, x: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` to logits ``[N, n_classes]``."""
        logits: Tensor = self.head(self.features(x))
        return logits


def compacted(network: TactileTransformer, windows: Tensor) -> CompactNetwork | None:
    """Return the network, cut to windows ``[N, T, D]``, on the same device, if that saves time for
    them, else None."""
    if len(windows) < _WORTH or not CompactNetwork.suits(network):
        return None
    known = windows[evenly(len(windows), _KNOWN)]
    return CompactNetwork(network, known).to(network.head.weight.device)


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
