"""What was fitted once is not fitted again."""

import re

import numpy as np
import pytest

from adaptfault.cli import main
from adaptfault.data.recordings import load
from adaptfault.inspection.fit_cache import FOLDER, FitCache
from diagnostics import SelfDiagnosis, SensorLayout

LAYOUT = SensorLayout(1, 2, 3, full_scale=1.0, unit="V")
OPTIONS = ["--shape", "2x3", "--full-scale", "1", "--unit", "V"]


def recordings(seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    force = np.maximum(0, np.sin(np.arange(90) / 9))[:, None]
    return [force * rng.uniform(0.1, 0.9, 6) for _ in range(6)]


@pytest.fixture
def folders(tmp_path):
    for name, seed in (("healthy", 0), ("today", 1)):
        (tmp_path / name).mkdir()
        for i, frames in enumerate(recordings(seed)):
            np.savetxt(tmp_path / name / f"{i}.csv", frames, "%.6f", ",")
    return tmp_path


def diagnose(folders, *options: str) -> int:
    reference = ["--reference", str(folders / "healthy")]
    return main(["diagnose", str(folders / "today"), *reference, *OPTIONS, *options])


def test_the_second_diagnosis_with_a_reference_takes_the_fit_and_says_the_same(folders, capsys):
    assert diagnose(folders) == diagnose(folders)
    told = capsys.readouterr()
    assert len(re.findall("fitting the healthy model", told.err)) == 1
    assert "taking the healthy model from" in told.err
    first, second = told.out[: len(told.out) // 2], told.out[len(told.out) // 2 :]
    assert first == second


def test_without_a_cache_nothing_is_kept(folders):
    diagnose(folders, "--no-cache")
    assert not (folders / "healthy" / FOLDER).exists()


def test_the_kept_fit_is_no_recording(folders):
    diagnose(folders)
    assert (folders / "healthy" / FOLDER).is_dir()
    assert len(load(folders / "healthy", layout=LAYOUT).recordings) == 6


def test_another_reading_another_array_and_a_damaged_file_are_fitted_anew(tmp_path):
    healthy = recordings()
    kept = FitCache(tmp_path, healthy, LAYOUT)
    assert kept.load() is None
    kept.save(SelfDiagnosis(LAYOUT).fit(healthy))
    assert kept.load() is not None
    changed = [healthy[0] + 1e-9, *healthy[1:]]
    assert FitCache(tmp_path, changed, LAYOUT).load() is None
    other = SensorLayout(1, 3, 2, full_scale=1.0, unit="V")
    assert FitCache(tmp_path, healthy, other).load() is None
    kept.path.write_bytes(kept.path.read_bytes()[:-100])
    assert kept.load() is None


def test_only_the_latest_fits_stay(tmp_path):
    fitted = SelfDiagnosis(LAYOUT).fit(recordings())
    for seed in range(7):
        FitCache(tmp_path, recordings(seed), LAYOUT).save(fitted)
    assert len(list((tmp_path / FOLDER).iterdir())) == 4


def test_a_folder_that_cannot_be_written_changes_nothing(tmp_path):
    (tmp_path / FOLDER).write_text("a file where the folder would be")
    kept = FitCache(tmp_path, recordings(), LAYOUT)
    kept.save(SelfDiagnosis(LAYOUT).fit(recordings()))
    assert kept.load() is None
