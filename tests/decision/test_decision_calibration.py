from itertools import pairwise

import numpy as np
import pytest
from scipy.special import expit
from sklearn.linear_model import LogisticRegression

from adaptfault.data.recordings import Recordings
from diagnostics import Fault, SelfDiagnosis, SensorLayout, inject
from diagnostics.decision import calibration
from diagnostics.decision.calibration import Calibrator, _bounded_logistic, _Trial, faulty_at

SCORED = np.ones(100, bool)
EARLY = np.zeros(100, int)  # of the kind that never moved
LATE = np.ones(100, int)  # of the kind that came to rest
NO_JUMP = np.zeros(100)


def probability(
    ratio: np.ndarray,
    jump: np.ndarray = NO_JUMP,
    scored: np.ndarray = SCORED,
    kind: np.ndarray = EARLY,
) -> np.ndarray:
    weights = Calibrator()
    return weights.probability(weights.calibrate(ratio, jump, kind), kind, scored)


def test_the_stronger_the_evidence_the_likelier_the_fault():
    p = probability(np.linspace(-5, 15, 100))
    assert (np.diff(p) >= 0).all()
    assert p[0] < 0.1
    assert p[-1] > 0.99
    assert ((p >= 0) & (p <= 1)).all()


def test_a_jump_adds_to_the_evidence():
    jump = np.where(np.arange(100) == 7, 4.0, 0.0)
    p = probability(np.full(100, 2.0), jump, kind=LATE)
    assert p[7] > p[8]


def test_cells_that_move_are_alive_whatever_their_evidence():
    scored = np.arange(100) < 50
    p = probability(np.full(100, 20.0), scored=scored)
    assert p[:50].min() > 0.99
    assert p[50:].max() < 0.001


def test_the_same_evidence_gives_a_higher_probability_where_many_cells_are_broken():
    alone = np.full(100, -3.0)
    among = np.full(100, -3.0)
    alone[0] = among[0] = 4.0
    among[1:40] = 12.0
    assert probability(among)[0] > probability(alone)[0]


def test_broken_cells_that_never_moved_do_not_make_those_that_did_suspect():
    kind = np.where(np.arange(100) < 50, 0, 1)
    many = np.full(100, 1.0)
    few = np.full(100, 1.0)
    many[:40] = 15.0
    assert (probability(many, kind=kind)[50:] == probability(few, kind=kind)[50:]).all()
    assert (probability(many, kind=kind)[40:50] > probability(few, kind=kind)[40:50]).all()


def test_without_any_scored_cell_none_is_faulty():
    assert probability(NO_JUMP, scored=~SCORED).max() < 0.001


@pytest.mark.parametrize("seed", range(10))
def test_the_expected_false_discoveries_exceed_the_rate_by_no_more_than_they_would_fall_short(
    seed: int,
):
    p = np.random.default_rng(seed).beta(0.3, 0.3, 200)
    for rate in (0.001, 0.01, 0.2):
        chosen = faulty_at(p, rate)
        inside = np.sort(p[chosen])
        rest = p[~chosen & (p > 0.5)]

        def off(cells: np.ndarray, rate: float = rate) -> float:
            return float((1 - cells).sum() - rate * len(cells))

        assert off(inside) <= max(rate - off(inside[1:]), 0) + 1e-12
        if len(rest):  # one more would have been too far
            assert off(np.append(inside, rest.max())) > rate - off(inside) - 1e-12


def test_a_looser_rate_never_takes_a_cell_out_again():
    p = np.random.default_rng(0).beta(0.3, 0.3, 200)
    chosen = [faulty_at(p, rate) for rate in (0.001, 0.01, 0.1, 0.5)]
    assert all((fewer <= more).all() for fewer, more in pairwise(chosen))


def test_no_cell_that_is_probably_alive_is_faulty_whatever_the_others_are():
    p = np.array([1.0] * 99 + [0.4])
    assert faulty_at(p, 0.1).sum() == 99
    assert not faulty_at(np.zeros(5), 0.5).any()


def test_too_few_recordings_to_split_give_the_defaults():
    layout = SensorLayout(1, 3, 3)
    rng = np.random.default_rng(0)
    assert Calibrator.fit([rng.uniform(0, 3, (50, 9))] * 3, layout) == Calibrator()


