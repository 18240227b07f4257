"""adaptfault restore: recordings with faulty cells in, whole recordings out."""

from __future__ import annotations

import json
from pathlib import Path

from adaptfault.cli.command import argument, option
from adaptfault.cli.paths import Read, Stated, WrittenInto, written_into
from adaptfault.cli.shared_options import Trusting

_RESTORED = "restored.npz"
_ABOUT = "restored.json"


class Restore(Trusting):
    """Replace faulty cells by estimates from the healthy ones."""

    example = """  adaptfault restore today/ --bundle robot.bundle --out restored/
      writes restored.npz, readable by every command,
      and restored.json with the deviation of each restored cell
  adaptfault restore today/ --bundle robot.bundle --out restored/ --faults 3,17,200"""

    recordings: list[Read] = argument("file or folder of recordings", "RECORDINGS")
    bundle: Read = option("folder with the healthy windows of the array", "BUNDLE", required=True)
    out: WrittenInto = option(
        "folder to write", "FOLDER", required=True, type=written_into(_RESTORED, _ABOUT)
    )
    faults: Stated | None = option(
        "a diagnosis (JSON), or cell indices as 3,17,200 (default: the faulty cells that the"
        " bundle lists)",
        "F",
    )

    def run(self) -> int:
        """Restore the faulty cells and missing readings of each recording."""
        import numpy as np

        from adaptfault.cli.diagnoses import fault_set
        from adaptfault.data.atomic import atomic_write
        from adaptfault.data.recordings import Recordings, save_npz
        from adaptfault.robot.new_recordings import load_new_recordings

        bundle = self.opened(self.bundle)
        layout = bundle.layout
        faults = (
            bundle.known_faults().fault_set
            if self.faults is None
            else fault_set(self.faults, layout)
        )
        incoming = load_new_recordings(bundle, self.recordings)
        self.tell_problems(incoming.problems)
        self.say(
            f"{len(faults)} of {layout.present.sum()} cells are faulty; restoring"
            f" {len(incoming.frames)} recordings"
        )
        restorer = bundle.restorer()
        version = bundle.active()  # wires are put back and pads recalibrated, as it does
        given = [version.undo(layout.check_recording(frames)) for frames in incoming.frames]
        restored = [restorer.transform(frames, faults).astype(np.float32) for frames in given]
        missing = sum(int(np.isnan(frames[:, faults.healthy]).sum()) for frames in given)
        deviation = restorer.deviation(faults)
        folder = Path(self.out)
        folder.mkdir(parents=True, exist_ok=True)
        save_npz(folder / _RESTORED, Recordings(tuple(restored), layout, names=incoming.names))
        result = {
            "schema": "adaptfault.restore/1",
            "recordings": len(restored),
            "fault_set": list(faults),
            "unit": layout.unit,
            "deviation": {str(cell): float(deviation[cell]) for cell in faults},
            "missing_readings": missing,
            "restored": str(folder / _RESTORED),
        }
        about = json.dumps(result, indent=1, allow_nan=False)
        atomic_write(folder / _ABOUT, about.encode())
        typical = (
            f", typical deviation {np.median(deviation[list(faults)]):.3g} {layout.unit}"
            if len(faults)
            else ""
        )
        self.emit(
            result,
            f"{len(restored)} recordings: {len(faults)} cells and {missing} other missing readings"
            f" restored{typical}\nrestored recordings: {folder / 'restored.npz'}",
        )
        return 0


add = Restore.add
