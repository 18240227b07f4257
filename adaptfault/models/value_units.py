"""Units in which a regression trains: values less their mean, in standard deviations.

A network whose values are 0.001 or 4000 learns nothing at the learning rates of one whose values
are near 1. It is trained on standardised values, and its last layer then takes up mean and standard
deviation, so that the stored network returns values in their own unit.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.data.windows import Windows
from adaptfault.models.any_model import AnyModel
from adaptfault.models.network import Batch, TactileTransformer, logits_of

_PROBES = 3  # windows of the test run


@dataclass(frozen=True, eq=False)
class ValueUnits:
    """Mean and standard deviation of the values that a regression learns.

    Attributes:
        mean, deviation: float64 ``[k]``; a deviation of 0 is 1.
    """

    mean: NDArray[np.float64]
    deviation: NDArray[np.float64]

    @classmethod
    def of(cls, windows: Windows) -> ValueUnits:
        """Return the units of training windows.

        Raises:
            ValueError: the windows have classes.
        """
        if windows.y.ndim != 2:
            raise ValueError("units need values y [N, k], got classes y [N]: a class has no unit")
        y = windows.y.astype(np.float64)
        varies = y.min(axis=0) < y.max(axis=0)
        return cls(y.mean(axis=0), np.where(varies, y.std(axis=0), 1.0))

    def standardised(self, windows: Windows) -> Windows:
        """Return windows with standardised values."""
        y = (windows.y.astype(np.float64) - self.mean) / self.deviation
        return replace(windows, y=y.astype(np.float32))

    def to_dict(self, names: Sequence[str]) -> dict[str, dict[str, float]]:
        """Return mean and standard deviation of each value by name, a JSON-safe dict."""
        units = zip(names, self.mean.tolist(), self.deviation.tolist(), strict=True)
        return {name: {"mean": mean, "deviation": deviation} for name, mean, deviation in units}

    @torch.no_grad()
    def fold(self, model: TactileTransformer | AnyModel) -> None:
        """Let the last layer of a model of standardised values return them in their own unit.

        Raises:
            ValueError: the model does not end with a linear layer with a bias.
        """
        head = _last_layer(model)
        mean, deviation = self._like(head.weight)
        head.weight.mul_(deviation[:, None])
        head.bias.mul_(deviation).add_(mean)

    @torch.no_grad()
    def unfold(self, model: TactileTransformer | AnyModel) -> None:
        """Undo :meth:`fold`, up to rounding; raises its error."""
        head = _last_layer(model)
        mean, deviation = self._like(head.weight)
        head.weight.div_(deviation[:, None])
        head.bias.sub_(mean).div_(deviation)

    def _like(self, weight: Tensor) -> tuple[Tensor, Tensor]:
        return torch.from_numpy(self.mean).to(weight), torch.from_numpy(self.deviation).to(weight)


@torch.no_grad()
def foldable(
    model: TactileTransformer | AnyModel, extra: Mapping[str, Batch] = MappingProxyType({})
) -> bool:
    """Return whether the outputs of a model are those of a last linear layer with a bias.

    ``extra`` is what else it sees of some windows, ``[N, ...]`` each.
    """
    head = model.head
    if head is None or head.bias is None:
        return False
    rng = np.random.default_rng(0)
    probes = min([_PROBES, *map(len, extra.values())])
    shape = (probes, model.length, model.layout.n_cells)
    x = rng.random(shape).astype(np.float32)
    few = {name: values[:probes] for name, values in extra.items()}
    changed = copy.deepcopy(model)
    before = logits_of(changed, x, few)
    assert changed.head is not None
    changed.head.weight.mul_(2.0)
    changed.head.bias.mul_(2.0).add_(1.0)
    return bool(torch.allclose(logits_of(changed, x, few), 2 * before + 1, rtol=1e-4, atol=1e-4))


def _last_layer(model: TactileTransformer | AnyModel) -> nn.Linear:
    head = model.head
    if head is None or head.bias is None:
        name = type(model.module if isinstance(model, AnyModel) else model).__name__
        raise ValueError(
            f"the values of {name} do not come from a last nn.Linear with a bias, so they cannot be"
            " given their unit: end the module with one"
        )
    return head
