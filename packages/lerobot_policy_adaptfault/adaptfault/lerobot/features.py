"""The features of an observation that hold touch, as frames of one array and back. Needs torch, and
no LeRobot."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from adaptfault.data.recordings.facts.labels import natural_key
from adaptfault.data.recordings.formats.datasets.features import VALID, is_touch
from diagnostics import SensorLayout


def touch_of(features: Iterable[str]) -> tuple[str, ...]:
    """Return the names of features that hold touch, in the order in which data sets of them are
    read: natural order, so that ``finger2`` is before ``finger10``."""
    return tuple(sorted(filter(is_touch, features), key=natural_key))


def widths(layout: SensorLayout) -> tuple[int, ...]:
    """Return how many readings a frame may have: one for each position of the array, or for each
    that has a cell."""
    return tuple(dict.fromkeys((layout.n_cells, int(layout.present.sum()))))


@dataclass(frozen=True)
class Touch:
    """Frames of an array that lie in several features of an observation, one after the other.

    Attributes:
        layout: the array.
        tensors: the features, ``[..., *sizes]`` each; what stands before their sizes counts frames:
            nothing, a batch, or steps of time.
        n_frames: frames in them.
    """

    layout: SensorLayout
    tensors: Mapping[str, Tensor]
    n_frames: int

    @classmethod
    def of(
        cls, observation: Mapping[str, Any], names: Sequence[str], layout: SensorLayout
    ) -> Touch:
        """Return the frames of these features.

        Raises:
            ValueError: a feature is missing or no tensor, or they hold no whole frames of the
                array.
        """
        missing = [name for name in names if name not in observation]
        if missing or not names:
            what = ", ".join(missing) or "tactile feature"
            raise ValueError(
                f"the observation has no {what}; it has {', '.join(observation) or 'nothing'}: name"
                " those of the sensor in features="
            )
        tensors = {name: observation[name] for name in names}
        for name, tensor in tensors.items():
            if not isinstance(tensor, Tensor):
                raise ValueError(
                    f"{name} is a {type(tensor).__name__}, expected a torch tensor: put the step"
                    " behind what makes tensors of the observation"
                )
        n_frames = _n_frames([one.shape for one in tensors.values()], layout)
        if n_frames is None:
            sizes = ", ".join(f"{name} {list(one.shape)}" for name, one in tensors.items())
            raise ValueError(
                f"{sizes}: expected frames of {layout.n_cells} cells, those of {layout}, which the"
                " bundle is for; give the bundle of this sensor"
            )
        return cls(layout, tensors, n_frames)

    def readings(self) -> NDArray[np.float64]:
        """Return the frames, ``[n_frames, D]``; a position without a cell holds 0."""
        return self._frames(self.tensors, 0.0)

    def given_valid(self, observation: Mapping[str, Any]) -> NDArray[np.bool_]:
        """Return which readings the observation itself says are valid, bool ``[n_frames, D]``: all
        where it has no masks.

        Raises:
            ValueError: a mask of another size than its feature.
        """
        masks = {}
        for name, tensor in self.tensors.items():
            mask = observation.get(name + VALID)
            if mask is None:
                masks[name] = torch.ones(tensor.shape)
                continue
            mask = torch.as_tensor(mask)
            if mask.shape != tensor.shape:
                raise ValueError(
                    f"{name}{VALID} is {list(mask.shape)}, and {name} {list(tensor.shape)}:"
                    " expected a mask with one value a reading"
                )
            masks[name] = mask
        valid: NDArray[np.bool_] = self._frames(masks, 1.0) != 0
        return valid

    def parts(self, values: NDArray[Any]) -> dict[str, Tensor]:
        """Return values ``[n_frames, D]`` as the features lie, on their devices."""
        places = self._places()
        flat = values if places is None else values[:, places]
        found = {}
        before = 0
        for name, tensor in self.tensors.items():
            size = tensor.numel() // self.n_frames
            part = np.ascontiguousarray(flat[:, before : before + size])
            found[name] = torch.from_numpy(part).reshape(tensor.shape).to(tensor.device)
            before += size
        return found

    def _frames(self, tensors: Mapping[str, Tensor], nowhere: float) -> NDArray[np.float64]:
        rows = [
            one.detach().to("cpu", torch.float64).reshape(self.n_frames, -1)
            for one in tensors.values()
        ]
        joined: NDArray[np.float64] = torch.cat(rows, dim=1).numpy()
        places = self._places()
        if places is None:
            return joined
        frames = np.full((self.n_frames, self.layout.n_cells), nowhere)
        frames[:, places] = joined
        return frames

    def _places(self) -> NDArray[np.intp] | None:
        """Return where in a frame each reading belongs; None: one after the other."""
        width = sum(one.numel() for one in self.tensors.values()) // self.n_frames
        if width == self.layout.n_cells:
            return None
        return np.flatnonzero(self.layout.present)


def replaced(tensor: Tensor, values: Tensor, where: Tensor) -> Tensor:
    """Return a tensor with values at some places, in its own type; all others stay bit for bit."""
    if not tensor.dtype.is_floating_point:
        values = values.round()
    return torch.where(where, values.to(tensor.dtype), tensor)


def _n_frames(shapes: Sequence[Sequence[int]], layout: SensorLayout) -> int | None:
    """Return how many frames features of these shapes hold; None: they hold no whole ones."""
    readings = sum(map(math.prod, shapes))
    for width in widths(layout):
        n_frames, rest = divmod(readings, width)
        if n_frames and not rest and all(_counts(shape, n_frames) for shape in shapes):
            return n_frames
    return None


def _counts(shape: Sequence[int], n_frames: int) -> bool:
    """Return whether the first sizes of a shape count so many frames."""
    return n_frames in [math.prod(shape[:ends]) for ends in range(len(shape) + 1)]
