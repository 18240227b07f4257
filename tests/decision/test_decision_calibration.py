from itertools import pairwise

import numpy as np
import pytest

from adaptfault.data.recordings import Recordings
from diagnostics import Fault, SelfDiagnosis, inject
from diagnostics.decision.calibration import calibrated, faulty_at, probability_of

SCORED = np.ones(100, bool)
EARLY = np.zeros(100, bool)  # never moved
LATE = np.ones(100, bool)  # came to rest
NOTHING = np.zeros(100)


def probability(
    ratio: np.ndarray,
    temporal: np.ndarray = NOTHING,
    scored: np.ndarray = SCORED,
    moved: np.ndarray = EARLY,
) -> np.ndarray:
    every = np.ones(len(ratio), bool)
    return probability_of(calibrated(ratio, temporal, moved, every, tested=every), moved, scored)


def test_the_stronger_the_evidence_the_likelier_the_fault():
    p = probability(np.linspace(-5, 15, 100))
    assert (np.diff(p) >= 0).all()
    assert p[0] < 0.1
    assert p[-1] > 0.99
    assert ((p >= 0) & (p <= 1)).all()


def test_the_level_of_a_run_adds_to_the_evidence():
    level = np.where(np.arange(100) == 7, 4.0, 0.0)
    p = probability(np.full(100, 2.0), level, moved=LATE)
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
    moved = np.arange(100) >= 50
    many = np.full(100, 1.0)
    few = np.full(100, 1.0)
    many[:40] = 15.0
    assert (probability(many, moved=moved)[50:] == probability(few, moved=moved)[50:]).all()
    assert (probability(many, moved=moved)[40:50] > probability(few, moved=moved)[40:50]).all()


def test_without_any_scored_cell_none_is_faulty():
    assert probability(NOTHING, scored=~SCORED).max() < 0.001


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
    off = sum(abs(p[tenth == t].sum() - broken[tenth == t].sum()) for t in range(10))
    assert off < 0.017 * len(p)
    assert broken[p < 0.02].mean() < 0.01
    assert broken[p > 0.9].mean() > 0.99
    assert p.sum() == pytest.approx(broken.sum(), rel=0.15)  # other kinds may be there as well
