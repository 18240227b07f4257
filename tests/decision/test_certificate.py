"""A bound of how often a healthy sensor is blamed."""

import numpy as np
import pytest
from scipy.stats import binomtest

from diagnostics import Fault, SelfDiagnosis, SensorLayout, inject
from diagnostics.decision.certificate import FEWEST_LOGS, LOG, Certificate, certify

LAYOUT = SensorLayout(1, 3, 4, full_scale=1.0)
NONE = np.zeros(12, bool)


def recordings(n: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    course = np.maximum(np.sin(np.linspace(-0.5, np.pi + 0.5, 40)), 0)[:, None]
    return [
        0.05 + course * rng.uniform(0.2, 0.8, 12) + rng.normal(0, 0.002, (40, 12)) for _ in range(n)
    ]


@pytest.mark.parametrize(("alarms", "logs"), [(0, 59), (1, 25), (7, 30), (5, 5)])
def test_the_bound_is_that_of_clopper_and_pearson(alarms, logs):
    interval = binomtest(alarms, logs, alternative="less").proportion_ci(0.95, "exact")
    assert Certificate.of(alarms, logs).false_alarms == pytest.approx(interval.high)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.1, 0.3])
def test_the_bound_holds_as_often_as_stated(share):
    rng = np.random.default_rng(1)
    held = np.mean(
        [Certificate.of(int(n), 40).false_alarms >= share for n in rng.binomial(40, share, 4000)]
    )
    assert held >= 0.945


def test_every_log_is_judged_once_by_a_fit_without_it():
    given = [np.full((1, 12), i) for i in range(30)]
    judged = []

    def blamed(rest, logs):
        of_rest = {int(one[0, 0]) for one in rest}
        for log in logs:
            of_log = [int(one[0, 0]) for one in log]
            assert not of_rest & set(of_log)
            assert of_log == list(range(of_log[0], of_log[0] + LOG))
            judged.append(of_log[0])
        return [np.arange(12) == 3 if log[0][0, 0] in (0, 8) else NONE for log in logs]

    certificate = certify(given, NONE, blamed)
    assert sorted(judged) == list(range(0, 28, LOG))
    assert (certificate.n_alarms, certificate.n_logs) == (2, 7)
    excluded = np.arange(12) == 3
    assert certify(given, excluded, blamed).n_alarms == 0


def test_too_few_recordings_give_none():
    assert certify(recordings(FEWEST_LOGS * LOG - 1), NONE, lambda rest, logs: []) is None
    assert SelfDiagnosis(LAYOUT).certificate_ is None
    assert SelfDiagnosis(LAYOUT).fit(recordings(12)).certificate_ is None


def test_a_fit_certifies_itself_and_the_file_keeps_it(tmp_path):
    fitted = SelfDiagnosis(LAYOUT).fit(recordings(24))
    certificate = fitted.certificate_
    assert (certificate.n_logs, certificate.n_recordings, certificate.confidence) == (6, 4, 0.95)
    assert certificate.false_alarms < 1
    assert "of healthy logs of 4 recordings" in str(certificate)
    fitted.save(tmp_path / "fit.npz")
    assert SelfDiagnosis.load(tmp_path / "fit.npz").certificate_ == certificate
    assert fitted.set_params(false_discovery_rate=0.01).certificate_ is None


def test_a_cell_that_is_dead_in_the_reference_is_no_false_alarm():
    dead = [inject(one, [Fault("short", (5,))], LAYOUT) for one in recordings(24)]
    assert SelfDiagnosis(LAYOUT).fit(dead).certificate_.n_alarms == 0


def test_copies_in_the_reference_make_no_certificate_better():
    originals = recordings(8)
    fitted = SelfDiagnosis(LAYOUT).fit([*originals, *(one[1:] for one in originals * 4)])
    assert fitted.copies_.tolist() == list(range(8)) * 5
    assert fitted.certificate_ is None  # eight recordings are too few, however often they stand
