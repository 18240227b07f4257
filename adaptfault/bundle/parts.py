"""The constant parts of a bundle: adapter, reference of the diagnosis, held-out windows,
calibration, ONNX graph."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from adaptfault.bundle.checksummed_json import Damaged, Sealed, decoding
from adaptfault.data.atomic import atomic_write
from adaptfault.data.recordings.formats.text import decoded
from adaptfault.data.shortage import is_shortage
from adaptfault.models.store import InMemory, check_names, load_arrays, save_arrays
from diagnostics import SelfDiagnosis

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from adaptfault.adaptation.adapter import Adapter
    from adaptfault.data.calibration import Calibration
    from adaptfault.data.windows import Windows
    from adaptfault.models.any_model import AnyModel
    from adaptfault.models.network import TactileTransformer

_log = logging.getLogger(__name__)

_ADAPTER = "adapter"
_REFERENCE = "reference"
_CHECK = "check"
_CALIBRATION = "calibration.csv"
_COPY = "reference.copy"
_GRAPH = "graph.onnx"
_SCHEMA = "adaptfault.reference/1"


class Parts:
    """Reads the parts. Each read compares what it decodes with the recorded hash and raises Damaged
    on a mismatch; a file that was not recorded is no part.

    Args:
        folder: of the parts.
        hashes: of their files.
    """

    def __init__(self, folder: Path, hashes: Mapping[str, str]) -> None:
        self.folder = folder
        self._files = Sealed(folder, hashes)

    @staticmethod
    def files(
        adapter: Adapter,
        diagnoser: SelfDiagnosis,
        check: Windows,
        calibration: Calibration | None,
    ) -> dict[str, bytes]:
        """Return the content of the files of new parts, by path.

        Raises:
            ValueError: the diagnoser is not fitted.
        """
        from adaptfault.adaptation.adapter_files import save_adapter, save_windows

        if diagnoser.reference_ is None:
            raise ValueError(
                "a bundle needs a diagnoser that is fitted on fault-free recordings: call fit first"
            )
        folders = {name: InMemory() for name in (_ADAPTER, _CHECK, _REFERENCE, _COPY)}
        save_adapter(folders[_ADAPTER], adapter)
        save_windows(folders[_CHECK], check)
        about, arrays = diagnoser.state()
        for name in (_REFERENCE, _COPY):  # prediction needs it, so there are two
            save_arrays(folders[name], _SCHEMA, {"diagnosis": about}, arrays)
        files = {
            f"{name}/{file}": data
            for name, folder in folders.items()
            for file, data in folder.items()
        }
        if calibration is not None:
            files[_CALIBRATION] = calibration.encode()
        graph = _graph(adapter)
        if graph is not None:
            files[_GRAPH] = graph
        return files

    def check(self, *, repair: bool = False) -> None:
        """Check all of them; ``repair`` restores the reference or its copy from the other. Raises
        Damaged."""
        problems = []
        for name in sorted({PurePosixPath(file).parts[0] for file in self._files.hashes}):
            try:
                self._check(name)
            except Damaged as error:
                problems.append(str(error))
                if repair and name in (_REFERENCE, _COPY):
                    self._restore(name, _COPY if name == _REFERENCE else _REFERENCE)
        if problems:
            raise Damaged("; ".join(problems))

    def _check(self, name: str) -> None:
        """Check one part, a file or a folder; raises Damaged."""
        if name in self._files:
            self._files.read(name)
        else:
            self._files.below(name).check()

    def _restore(self, name: str, source: str) -> None:
        whole = self._files.below(source)
        with suppress(Damaged, OSError):
            for file in whole.hashes:
                atomic_write(self.folder / name / file, whole.read(file))

    def diagnoser(self) -> SelfDiagnosis:
        """Return the fitted self-diagnosis, from its copy where the part is damaged. Needs no
        torch."""
        try:
            return self._diagnoser(_REFERENCE)
        except (FileNotFoundError, Damaged):
            if not self._files.below(_COPY).hashes:
                raise
        return self._diagnoser(_COPY)

    def _diagnoser(self, name: str) -> SelfDiagnosis:
        part = self._files.below(name)
        with decoding(part.folder):
            about, arrays = load_arrays(part, _SCHEMA)
            return SelfDiagnosis.from_state(about["diagnosis"], arrays)

    def adapter(self) -> Adapter:
        """Return the adapter, with the fault-free model and windows."""
        from adaptfault.adaptation.adapter_files import load_adapter

        part = self._files.below(_ADAPTER)
        with decoding(part.folder):
            return load_adapter(part)

    def recordings(self, full_scale: float) -> list[NDArray[np.floating]]:
        """Return the fault-free recordings ``[T, D]`` that the adapter's windows hold, in units of
        ``full_scale``.

        Raises:
            ValueError: some windows of a large array were left out, so that there are none whole.
        """
        from adaptfault.adaptation.adapter_files import load_recordings

        part = self._files.below(_ADAPTER)
        with decoding(part.folder):
            found = load_recordings(part)
        if found is None:
            raise ValueError(
                f"{part.folder} keeps some windows of a large array, and no recording whole; give"
                " the fault-free recordings"
            )
        return [full_scale * frames for frames in found]

    def check_windows(self) -> Windows:
        """Return the held-out windows on which a candidate and the running version are compared."""
        from adaptfault.adaptation.adapter_files import load_windows

        part = self._files.below(_CHECK)
        with decoding(part.folder):
            return load_windows(part)

    @property
    def calibration(self) -> Calibration | None:
        """Calibration from raw counts to the layout's unit; None without one."""
        from adaptfault.data.calibration import Calibration

        if _CALIBRATION not in self._files:
            return None
        path = self.folder / _CALIBRATION
        with decoding(path):
            return Calibration.decode(path, decoded(path, self._files.read(_CALIBRATION)))

    @property
    def graph(self) -> bytes | None:
        """ONNX graph of the network with a head in closed form; None without one, or where it is
        damaged."""
        with suppress(Damaged, FileNotFoundError):
            return self._files.read(_GRAPH)
        return None

    def lacks_memory_for_onnx(self, files: InMemory) -> bool:
        """Add the ONNX file to those of a version, which runs on torch without it; return whether
        it is missing for want of memory, so that a later run may add it."""
        from adaptfault.prediction.export import ExportError, add_onnx

        try:
            add_onnx(files, self.graph)
        except Exception as error:
            lacks_memory = is_shortage(error)
            if not lacks_memory and not isinstance(error, ImportError | ExportError):
                raise
            _log.warning("no ONNX export, this version runs on torch: %s", error)
            return lacks_memory
        return False


