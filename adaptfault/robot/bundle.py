"""The bundle: the one folder that a robot carries. Opening it, and running what it holds, needs no torch."""

from __future__ import annotations

import errno
import logging
import os
import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from adaptfault.robot.checksummed_json import (
    Damaged,
    damage,
    hash_files,
    read_either,
    sync,
    sync_tree,
    write_twice,
)
from adaptfault.robot.journal import Journal
from adaptfault.robot.known_faults import Knowledge
from adaptfault.robot.lock import locked
from adaptfault.robot.parts import Parts
from adaptfault.robot.pointer import NAME as POINTER
from adaptfault.robot.pointer import SCHEMA as POINTER_SCHEMA
from adaptfault.robot.pointer import STARTS, Pointer
from adaptfault.robot.versions import Version, Versions
from diagnostics import SelfDiagnosis, SensorLayout

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter
    from adaptfault.adaptation.result import Adaptation
    from adaptfault.data.calibration import Calibration
    from adaptfault.data.windows import Windows
    from adaptfault.models.any_model import AnyModel
    from adaptfault.models.network import TactileTransformer

SCHEMA = "adaptfault.bundle/1"

_ABOUT, _PARTS = "bundle.json", "parts"
_MAINTENANCE_LOCK, _STATE_LOCK = "maintenance.lock", "state.lock"

PROCESS = uuid4().hex  # this one, among those that start versions
_log = logging.getLogger(__name__)
_KEPT = 5  # versions, besides the fault-free one


