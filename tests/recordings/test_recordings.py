"""Reading recordings: calibration on the way, and what importing the readers loads."""

import subprocess
import sys
from pathlib import Path

import numpy as np
from recording_files import archive, counts, messages, refusal

from adaptfault.data.recordings import load
from diagnostics import SensorLayout


def test_counts_are_calibrated_while_they_are_read(tmp_path):
    table = tmp_path / "tables.csv"
    table.write_text(
        "cell,raw,force\n" + "".join(f"{cell},100,0\n{cell},900,4\n" for cell in range(6))
    )
    file = archive(
        tmp_path / "a.npz",
        frames=np.array([[[50, 100, 500, 900, 1000, 300]]], np.uint16),
        full_scale=1023,
    )
    loaded = load(file, layout="1x2x3", calibration=table)
    assert loaded.recordings.layout == SensorLayout(1, 2, 3, full_scale=4.0, unit="N")
    np.testing.assert_allclose(loaded.recordings.frames[0], [[0, 0, 2, 4, 4, 1]])
    (warning,) = messages(loaded, "warning")
    assert "1 readings below and 1 above the tables of 2 cells" in warning
    assert "tables for 6 cells, but the layout has 4" in refusal(
        archive(tmp_path / "b.npz", frames=counts(shape=(1, 2, 2))), calibration=table
    )


def test_importing_the_readers_is_quick_and_loads_no_torch():
    code = (
        "import sys, adaptfault.data.calibration, adaptfault.data.recordings; sys.exit('torch' in"
        " sys.modules)"
    )
    root = Path(__file__).parents[2]
    for script in (code, code.replace("adaptfault.data.calibration, ", "")):
        assert subprocess.run([sys.executable, "-c", script], cwd=root, check=False).returncode == 0