def split_validation(adapter: Adapter) -> tuple[Adapter, Windows]:
    """Return an adapter with every second validation recording of each class, and the windows of
    the others; of a regression, with every second recording."""
    import numpy as np

    from adaptfault.adaptation.adapter import Adapter

    windows = adapter.validation
    recordings, first = np.unique(windows.recording, return_index=True)
    if len(recordings) < 2:
        raise ValueError(
            "one validation recording cannot be split into validation and check; give held-out"
            " windows as check="
        )
    if adapter.task == "classification":
        recordings = recordings[np.argsort(windows.y[first], kind="stable")]
    given = np.isin(windows.recording, recordings[1::2])
    return Adapter(adapter.model, adapter.train, windows.select(~given)), windows.select(given)


def check_parts(
    path: Path,
    model: TactileTransformer | AnyModel,
    adapter: Adapter,
    diagnoser: SelfDiagnosis,
    class_names: Sequence[str],
    check: Windows | None,
    head: str,
) -> None:
    """Refuse parts that make no bundle, before anything is written; the errors are those of
    :meth:`~adaptfault.bundle.bundle.Bundle.create`."""
    if path.exists():
        raise FileExistsError(f"{path} exists: choose another name, or remove it")
    if not diagnoser.layout.shape == adapter.model.layout.shape == model.layout.shape:
        raise ValueError(
            f"model, adapter and diagnoser need one array shape; got {model.layout} and"
            f" {diagnoser.layout}"
        )
    if adapter.acts:
        raise ValueError(
            "a bundle holds a classifier or a regression of touch alone: store a policy with"
            " save_adapter, or its repair with Adaptation.save"
        )
    check_names(class_names, model.n_classes, adapter.task)
    if check is not None and check.y.shape[1:] != adapter.validation.y.shape[1:]:
        raise ValueError(
            f"check has targets [N{_more(check)}], the adapter [N{_more(adapter.validation)}]:"
            " give windows with the same classes or values"
        )
    if head not in ("auto", "linear"):
        raise ValueError(f"unknown head {head!r}: use 'auto' or 'linear'")


def _more(windows: Windows) -> str:
    return "".join(f", {size}" for size in windows.y.shape[1:])


def _graph(adapter: Adapter) -> bytes | None:
    """Return the ONNX graph that repairs of this adapter share, so that each is exported in a
    second."""
    from adaptfault.imputation.tiled_statistics import LARGE
    from adaptfault.prediction.export import ExportError, graph_of

    # a large array has another front end for each F
    if not adapter.has_features or adapter.layout.n_cells > LARGE:
        return None
    with suppress(ImportError, ExportError):  # logged with version 1
        return graph_of(adapter.model, values=adapter.task == "regression")
    return None
