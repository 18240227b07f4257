import numpy as np
import torch
from sklearn.ensemble import ExtraTreesClassifier

from adaptfault.adaptation.forest import Forest


def data(n: int = 200) -> tuple[torch.Tensor, np.ndarray]:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(n, 6)).astype(np.float32)
    return torch.from_numpy(x), (x[:, 0] > 0.3).astype(int) + 2 * (x[:, 1] > 0)


def test_the_forest_votes_as_scikit_learns():
    x, y = data()
    fresh = torch.from_numpy(np.random.default_rng(1).normal(size=(300, 6)).astype(np.float32))
    forest = Forest.fit(x, y, 5, seed=3)
    grown = ExtraTreesClassifier(100, random_state=3).fit(x.numpy(), y)
    shares = (forest(fresh).exp() * 101 - 1 / 5) / 100
    np.testing.assert_allclose(shares[:, :4].numpy(), grown.predict_proba(fresh.numpy()), atol=1e-5)
    assert (shares[:, 4].abs() < 1e-5).all()


def test_windows_on_a_threshold_go_the_same_way():
    x = torch.arange(20, dtype=torch.float32)[:, None].repeat(1, 2)
    y = np.arange(20) % 4
    assert (Forest.fit(x, y, 4)(x).argmax(1).numpy() == y).all()


def test_a_forest_comes_back_from_its_state():
    x, y = data()
    forest = Forest.fit(x, y, 4)
    again = Forest.empty(forest.about)
    again.load_state_dict(forest.state_dict())
    assert torch.equal(again(x), forest(x))


def test_one_class_alone_is_always_the_answer():
    x, _ = data(10)
    assert (Forest.fit(x, np.full(10, 2), 4)(x).argmax(1) == 2).all()