class Bundle:
    """Network, layout, calibration, healthy reference, replay set, versions and history of one robot's skin.

    The folder::

        bundle.json           the layout, the classes, and the hash of each part (and a copy)
        parts/adapter         fault-free model and windows: what an adaptation starts from
        parts/reference       what healthy looks like: what a diagnosis compares with
        parts/check           windows that no model learns from: what a new version is judged on
        parts/calibration.csv
        versions/0001, ...    one model for one fault set each; 0001 is the fault-free one
        current.json          which version runs (and a copy)
        journal.sqlite        recordings seen, runs, what is known of the cells

    Parts and versions are written once, in a new folder that gets its name when all is on the disk. Every load checks
    the hashes. A version that is damaged makes the one before run.

    Args:
        path: an existing bundle.

    Raises:
        FileNotFoundError: there is none.
        Damaged: neither ``bundle.json`` nor its copy is what was written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not (self.path / _ABOUT).is_file():
            raise FileNotFoundError(
                f"{self.path}: expected a bundle, a folder with {_ABOUT}; adaptfault train --out X.bundle makes one"
            )
        self.about: dict[str, Any] = read_either(self.path / _ABOUT, SCHEMA)
        self.layout = SensorLayout.from_dict(self.about["layout"])
        self.class_names: tuple[str, ...] = tuple(self.about["class_names"])
        self.parts = Parts(self.path / _PARTS, self.about["parts"])
        self.versions = Versions(self.path / "versions")
        self.journal = Journal(self.path)

    @classmethod
    def open(cls, path: str | Path) -> Bundle:
        """Open a bundle; see the class."""
        return cls(path)

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
    ) -> Bundle:
        """Make a bundle from a fault-free model and what belongs to it.

        Args:
            path: where to; must not exist.
            model: the fault-free model, which becomes version 1.
            adapter: adapts it; its windows are kept, within 20 MB.
            diagnoser: fitted on fault-free recordings.
            check: fault-free, labelled windows that neither model nor adapter learns from, as the test windows of
                ``split``; new versions are judged on them. None: the adapter gives up half of its validation windows.
            class_names: one name a class, or none.
            calibration: from raw counts to the layout's unit, if recordings come raw.

        Raises:
            FileExistsError: there is something at ``path``.
            ValueError: the parts are of different arrays, or the diagnoser is not fitted.
        """
        path = Path(path)
        if path.exists():
            raise FileExistsError(f"{path} exists: choose another name, or remove it")
        if not diagnoser.layout.shape == adapter.model.layout.shape == model.layout.shape:
            raise ValueError(
                f"model, adapter and diagnoser are of different arrays: {model.layout}, {diagnoser.layout}"
            )
        if class_names and len(class_names) != model.n_classes:
            raise ValueError(f"{model.n_classes} classes need as many class names, got {len(class_names)}")
        path.parent.mkdir(parents=True, exist_ok=True)
        new = path.with_name(f".{path.name}.unfinished")
        shutil.rmtree(new, ignore_errors=True)  # of a crash, if it is there
        Parts.write(new / _PARTS, adapter, diagnoser, check, calibration)
        about: dict[str, Any] = {
            "schema": SCHEMA,
            "layout": model.layout.to_dict(),
            "class_names": list(class_names),
            "created": now(),
            "parts": hash_files(new / _PARTS),
        }
        write_twice(new / _ABOUT, about)
        bundle = cls(new)
        Pointer(active=1).write(new)
        bundle.write_version(_fault_free(model, adapter.validation), {"reason": "the fault-free model"})
        sync_tree(new)
        os.replace(new, path)
        sync(path.parent)
        return cls(path)

    # What runs.

    @property
    def pointer(self) -> Path:
        """The file that is replaced when another version is to run."""
        return self.path / POINTER

    def active(self) -> Version:
        """Return the version that runs, or where that is damaged, the last good one before it.

        Raises:
            Damaged: no version is left that can be read.
        """
        pointer = Pointer.read(self.path)
        before = [n for n in reversed(self.versions.numbers) if n < pointer.active]
        problems = []
        for number in dict.fromkeys((pointer.active, *pointer.fallbacks, *before)):
            try:
                return self.versions[number]
            except (FileNotFoundError, Damaged) as error:
                problems.append(str(error))
        raise Damaged(f"{self.path} holds no version that can be read: {problems[0]}")

    def begin(self, starter: str = PROCESS) -> Version:
        """Return the version to run, from the one that starts to run it: counts starts while it is on probation.

        One that was started twice without :meth:`confirm` gives way to the one before.

        Args:
            starter: who starts it. The same one in a row counts once: a process may serve several devices.
        """
        try:
            with locked(self.path / _STATE_LOCK, wait=True):
                pointer = Pointer.read(self.path)
                after = pointer.started(starter)
                if after.starts > STARTS and pointer.fallbacks:
                    self._fall_back(pointer, f"version {pointer.active} was started {STARTS} times and never confirmed")
                elif after != pointer:
                    after.write(self.path)
        except OSError as error:
            if error.errno not in (errno.EROFS, errno.EACCES, errno.EPERM):
                raise  # a bundle that cannot be written runs all the same
        return self.active()

    def confirm(self) -> None:
        """Say that the version which runs is healthy: its probation is over."""
        with locked(self.path / _STATE_LOCK, wait=True):
            pointer = Pointer.read(self.path)
            if pointer.probation:
                pointer.confirmed().write(self.path)
                self.journal.add(now(), "confirmed", {"version": pointer.active})

    def deploy(self, number: int) -> None:
        """Switch to a version, on probation."""
        with locked(self.path / _STATE_LOCK, wait=True):
            Pointer.read(self.path).deployed(number).write(self.path)

    def rollback(self) -> Version:
        """Return to the version before; what is left is not deployed for the same faults again.

        Raises:
            ValueError: there is none before.
        """
        with locked(self.path / _STATE_LOCK, wait=True):
            pointer = Pointer.read(self.path)
            self._fall_back(pointer, f"version {pointer.active} was rolled back")
        return self.active()

    def problems(self, *, mend: bool = True) -> list[str]:
        """Check every file and return what is damaged; what can be mended is, unless ``mend`` is False."""
        problems = damage(self.pointer, POINTER_SCHEMA, mend=mend) + damage(self.path / _ABOUT, SCHEMA, mend=mend)
        problems += self.journal.damage(mend=mend)
        try:
            self.parts.check()
        except Damaged as error:
            problems.append(str(error))
        for number in self.versions.numbers:
            try:
                self.versions[number]
            except (Damaged, FileNotFoundError) as error:
                problems.append(str(error))
        return problems

    def _fall_back(self, pointer: Pointer, reason: str) -> None:
        try:
            rejected = self.versions[pointer.active].fault_set.cells
        except (FileNotFoundError, Damaged):
            rejected = ()
        after = pointer.fallen_back(rejected)
        after.write(self.path)
        self.journal.add(now(), "rollback", {"from": pointer.active, "to": after.active, "reason": reason})

    def diagnoser(self) -> SelfDiagnosis:
        """Return the fitted self-diagnosis; raises Damaged. Needs no torch."""
        return self.parts.diagnoser()

    # Its history.

    def knowledge(self) -> Knowledge:
        """Return what is known of the cells after the last run."""
        known = self.journal.last("knowledge")
        if known is None:  # the journal is new or was lost: the version that runs knows what it was made for
            known = self.active().about.get("knowledge")
        return Knowledge(self.layout.n_cells) if known is None else Knowledge.from_dict(known)

    def maintenance(self) -> AbstractContextManager[None]:
        """Hold the lock of maintenance: one run at a time; raises Busy."""
        return locked(self.path / _MAINTENANCE_LOCK, wait=False)

    def write_version(self, adaptation: Adaptation, about: dict[str, Any]) -> Version:
        """Write an adaptation as a new version. Nothing is switched."""
        version = self.versions.write(
            partial(_save, adaptation),
            layout=self.layout,
            class_names=self.class_names,
            length=adaptation.model.network.length,
            fault_set=adaptation.fault_set,
            about=about,
        )
        pointer = Pointer.read(self.path)
        needed = {1, pointer.active, *pointer.fallbacks[:_KEPT]}
        self.versions.sweep(keep={*self.versions.numbers[-_KEPT:], *needed})
        return version


def now() -> str:
    """Return the time, UTC, as ISO 8601."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def _save(adaptation: Adaptation, folder: Path) -> None:
    """Write an adaptation, and beside it the ONNX file: where that cannot be made, it runs on torch."""
    from adaptfault.models.export import ExportError, add_onnx

    adaptation.save(folder)
    try:
        add_onnx(folder)
    except (ImportError, ExportError) as error:
        _log.warning("without ONNX, this version runs on torch: %s", error)


def _fault_free(model: TactileTransformer | AnyModel, validation: Windows) -> Adaptation:
    """Return the model as an adaptation to no fault: the same logits, bit for bit."""
    from adaptfault.adaptation.reduced_model import ReducedModel
    from adaptfault.adaptation.result import Adaptation
    from diagnostics import FaultSet

    none = FaultSet((), model.layout.n_cells)
    return Adaptation(ReducedModel(model, none, None).eval(), none, (), _validation=validation)
