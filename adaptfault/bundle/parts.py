"""The constant parts of a bundle: adapter, reference of the diagnosis, held-out windows,
calibration, ONNX graph."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from adaptfault.bundle.checksummed_json import Damaged, Sealed, decoding
from adaptfault.data.atomic import atomic_write
from adaptfault.data.recordings.formats.text import decoded
from adaptfault.models.store import InMemory, load_arrays, save_arrays
from diagnostics import SelfDiagnosis

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

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
        graph: bytes | None,
    ) -> dict[str, bytes]:
        """Return the content of the files of new parts, by path; see
        :func:`~adaptfault.prediction.export.graph_of` for ``graph``.

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
