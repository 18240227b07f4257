"""The bundle: the folder with everything that one robot needs. Opening it and predicting need no
torch."""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from adaptfault.bundle.checksummed_json import (
    Damaged,
    Sealed,
    damage,
    decoding,
    read_with_copy,
    reading,
    write_files,
    write_with_copy,
)
from adaptfault.bundle.journal import Entry, now
from adaptfault.bundle.known_faults import KnownFaults
from adaptfault.bundle.lock import locked
from adaptfault.bundle.parts import Parts, check_parts, split_validation
from adaptfault.bundle.pointer import SCHEMA as POINTER_SCHEMA
from adaptfault.bundle.pointer import Pointer
from adaptfault.bundle.running import Running
from adaptfault.bundle.signature import sign_versions, verify
from adaptfault.bundle.versions import Version
from adaptfault.data.atomic import make_folder, sync, sync_tree
from adaptfault.models.store import InMemory
from diagnostics import FaultSet, SelfDiagnosis, SensorLayout

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter
    from adaptfault.adaptation.result import Adaptation
    from adaptfault.data.calibration import Calibration
    from adaptfault.data.windows import Windows
    from adaptfault.evaluation.class_recall import ClassRecall
    from adaptfault.imputation.restorer import Restorer
    from adaptfault.models.any_model import AnyModel
    from adaptfault.models.network import TactileTransformer

SCHEMA = "adaptfault.bundle/1"
WITHOUT_ONNX = "without_onnx"
"""In ``about`` of a version: there was too little memory for its ONNX file."""

_ABOUT = "bundle.json"
_PARTS = "parts"
_MAINTENANCE_LOCK = "maintenance.lock"
# names that atomic_write makes
_TEMPORARY = re.compile(r"\.(bundle|current|journal)\..*\.[a-z0-9_]{8}")
_ABANDONED = 3600  # seconds
_KEPT = 5  # latest versions that stay on the disk, besides the fault-free one


