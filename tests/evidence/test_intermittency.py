import numpy as np
import pytest

from diagnostics import Fault, SensorLayout, inject
from diagnostics.evidence.intermittency import HealthyRates, Intermittency
from diagnostics.preprocessing.scale import Scale

LAYOUT = SensorLayout(1, 4, 5)
CELLS = 20
SCALE = Scale(np.zeros(CELLS), 0.05, 5.0)
CONSTANT = np.zeros(CELLS, bool)


def healthy(seed: int, frames: int = 640) -> np.ndarray:
    """Loads that rise and fall slowly, each cell at its own pace, with a little noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None]
    load = 1.5 + np.sin(t / rng.uniform(15, 40, CELLS) + rng.uniform(0, 6, CELLS))
    return np.maximum(0, load + rng.normal(0, 0.01, load.shape))


@pytest.fixture(scope="module")
def usual() -> HealthyRates:
    return HealthyRates.fit([healthy(seed) for seed in range(10)], SCALE, LAYOUT)


def evidence_of(
    log: np.ndarray,
    usual: HealthyRates,
    still: np.ndarray = CONSTANT,
    scale: Scale = SCALE,
    length: int | None = None,
) -> Intermittency:
    """Return the sums after a log, which consists of recordings of some ``length``; None: of
    one."""
    begins = np.zeros(len(log), bool)
    if length is not None:
        begins[::length] = True
    intermittency = Intermittency.begin(LAYOUT)
    for first in range(0, len(log), 32):
        frames = log[first : first + 32]
        numbers = np.arange(first, first + len(frames))
        intermittency = intermittency.extend(
            frames,
            scale.root_load(frames),
            numbers,
            scale,
            usual,
            still,
            begins=begins[numbers],
        )
    return intermittency


def cells(mask: np.ndarray) -> list[int]:
    return np.flatnonzero(mask).tolist()


@pytest.mark.parametrize("seed", range(20, 25))
def test_healthy_cells_neither_blink_nor_are_noisy(usual, seed: int):
    for reference in (usual, HealthyRates.unknown()):
        intermittency = evidence_of(healthy(seed), reference)
        assert cells(intermittency.intermittent | intermittency.excess) == []


@pytest.mark.parametrize("value", [0.0, 5.0])
def test_a_cell_that_blinks_to_a_rail_is_intermittent_and_dated(usual, value: float):
    log = inject(healthy(30), [Fault("intermittent", (7,), value=value, onset=320)], LAYOUT, seed=0)
    intermittency = evidence_of(log, usual)
    assert cells(intermittency.intermittent) == [7]
    assert cells(intermittency.excess) == []
    assert 288 <= intermittency.blinks_since[7] <= 384
    assert intermittency.blinks[7] > 3
    assert (intermittency.high[7] > 0) == (value == 5)


def test_a_cell_with_excess_noise_is_noisy_and_dated(usual):
    log = inject(healthy(31), [Fault("noisy", (7,), value=0.5, onset=320)], LAYOUT, seed=0)
    intermittency = evidence_of(log, usual)
    assert cells(intermittency.excess) == [7]
    assert cells(intermittency.intermittent) == []
    assert 288 <= intermittency.noisy_since[7] <= 384


def test_noise_that_now_and_then_reaches_the_baseline_is_seldom_taken_for_blinks(usual):
    named = 0
    for seed in range(10):
        log = healthy(31, 192)
        log[:, :4] = np.clip(np.random.default_rng(seed).normal(1.0, 1.2, (192, 4)), 0, 5)
        evidence = evidence_of(log, usual)
        assert cells(evidence.excess | evidence.intermittent) == [0, 1, 2, 3]
        named += evidence.excess.sum()
    assert named >= 28  # of 40


def test_a_fault_that_has_gone_is_forgotten(usual):
    faults = [Fault("intermittent", (7,)), Fault("noisy", (12,), value=0.5)]
    log = inject(healthy(32, 1600), faults, LAYOUT, seed=0, until=480)
    during = evidence_of(log[:480], usual)
    after = evidence_of(log, usual)
    assert cells(during.intermittent) == [7]
    assert cells(during.excess) == [12]
    assert cells(after.intermittent | after.excess) == []


def test_a_fast_grasp_that_shakes_many_cells_alike_is_no_fault(usual):
    rng = np.random.default_rng(0)
    shaken = healthy(33) * (1 + rng.normal(0, 0.3, (640, 1)))
    intermittency = evidence_of(shaken, usual)
    assert cells(intermittency.intermittent | intermittency.excess) == []


def test_a_load_that_is_released_does_not_blink(usual):
    log = healthy(34)
    log[::64, 7] = 0  # the last frame of each other segment, and then it stays away
    log[300:, 7] = 0
    for start in range(0, 300, 64):
        log[start : start + 30, 7] = 0
    assert cells(evidence_of(log, usual).intermittent) == []


def test_constant_cells_do_not_count(usual):
    log = inject(
        healthy(35), [Fault("intermittent", (7,)), Fault("noisy", (12,), value=0.5)], LAYOUT, seed=0
    )
    intermittency = evidence_of(log, usual, np.isin(np.arange(CELLS), [7, 12]))
    assert cells(intermittency.intermittent | intermittency.excess) == []


def test_noise_under_load_is_fitted_to_the_reference():
    rng = np.random.default_rng(0)
    blinking_reference = [healthy(seed) + rng.normal(0, 0.4, (640, CELLS)) for seed in range(10)]
    log = healthy(36)
    log[:, 7] += rng.normal(0, 0.4, 640)
    assert cells(evidence_of(log, HealthyRates.fit(blinking_reference, SCALE, LAYOUT)).excess) == []
    assert cells(
        evidence_of(
            log, HealthyRates.fit([healthy(seed) for seed in range(10)], SCALE, LAYOUT)
        ).excess
    ) == [7]


@pytest.mark.parametrize("recordings", [1, 2, 4])
def test_a_few_recordings_do_not_lower_the_noise_limit(recordings: int):
    # The harder a cell is pressed, the noisier; now and then, and seldom in so few frames, one far
    # more than that.
    def blinking_reference(seed: int, frames: int = 128) -> np.ndarray:
        rng = np.random.default_rng(seed)
        load = healthy(seed, frames)
        noise = 0.02 * np.exp(rng.normal(0, 0.4, (frames // 32, CELLS))).repeat(32, axis=0)
        return np.maximum(0, load * (1 + rng.normal(0, noise)))

    usual = HealthyRates.fit(
        [blinking_reference(seed) for seed in range(recordings)], SCALE, LAYOUT
    )
    assert [
        cells(evidence_of(blinking_reference(seed, 640), usual).excess) for seed in range(50, 60)
    ] == [[]] * 10
    noisy = inject(blinking_reference(60, 640), [Fault("noisy", (7,), value=0.5)], LAYOUT, seed=0)
    assert cells(evidence_of(noisy, usual).excess) == [7]


def test_a_load_that_saturates_now_and_then_does_not_blink(usual):
    log = healthy(35)
    log[:, 3] = np.minimum(4.6 + 0.6 * np.sin(np.arange(len(log))), 5.0)
    for reference in (usual, HealthyRates.unknown()):
        assert cells(evidence_of(log, reference).intermittent) == []


def test_a_load_that_saturates_now_and_then_above_a_high_rest_does_not_blink(usual):
    log = 1.5 + 0.8 * healthy(41)
    flickers = np.random.default_rng(0).random((640, 2)) < 0.3
    log[:, [3, 7]] = np.where(flickers, 4.97, 4.9)
    found = evidence_of(log, usual, scale=Scale(np.full(CELLS, 1.5), 0.05, 5.0))
    assert cells(found.intermittent) == []


def tapped(seed: int, cells: list[int], frames: int = 640, rate: float = 5.0) -> np.ndarray:
    """A finger that taps on some cells in the middle of slow loads: gone and back within a few
    frames."""
    rng = np.random.default_rng(seed)
    log = healthy(seed, frames)
    up = np.sin(2 * np.pi * rate * np.arange(frames) / 54 + rng.uniform(0, 6)) < -0.5
    log[np.ix_(up, cells)] = 0
    log[:, cells] = np.where(log[:, cells] > 0, 1.5, 0)
    return log


@pytest.fixture(scope="module")
def blinking_reference() -> HealthyRates:
    """Learned where fingers tap and scratch, on two cells or more."""
    rng = np.random.default_rng(2)
    recordings = [
        tapped(seed, [6, 7] if seed % 2 else [12, 13, 17], 128) for seed in range(100, 140)
    ]
    for recording in recordings[::4]:
        recording[:, 1:4] += rng.normal(0, 0.5, (len(recording), 1))
    usual = HealthyRates.fit(recordings, SCALE, LAYOUT)
    assert usual.alone
    return usual


def test_neighbours_are_compared_only_where_healthy_changes_are_shared(usual):
    assert not usual.alone
    log = inject(
        healthy(30), [Fault("intermittent", (cell,)) for cell in (6, 7, 12)], LAYOUT, seed=0
    )
    assert cells(evidence_of(log, usual).intermittent) == [6, 7, 12]


@pytest.mark.parametrize("finger", [[6, 7, 11, 12], [0, 1], [4, 9], [7, 13]])
def test_a_tapping_finger_is_no_loose_contact(blinking_reference, finger: list[int]):
    for reference in (blinking_reference, HealthyRates.unknown()):
        intermittency = evidence_of(tapped(40, finger), reference)
        assert cells(intermittency.intermittent | intermittency.excess) == []


def test_a_wire_with_a_loose_contact_is_distinguished_from_a_finger_by_its_neighbours(
    blinking_reference,
):
    # a row; of its ends only one side is known
    intermittency = evidence_of(tapped(41, [5, 6, 7, 8, 9]), blinking_reference)
    assert {6, 7, 8} <= set(cells(intermittency.intermittent))
    assert cells(intermittency.intermittent | intermittency.excess)[0] >= 5
    assert cells(intermittency.intermittent | intermittency.excess)[-1] <= 9


def test_noise_that_neighbours_share_is_the_contact(blinking_reference):
    rng = np.random.default_rng(1)
    finger = [6, 7, 11, 12]
    log = healthy(42)
    log[:, finger] += rng.normal(0, 0.5, (640, 1)) * rng.uniform(0.7, 1, 4)
    assert cells(evidence_of(log, blinking_reference).excess) == []
    alone = healthy(42)
    alone[:, 7] += rng.normal(0, 1.5, 640)
    assert cells(evidence_of(alone, blinking_reference).excess) == [7]


def test_where_healthy_cells_blink_in_bursts_it_takes_more_to_be_faulty():
    # on one cell, without neighbours to compare
    blinking = [tapped(seed, [seed % CELLS], 96, rate=8.0) for seed in range(30)]
    calm = [healthy(seed, 320) for seed in range(100, 130)]
    bursts = HealthyRates.fit([*blinking, *calm], SCALE, LAYOUT)
    assert bursts.blinks_count < 1
    for seed in range(50, 60):
        assert (
            cells(evidence_of(tapped(seed, [seed % CELLS], 96, rate=8.0), bursts).intermittent)
            == []
        )
    assert HealthyRates.fit(calm, SCALE, LAYOUT).blinks_count == 1


def test_bursts_that_a_few_recordings_show_on_other_cells_are_healthy_on_any():
    few = [tapped(seed, [seed], 96, rate=8.0) for seed in range(8)]
    bursts = HealthyRates.fit(
        [*few, *(healthy(seed, 96) for seed in range(100, 108))], SCALE, LAYOUT
    )
    for seed in range(50, 60):
        assert (
            cells(evidence_of(tapped(seed, [8 + seed % 12], 96, rate=8.0), bursts).intermittent)
            == []
        )


def test_a_cell_that_always_blinked_is_healthy_and_no_other_is_forgiven():
    edge = HealthyRates.fit([tapped(seed, [3]) for seed in range(10)], SCALE, LAYOUT)
    log = inject(tapped(30, [3]), [Fault("intermittent", (7,), onset=320)], LAYOUT, seed=0)
    assert edge.blinks_count == 1
    assert cells(evidence_of(log, edge).intermittent) == [7]


@pytest.mark.parametrize("fitted", [True, False])
def test_weak_loads_that_a_threshold_hides_do_not_blink(fitted: bool):
    def thresholded(seed: int) -> np.ndarray:
        load = healthy(seed) + np.random.default_rng(seed).normal(0, 0.15, (640, CELLS))
        return np.where(load < 0.7, 0.0, load)

    reference = (
        HealthyRates.fit([thresholded(s) for s in range(5)], SCALE, LAYOUT)
        if fitted
        else HealthyRates.unknown()
    )
    assert cells(evidence_of(thresholded(9), reference).intermittent) == []
    broken = inject(thresholded(9), [Fault("intermittent", (7,), value=0.0)], LAYOUT, seed=0)
    assert 7 in cells(evidence_of(broken, reference).intermittent)


@pytest.mark.parametrize("length", [1, 2, 3, 5, 12, 50])
def test_recordings_that_differ_from_each_other_neither_blink_nor_are_noisy(length: int):
    def recordings(seed: int) -> list[np.ndarray]:
        rng = np.random.default_rng(seed)
        steady = rng.choice([0.0, 1.0, 3.0, 5.0], (600 // length, 1, CELLS))
        shape = (len(steady), length, CELLS)
        return list(np.clip(steady + rng.normal(0, 0.01, shape), 0, 5))

    reference = HealthyRates.fit(recordings(1), SCALE, LAYOUT)
    log = np.concatenate(recordings(2))
    for usual in (reference, HealthyRates.unknown()):
        found = evidence_of(log, usual, length=length)
        assert cells(found.intermittent | found.excess) == []


def test_a_cell_that_blinks_in_short_recordings_is_intermittent(usual):
    log = inject(healthy(30), [Fault("intermittent", (7,), value=0.0)], LAYOUT, seed=0)
    assert cells(evidence_of(log, usual, length=20).intermittent) == [7]
