"""The constant parts of a bundle: adapter, reference of the diagnosis, held-out windows, calibration."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from adaptfault.models.store import load_arrays, save_arrays
from adaptfault.robot.checksummed_json import check_files
from diagnostics import SelfDiagnosis

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter
    from adaptfault.data.calibration import Calibration
    from adaptfault.data.windows import Windows

_ADAPTER, _REFERENCE, _CHECK, _CALIBRATION = "adapter", "reference", "check", "calibration.csv"
_SCHEMA = "adaptfault.reference/1"


class Parts:
    """Reads the parts. The first use checks all hashes and raises Damaged on a mismatch.

    Args:
        folder: of the parts.
        hashes: of their files.
    """

    def __init__(self, folder: Path, hashes: Mapping[str, str]) -> None:
        self.folder, self.hashes = folder, hashes

    @staticmethod
    def write(
        folder: Path,
        adapter: Adapter,
        diagnoser: SelfDiagnosis,
        check: Windows | None,
        calibration: Calibration | None,
    ) -> None:
        """Write the parts into a new folder; without ``check``, half of the validation windows become the check.

        Raises:
            ValueError: the diagnoser is not fitted, or there are too few windows.
        """
        from adaptfault.adaptation.adapter_files import save_adapter, save_windows

        if diagnoser.reference_ is None:
            raise ValueError("a bundle needs a diagnoser that is fitted on fault-free recordings: call fit first")
        if check is None:
            adapter, check = _split_validation(adapter)
        folder.mkdir(parents=True)
        save_adapter(folder / _ADAPTER, adapter)
        save_windows(folder / _CHECK, check)
        about, arrays = diagnoser.state()
        save_arrays(folder / _REFERENCE, _SCHEMA, {"diagnosis": about}, arrays)
        if calibration is not None:
            calibration.write(folder / _CALIBRATION)

    def check(self) -> None:
        """Check all of them; raises Damaged."""
        check_files(self.folder, self.hashes)

    @cached_property
    def _checked(self) -> Path:
        self.check()
        return self.folder

    def diagnoser(self) -> SelfDiagnosis:
        """Return the fitted self-diagnosis. Needs no torch."""
        about, arrays = load_arrays(self._checked / _REFERENCE, _SCHEMA)
        return SelfDiagnosis.from_state(about["diagnosis"], arrays)

    def adapter(self) -> Adapter:
        """Return the adapter, with the fault-free model and windows."""
        from adaptfault.adaptation.adapter_files import load_adapter

        return load_adapter(self._checked / _ADAPTER)

    def check_windows(self) -> Windows:
        """Return the held-out windows on which a candidate and the running version are compared."""
        from adaptfault.adaptation.adapter_files import load_windows

        return load_windows(self._checked / _CHECK)

    @property
    def calibration(self) -> Path | None:
        """Path of the calibration table from raw counts to the layout's unit; None without one."""
        path = self._checked / _CALIBRATION
        return path if path.is_file() else None


def _split_validation(adapter: Adapter) -> tuple[Adapter, Windows]:
    """Return an adapter with every second validation recording of each class, and the windows of the others."""
    import numpy as np

    from adaptfault.adaptation.adapter import Adapter

    windows = adapter.validation
    recordings, first = np.unique(windows.recording, return_index=True)
    if len(recordings) < 2:
        raise ValueError(
            "one validation recording cannot be split into validation and check; give held-out windows as check="
        )
    by_class = recordings[np.argsort(windows.y[first], kind="stable")]
    given = np.isin(windows.recording, by_class[1::2])
    return Adapter(adapter.model, adapter.train, windows.select(~given)), windows.select(given)