class Bundle(Running):
    """Network, layout, calibration, healthy reference, stored windows, versions and history of one
    robot's sensor.

    The folder::

        bundle.json           the layout, the classes, and the hash of each part (and a copy)
        parts/adapter         fault-free model and windows, from which every adaptation starts
        parts/reference       fitted healthy model of the self-diagnosis
        parts/check           held-out windows on which a new version is compared
        parts/calibration.csv
        versions/0001, ...    one model for one fault set each; 0001 is the fault-free one
        current.json          which version runs (and a copy)
        journal.sqlite        recordings used, maintenance runs, known faults

    Parts and versions are written once, into a temporary folder that is renamed after all data is
    synced. Every load checks the hashes. Where the active version is damaged, the last valid one
    before it runs.

    Args:
        path: an existing bundle.
        keys: PEM files of public ed25519 keys. The bundle must be signed by one of them
            (:func:`adaptfault.sign_bundle`), and only signed versions run, and those that this
            object wrote. None: signatures are not checked.
        least_serial: smallest serial number of the signature that is accepted.

    Raises:
        FileNotFoundError: the folder holds no bundle.
        Damaged: both ``bundle.json`` and its copy fail their checksum.
        Untrusted: no given key signed the bundle, or it is older than ``least_serial``.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        keys: Sequence[str | os.PathLike[str]] | None = None,
        least_serial: int = 0,
    ) -> None:
        super().__init__(Path(path))
        with reading(self.path):
            there = any((self.path / name).is_file() for name in (_ABOUT, "bundle.copy.json"))
        if not there:
            raise FileNotFoundError(
                f"{self.path}: expected a bundle, a folder with {_ABOUT}; adaptfault train --out"
                " X.bundle makes one"
            )
        self.about: dict[str, Any] = read_with_copy(self.path / _ABOUT, SCHEMA)
        with decoding(self.path / _ABOUT):
            self.layout = SensorLayout.from_dict(self.about["layout"])
            self.class_names: tuple[str, ...] = tuple(map(str, self.about["class_names"]))
            self.parts = Parts(self.path / _PARTS, dict(self.about["parts"]))
        self.serial = 0  # of the signature that was verified, or written here
        if keys is not None:
            self.serial, self.versions.signed = verify(self.path, self.about, keys, least_serial)

    @classmethod
    def open(
        cls,
        path: str | Path,
        *,
        keys: Sequence[str | os.PathLike[str]] | None = None,
        least_serial: int = 0,
    ) -> Bundle:
        """Open a bundle; see the class."""
        return cls(path, keys=keys, least_serial=least_serial)

    @classmethod
    def create(
        cls,
        path: str | Path,
        model: TactileTransformer | AnyModel,
        adapter: Adapter,
        diagnoser: SelfDiagnosis,
        *,
        check: Windows | None = None,
        class_names: Sequence[str] = (),
        calibration: Calibration | None = None,
        head: Literal["auto", "linear"] = "auto",
        sign: str | os.PathLike[str] | None = None,
    ) -> Bundle:
        """Write a new bundle from a fault-free model, its adapter and a fitted diagnoser.

        Args:
            path: folder to create; must not exist.
            model: the fault-free model, which is version 1.
            adapter: of the same model; its windows are stored, at most 20 MB of them.
            diagnoser: fitted on fault-free recordings.
            check: held-out fault-free labelled windows, as the test windows of ``split``, on which
                new versions are compared with the running one. None takes half of the adapter's
                validation windows.
            class_names: one name a class, or a value of a regression; or none.
            calibration: from raw counts to the layout's unit, if recordings are raw counts.
            head: of version 1. "auto": of :attr:`~adaptfault.adaptation.adapter.Adapter.healthy`.
                "linear": the model's own.
            sign: PEM file of the private key that signs the bundle; None: it is not signed.

        Raises:
            FileExistsError: ``path`` exists.
            ValueError: the parts have different array shapes, ``check`` has targets of another
                kind, the diagnoser is not fitted, or ``head`` is unknown.
        """
        path = Path(path)
        check_parts(path, model, adapter, diagnoser, class_names, check, head)
        make_folder(path.parent)
        new = path.with_name(f".{path.name}.unfinished")
        shutil.rmtree(new, ignore_errors=True)  # left by a crash
        if check is None:
            adapter, check = split_validation(adapter)
        parts = Parts.files(adapter, diagnoser, check, calibration)
        about = {
            "schema": SCHEMA,
            "layout": model.layout.to_dict(),
            "class_names": list(class_names),
            "created": now(),
            "parts": write_files(new / _PARTS, parts),
        }
        write_with_copy(new / _ABOUT, about)
        bundle = cls(new)
        Pointer(active=1).write(new)
        first = adapter.healthy if head == "auto" else adapter.adapt((), method="fill")
        bundle.write_version(first, {"reason": "the fault-free model"})
        if sign is not None:
            bundle.sign(sign, {1})
        sync_tree(new)
        os.replace(new, path)
        sync(path.parent)
        return cls(path)

    def deploy(
        self,
        number: int,
        entry: Entry | None = None,
        *,
        sign: str | os.PathLike[str] | None = None,
    ) -> None:
        """Make a version the active one, on probation, and journal it: both, or neither.

        Args:
            number: of the version.
            entry: of the journal; None: it is not journalled.
            sign: PEM file of the private key that signs the bundle first, so that what runs is
                signed at every moment; None: it is not signed.

        Raises:
            OSError: the bundle cannot be written, or another process holds it.
        """
        with self._state() as pointer:
            after = pointer.deployed(number)
            if sign is not None:
                self.sign(sign, pointer.versions | after.versions)
            if entry is None:
                after.write(self.path)
            else:
                self._switch(pointer, after, entry)

    def sign(
        self,
        private_key: str | os.PathLike[str],
        numbers: Collection[int],
        *,
        serial: int | None = None,
    ) -> None:
        """Sign the manifest and the versions of these numbers; see
        :func:`~adaptfault.bundle.signature.sign_versions` for arguments and errors."""
        self.serial = sign_versions(
            self.path,
            self.about,
            self.versions,
            private_key,
            numbers,
            before=self.serial,
            serial=serial,
        )

    def problems(self, *, repair: bool = True) -> list[str]:
        """Check every file and return the damage; ``repair`` restores what has a copy.

        Raises:
            OSError: a file cannot be read or written now.
        """
        problems = damage(self.pointer, POINTER_SCHEMA, repair=repair) + damage(
            self.path / _ABOUT, SCHEMA, repair=repair
        )
        problems += self.journal.damage(repair=repair)
        if repair:
            self._settle()
        try:
            self.parts.check(repair=repair)
        except Damaged as error:
            problems.append(str(error))
        for number in self.versions.numbers:
            try:
                self.versions[number]
            except (Damaged, FileNotFoundError) as error:
                problems.append(str(error))
        return problems

    def sweep(self) -> None:
        """Remove temporary files that crashes left, once they are older than any write."""
        for path in self.path.glob(".*"):
            with suppress(OSError):  # another process may remove it, too
                if (
                    _TEMPORARY.fullmatch(path.name)
                    and time.time() - path.stat().st_mtime > _ABANDONED
                ):
                    path.unlink()

    def diagnoser(self) -> SelfDiagnosis:
        """Return the fitted self-diagnosis; raises Damaged. Needs no torch."""
        return self.parts.diagnoser()

    def restorer(self) -> Restorer:
        """Return a restorer that is fitted on the healthy windows; raises Damaged. Loads torch."""
        from adaptfault.data.windows import recordings_of
        from adaptfault.imputation.restorer import Restorer

        return Restorer(self.layout).fit(recordings_of(self.parts.adapter().train, self.layout))

    # History.

    def known_faults(self) -> KnownFaults:
        """Return the known faults after the last maintenance run."""
        known = self.journal.last("knowledge")
        # new or lost journal: the active version stores the faults it was adapted to
        if known is None:
            known = self.active().about.get("knowledge")
        if known is None:
            return KnownFaults(self.layout.n_cells)
        with decoding(self.journal.path):
            return KnownFaults.from_dict(known)

    def class_recalls(self) -> tuple[ClassRecall, ...]:
        """Return the recall of each class by the running version, under the known faults.

        It was measured on validation recordings without F when the version was made. Where the
        version uses known faulty cells, it is that of the comparison with these faults; without
        one, and of a regression, there is none. Needs no torch.

        Raises:
            Damaged: no version can be read.
        """
        from adaptfault.evaluation.class_recall import ClassRecall
        from adaptfault.models.store import ADAPTATION, MANIFEST, read_manifest

        version = self.active()
        faulty = self.known_faults().fault_set
        if faulty - version.fault_set:
            path = self.journal.path
            measured = self.journal.judged(faulty, version.number) or {}
        else:
            path = version.folder / MANIFEST
            with decoding(path):
                measured = read_manifest(version.files, ADAPTATION)
        with decoding(path):
            return tuple(ClassRecall.from_dict(one) for one in measured.get("classes", ()))

    def allows(self, label: str | int, *, min_recall: float) -> bool:
        """Return whether a program may rely on a class: whether the lower limit of the 95 %
        interval of its recall is at least ``min_recall``.

        The recall is that of :meth:`class_recalls`. A class without one is not allowed: none is
        while the running version uses a cell that is known to be faulty, unless it was compared
        with this fault.

        Args:
            label: name of the class, or its number.
            min_recall: above 0, at most 1.

        Raises:
            ValueError: no such class, or no such recall.
            Damaged: no version can be read.
        """
        if not 0 < min_recall <= 1:
            raise ValueError(f"min_recall is a share of windows, above 0 to 1; got {min_recall}")
        if isinstance(label, str) and label not in self.class_names:
            known = ", ".join(self.class_names) or "classes have numbers"
            raise ValueError(f"the bundle has no class {label!r}: {known}")
        number = self.class_names.index(label) if isinstance(label, str) else label
        lows = [one.low for one in self.class_recalls() if one.label == number]
        return bool(lows) and lows[0] >= min_recall

    def maintenance(self, *, dry_run: bool = False) -> AbstractContextManager[None]:
        """Hold the maintenance lock, one run at a time; raises Busy. A dry run goes on without
        it."""
        return locked(self.path / _MAINTENANCE_LOCK, patience=0, needed=not dry_run)

    def write_version(self, adaptation: Adaptation, about: dict[str, Any]) -> Version:
        """Write an adaptation as a new version without activating it."""
        files = InMemory()
        adaptation.save(files)
        if self.parts.lacks_memory_for_onnx(files):
            about = {**about, WITHOUT_ONNX: True}
        length = adaptation.model.network.length
        return self._write_version(files, length, adaptation.fault_set, about)

    def with_onnx(self, version: Version) -> Version | None:
        """Write a version again with the ONNX file for which there was too little memory.

        Returns:
            The new version, not active yet; None where ``version`` lacks none for this reason, or
            there is still too little memory.
        """
        if WITHOUT_ONNX not in version.about or version.hashes is None:
            return None
        sealed = Sealed(version.folder, version.hashes)
        files = InMemory({name: sealed.read(name) for name in version.hashes})
        if self.parts.lacks_memory_for_onnx(files):
            return None
        about = {name: value for name, value in version.about.items() if name != WITHOUT_ONNX}
        return self._write_version(files, version.length, version.fault_set, about)

    def _write_version(
        self, files: InMemory, length: int, fault_set: FaultSet, about: dict[str, Any]
    ) -> Version:
        version = self.versions.write(
            files,
            layout=self.layout,
            class_names=self.class_names,
            length=length,
            fault_set=fault_set,
            about=about,
        )
        pointer = Pointer.read(self.path)
        needed = {1, pointer.active, *pointer.fallbacks[:_KEPT]}
        self.versions.sweep(keep={*self.versions.numbers[-_KEPT:], *needed})
        return version
