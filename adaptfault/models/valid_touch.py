"""A data set of torch in which no invalid reading of touch is left: masked, or restored.

It wraps one that a training has already, as LeRobot's, item by item: nothing is stored twice, and
sampler, batches and all other features stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from adaptfault.data.recordings.formats.datasets.features import VALID
from adaptfault.imputation.restorer import Restorer

__all__ = ["ValidTouch"]


class ValidTouch(Dataset[dict[str, Any]]):
    """The items of a data set without their invalid readings.

    An item is a mapping of features to tensors. ``<feature>.valid``, as ``adaptfault check
    --write-copy`` writes it, says which readings of ``<feature>`` are valid; a mask of one frame
    holds for all frames of a window.

    Args:
        dataset: with ``__len__`` and ``__getitem__``; its other attributes stay at hand.
        how: ``"mask"`` puts ``neutral`` in place of invalid readings, ``"restore"`` what the valid
            readings of the same frame say of them.
        neutral: what stands for no reading, in the unit of the features: one value, or one for each
            feature.
        restorer: for ``"restore"``: fitted to healthy recordings. Its cells are those of the
            features, one after the other as in an item.

    Raises:
        ValueError: ``"restore"`` without a restorer.
    """

    def __init__(
        self,
        dataset: Any,
        how: Literal["mask", "restore"] = "mask",
        *,
        neutral: float | Mapping[str, float] = 0.0,
        restorer: Restorer | None = None,
    ) -> None:
        if how not in ("mask", "restore"):
            raise ValueError(f"how={how!r}: expected 'mask' or 'restore'")
        if how == "restore" and restorer is None:
            raise ValueError(
                "how='restore' needs restorer=Restorer(layout).fit(healthy): nothing else says what"
                " healthy cells read"
            )
        self.dataset = dataset
        self.how = how
        self.neutral = neutral
        self.restorer = restorer

    def __len__(self) -> int:
        return len(self.dataset)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "dataset":  # asked for before it is there
            raise AttributeError(name)
        return getattr(self.dataset, name)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Return an item.

        Raises:
            ValueError: no feature of it has a mask, or the restorer has other cells.
        """
        item = dict(self.dataset[index])
        features = [name for name in item if f"{name}{VALID}" in item]
        if not features:
            raise ValueError(
                f"item {index} has no feature with a mask, <feature>{VALID}: adaptfault check"
                " --write-copy writes them"
            )
        readings = [torch.as_tensor(item[name]) for name in features]
        valid = [
            torch.as_tensor(item[f"{name}{VALID}"]).expand(one.shape)
            for name, one in zip(features, readings, strict=True)
        ]
        if self.restorer is None or self.how == "mask":
            new = [
                torch.where(mask, one, self._neutral(name))
                for name, one, mask in zip(features, readings, valid, strict=True)
            ]
        else:
            new = _restored(self.restorer, features, readings, valid)
        return {**item, **dict(zip(features, new, strict=True))}

    def _neutral(self, feature: str) -> float:
        return self.neutral[feature] if isinstance(self.neutral, Mapping) else self.neutral


def _restored(
    restorer: Restorer,
    features: Sequence[str],
    readings: Sequence[Tensor],
    valid: Sequence[Tensor],
) -> list[Tensor]:
    """Return the readings of features, ``[...]`` or ``[T, ...]`` each, with the invalid ones
    restored."""
    total = sum(one.numel() for one in readings)
    frames, rest = divmod(total, restorer.layout.n_cells)
    if rest or not frames:
        raise ValueError(
            f"{', '.join(features)} hold {total} readings, and the restorer knows"
            f" {restorer.layout.n_cells} cells; fit one to recordings of these features"
        )
    x = torch.cat([one.reshape(frames, -1) for one in readings], dim=1).double().numpy()
    known = torch.cat([one.reshape(frames, -1) for one in valid], dim=1).numpy()
    restored = torch.from_numpy(restorer.transform(np.where(known, x, np.nan)))
    sizes = [one.numel() // frames for one in readings]
    parts = torch.split(restored, sizes, dim=1)
    return [
        part.reshape(one.shape).to(one.dtype) for part, one in zip(parts, readings, strict=True)
    ]
