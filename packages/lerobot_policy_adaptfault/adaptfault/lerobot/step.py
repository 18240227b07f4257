"""The step of LeRobot's pipelines."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from lerobot.configs.types import PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from torch import Tensor

from adaptfault.acquisition.followed import BundleAt
from adaptfault.data.recordings.formats.datasets.features import VALID
from adaptfault.lerobot.features import Touch, replaced, touch_of, widths
from adaptfault.lerobot.limits import Limits
from adaptfault.lerobot.live import LiveTouch
from diagnostics import FaultSet

NAME = "adaptfault_touch"
"""In the registry, and in the files of a pipeline."""

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


@ProcessorStepRegistry.register(NAME)
class TouchProcessorStep(ObservationProcessorStep):  # type: ignore[misc]
    """Gives a policy readings of touch without those of dead cells, and a mask of the valid ones.

    Each feature of touch keeps its shape, type and device, and ``<feature>.valid``, bool of the
    same shape, joins it. F is what the bundle knows, and what a monitor of the running sensor finds
    besides; a new version that ``maintain`` deploys takes over between two frames. Valid readings
    stay bit for bit as they came.

    The step belongs before all that scales readings: it takes them as the sensor sends them.
    The state that is saved with a policy is F and the version that it was found under; beside a
    newer version of the bundle the bundle alone counts.

    It does not repair the policy: what the valid cells do not say of the invalid ones is lost.

    Args:
        bundle: folder of the bundle of this sensor; its cells are those of the features, one after
            the other.
        features: names of the features, one behind the other as in the array; None: all that have
            touch in their names, in natural order, as data sets are read.
        fill: "restore" puts what the valid readings of the frame say in place of invalid ones,
            "mask" puts ``neutral``, for policies that were trained so.
        neutral: a reading, in the unit of the features.
        watch: monitor frames that come alone; False on a computer that only trains.
        keys: PEM files of public keys, one of which must have signed the bundle; None: signatures
            are not checked.
        shape: ``[pads, rows, cols]`` of the array that the policy was saved with; None: any.
        most_false_alarms, min_recall, largest_error: of
            :class:`~adaptfault.lerobot.limits.Limits`; beyond one of them the step raises
            :class:`~adaptfault.lerobot.limits.NotCertified`, and no action follows.

    Raises:
        ValueError: the bundle is damaged, not signed, or of another array; an unknown ``fill``.
        OSError: the bundle cannot be read.
    """

    def __init__(
        self,
        bundle: str | os.PathLike[str],
        features: Sequence[str] | None = None,
        *,
        fill: Literal["restore", "mask"] = "restore",
        neutral: float = 0.0,
        watch: bool = True,
        keys: Sequence[str | os.PathLike[str]] | None = None,
        shape: Sequence[int] | None = None,
        most_false_alarms: float | None = None,
        min_recall: float | None = None,
        largest_error: float | None = None,
    ) -> None:
        if fill not in ("restore", "mask"):
            raise ValueError(f"fill={fill!r}: expected 'restore' or 'mask'")
        self.bundle = os.fspath(bundle)
        self.features = None if features is None else tuple(features)
        self.fill = fill
        self.neutral = neutral
        self.watch = watch
        self.keys = None if keys is None else [os.fspath(key) for key in keys]
        self.limits = Limits(most_false_alarms, min_recall, largest_error)
        self.live = LiveTouch(BundleAt(self.bundle, self.keys), watch=watch, limits=self.limits)
        found = self.live.layout.shape
        if shape is not None and tuple(shape) != found:
            raise ValueError(
                f"{self.bundle} is for an array of {_by(found)}, and the policy was saved with one"
                f" of {_by(shape)}: give the bundle of this sensor"
            )

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return an observation with whole frames and their masks.

        Raises:
            ValueError: it has no touch, or frames or masks of another size.
            NotCertified: a limit does not hold.
        """
        names = touch_of(observation) if self.features is None else self.features
        touch = Touch.of(observation, names, self.live.layout)
        given = touch.given_valid(observation)
        whole, valid, other = self.live(touch.readings(), given)
        if self.fill == "mask":
            whole = np.where(valid, whole, self.neutral)
            other = other | ~valid
        values = touch.parts(whole)
        changed = touch.parts(other)
        masks = touch.parts(valid)
        for name, tensor in touch.tensors.items():
            observation[name] = replaced(tensor, values[name], changed[name])
            observation[name + VALID] = masks[name]
        return observation

    def transform_features(self, features: Features) -> Features:
        """Return the declared features with a mask beside each of touch.

        Raises:
            ValueError: none of them is touch, or they have another number of cells than the array.
        """
        declared = features.get(PipelineFeatureType.OBSERVATION, {})
        names = touch_of(declared) if self.features is None else self.features
        missing = [name for name in names if name not in declared]
        if missing or not names:
            raise ValueError(
                f"the policy declares no {', '.join(missing) or 'tactile feature'}; it declares"
                f" {', '.join(declared) or 'nothing'}: name those of the sensor in features="
            )
        cells = sum(int(np.prod(declared[name].shape)) for name in names)
        if cells not in widths(self.live.layout):
            raise ValueError(
                f"{', '.join(names)} declare {cells} cells, and {self.bundle} is for"
                f" {self.live.layout}: give the bundle of this sensor"
            )
        masks = {
            name + VALID: PolicyFeature(type=declared[name].type, shape=declared[name].shape)
            for name in names
        }
        return {**features, PipelineFeatureType.OBSERVATION: {**declared, **masks}}

    def get_config(self) -> dict[str, Any]:
        """Return the arguments of a step like this one, as JSON holds them."""
        return {
            "bundle": self.bundle,
            "features": None if self.features is None else list(self.features),
            "fill": self.fill,
            "neutral": self.neutral,
            "watch": self.watch,
            "keys": self.keys,
            "shape": list(self.live.layout.shape),
            "most_false_alarms": self.limits.most_false_alarms,
            "min_recall": self.limits.min_recall,
            "largest_error": self.limits.largest_error,
        }

    def state_dict(self) -> dict[str, Tensor]:
        """Return F, bool ``[D]``, and the number of the version that it was found under."""
        return {
            "fault_set": torch.from_numpy(self.live.fault_set.mask.copy()),
            "version": torch.tensor([self.live.version]),
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take in the F of a saved policy, unless the bundle has been maintained since.

        Raises:
            ValueError: F of another number of cells.
        """
        saved = state["fault_set"].numpy().astype(bool)
        n_cells = self.live.layout.n_cells
        if saved.shape != (n_cells,):
            raise ValueError(
                f"the saved F is of {saved.size} cells, and {self.bundle} of {n_cells}: give the"
                " bundle of this sensor"
            )
        if self.live.version <= int(state["version"]):
            self.live.remember(FaultSet.of(np.flatnonzero(saved), n_cells))


def _by(shape: Sequence[int]) -> str:
    return " x ".join(map(str, shape))
