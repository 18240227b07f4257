"""A version: one model for one fault set, in a folder written once and verified at every load.
Needs no torch."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.bundle.checksummed_json import (
    Damaged,
    Sealed,
    decoding,
    read_hashed,
    write_checksummed,
    write_files,
)
from adaptfault.data.atomic import sync, sync_tree
from adaptfault.models.store import Place
from diagnostics import FaultSet, SensorLayout
from diagnostics.sensor.recalibration import recalibrated

SCHEMA = "adaptfault.version/1"
ABOUT = "version.json"

_UNFINISHED = ".unfinished-"


class Untrusted(Damaged):
    """A bundle or a version that no trusted key signed."""


@dataclass(frozen=True)
class Version:
    """One model version of a robot.

    Attributes:
        number: 1 is the fault-free model.
        folder: with the weights, and ``model.onnx`` where the export worked.
        layout: the array.
        class_names: one name for each class.
        length: frames in a window.
        fault_set: F, the cells that it does not use.
        hashes: SHA-256 of each of its files, by name; None of a version that nobody recorded.
        digest: SHA-256 of its description, which states the hashes.
        about: origin of the version, JSON. ``source``, where given: a permutation that undoes a
            changed wiring. ``gain`` and ``offset``, where given: of each cell of a replaced pad.
    """

    number: int
    folder: Path
    layout: SensorLayout
    class_names: tuple[str, ...]
    length: int
    fault_set: FaultSet
    about: Mapping[str, Any] = field(default_factory=dict, repr=False)
    hashes: Mapping[str, str] | None = field(default=None, repr=False)
    digest: str = field(default="", repr=False)

    @property
    def files(self) -> Place:
        """Where its model is read from; each read compares a file with its recorded hash."""
        return self.folder if self.hashes is None else Sealed(self.folder, self.hashes)

    @cached_property
    def source(self) -> NDArray[np.intp]:
        """int ``[D]``: cell i of the array answers at index ``source[i]``; its own index unless the
        wiring changed."""
        every = np.arange(self.layout.n_cells)
        source = np.asarray(self.about.get("source", every), dtype=np.intp)
        if not np.array_equal(np.sort(source), every):
            raise Damaged(
                f"{self.folder / ABOUT}: source is no permutation of {self.layout.n_cells} cells"
            )
        return source

    @cached_property
    def gain(self) -> NDArray[np.float64]:
        """float ``[D]``; cell i reads ``gain[i]`` times what the model was trained on, plus
        ``offset[i]``."""
        gain = self._of_cells("gain", 1.0)
        if not (gain > 0).all():
            raise Damaged(f"{self.folder / ABOUT}: a gain is not positive")
        return gain

    @cached_property
    def offset(self) -> NDArray[np.float64]:
        """float ``[D]``, in the layout's unit; see ``gain``."""
        return self._of_cells("offset", 0.0)

    def _of_cells(self, name: str, otherwise: float) -> NDArray[np.float64]:
        values = np.asarray(
            self.about.get(name, np.full(self.layout.n_cells, otherwise)), dtype=np.float64
        )
        if values.shape != (self.layout.n_cells,) or not np.isfinite(values).all():
            raise Damaged(
                f"{self.folder / ABOUT}: {name} is not a number for each of {self.layout.n_cells}"
                " cells"
            )
        return values

    @property
    def readings(self) -> dict[str, list[Any]]:
        """How readings become those of the model: what ``about`` of a version with the same sensor
        holds."""
        return {name: getattr(self, name).tolist() for name in ("source", "gain", "offset")}

    @cached_property
    def set_size(self) -> float | None:
        """Mean number of classes in the sets of its validation windows that hold the true class
        with probability 0.9; None of a regression, or where it is not stored."""
        from adaptfault.models.store import ADAPTATION, read_manifest

        with decoding(self.folder):
            sets = read_manifest(self.files, ADAPTATION).get("sets") or {}
            size = sets.get("size")
            return None if size is None else float(size)

    def undo(self, frames: NDArray[Any], full_scale: float | None = None) -> NDArray[Any]:
        """Return frames ``[..., D]`` as the model reads them: wires put back, replaced pads
        recalibrated.

        Args:
            frames: in the layout's unit.
            full_scale: in which unit they are instead, as 1 for scaled windows.
        """
        frames = frames[..., self.source]
        if (self.gain == 1).all() and not self.offset.any():
            return frames
        top = self.layout.full_scale if full_scale is None else full_scale
        return recalibrated(frames, self.gain, self.offset * (top / self.layout.full_scale), top)

    def __str__(self) -> str:
        cells = self.layout.present.sum()
        faulty = len(self.fault_set)
        return f"version {self.number}, " + (
            f"without {faulty} of {cells} cells" if faulty else f"with all {cells} cells"
        )

    @classmethod
    def read(cls, folder: Path) -> Version:
        """Read a version and verify each of its files.

        Raises:
            FileNotFoundError: the folder holds no version.
            Damaged: a file fails its checksum, or cannot be read.
        """
        document, digest = read_hashed(folder / ABOUT, SCHEMA)
        with decoding(folder / ABOUT):
            version = cls._decode(folder, document, digest)
            Sealed(folder, document["files"]).check()
            return version

    @classmethod
    def _decode(cls, folder: Path, document: Mapping[str, Any], digest: str) -> Version:
        layout = SensorLayout.from_dict(document["layout"])
        return cls(
            number=int(document["number"]),
            folder=folder,
            layout=layout,
            class_names=tuple(document["class_names"]),
            length=int(document["length"]),
            fault_set=FaultSet(tuple(document["fault_set"]), layout.n_cells),
            about=dict(document["about"]),
            hashes={str(name): str(hashed) for name, hashed in document["files"].items()},
            digest=digest,
        )


