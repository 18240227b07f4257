"""What a network says with one cell stuck, for every cell in turn, at a fraction of the cost of running it each time.

A window with a stuck cell differs from the window itself by one number a frame. Everything up to the first attention is
linear (the convolutions have no ReLU), and from there on the residual stream of width d stays a combination of few
vectors: what the frame itself gives (r), what one unit in the stuck cell gives (a), and the columns of the later linear
layers (B). So the stream is kept as coordinates (sigma, tau, y) of sigma r + tau a + y B. A LayerNorm maps the vectors
once for all and divides the coordinates; its variance is a quadratic form in them. No vector of width d is ever made
for a stuck cell, and the result is the network's own up to rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from adaptfault.network import HEAD_DIM, HEADS, HIDDEN, EncoderBlock, TactileTransformer, logits_of

_TIE = 1e-3  # logits that are closer are computed again by the network itself, so that rounding decides nothing


class StuckCells:
    """The network's logits for windows in which one cell is stuck.

    Dropout is left out, whatever mode the model is in. Its weights must stay as they are.
    """

    def __init__(self, model: TactileTransformer) -> None:
        self.model = model
        with torch.no_grad():
            cells = torch.diag(model.present.to(model.head.weight.dtype))  # absent positions give nothing
            frames = _convolved(model, torch.cat([torch.zeros_like(cells[:1]), cells]))
            self.unit = frames[1:] - frames[0]  # (D, d)
            self.layers = _layers(model)
            self.cells = _follow(self.layers, self.unit)
            self.qkv = cast(EncoderBlock, model.blocks[0]).qkv
            self.first = self.unit @ self.qkv.weight.T  # (D, 768)

    @torch.no_grad()
    def logits(self, window: Tensor, cells: Tensor, values: Tensor) -> Tensor:
        """Return logits ``[P, n_classes]`` of ``window [T, D]`` with cell ``cells[p]`` stuck at ``values[p]``."""
        out = self._by_coordinates(window, cells, values)
        best = out.topk(min(2, out.shape[1]), dim=1).values
        near = (best[:, 0] - best[:, -1] < _TIE).nonzero().squeeze(1)
        if len(near) and out.shape[1] > 1:
            stuck = window.repeat(len(near), 1, 1)
            stuck[torch.arange(len(near)), :, cells[near]] = values[near, None]
            out[near] = logits_of(self.model, stuck).to(out.device)
        return out

    def _by_coordinates(self, window: Tensor, cells: Tensor, values: Tensor) -> Tensor:
        frames = _convolved(self.model, window)  # (T, d)
        own = _follow(self.layers, frames)
        delta = values[:, None] - window.T[cells]  # (P, T)
        qkv = self.qkv(frames) + delta[..., None] * self.first[cells][:, None]
        sigma, tau = torch.ones_like(delta), delta
        # One buffer takes all coordinates as they come; 1 is the coordinate of a bias, of a layer or of a norm.
        y = window.new_ones(*delta.shape, len(self.layers[-1].mapped))
        y[..., : HEADS * HEAD_DIM] = _attend(qkv)
        for layer, frame, cell in zip(self.layers, own, self.cells, strict=True):
            known = y[..., : len(layer.gram)]
            inner = _half_product(known, layer.gram)
            inner.addcmul_(sigma[..., None], frame.along)
            inner.addcmul_(tau[..., None], cell.along[cells, None])
            square = 2 * inner.mul_(known).sum(-1)
            square += sigma**2 * frame.square + tau**2 * cell.square[cells, None]
            square += 2 * sigma * tau * (cell.centred @ frame.centred.T)[cells]
            scale = torch.rsqrt(square / self.unit.shape[1] + layer.norm.eps)
            sigma, tau = sigma * scale, tau * scale
            known *= scale[..., None]
            if layer.reader is not None:
                m, n = layer.mapped.shape[0], layer.written
                out = y.new_empty(*delta.shape, layer.read.shape[1])
                _times(y[..., :m], layer.read, out)
                out.addcmul_(sigma[..., None], frame.read)
                out.addcmul_(tau[..., None], cell.read[cells, None])
                y[..., m : m + n] = _attend(out) if layer.attends else out.relu_()
        return self._head(y, sigma, tau, own[-1].mapped, cells)

    def _head(self, y: Tensor, sigma: Tensor, tau: Tensor, frames: Tensor, cells: Tensor) -> Tensor:
        """Pool over the frames and classify."""
        dense, last = self.model.dense, self.layers[-1]
        pooled = y.mean(1) @ (last.mapped @ dense.weight.T)
        pooled += sigma @ (frames @ dense.weight.T) / sigma.shape[1]
        pooled += tau.mean(1, keepdim=True) * (self.cells[-1].mapped @ dense.weight.T)[cells]
        out: Tensor = self.model.head(F.relu(pooled + dense.bias))
        return out


@dataclass(frozen=True, eq=False)
class _Layer:
    """A LayerNorm, the m vectors that later layers have put into the stream before it, and what reads the stream next.

    Attributes:
        norm: the LayerNorm.
        centred: ``[m, d]``, those vectors without their mean.
        gram: ``[m, m]``, half their inner products (:func:`_half_gram`).
        mapped: ``[m + 1, d]``, what the norm makes of them, and its bias.
        reader: the linear layer that reads what the norm gives; None after the last one.
        read: ``[m + 1, k]``, what it reads of ``mapped``, its bias included.
        attends: its outputs are queries, keys and values.
    """

    norm: nn.LayerNorm
    centred: Tensor
    gram: Tensor
    mapped: Tensor
    reader: nn.Linear | None
    read: Tensor
    attends: bool

    @property
    def written(self) -> int:
        """How many coordinates come of what is read."""
        return HEADS * HEAD_DIM if self.attends else HIDDEN


def _layers(model: TactileTransformer) -> list[_Layer]:
    first, second = (cast(EncoderBlock, block) for block in model.blocks)
    layers: list[_Layer] = []
    known = first.out.weight.new_zeros(0, first.out.weight.shape[0])
    for writer, norm, reader in (
        (first.out, first.norm1, first.up),
        (first.down, first.norm2, second.qkv),
        (second.out, second.norm1, second.up),
        (second.down, second.norm2, None),
    ):
        vectors = torch.cat([known, writer.weight.T, writer.bias[None]])
        centred = vectors - vectors.mean(1, keepdim=True)
        known = torch.cat([centred * norm.weight, norm.bias[None]])
        read = known.new_zeros(0)
        if reader is not None:
            read = known @ reader.weight.T
            read[-1] += reader.bias  # the last coordinate, of the norm's bias, is 1
        layers.append(_Layer(norm, centred, _half_gram(centred), known, reader, read, reader is second.qkv))
    return layers


@dataclass(frozen=True, eq=False)
class _Along:
    """Vectors ``[n, d]`` on their way through the norms: what one norm needs to know of them.

    Attributes:
        centred: ``[n, d]``, without their mean, before the norm.
        square: ``[n]``, their squared lengths.
        along: ``[n, m]``, their inner products with the vectors of the layer.
        mapped: ``[n, d]``, what the norm makes of them.
        read: ``[n, k]``, what the next linear layer reads of them.
    """

    centred: Tensor
    square: Tensor
    along: Tensor
    mapped: Tensor
    read: Tensor


def _follow(layers: Sequence[_Layer], vectors: Tensor) -> list[_Along]:
    followed = []
    for layer in layers:
        centred = vectors - vectors.mean(1, keepdim=True)
        vectors = centred * layer.norm.weight
        read = vectors.new_zeros(0) if layer.reader is None else vectors @ layer.reader.weight.T
        followed.append(_Along(centred, centred.square().sum(1), centred @ layer.centred.T, vectors, read))
    return followed


def _convolved(model: TactileTransformer, frames: Tensor) -> Tensor:
    """Return what the convolutions make of frames ``[n, D]``, ``[n, d]``."""
    frames = torch.where(model.present, frames, 0.0)
    out: Tensor = model.conv2(model.conv1(frames.reshape(-1, *model.layout.shape))).flatten(1)
    return out


def _attend(qkv: Tensor) -> Tensor:
    """Map queries, keys and values ``[P, T, 3 * 256]`` to what is attended to, ``[P, T, 256]``."""
    q, k, v = qkv.view(*qkv.shape[:2], 3, HEADS, HEAD_DIM).permute(2, 0, 3, 1, 4)
    return F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)


def _half_gram(vectors: Tensor) -> Tensor:
    """Return half the inner products G of ``vectors [m, d]``, but those of the first with the second part whole."""
    gram, half = vectors @ vectors.T, len(vectors) // 2
    gram[:half, :half] /= 2
    gram[half:, half:] /= 2
    return gram


def _half_product(y: Tensor, gram: Tensor) -> Tensor:
    """Return z of ``y [P, T, m]`` such that z y = y G y / 2, G being symmetric: a quarter less work than y G."""
    half = len(gram) // 2
    out = y.new_empty(y.shape)
    _times(y[..., :half], gram[:half, :half], out[..., :half])
    _times(y, gram[:, half:], out[..., half:])
    return out


def _times(y: Tensor, matrix: Tensor, out: Tensor) -> None:
    """Write ``y [P, T, m]`` times ``matrix [m, k]`` to ``out [P, T, k]``; both may be parts of a wider buffer."""
    a, b = (part.as_strided((part.shape[0] * part.shape[1], part.shape[2]), (part.stride(1), 1)) for part in (y, out))
    torch.mm(a, matrix, out=b)
