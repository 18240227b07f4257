"""The constant parts of a bundle: adapter, reference of the diagnosis, held-out windows,
calibration, ONNX graph."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from adaptfault.bundle.checksummed_json import Damaged, check_files, decoding, reading
from adaptfault.data.atomic import atomic_write
from adaptfault.models.store import load_arrays, save_arrays
from diagnostics import SelfDiagnosis

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter
    from adaptfault.data.calibration import Calibration
    from adaptfault.data.windows import Windows

_ADAPTER = "adapter"
_REFERENCE = "reference"
_CHECK = "check"
_CALIBRATION = "calibration.csv"
_COPY = "reference.copy"
_GRAPH = "graph.onnx"
_SCHEMA = "adaptfault.reference/1"


class Parts:
    """Reads the parts. The first use of each checks its hashes and raises Damaged on a mismatch.

    Args:
        folder: of the parts.
        hashes: of their files.
    """

    def __init__(self, folder: Path, hashes: Mapping[str, str]) -> None:
        self.folder = folder
        self.hashes = hashes
        self._whole: set[str] = set()  # parts that were checked

    @staticmethod
    def write(
        folder: Path,
        adapter: Adapter,
        diagnoser: SelfDiagnosis,
        check: Windows,
        calibration: Calibration | None,
        graph: bytes | None,
    ) -> None:
        """Write the parts into a new folder; see :func:`~adaptfault.prediction.export.graph_of` for
        ``graph``.

        Raises:
            ValueError: the diagnoser is not fitted.
        """
        from adaptfault.adaptation.adapter_files import save_adapter, save_windows

        if diagnoser.reference_ is None:
            raise ValueError(
                "a bundle needs a diagnoser that is fitted on fault-free recordings: call fit first"
            )
        folder.mkdir(parents=True)
        save_adapter(folder / _ADAPTER, adapter)
        save_windows(folder / _CHECK, check)
        about, arrays = diagnoser.state()
        for name in (_REFERENCE, _COPY):  # prediction needs it, so there are two
            save_arrays(folder / name, _SCHEMA, {"diagnosis": about}, arrays)
        if calibration is not None:
            calibration.write(folder / _CALIBRATION)
        if graph is not None:
            atomic_write(folder / _GRAPH, graph)

    def check(self, *, repair: bool = False) -> None:
        """Check all of them; ``repair`` restores the reference or its copy from the other. Raises
        Damaged."""
        problems = []
        for name in sorted({PurePosixPath(file).parts[0] for file in self.hashes}):
            try:
                self._verified(name)
            except Damaged as error:
                problems.append(str(error))
                if repair and name in (_REFERENCE, _COPY):
                    self._restore(name, _COPY if name == _REFERENCE else _REFERENCE)
        if problems:
            raise Damaged("; ".join(problems))

    def _verified(self, name: str) -> Path:
        """Return the path of one part after a check of its files only; raises Damaged."""
        if name not in self._whole:
            check_files(
                self.folder,
                {f: h for f, h in self.hashes.items() if PurePosixPath(f).parts[0] == name},
            )
            self._whole.add(name)
        return self.folder / name

    def _restore(self, name: str, source: str) -> None:
        with suppress(Damaged, OSError):
            whole = self._verified(source)
            for path in whole.iterdir():
                atomic_write(self.folder / name / path.name, path.read_bytes())

    def diagnoser(self) -> SelfDiagnosis:
        """Return the fitted self-diagnosis, from its copy where the part is damaged. Needs no
        torch."""
        try:
            return _diagnoser(self._verified(_REFERENCE))
        except (FileNotFoundError, Damaged):
            if not any(PurePosixPath(file).parts[0] == _COPY for file in self.hashes):
                raise
        return _diagnoser(self._verified(_COPY))

    def adapter(self) -> Adapter:
        """Return the adapter, with the fault-free model and windows."""
        from adaptfault.adaptation.adapter_files import load_adapter

        path = self._verified(_ADAPTER)
        with decoding(path):
            return load_adapter(path)

    def check_windows(self) -> Windows:
        """Return the held-out windows on which a candidate and the running version are compared."""
        from adaptfault.adaptation.adapter_files import load_windows

        path = self._verified(_CHECK)
        with decoding(path):
            return load_windows(path)

    @property
    def calibration(self) -> Path | None:
        """Path of the calibration table from raw counts to the layout's unit; None without one."""
        path = self._verified(_CALIBRATION)
        with reading(path):
            return path if path.is_file() else None

    @property
    def graph(self) -> bytes | None:
        """ONNX graph of the network with a head in closed form; None without one, or where it is
        damaged."""
        with suppress(Damaged, FileNotFoundError):
            path = self._verified(_GRAPH)
            with reading(path):
                return path.read_bytes()
        return None


def _diagnoser(path: Path) -> SelfDiagnosis:
    with decoding(path):
        about, arrays = load_arrays(path, _SCHEMA)
        return SelfDiagnosis.from_state(about["diagnosis"], arrays)


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
