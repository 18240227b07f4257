"""A policy sees no invalid reading: items of a data set are masked or restored."""

import pickle

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import adaptfault as af
from adaptfault.data.simulated_grasps import simulate
from diagnostics import SensorLayout

LAYOUT = SensorLayout(2, 3, 4, full_scale=1.0, unit="V", rate=50.0)
LEFT = "observation.tactile.left"
RIGHT = "observation.tactile.right"


class Frames:
    """A data set of frames, as LeRobot's; with windows of ``steps`` frames."""

    fps = 30

    def __init__(self, frames: np.ndarray, valid: np.ndarray, steps: int = 0) -> None:
        self.frames = frames.reshape(-1, 2, 3, 4).astype(np.float32)
        self.valid = valid.reshape(-1, 2, 3, 4)
        self.steps = steps

    def __len__(self) -> int:
        return len(self.frames) - self.steps

    def __getitem__(self, i):
        of = slice(i, i + self.steps) if self.steps else i
        item = {"action": torch.zeros(2)}
        for pad, name in enumerate((LEFT, RIGHT)):
            item[name] = torch.tensor(self.frames[of][..., pad, :, :])
            item[f"{name}.valid"] = torch.tensor(self.valid[i, pad])
        return item


@pytest.fixture(scope="module")
def frames():
    made = simulate(6, LAYOUT, n_frames=40, seed=0)
    return np.concatenate([np.asarray(one).reshape(-1, 24) for one in made.frames])


@pytest.fixture
def valid(frames):
    valid = np.ones(frames.shape, bool)
    valid[:, 5] = False
    valid[10:, 17] = False
    return valid


@pytest.mark.parametrize("steps", [0, 5])
def test_what_is_invalid_is_masked_and_all_else_stays(frames, valid, steps):
    plain = Frames(frames, valid, steps)
    masked = af.ValidTouch(plain, neutral={LEFT: -1.0, RIGHT: -2.0})
    assert (len(masked), masked.fps) == (len(plain), 30)
    old, new = plain[20], masked[20]
    assert new.keys() == old.keys()
    for pad, (name, neutral) in enumerate({LEFT: -1.0, RIGHT: -2.0}.items()):
        mask = torch.tensor(valid[20].reshape(2, 3, 4)[pad]).expand(old[name].shape)
        assert torch.equal(new[name][mask], old[name][mask])
        assert (new[name][~mask] == neutral).all()
        assert (new[name].shape, new[name].dtype) == (old[name].shape, torch.float32)


@pytest.mark.parametrize("steps", [0, 5])
def test_what_is_invalid_is_restored_from_the_valid_readings(frames, valid, steps):
    broken = np.where(valid, frames, 1e6)
    restorer = af.Restorer(LAYOUT).fit(frames)
    restored = af.ValidTouch(Frames(broken, valid, steps), "restore", restorer=restorer)
    item = restored[20]
    got = torch.stack([item[LEFT], item[RIGHT]], dim=-3).reshape(-1, 24).numpy()
    mask = valid[20]
    window = frames[20 : 20 + max(steps, 1)]
    np.testing.assert_allclose(got[:, mask], window[:, mask], rtol=1e-6)
    expected = restorer.transform(np.where(mask, window, np.nan))
    np.testing.assert_allclose(got, expected, atol=1e-6)


def test_it_is_loaded_in_batches_by_workers(frames, valid):
    masked = af.ValidTouch(Frames(frames, valid))
    assert len(pickle.loads(pickle.dumps(masked))) == len(frames)
    batch = next(iter(DataLoader(masked, batch_size=16)))
    assert batch[LEFT].shape == (16, 3, 4)
    assert (batch[LEFT].reshape(16, 12)[:, 5] == 0).all()


def test_what_cannot_be_meant_is_refused(frames, valid):
    plain = Frames(frames, valid)
    with pytest.raises(ValueError, match=r"needs restorer=Restorer\(layout\)"):
        af.ValidTouch(plain, "restore")
    with pytest.raises(ValueError, match="expected 'mask' or 'restore'"):
        af.ValidTouch(plain, "drop")
    with pytest.raises(ValueError, match=r"no feature with a mask.*--write-copy"):
        af.ValidTouch([{"action": torch.zeros(2)}])[0]
    other = af.Restorer(SensorLayout(1, 3, 3, full_scale=1.0)).fit(frames[:, :9])
    with pytest.raises(ValueError, match="hold 24 readings, and the restorer knows 9 cells"):
        af.ValidTouch(plain, "restore", restorer=other)[0]
    with pytest.raises(AttributeError):
        _ = af.ValidTouch(plain).nothing