@pytest.mark.parametrize(("recordings", "frames"), [(40, 1000), (4, 3000)])
def test_no_log_is_diagnosed_with_a_reference_fitted_on_its_own_recordings(
    monkeypatch, recordings: int, frames: int
):
    trained_on: dict[int, set[int]] = {}
    used: list[
        tuple[set[int], set[int], int]
    ] = []  # recordings of a log and of its reference, frames of the log

    class Stop(Exception):
        pass

    def fit(cls: type, given: list[np.ndarray], layout: SensorLayout) -> object:
        reference = object()
        trained_on[id(reference)] = {int(r[0, 8] // 1) for r in given}
        kept.append(reference)
        return reference

    def trial(
        log: np.ndarray, faults: object, layout: object, reference: object, exclusion: object
    ) -> None:
        used.append(
            (
                set(np.unique(log[:, 8] // 1).astype(int).tolist()),
                trained_on[id(reference)],
                len(log),
            )
        )
        if len(used) == 20:
            raise Stop

    kept: list[object] = []
    monkeypatch.setattr(calibration.Reference, "fit", classmethod(fit))
    monkeypatch.setattr(calibration, "_trial", trial)
    rng = np.random.default_rng(0)
    reference = [
        np.column_stack([rng.uniform(0, 3, (frames, 8)), np.full(frames, i + 0.5)])
        for i in range(recordings)
    ]
    with pytest.raises(Stop):
        Calibrator.fit(reference, SensorLayout(1, 3, 3))
    assert max(frames for *_, frames in used) <= 8 * 600
    # Of few recordings one may be parted, and no more.
    assert max(len(log & known) for log, known, _ in used) <= (recordings < 32)


def test_probabilities_are_calibrated(fitted: SelfDiagnosis, grasps: Recordings):
    rng = np.random.default_rng(0)
    predicted = []
    true = []
    for _ in range(25):
        log = np.concatenate(
            [grasps.frames[i] for i in rng.choice(np.arange(21, 140, 2), 3, replace=False)]
        )
        cells = rng.choice(220, 22, replace=False)
        faults = [
            Fault(kind, (int(c),)) for c, kind in zip(cells, ["open", "short"] * 11, strict=True)
        ]
        diagnosis = fitted.diagnose(inject(log, faults, grasps.layout))
        predicted.append(diagnosis.probability)
        true.append(np.isin(np.arange(220), cells))
    p = np.concatenate(predicted)
    broken = np.concatenate(true)
    tenth = np.minimum((10 * p).astype(int), 9)
    assert sum(abs(p[tenth == t].sum() - broken[tenth == t].sum()) for t in range(10)) < 0.01 * len(
        p
    )
    assert broken[p < 0.02].mean() < 0.002
    assert broken[p > 0.9].mean() > 0.99
    assert p.sum() == pytest.approx(broken.sum(), rel=0.1)


def test_without_evidence_the_log_ratio_is_not_positive_however_few_healthy_cells_there_are():
    rng = np.random.default_rng(0)
    dead = np.arange(200) >= 6  # healthy cells that hold a load are rare in a small reference
    evidence = np.column_stack(
        [np.where(dead, 4, -4) + rng.normal(0, 3, 200), rng.normal(0, 1, 200) + 2 * dead]
    )
    # as if faults were rarer elsewhere
    offset, slope, jump = _bounded_logistic(evidence, dead, base=-1.0, expected=(0.0, 0.0))
    assert offset <= 0
    assert slope > 0
    assert 0 <= jump <= 1
    # Without the bounds, the same data would call a cell faulty that nothing speaks against.
    free = LogisticRegression(C=10.0).fit(evidence, dead)
    assert free.intercept_[0] + 1.0 > 2


def test_within_the_bounds_it_is_a_logistic_regression():
    rng = np.random.default_rng(1)
    evidence = rng.normal(0, 2, (5000, 2))
    dead = rng.random(5000) < expit(-1.5 + 1.2 * evidence[:, 0] + 0.4 * evidence[:, 1] - 0.5)
    free = LogisticRegression(C=10.0).fit(evidence, dead)
    expected = (free.intercept_[0] + 0.5, *free.coef_[0])
    found = _bounded_logistic(evidence, dead, base=-0.5, expected=(0.0, 0.0))
    assert found == pytest.approx(expected, abs=2e-3)


def came_to_rest(ratio: np.ndarray, temporal: np.ndarray, broken: np.ndarray) -> Calibrator:
    """Calibrate on one log whose cells all came to rest in it."""
    return Calibrator._of(
        [_Trial(np.ones(len(broken), np.intp), ratio, temporal, broken, 0.0, 0.0)]
    )


def test_where_events_do_not_tell_broken_cells_apart_only_the_temporal_evidence_counts():
    broken = np.arange(400) >= 300
    found = came_to_rest(np.where(broken, -0.9, 0.0), np.where(broken, 12.0, -3.0), broken)
    assert found.slope[1] == pytest.approx(0, abs=0.05)
    assert found.temporal[1] > 0.9


def test_where_the_temporal_evidence_tells_all_cells_apart_events_keep_their_usual_weight():
    broken = np.arange(400) >= 300
    found = came_to_rest(np.zeros(400), np.where(broken, 12.0, -12.0), broken)
    assert found.slope[1] == pytest.approx(Calibrator().slope[1], abs=0.05)
