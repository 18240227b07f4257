import numpy as np
import pytest
import torch

from adaptfault.adaptation.baselines.fault_aware import FaultySamples, train_fault_aware
from adaptfault.data.windows import Windows
from adaptfault.models.network import TactileTransformer
from diagnostics import SensorLayout

PRESENT = np.ones((2, 4, 5), bool)
PRESENT[0, 0, 0] = False
LAYOUT = SensorLayout(2, 4, 5, present=PRESENT)


def windows(n: int = 64, seed: int = 0) -> Windows:
    """Two classes told apart by every other cell; nothing is at a rail."""
    rng = np.random.default_rng(seed)
    y = rng.integers(0, 2, n)
    x = rng.uniform(0.01, 0.2, (n, 10, 40)) + 0.1 * (np.arange(40) % 2 == y[:, None])[:, None]
    return Windows(x.astype(np.float32) * PRESENT.ravel(), y, np.arange(n))


def changed(samples: FaultySamples, n: int) -> np.ndarray:
    """Which cells of the first n samples differ from their source, [n, D]."""
    data = samples.windows.x[samples.source[:n]]
    return (samples.draw(np.arange(n)) != data).any(axis=1)


def test_k_cells_are_stuck_at_0_or_full_scale_throughout_with_equal_chance():
    samples = FaultySamples(windows(), LAYOUT, n=400)
    x = samples.draw(np.arange(400))
    faulty = changed(samples, 400)
    assert set(faulty.sum(1)) == {5, 10}
    stuck = x.transpose(0, 2, 1)[faulty]
    assert ((stuck == 0).all(1) | (stuck == 1).all(1)).all()
    assert 0.45 < stuck[:, 0].mean() < 0.55
    assert not faulty[:, ~PRESENT.ravel()].any()
    counts = faulty[:, PRESENT.ravel()].sum(0)
    assert counts.min() > 0.6 * counts.mean()


def test_a_sample_is_the_same_whenever_and_with_whomever_it_is_drawn():
    first, again = (FaultySamples(windows(), LAYOUT, n=100, seed=4) for _ in range(2))
    together = first.draw(np.arange(100))
    np.testing.assert_array_equal(again.draw(np.array([70, 3])), together[[70, 3]])
    other = FaultySamples(windows(), LAYOUT, n=100, seed=5)
    assert (other.draw(np.arange(100)) != together).any()


def test_a_smaller_set_is_the_beginning_of_a_larger_one():
    few, many = (FaultySamples(windows(), LAYOUT, n=n) for n in (10, 1000))
    np.testing.assert_array_equal(few.draw(np.arange(10)), many.draw(np.arange(10)))


def test_many_samples_take_no_room():
    samples = FaultySamples(windows(), LAYOUT, n=10_000_000)
    assert len(samples) == len(samples.y) == 10_000_000
    assert samples.draw(np.array([9_999_999])).shape == (1, 10, 40)


def test_without_faults_the_samples_are_the_very_windows_that_the_faults_hit():
    broken, healthy = (FaultySamples(windows(), LAYOUT, n=50, n_faults=k) for k in ((5, 10), (0,)))
    np.testing.assert_array_equal(healthy.draw(np.arange(50)), healthy.windows.x[broken.source])
    np.testing.assert_array_equal(healthy.y, broken.y)


def test_lines_break_as_a_whole_and_blocks_are_patches():
    lines = FaultySamples(windows(), LAYOUT, n=50, n_faults=(1,), kind="lines")
    wires = [set(cells.tolist()) for cells in lines.faults.lines]
    assert all(set(np.flatnonzero(row)) in wires for row in changed(lines, 50))
    blocks = FaultySamples(windows(), LAYOUT, n=50, n_faults=(1,), kind="blocks")
    sizes = set()
    for row in changed(blocks, 50):
        pad, at, col = np.unravel_index(np.flatnonzero(row), LAYOUT.shape)
        assert len(set(pad)) == 1
        assert np.ptp(at) < 4 and np.ptp(col) < 4  # noqa: PT018
        sizes.add(row.sum())
    assert len(sizes) > 4


@pytest.mark.slow
def test_training_with_faults_bears_them_better():
    data = windows(256)
    held_out = windows(64, seed=1)
    broken = FaultySamples(windows(200, seed=2), LAYOUT, n=200, n_faults=(10,), seed=9)
    reached = []
    for n_samples in (0, 1000):
        model = TactileTransformer(LAYOUT, 2, init="glorot")
        history = train_fault_aware(
            model,
            data,
            held_out,
            n_samples=n_samples,
            epochs=3,
            learning_rate=1e-3,
            patience=None,
            progress=False,
        )
        assert history.epochs == 3
        reached.append((model.predict(broken.draw(np.arange(200))) == broken.y).mean())
    assert reached[1] > reached[0] + 0.02


def test_an_interrupted_training_ends_as_an_unbroken_one(tmp_path):
    options = {"n_samples": 40, "learning_rate": 1e-3, "patience": None, "progress": False}
    models = [TactileTransformer(LAYOUT, 2) for _ in range(3)]
    data = windows(32)
    train_fault_aware(models[0], data, data, epochs=2, **options)
    train_fault_aware(models[1], data, data, epochs=1, checkpoint=tmp_path / "run", **options)
    train_fault_aware(models[2], data, data, epochs=2, checkpoint=tmp_path / "run", **options)
    for a, b in zip(models[0].parameters(), models[2].parameters(), strict=True):
        assert torch.equal(a, b)
    with pytest.raises(ValueError, match="another data, more"):
        train_fault_aware(
            TactileTransformer(LAYOUT, 2),
            data,
            data,
            checkpoint=tmp_path / "run",
            kind="lines",
            n_faults=(1,),
            **options,
        )


def test_what_does_not_fit_is_said():
    data = windows()
    with pytest.raises(ValueError, match=r"from 0 to 39, got 10 and \[40\]"):
        FaultySamples(data, LAYOUT, n=10, n_faults=(40,))
    with pytest.raises(ValueError, match="unknown kind 'pads'"):
        FaultySamples(data, LAYOUT, n=10, kind="pads")
    with pytest.raises(ValueError, match="windows of 12 cells"):
        FaultySamples(data, SensorLayout(1, 3, 4), n=10)
    with pytest.raises(TypeError, match="known layout, got Linear"):
        train_fault_aware(torch.nn.Linear(2, 2), data, data)
