"""Logits of the paper's network with one cell stuck, for all cells, at a fraction of the cost of a
pass for each.

A window with a stuck cell differs from the window itself by one number a frame. The network is
linear up to the first attention (the convolutions have no ReLU). After it, the residual stream of
width d is a combination of few vectors: the contribution of the frame (r), the contributions of one
unit in the stuck cell, direct and through each head (a, five vectors), and vectors that all stuck
cells of a window share (B): the frames through each head, and the columns of the later linear
layers. The stream is stored as coordinates (sigma, tau, y) of sigma r + tau a + y B. A LayerNorm
maps these vectors once and scales the coordinates; its variance is a quadratic form in the
coordinates. No vector of width d is computed for a window, and the result equals the logits of the
network up to rounding.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from adaptfault.models.network import (
    HEAD_DIM,
    HEADS,
    EncoderBlock,
    TactileTransformer,
    attend,
    logits_of,
)

# relative to the largest; closer logits are recomputed by the network, so that rounding decides no
# class
_TIE = 2e-4
_BATCH = 512  # stuck cells at once
_VALUES = HEADS * HEAD_DIM  # width of the output of the first attention
_PARTS = 4  # of a quadratic form


class StuckCells:
    """The network's logits for windows in which one cell is stuck.

    Dropout is left out in any mode. The weights of the model must not change.
    """

    def __init__(self, model: TactileTransformer) -> None:
        self.model = model
        with torch.no_grad():
            # absent positions contribute 0
            cells = torch.diag(model.present.to(model.head.weight.dtype))
            frames = model.standardised(torch.cat([cells, torch.zeros_like(cells[:1])]))
            frames = _convolved(model, frames)
            # of one unit in each cell; the last is that of no pressure, (D + 1, d)
            frames[:-1] -= frames[-1]
            reader = cast(EncoderBlock, model.blocks[0]).qkv
            first = frames @ reader.weight.T
            first[-1] += reader.bias
            # (3, heads, D + 1, 64)
            self.first = first.view(-1, 3, HEADS, HEAD_DIM).permute(1, 2, 0, 3)
            self.layers = _layers(model, frames, _spread(self.first[2, :, :-1].transpose(0, 1)))

    @torch.no_grad()
    def logits(self, window: Tensor, cells: Tensor, values: Tensor) -> Tensor:
        """Return logits ``[P, n_classes]`` of ``window [T, D]`` with cell ``cells[p]`` stuck at
        ``values[p]``."""
        out = self._by_coordinates(window, cells, values)
        best = out.topk(min(2, out.shape[1]), dim=1).values
        near = (best[:, 0] - best[:, -1] < _TIE * out.abs().amax(1)).nonzero().squeeze(1)
        if len(near) and out.shape[1] > 1:
            stuck = window.repeat(len(near), 1, 1)
            stuck[torch.arange(len(near), device=window.device), :, cells[near]] = values[
                near, None
            ]
            out[near] = logits_of(self.model, stuck).to(out.device)
        return out

    def _by_coordinates(self, window: Tensor, cells: Tensor, values: Tensor) -> Tensor:
        frames = torch.where(self.model.present, window, 0.0)
        frames = torch.cat([frames, torch.ones_like(frames[:, :1])], dim=1)  # (T, D + 1)
        own = frames @ self.first  # (3, heads, T, 64)
        shared = _spread(own[2].transpose(0, 1)).flatten(0, 1)  # (T * heads, 256)
        seen = [layer.within(frames, shared) for layer in self.layers]
        delta = values[:, None] - window.T[cells]  # (P, T)
        batches = zip(torch.split(cells, _BATCH), torch.split(delta, _BATCH), strict=True)
        return torch.cat([self._answers(own, seen, *batch) for batch in batches])

    def _answers(self, own: Tensor, seen: list[_Seen], cells: Tensor, delta: Tensor) -> Tensor:
        """Return the logits of P stuck cells whose readings change by ``delta [P, T]``."""
        shares = self._attention(own, cells, delta)  # (heads, P, T, T)
        through = (shares @ delta[..., None]).squeeze(3).permute(1, 2, 0)
        sigma = torch.ones_like(delta)
        tau = torch.cat([delta[..., None], through], dim=2)
        # One buffer for all coordinates; the coordinate of a bias, of a layer or of a norm is 1.
        y = delta.new_ones(*delta.shape, len(seen[-1].read))
        mixed = shares.permute(1, 2, 3, 0).flatten(2)
        y[..., : mixed.shape[2]] = mixed
        for layer, at in zip(self.layers, seen, strict=True):
            known = y[..., : len(at.gram)]
            inner = _half_product(known, at.gram)
            inner.addcmul_(sigma[..., None], at.frames_along)
            inner.baddbmm_(tau, at.cells_along[cells])
            square = 2 * inner.mul_(known).sum(-1) + sigma**2 * at.frames_square
            square += (
                (tau @ layer.products[cells] + 2 * sigma[..., None] * at.across[cells])
                .mul_(tau)
                .sum(-1)
            )
            scale = torch.rsqrt(square / len(layer.norm.weight) + layer.norm.eps)
            sigma = sigma * scale
            tau = tau * scale[..., None]
            known *= scale[..., None]
            if layer is not self.layers[-1]:
                out = y.new_empty(*delta.shape, at.read.shape[1])
                _times(y[..., : len(at.read)], at.read, out)
                out.addcmul_(sigma[..., None], at.frames_read)
                out.baddbmm_(tau, layer.cells_read[cells])
                out = attend(out) if layer.attends else out.relu_()
                y[..., len(at.read) : len(at.read) + out.shape[2]] = out
        pooled = y.mean(1) @ at.read + sigma @ at.frames_read / sigma.shape[1]  # over the frames
        pooled += (tau.mean(1, keepdim=True) @ layer.cells_read[cells]).squeeze(1)
        return cast(Tensor, self.model.head(F.relu(pooled)))

    def _attention(self, own: Tensor, cells: Tensor, delta: Tensor) -> Tensor:
        """Return the weights of the first attention, ``[heads, P, T, T]``."""
        # of one unit in the stuck cell, (heads, P, 64)
        query, key = (self.first[i][:, cells] for i in (0, 1))
        key_side = query @ own[1].mT + (query * key).sum(2, keepdim=True) * delta
        scores = delta[:, :, None] * key_side[:, :, None]
        scores.addcmul_((key @ own[0].mT)[..., None], delta[:, None])
        scores += (own[0] @ own[1].mT)[:, None]
        return torch.softmax(scores / HEAD_DIM**0.5, dim=3)


@dataclass(frozen=True, eq=False)
class _Seen:
    """A :class:`_Layer` for one window of T frames, in m coordinates; the first 256 are replaced.

    Attributes:
        gram: ``[m, m]``, for :func:`_half_product`.
        read: ``[m + 1, k]``.
        frames_along: ``[T, m]``, inner products of the frames with the vectors of the layer.
        frames_square: ``[T]``, of the frames with themselves.
        frames_read: ``[T, k]``, their output by the next linear layer.
        cells_along: ``[D, K, m]``.
        across: ``[D, T, K]``, inner products of frames and cells.
    """

    gram: Tensor
    read: Tensor
    frames_along: Tensor
    frames_square: Tensor
    frames_read: Tensor
    cells_along: Tensor
    across: Tensor


@dataclass(frozen=True, eq=False)
class _Layer:
    """A LayerNorm, the vectors that span its input, and the linear layer after it.

    The vectors are m outputs of linear layers (the first 256 by the first attention), and K = 1 +
    heads for each of D cells: the contribution of one unit in the cell, direct and through each
    head.

    Attributes:
        norm: the LayerNorm.
        gram: ``[m, m]``, inner products of the m centred vectors.
        read: ``[m + 1, k]``, output of the next linear layer for each after the norm; the last row
            has the biases.
        attends: whether the next layer computes queries, keys and values.
        straight: ``[D + 1, D + 1]``, inner products of the direct vectors of the cells and of the
            empty frame.
        straight_along: ``[D + 1, m]``, inner products of these with the m vectors.
        straight_read: ``[D + 1, k]``, output of the next linear layer for these.
        through: ``[D, heads, 256]``, the other vectors of the cells as coordinates of the first
            256.
        cells_along: ``[D, K, m]``, inner products of the vectors of the cells with the m vectors.
        products: ``[D, K, K]``, inner products of the vectors of one cell.
        cells_read: ``[D, K, k]``, output of the next linear layer for the vectors of the cells.
    """

    norm: nn.LayerNorm
    gram: Tensor
    read: Tensor
    attends: bool
    straight: Tensor
    straight_along: Tensor
    straight_read: Tensor
    through: Tensor
    cells_along: Tensor
    products: Tensor
    cells_read: Tensor

    @classmethod
    def of(
        cls, norm: nn.LayerNorm, reader: nn.Linear, written: Tensor, cells: Tensor, through: Tensor
    ) -> _Layer:
        """Compute the products of centred vectors ``written [m, d]`` and ``cells [D + 1, d]``."""
        gram = written @ written.T
        along = cells @ written.T
        read = torch.cat([written * norm.weight, norm.bias[None]]) @ reader.weight.T
        read[-1] += reader.bias  # the coordinate of the norm's bias is 1
        straight = cells @ cells.T
        straight_read = (cells * norm.weight) @ reader.weight.T
        cells_along = torch.cat([along[:-1, None], through @ gram[:_VALUES]], dim=1)
        others = cells_along[:, :, :_VALUES] @ through.mT
        first = torch.cat([straight.diagonal()[:-1, None, None], others[:, :1].mT], dim=1)
        cells_read = torch.cat([straight_read[:-1, None], through @ read[:_VALUES]], dim=1)
        products = torch.cat([first, others], dim=2)
        attends = reader.out_features == 3 * _VALUES
        return cls(
            norm,
            gram,
            read,
            attends,
            straight,
            along,
            straight_read,
            through,
            cells_along,
            products,
            cells_read,
        )

    def within(self, frames: Tensor, shared: Tensor) -> _Seen:
        """Return the layer for a window of ``frames [T, D + 1]``; ``shared [n, 256]`` replace the
        first 256 vectors."""
        along = frames @ self.straight_along
        straight = frames @ self.straight
        return _Seen(
            gram=_half_gram(_mix(_mix(self.gram, shared).T, shared)),
            read=torch.cat([shared @ self.read[:_VALUES], self.read[_VALUES:]]),
            frames_along=_mix(along, shared),
            frames_square=(straight * frames).sum(1),
            frames_read=frames @ self.straight_read,
            cells_along=_mix(self.cells_along, shared),
            across=torch.cat(
                [straight[:, :-1].T[..., None], along[:, :_VALUES] @ self.through.mT], dim=2
            ),
        )


def _layers(model: TactileTransformer, cells: Tensor, through: Tensor) -> list[_Layer]:
    """Propagate the outputs of the layers and the cells ``[D + 1, d]`` through the norms."""
    first, second = (cast(EncoderBlock, block) for block in model.blocks)
    layers: list[_Layer] = []
    written = cells.new_zeros(0, cells.shape[1])
    for writer, norm, reader in (
        (first.out, first.norm1, first.up),
        (first.down, first.norm2, second.qkv),
        (second.out, second.norm1, second.up),
        (second.down, second.norm2, model.dense),
    ):
        written = torch.cat([written, writer.weight.T, writer.bias[None]])
        written = written - written.mean(1, keepdim=True)
        cells = cells - cells.mean(1, keepdim=True)
        layers.append(_Layer.of(norm, reader, written, cells, through))
        written = torch.cat([written * norm.weight, norm.bias[None]])
        cells = cells * norm.weight
    return layers


def _convolved(model: TactileTransformer, frames: Tensor) -> Tensor:
    """Return the output ``[n, d]`` of the convolutions for frames ``[n, D]``."""
    frames = torch.where(model.present, frames, 0.0)
    out: Tensor = model.conv2(model.conv1(frames.reshape(-1, *model.layout.shape))).flatten(1)
    return out


def _spread(values: Tensor) -> Tensor:
    """Place the values ``[n, heads, 64]`` of each head among those of all heads,
    ``[n, heads, 256]``."""
    return torch.diag_embed(values.mT).permute(0, 2, 3, 1).flatten(2)


def _mix(products: Tensor, shared: Tensor) -> Tensor:
    """Replace inner products ``[..., m]`` with the first 256 vectors by those with
    ``shared [n, 256]``."""
    return torch.cat([products[..., :_VALUES] @ shared.T, products[..., _VALUES:]], dim=-1)


def _edges(m: int) -> list[tuple[int, int]]:
    """Return where each of the parts of m begins and ends."""
    at = [m * i // _PARTS for i in range(_PARTS + 1)]
    return list(itertools.pairwise(at))


def _half_gram(gram: Tensor) -> Tensor:
    """Return ``gram [m, m]`` with the blocks on its diagonal halved, for :func:`_half_product`."""
    for start, stop in _edges(len(gram)):
        gram[start:stop, start:stop] /= 2
    return gram


def _half_product(y: Tensor, gram: Tensor) -> Tensor:
    """Return z of ``y [P, T, m]`` such that z y = y G y / 2, G being symmetric: 5 / 8 of the work
    of y G."""
    out = y.new_empty(y.shape)
    for start, stop in _edges(len(gram)):
        _times(y[..., :stop], gram[:stop, start:stop], out[..., start:stop])
    return out


def _times(y: Tensor, matrix: Tensor, out: Tensor) -> None:
    """Write ``y [P, T, m]`` times ``matrix [m, k]`` to ``out [P, T, k]``; both may be parts of a
    wider buffer."""
    a, b = (
        part.as_strided((part.shape[0] * part.shape[1], part.shape[2]), (part.stride(1), 1))
        for part in (y, out)
    )
    torch.mm(a, matrix, out=b)
