"""Touch in the features of an observation: the same readings as frames of one array, and back."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.lerobot.features import Touch, replaced, touch_of
from diagnostics import SensorLayout

LEADING = st.lists(st.integers(1, 3), max_size=2)
DTYPES = st.sampled_from([torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int16])


@st.composite
def observations(draw):
    """Draw a layout, and an observation of it: pads as grids or flat, one frame or several."""
    pads, rows, cols = (draw(st.integers(1, 4)) for _ in range(3))
    leading = draw(LEADING)
    size = draw(st.sampled_from([(rows, cols), (rows * cols,)]))
    dtype = draw(DTYPES)
    values = torch.arange(int(np.prod(leading, dtype=int)) * pads * rows * cols) % 120
    grids = values.reshape(*leading, pads, *size).to(dtype)
    split = {f"observation.tactile.{p}": grids.select(len(leading), p) for p in range(pads)}
    return SensorLayout(pads, rows, cols), split, values.reshape(-1, pads * rows * cols)


@given(observations())
def test_frames_hold_pad_after_pad_and_go_back_where_they_came_from(drawn):
    layout, features, frames = drawn
    touch = Touch.of({"observation.state": torch.zeros(3), **features}, touch_of(features), layout)
    np.testing.assert_array_equal(touch.readings(), frames.numpy())
    for name, part in touch.parts(touch.readings()).items():
        assert part.shape == features[name].shape
        assert torch.equal(part, features[name].double())


@given(observations(), st.randoms(use_true_random=False))
def test_a_mask_of_the_observation_lies_as_its_feature(drawn, random):
    layout, features, _ = drawn
    name = random.choice(sorted(features))
    mask = torch.tensor([random.random() < 0.5 for _ in range(features[name].numel())])
    mask = mask.reshape(features[name].shape)
    touch = Touch.of(features, touch_of(features), layout)
    found = touch.parts(touch.given_valid({f"{name}.valid": mask}))
    assert all(torch.equal(part, mask if one == name else part) for one, part in found.items())
    assert all(part.all() for one, part in found.items() if one != name)


def test_pads_of_unequal_size_fill_the_positions_that_have_a_cell():
    present = np.ones((2, 2, 3), bool)
    present[1, :, 2] = False
    layout = SensorLayout(2, 2, 3, present=present)
    features = {"observation.tactile.a": torch.arange(6.0).reshape(2, 3)}
    features["observation.tactile.b"] = torch.arange(6.0, 10).reshape(2, 2)
    touch = Touch.of(features, touch_of(features), layout)
    assert touch.readings().tolist() == [[0, 1, 2, 3, 4, 5, 6, 7, 0, 8, 9, 0]]
    assert touch.parts(touch.readings())["observation.tactile.b"].tolist() == [[6, 7], [8, 9]]
    assert touch.given_valid(features).all()


def test_the_features_of_touch_are_those_of_a_data_set_in_natural_order():
    names = ["observation.tactile.10", "action", "observation.tactile.9", "observation.state"]
    assert touch_of([*names, "observation.tactile.9.valid"]) == (names[2], names[0])


@given(DTYPES)
def test_a_value_that_is_put_in_leaves_all_others_bit_for_bit(dtype):
    tensor = (torch.arange(12) * 7).reshape(3, 4).to(dtype)
    where = torch.zeros(3, 4, dtype=torch.bool)
    where[1, 2] = True
    new = replaced(tensor, torch.full((3, 4), 2.6, dtype=torch.float64), where)
    assert new.dtype == dtype
    assert torch.equal(new[~where], tensor[~where])
    assert abs(new[1, 2].item() - 2.6) <= (0.5 if dtype == torch.int16 else 0.02)


@pytest.mark.parametrize(
    ("observation", "names", "told"),
    [
        ({"observation.state": torch.zeros(3)}, (), "the observation has no tactile feature; it"),
        ({}, ("observation.tactile.a",), "has no observation.tactile.a; it has nothing: name"),
        ({"touch": np.zeros(12)}, ("touch",), "touch is a ndarray, expected a torch tensor"),
        ({"touch": torch.zeros(11)}, ("touch",), r"touch \[11\]: expected frames of 12 cells"),
        ({"touch": torch.zeros(3, 8)}, ("touch",), r"touch \[3, 8\]: expected frames of 12 cells"),
    ],
)
def test_an_observation_without_the_touch_of_this_sensor_is_told_in_one_line(
    observation, names, told
):
    with pytest.raises(ValueError, match=told) as error:
        Touch.of(observation, names, SensorLayout(2, 2, 3))
    assert "\n" not in str(error.value)


def test_a_mask_of_another_width_is_told():
    features = {"touch": torch.zeros(2, 12)}
    touch = Touch.of(features, ("touch",), SensorLayout(2, 2, 3))
    with pytest.raises(ValueError, match=r"touch.valid is \[12\], and touch \[2, 12\]"):
        touch.given_valid({"touch.valid": torch.ones(12)})
