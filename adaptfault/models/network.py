"""The paper's network (Section III-A): convolutions over each frame, a transformer over time, for
any tactile array."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from diagnostics import SensorLayout
from diagnostics.preprocessing.array_likes import plain_array

FILTERS = (16, 32)  # of the two 3 x 3 convolutions
BLOCKS = 2
# 256 wide inside the attention, whatever d is
HEADS = 4
HEAD_DIM = 64
HIDDEN = 128  # of the feed-forward blocks and of the head
# Keras's default; frames with hardly any contact are not amplified to unit variance
NORM_EPS = 1e-3

Batch = Tensor | NDArray[Any]


class Dropout(nn.Module):
    """Drop a share ``p`` of the values while training and scale up the rest.

    Equivalent to ``torch.nn.Dropout``. One 64-bit draw decides four values, because torch's
    generator takes a sixth of a training step on a CPU.
    """

    def __init__(self, p: float) -> None:
        super().__init__()
        if not 0 <= p < 1:
            raise ValueError(f"dropout must lie in [0, 1), got {p}")
        self.cut = round(p * 2**16)  # draws below this, of 2^16 possible ones, drop the value

    def forward(self, x: Tensor) -> Tensor:
        """Map a tensor to one of the same shape; in eval mode to itself."""
        if not (self.training and self.cut):
            return x
        draws = torch.empty((x.numel() + 3) // 4, dtype=torch.int64, device=x.device).random_(
            -(2**63), None
        )
        kept = draws.view(torch.int16)[: x.numel()].view(x.shape) >= self.cut - 2**15
        return x * (kept * (2**16 / (2**16 - self.cut)))


class EncoderBlock(nn.Module):
    """Post-norm transformer block of width d: attention, then d -> 128 -> d, a residual and
    LayerNorm after each."""

    def __init__(self, d: int, dropout: float) -> None:
        super().__init__()
        self.qkv = nn.Linear(d, 3 * HEADS * HEAD_DIM)
        self.out = nn.Linear(HEADS * HEAD_DIM, d)  # W^O
        self.norm1 = nn.LayerNorm(d, eps=NORM_EPS)
        # The paper prints Dense_128(ReLU(Dense_d(x))), whose 128 values could not be added to the d
        # of the residual.
        self.up = nn.Linear(d, HIDDEN)
        self.down = nn.Linear(HIDDEN, d)
        self.norm2 = nn.LayerNorm(d, eps=NORM_EPS)
        self.dropout = Dropout(dropout)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``[N, T, d]`` to ``[N, T, d]``."""
        x = self.norm1(x + self.dropout(self.out(attend(self.qkv(x)))))
        fed: Tensor = self.norm2(x + self.dropout(self.down(F.relu(self.up(x)))))
        return fed


def attend(qkv: Tensor) -> Tensor:
    """Map queries, keys and values ``[N, T, 768]`` to the attended values of each frame,
    ``[N, T, 256]``."""
    # each (N, heads, T, 64)
    q, k, v = torch.unflatten(qkv, -1, (3, HEADS, HEAD_DIM)).permute(2, 0, 3, 1, 4)
    attended = F.scaled_dot_product_attention(q, k, v)  # (N, heads, T, 64)
    return attended.transpose(1, 2).flatten(2)


class WindowModel(nn.Module):
    """A module from windows ``[N, T, D]`` on the 0..1 scale to outputs ``[N, n]``."""

    def predict(self, x: Batch) -> NDArray[np.int64]:
        """Return the class of each window ``[N, T, D]``, int64 ``[N]``."""
        classes: NDArray[np.int64] = logits_of(self, x).argmax(1).numpy()
        return classes

    def predict_proba(self, x: Batch) -> NDArray[np.float32]:
        """Return the probability of each class for windows ``[N, T, D]``, float32
        ``[N, n]``."""
        probabilities: NDArray[np.float32] = logits_of(self, x).softmax(1).numpy()
        return probabilities


