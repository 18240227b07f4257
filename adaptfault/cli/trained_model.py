"""A trained model, from a folder of ``adaptfault train`` or from a bundle, and the recordings that
belong to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.cli.paths import is_bundle
from adaptfault.data.recordings import Recordings
from adaptfault.data.windows import Windows, make_windows, split
from adaptfault.models.store import SCHEMA, read_manifest

if TYPE_CHECKING:  # a command that opens a bundle alone needs no torch
    from adaptfault.adaptation.fault_free import Network
    from adaptfault.adaptation.result import Adaptation
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.bundle.versions import Version
    from adaptfault.cli.command import Command
    from adaptfault.cli.reading import Reading
    from adaptfault.cli.shared_options import Trusting
    from adaptfault.data.calibration import Calibration


@dataclass(frozen=True)
class TrainedModel:
    """A model and the facts that it was stored with.

    Attributes:
        network: the fault-free model, with its layout and window length.
        class_names: one name a class, or a value of a regression; or none.
        split_seed: of the split into training, validation and test recordings; None where it is not
            stored.
        adaptation: the version that a bundle runs; of a model, its form for the healthy sensor,
            with the head in closed form if it has one.
        calibration: the bundle's table from raw counts to the layout's unit.
        version: that a bundle runs; None of a model.
    """

    network: Network
    class_names: tuple[str, ...]
    split_seed: int | None
    adaptation: Adaptation
    calibration: Calibration | None = None
    version: Version | None = None

    @classmethod
    def open(cls, args: Trusting, folder: str) -> TrainedModel:
        """Read a model or a bundle.

        Args:
            args: whose signature a bundle needs.
            folder: of the model or the bundle.

        Raises:
            FileNotFoundError, ValueError: neither, damaged, or not signed by a trusted key.
        """
        from adaptfault.adaptation.result import Adaptation, load_healthy

        bundle = open_bundle(args, folder)
        if bundle is None:
            manifest = read_manifest(folder, SCHEMA)
            seed = int(manifest["extra"].get("split_seed", 0))
            healthy = load_healthy(folder)
            return cls(healthy.model.network, tuple(manifest["class_names"]), seed, healthy)
        version = bundle.active()
        active = Adaptation.load(version.files)
        return cls(
            active.model.network,
            bundle.class_names,
            None,
            active,
            bundle.parts.calibration,
            version,
        )

    @property
    def is_regression(self) -> bool:
        """Whether the model predicts values."""
        return self.adaptation.task == "regression"

    def recordings(self, args: Reading, paths: Sequence[str]) -> Recordings:
        """Read labelled recordings in the layout of the model; of a regression, with targets.

        Raises:
            ValueError: they contradict the layout, the classes or the values of the model; both are
                named.
        """
        table = args.targets
        if self.is_regression and table is None:
            names = ", ".join(self.class_names)
            raise ValueError(f"the model is a regression of {names}: give --targets TABLE")
        if table is not None and not self.is_regression:
            raise ValueError(
                "--targets is for a regression, and this model names classes: give --labels TABLE"
            )
        if args.calibration is None and self.calibration is not None:
            args.calibration = self.calibration
        recordings = args.load(paths, labelled=True, layout=self.network.layout)
        if table is not None:
            return self._with_values(table, recordings)
        if self.class_names and recordings.class_names != self.class_names:
            recordings = self._in_order(recordings)
        return recordings

    def rewired(self, recordings: Recordings) -> Recordings:
        """Return recordings as the version that a bundle runs reads them on the robot; see
        ``Version.undo``."""
        if self.version is None:
            return recordings
        return replace(
            recordings,
            frames=tuple(self.version.undo(np.asarray(frames)) for frames in recordings.frames),
        )

    def _in_order(self, recordings: Recordings) -> Recordings:
        """Return the recordings with the classes of the model, in the order of the model."""
        unknown = sorted(set(recordings.class_names) - set(self.class_names))
        if unknown:
            classes = ", ".join(self.class_names)
            raise ValueError(
                f"the recordings have the class {unknown[0]!r}, the model has {classes}"
            )
        assert recordings.labels is not None
        index = np.array(
            [self.class_names.index(name) for name in recordings.class_names], dtype=np.int64
        )
        labels = index[recordings.labels]
        return Recordings(
            recordings.frames, recordings.layout, labels, self.class_names, recordings.names
        )

    def _with_values(self, table: str, recordings: Recordings) -> Recordings:
        """Return the recordings with the values of the model, in the order of the model."""
        names = recordings.value_names
        lacking = [name for name in self.class_names if name not in names]
        if lacking:
            raise ValueError(
                f"{table}: the columns are {', '.join(names)}, the model has"
                f" {', '.join(self.class_names)}; add {lacking[0]}"
            )
        assert recordings.targets is not None
        index = [names.index(name) for name in self.class_names]
        targets = tuple(of[..., index] for of in recordings.targets)
        return replace(recordings, targets=targets, value_names=self.class_names)

    def windows(
        self, recordings: Recordings, frames: Sequence[NDArray[Any]] | None = None
    ) -> Windows:
        """Cut recordings, or other ``frames`` of them, into the windows that the model takes."""
        return make_windows(
            recordings.frames if frames is None else frames,
            recordings.targets if self.is_regression else recordings.labels,
            recordings.layout,
            length=self.network.length,
        )

    def parts(self, recordings: Recordings) -> tuple[Windows, Windows, Windows]:
        """Return training, validation and test windows, the same as in training."""
        return split(self.windows(recordings), seed=self.split_seed or 0)


def say_short(args: Command, recordings: Recordings, length: int) -> None:
    """Say on stderr how many recordings are shorter than a window of ``length`` frames, if any
    is."""
    if short := sum(len(frames) < length for frames in recordings.frames):
        many = "is" if short == 1 else "are"
        args.say(
            f"{short} of {len(recordings)} recordings {many} shorter than a window of {length}"
            " frames: not used"
        )


def open_bundle(args: Trusting, folder: str) -> Bundle | None:
    """Return the bundle in a folder; None if it holds something else.

    Args:
        args: whose signature it needs.
        folder: of the bundle, a model, or recordings.

    Raises:
        FileNotFoundError, ValueError: the bundle is damaged or not signed by a trusted key; or no
        bundle, with --trust.
    """
    if is_bundle(folder):
        return args.opened(folder)
    if args.trusted()["keys"]:
        raise ValueError(f"--trust: {folder} is no bundle, and only bundles are signed")
    return None