class Versions:
    """The versions of a bundle, each in a folder named by its number.

    Attributes:
        folder: of all versions.
        signed: hash of the description of each version that a trusted key signed, or that was
            written here; None: every version may be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.signed: dict[int, str] | None = None

    def __getitem__(self, number: int) -> Version:
        """Read a version; raises FileNotFoundError, Damaged or Untrusted."""
        version = Version.read(self.path(number))
        if self.signed is not None and self.signed.get(number) != version.digest:
            raise Untrusted(f"version {number} is not signed")
        return version

    def path(self, number: int) -> Path:
        """Return the folder of a version."""
        return self.folder / f"{number:04d}"

    @property
    def numbers(self) -> list[int]:
        """Numbers of all versions on disk, ascending; versions may be damaged."""
        return sorted(
            int(p.name) for p in self.folder.glob("[0-9]*") if p.name.isdecimal() and p.is_dir()
        )

    def write(
        self,
        files: Mapping[str, bytes],
        *,
        layout: SensorLayout,
        class_names: tuple[str, ...],
        length: int,
        fault_set: FaultSet,
        about: Mapping[str, Any],
    ) -> Version:
        """Write a version into a temporary folder, sync it, then rename it.

        Args:
            files: of the model, by name.
            layout, class_names, length, fault_set, about: see :class:`Version`.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        self.sweep()
        number = (
            max((int(p.name) for p in self.folder.iterdir() if p.name.isdecimal()), default=0) + 1
        )
        new = self.folder / f"{_UNFINISHED}{number:04d}"
        new.mkdir()
        hashes = write_files(new, files)
        document = {
            "schema": SCHEMA,
            "number": number,
            "layout": layout.to_dict(),
            "class_names": list(class_names),
            "length": length,
            "fault_set": list(fault_set),
            "about": dict(about),
            "files": hashes,
        }
        digest = write_checksummed(new / ABOUT, document)
        sync_tree(new)
        os.replace(new, self.path(number))
        sync(self.folder)
        if self.signed is not None:
            self.signed[number] = digest
        return self[number]

    def sweep(self, keep: Collection[int] | None = None) -> None:
        """Remove unfinished versions of crashed runs and, if ``keep`` is given, all versions but
        these."""
        for unfinished in self.folder.glob(f"{_UNFINISHED}*"):
            shutil.rmtree(unfinished) if unfinished.is_dir() else unfinished.unlink()
        if keep is not None:
            # Renamed first, so that a power cut during the removal leaves no version with missing
            # files.
            removed = [
                self.folder / f"{_UNFINISHED}{number:04d}"
                for number in sorted(set(self.numbers) - set(keep))
            ]
            for unfinished in removed:
                os.replace(self.folder / unfinished.name.removeprefix(_UNFINISHED), unfinished)
            if removed:
                sync(self.folder)
            for unfinished in removed:
                shutil.rmtree(unfinished)