class TactileTransformer(WindowModel):
    """Classifier of tactile windows, Section III-A, for any layout.

    The pads are the channels of the convolutions, which see each frame alone; attention runs over
    the frames. There is no positional encoding: the paper has none, so the order of the frames does
    not matter. The paper's formulas write out every ReLU and put none after the convolutions, nor
    does Keras, so they are linear here. Their padding is not stated: "same" also suits pads of
    fewer than 5 rows. The dropout of 0.1 is stated for the head only; the blocks use the same. The
    initial weights are not stated either. The initialisation of Keras ("glorot") has larger weights
    and trains several times faster; on real grasps it reached 0.05 to 0.1 less accuracy (one seed)
    than the default, torch.

    The paper does not say how readings are scaled beyond 0..1. Where they use a small part of that
    range, or rest above 0, the network learns next to nothing in its first thousand steps. So
    :func:`~adaptfault.train` first calls :meth:`standardise`, which takes the mean of each cell off
    and divides by the standard deviation of all (fingertips, 280 steps: accuracy .68 without, .99
    with; finger on fabric, 732 steps: .70 and .96).

    Positions that the layout lacks cannot influence the output, whatever they hold, NaN included.

    Args:
        layout: the array; its D columns are the network's input.
        n_classes: number of outputs.
        length: T, frames in a window.
        padding: "same" or "valid" (no padding, needs 5 x 5 cells).
        init: "torch" (uniform, by the number of inputs) or "glorot" (uniform, by inputs and
            outputs).
        dropout: share of values dropped while training.
        inputs: "standardised" by the windows of the first training, or "readings" as they are.
        seed: of the initial weights; the global generator is left alone.

    Attributes:
        head: the last linear layer, 128 -> n_classes; :meth:`features` is its input.

    Raises:
        ValueError: a size below 1, an unknown padding, init or inputs, a pad too small for "valid".
    """

    present: Tensor
    mean: Tensor
    unit: Tensor

    def __init__(
        self,
        layout: SensorLayout,
        n_classes: int,
        *,
        length: int = 10,
        padding: Literal["same", "valid"] = "same",
        init: Literal["torch", "glorot"] = "torch",
        dropout: float = 0.1,
        inputs: Literal["standardised", "readings"] = "standardised",
        seed: int = 0,
    ) -> None:
        super().__init__()
        if n_classes < 1 or length < 1:
            raise ValueError(
                f"the network needs n_classes >= 1 and length >= 1, got {n_classes} and {length}"
            )
        if padding not in ("same", "valid"):
            raise ValueError(f"unknown padding {padding!r}: use 'same' or 'valid'")
        if init not in ("torch", "glorot"):
            raise ValueError(f"unknown init {init!r}: use 'torch' or 'glorot'")
        if inputs not in ("standardised", "readings"):
            raise ValueError(f"unknown inputs {inputs!r}: use 'standardised' or 'readings'")
        # each unpadded 3 x 3 takes one cell from every edge
        lost = 0 if padding == "same" else 2 * len(FILTERS)
        if min(layout.shape[1:]) <= lost:
            raise ValueError(
                f"padding 'valid' needs pads of 5 x 5, these have {layout.rows} x"
                f" {layout.shape[2]}: use 'same'"
            )
        self.layout = layout
        self.n_classes = n_classes
        self.length = length
        self.padding = padding
        self.init = init
        self.p_dropout = dropout
        self.inputs = inputs
        self.seed = seed
        self.register_buffer("mean", torch.zeros(layout.n_cells))
        self.register_buffer("unit", torch.tensor(0.0 if inputs == "standardised" else 1.0))
        self.register_buffer("present", torch.from_numpy(layout.is_cell.copy()), persistent=False)
        d = FILTERS[-1] * (layout.rows - lost) * (layout.shape[2] - lost)
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)
            self.conv1 = nn.Conv2d(layout.pads, FILTERS[0], 3, padding=padding)
            self.conv2 = nn.Conv2d(FILTERS[0], FILTERS[1], 3, padding=padding)
            self.blocks = nn.ModuleList(EncoderBlock(d, dropout) for _ in range(BLOCKS))
            self.dense = nn.Linear(d, HIDDEN)
            self.dropout = Dropout(dropout)
            self.head = nn.Linear(HIDDEN, n_classes)
            if init == "glorot":
                self.apply(_glorot)

    def standardise(self, x: Batch) -> None:
        """Set the mean of each cell, and the unit of all, to those of windows ``[N, T, D]``.

        It has an effect once, and none where ``inputs`` is "readings".
        """
        if self.unit > 0:
            return
        readings = np.asarray(x, dtype=np.float64)
        mean = np.where(self.layout.is_cell, readings.mean(axis=(0, 1)), 0.0)
        spread = (readings - mean)[..., self.layout.is_cell].std()
        self.mean.copy_(torch.from_numpy(mean))
        self.unit.fill_(float(spread) or 1.0)

    def standardised(self, x: Tensor) -> Tensor:
        """Map readings ``[..., D]`` to what the convolutions see; 0 where the layout lacks a
        cell."""
        if self.inputs == "standardised":
            # before any training the readings are left as they are
            x = (x - self.mean) / torch.where(self.unit > 0, self.unit, 1.0)
        if not self.layout.present.all():
            x = torch.where(self.present, x, 0.0)  # not a product: NaN * 0 is NaN
        return x

    def features(self, x: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` to features ``[N, 128]``, the input of the head."""
        n_cells = self.layout.n_cells
        if x.dim() != 3 or x.shape[1] != self.length or x.shape[2] != n_cells:
            raise ValueError(f"expected windows [N, {self.length}, {n_cells}], got {list(x.shape)}")
        x = self.standardised(x)
        x = x.reshape(-1, *self.layout.shape)  # (N * T, pads, rows, cols)
        x = self.conv1(x)  # (N * T, 16, rows, cols)
        x = self.conv2(x)  # (N * T, 32, rows, cols)
        x = x.flatten(1)  # (N * T, d)
        x = x.reshape(-1, self.length, x.shape[1])  # (N, T, d)
        for block in self.blocks:
            x = block(x)  # (N, T, d)
        x = x.mean(1)  # (N, d)
        return F.relu(self.dense(x))  # (N, 128)

    def forward(self, x: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` on the 0..1 scale to logits ``[N, n_classes]``.

        Raises:
            ValueError: windows of another shape.
        """
        logits: Tensor = self.head(self.dropout(self.features(x)))
        return logits

    @property
    def config(self) -> dict[str, Any]:
        """Arguments of :meth:`from_config` that rebuild this network without its weights;
        JSON-safe."""
        return {
            "layout": self.layout.to_dict(),
            "n_classes": self.n_classes,
            "length": self.length,
            "padding": self.padding,
            "init": self.init,
            "dropout": self.p_dropout,
            "inputs": self.inputs,
            "seed": self.seed,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> TactileTransformer:
        """Build an untrained network from a :attr:`config`."""
        rest = {name: value for name, value in config.items() if name != "layout"}
        return cls(SensorLayout.from_dict(config["layout"]), **rest)


def as_tensor(array: NDArray[Any]) -> Tensor:
    """View an array as a tensor; copy it if it is read-only or not contiguous."""
    return torch.from_numpy(np.require(array, requirements=("C", "W")))


def logits_of(
    model: nn.Module,
    x: Batch,
    extra: Mapping[str, Batch] = MappingProxyType({}),
    *,
    batch_size: int = 256,
) -> Tensor:
    """Return the logits ``[N, n]`` of any module for ``x [N, ...]``, and what else it takes by
    name: in eval mode, in batches, without gradients.

    The result is on the CPU. Each module of ``model`` returns to its earlier mode.
    """
    windows = x if isinstance(x, Tensor) else as_tensor(plain_array(x).astype(np.float32))
    device = next((p.device for p in model.parameters()), windows.device)
    outputs = []
    with evaluating(model):
        for part, others in batches(windows, extra, batch_size):
            placed = {name: values.to(device) for name, values in others.items()}
            outputs.append(model(part.to(device, torch.float32), **placed).cpu())
    return torch.cat(outputs)


def batches(
    x: Tensor, extra: Mapping[str, Batch], size: int
) -> Iterator[tuple[Tensor, dict[str, Tensor]]]:
    """Yield windows and what else a model sees, ``size`` at a time; once where there are none."""
    named = tensors_of(extra)
    for first in range(0, max(len(x), 1), size):
        part = slice(first, first + size)
        yield x[part], {name: values[part] for name, values in named.items()}


def tensors_of(extra: Mapping[str, Batch]) -> dict[str, Tensor]:
    """Return what a model sees beside touch as tensors; numbers that are not whole as float32."""
    found: dict[str, Tensor] = {}
    for name, values in extra.items():
        of = values if isinstance(values, Tensor) else as_tensor(plain_array(values))
        found[name] = of.float() if of.is_floating_point() else of
    return found


@contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """Put a module into eval mode, without gradients; each of its modules returns to its earlier
    mode."""
    modes = [(module, module.training) for module in model.modules()]
    model.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        for module, mode in modes:
            module.training = mode


@torch.no_grad()
def _glorot(module: nn.Module) -> None:
    """Draw a layer's weights as Keras does (Glorot and Bengio 2010), its biases 0."""
    if isinstance(module, nn.Linear | nn.Conv2d):
        nn.init.xavier_uniform_(module.weight)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(
        module, EncoderBlock
    ):  # after its layers: queries, keys and values each have their own fan-out
        for weight in torch.split(module.qkv.weight, HEADS * HEAD_DIM):
            nn.init.xavier_uniform_(weight)
