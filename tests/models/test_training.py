"""The training loop learns, keeps the best weights, keeps its budget, and survives being killed."""

import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Clock
from torch import Tensor, nn

from adaptfault.data.windows import Windows
from adaptfault.models.history import History
from adaptfault.models.network import TactileTransformer, logits_of
from adaptfault.models.training import train
from diagnostics import SensorLayout

LAYOUT = SensorLayout(1, 4, 4)


pytestmark = pytest.mark.usefixtures("one_thread")


def grasps(n: int = 60, seed: int = 0, cells: int = 16, length: int = 10) -> Windows:
    """Three classes: which third of the cells is loaded, in noise."""
    rng = np.random.default_rng(seed)
    y = np.arange(n) % 3
    loaded = np.arange(cells) * 3 // cells == y[:, None]
    x = 0.3 * loaded[:, None] + 0.2 * rng.random((n, length, cells))
    return Windows(x.astype(np.float32), y, np.arange(n))


def small(seed: int = 0) -> nn.Module:
    """A model of 51 parameters with dropout, whose epochs take milliseconds."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return nn.Sequential(nn.Flatten(), nn.Dropout(0.3), nn.Linear(160, 3))


def weights(model: nn.Module) -> list[Tensor]:
    return [p.detach().clone() for p in model.parameters()]


def same(a: list[Tensor], b: list[Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def without_times(history: History) -> dict[str, object]:
    return {name: value for name, value in history.to_dict().items() if name != "seconds"}


def test_the_network_learns_what_can_be_told_apart():
    model = TactileTransformer(LAYOUT, 3)
    history = train(model, grasps(96), grasps(30, 1), epochs=4, learning_rate=1e-3)
    assert history.best_accuracy > 0.9
    assert (model.predict(grasps(60, 2).x) == grasps(60, 2).y).mean() > 0.9
    assert history.train_loss[-1] < history.train_loss[0]
    assert not model.training


def test_the_same_seed_trains_the_same_weights_and_the_global_generator_is_left_alone():
    models = [small(), small(), small()]
    before = torch.random.get_rng_state()
    for model, seed in zip(models, (1, 1, 2), strict=True):
        train(model, grasps(), grasps(12, 1), epochs=3, learning_rate=0.01, seed=seed)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert same(weights(models[0]), weights(models[1]))
    assert not same(weights(models[0]), weights(models[2]))


def test_the_weights_of_the_best_validation_are_kept():
    model = small()
    seen = []
    validation = grasps(30, 1)
    noisy = Windows(validation.x, np.random.default_rng(0).integers(0, 3, 30), validation.recording)
    options = {"epochs": 12, "learning_rate": 0.05, "patience": None, "averaging": 0.0}
    history = train(
        model, grasps(), noisy, on_epoch=lambda h: seen.append(weights(model)), **options
    )
    keys = list(
        zip(history.validation_accuracy, (-v for v in history.validation_loss), strict=True)
    )
    assert history.best_epoch == keys.index(max(keys)) + 1 < 12
    assert same(weights(model), seen[history.best_epoch - 1])


def test_the_weights_kept_score_what_the_history_says():
    for averaging in (0.0, 0.9, 0.995):
        model = small()
        validation = grasps(30, 1)
        history = train(
            model, grasps(), validation, epochs=4, learning_rate=0.01, averaging=averaging
        )
        assert (
            logits_of(model, validation.x).argmax(1).numpy() == validation.y
        ).mean() == history.best_accuracy


def test_the_average_is_exponential_and_over_few_steps_at_first():
    start = small()
    plain = small()
    averaged = small()
    one_step = {"epochs": 1, "batch_size": 1000, "learning_rate": 0.01}
    train(plain, grasps(), grasps(30, 1), averaging=0.0, **one_step)
    train(averaged, grasps(), grasps(30, 1), averaging=0.9, **one_step)
    for w0, w1, mean in zip(weights(start), weights(plain), weights(averaged), strict=True):
        torch.testing.assert_close(mean, w0 / 11 + w1 * 10 / 11)
    with pytest.raises(ValueError, match=r"averaging must lie in \[0, 1\)"):
        train(small(), grasps(), grasps(30, 1), averaging=1.0)


def test_training_stops_when_validation_no_longer_improves():
    validation = grasps(30, 1)
    wrong = Windows(validation.x, (validation.y + 1) % 3, validation.recording)
    history = train(small(), grasps(), wrong, epochs=50, learning_rate=0.05, patience=3)
    assert history.stopped == "patience"
    assert history.epochs == history.best_epoch + 3 < 50


def test_fine_tuning_never_ends_worse_than_it_began():
    model = small()
    validation = grasps(30, 1)
    train(model, grasps(), validation, epochs=5, learning_rate=0.01)
    before = weights(model)
    wrong = Windows(grasps().x, (grasps().y + 1) % 3, grasps().recording)
    history = train(model, wrong, validation, epochs=5, learning_rate=0.1, evaluate_start=True)
    assert history.best_epoch == 0
    assert history.start is not None
    assert history.best_accuracy == history.start[1]
    assert same(weights(model), before)


def test_frozen_parameters_stay_as_they_are():
    model = nn.Sequential(nn.Flatten(), nn.Linear(160, 8), nn.ReLU(), nn.Linear(8, 3))
    model[1].requires_grad_(False)
    frozen = weights(model[1])
    head = weights(model[3])
    train(model, grasps(), grasps(12, 1), epochs=2, learning_rate=0.01)
    assert same(weights(model[1]), frozen)
    assert not same(weights(model[3]), head)
    with pytest.raises(ValueError, match="nothing to train"):
        train(model.requires_grad_(False), grasps(), grasps(12, 1))


def test_augment_changes_the_training_batches_only_and_draws_from_the_seed():
    data = grasps()
    shapes = []
    draws = []
    before = data.x.copy()

    def blank(x: Tensor, generator: torch.Generator) -> Tensor:
        shapes.append(tuple(x.shape))
        draws.append(torch.rand(1, generator=generator).item())
        return x.zero_()

    history = train(small(), data, grasps(12, 1), epochs=2, augment=blank)
    first = list(draws)
    train(small(), data, grasps(12, 1), epochs=2, augment=blank)
    assert shapes[:4] == [(32, 10, 16), (28, 10, 16)] * 2
    assert draws == first * 2
    assert history.train_loss[0] > 1
    np.testing.assert_array_equal(data.x, before)


class Slow(nn.Module):
    """Takes 1 ms a window by a clock, in training and validation alike."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock = clock
        self.linear = nn.Linear(160, 3)

    def forward(self, x: Tensor) -> Tensor:
        self.clock.now += len(x) * 1e-3
        return self.linear(x.flatten(1))


# a whole one takes 1.05 s
@pytest.mark.parametrize(("budget", "epochs"), [(0.5, 1), (1.5, 1), (3.0, 2)])
def test_the_budget_is_kept_within_an_epoch_validation_included(
    clock: Clock, budget: float, epochs: int
):
    history = train(Slow(clock), grasps(900), grasps(150, 1), budget=budget, batch_size=16)
    assert history.stopped == "budget"
    assert 0.5 * budget < clock.now <= budget
    assert len(history.validation_accuracy) == history.epochs == epochs


def test_without_any_time_nothing_is_trained():
    model = small()
    before = weights(model)
    history = train(model, grasps(), grasps(12, 1), budget=0.0, evaluate_start=True)
    assert (history.stopped, history.epochs) == ("budget", 0)
    assert same(weights(model), before)


def test_windows_that_would_train_nonsense_are_refused():
    good = grasps()
    holed = good.x.copy()
    holed[3, 2, 1] = np.nan
    for bad, message in [
        (Windows(holed, good.y, good.recording), "1 of 60 training windows hold NaN"),
        (good.select([]), "no training windows"),
        (
            Windows(good.x, good.y + 1, good.recording),
            "labels run from 1 to 3, the model has 3 classes",
        ),
        (Windows(good.x, good.y - 1, good.recording), "labels run from -1 to 1"),
    ]:
        with pytest.raises(ValueError, match=message):
            train(small(), bad, good)
    with pytest.raises(ValueError, match="no validation windows"):
        train(small(), good, good.select([]))
    with pytest.raises(ValueError, match="epochs, batch_size, learning_rate > 0"):
        train(small(), good, good, epochs=0)


def test_a_loss_that_is_no_longer_finite_ends_the_run_with_the_best_weights():
    model = small()
    best = []

    def third_epoch_fails(outputs: Tensor, y: Tensor) -> Tensor:
        loss = nn.functional.cross_entropy(outputs, y)
        return loss if len(best) < 2 else loss * float("nan")

    def keep_best(history: History) -> None:
        best.append(weights(model) if history.best_epoch == history.epochs else best[-1])

    options = {
        "learning_rate": 0.01,
        "averaging": 0.0,
        "loss": third_epoch_fails,
        "on_epoch": keep_best,
    }
    with pytest.raises(ValueError, match=r"loss became .* lower learning_rate"):
        train(model, grasps(), grasps(12, 1), **options)
    assert len(best) == 2
    assert same(weights(model), best[-1])


def test_an_interrupted_run_leaves_the_best_weights_in_the_model():
    model = small()
    seen = []
    validation = grasps(30, 1)
    # the last epoch is not the best
    wrong = Windows(validation.x, (validation.y + 1) % 3, validation.recording)

    def stop(history: History) -> None:
        seen.append((history.best_epoch, weights(model)))
        if history.epochs == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(model, grasps(), wrong, learning_rate=0.05, averaging=0.0, on_epoch=stop)
    best, _ = seen[-1]
    assert best < len(seen) == 3
    assert same(weights(model), seen[best - 1][1])
    assert not model.training


@pytest.mark.parametrize("evaluate_start", [False, True])
def test_a_resumed_run_equals_an_unbroken_one_bit_for_bit(tmp_path: Path, evaluate_start: bool):
    def run(epochs: int, path: Path | None = None) -> tuple[nn.Module, History]:
        model = TactileTransformer(SensorLayout(1, 2, 2), 3)
        options = {"learning_rate": 1e-3, "evaluate_start": evaluate_start, "checkpoint": path}
        return model, train(
            model, grasps(40, cells=4), grasps(12, 1, cells=4), epochs=epochs, **options
        )

    unbroken, expected = run(4)
    run(2, tmp_path / "run")
    resumed, history = run(4, tmp_path / "run")
    assert without_times(history) == without_times(expected)
    assert same(weights(resumed), weights(unbroken))
    again, finished = run(4, tmp_path / "run")  # nothing was left to do
    assert finished == history
    assert same(weights(again), weights(unbroken))
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_resuming_keeps_the_best_weights_of_before_the_interruption(tmp_path: Path):
    validation = grasps(30, 1)
    # the first epoch will be the best
    wrong = Windows(validation.x, (validation.y + 1) % 3, validation.recording)
    options = {"learning_rate": 0.05, "patience": None, "checkpoint": tmp_path / "run"}
    first = small()
    resumed = small()
    early = train(first, grasps(), wrong, epochs=4, **options)
    late = train(resumed, grasps(), wrong, epochs=6, **options)
    assert early.best_epoch == late.best_epoch < 4
    assert same(weights(first), weights(resumed))


@pytest.mark.slow
def test_a_run_killed_with_kill_9_continues_as_if_nothing_had_happened(tmp_path: Path):
    script = textwrap.dedent("""
        import sys
        from pathlib import Path
        from test_training import grasps, small, train
        import torch

        torch.set_num_threads(1)

        def told(history):
            print(history.epochs, flush=True)

        model = small()
        train(model, grasps(600), grasps(60, 1), epochs=int(sys.argv[1]), learning_rate=0.01,
              patience=None, checkpoint=sys.argv[2], on_epoch=told)
        """)
    path = tmp_path / "run"
    command = [sys.executable, "-c", script, "100000", str(path)]
    # Its weights are compared with those made here: the same instructions of the CPU, if the
    # environment chooses them.
    environment = {
        **os.environ,
        "PYTHONPATH": ":".join(map(str, [Path(__file__).parent, *Path(__file__).parents[1:3]])),
    }
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) >= 3:
                break
        process.send_signal(signal.SIGKILL)
        done = max([3, *map(int, process.stdout.read().split())])
    assert process.returncode == -signal.SIGKILL
    models = [small(), small()]
    options = {"epochs": done + 3, "learning_rate": 0.01, "patience": None}
    seen: list[int] = []
    resumed = train(
        models[0],
        grasps(600),
        grasps(60, 1),
        checkpoint=path,
        on_epoch=lambda h: seen.append(h.epochs),
        **options,
    )
    expected = train(models[1], grasps(600), grasps(60, 1), **options)
    assert seen[0] >= done  # went on where it was, did not start over
    assert without_times(resumed) == without_times(expected)
    assert same(weights(models[0]), weights(models[1]))


def test_a_checkpoint_of_another_run_is_refused_and_says_what_differs(tmp_path: Path):
    path = tmp_path / "run"
    train(small(), grasps(), grasps(12, 1), epochs=1, checkpoint=path)
    for model, data, options, difference in [
        (small(), grasps(), {"learning_rate": 0.5}, "learning_rate"),
        (small(), grasps(), {"seed": 3}, "seed"),
        (small(), grasps(61), {}, "data"),
        (small(1), grasps(), {}, "starting weights"),
    ]:
        with pytest.raises(
            ValueError, match=f"run with another {difference}: delete it or give another path"
        ):
            train(model, data, grasps(12, 1), epochs=1, checkpoint=path, **options)


def test_a_damaged_checkpoint_is_refused_in_one_line(tmp_path: Path):
    path = tmp_path / "run"
    train(small(), grasps(), grasps(12, 1), epochs=1, checkpoint=path)
    whole = path.read_bytes()
    for damaged in (whole[:-5], b"", b"not a checkpoint"):
        path.write_bytes(damaged)
        with pytest.raises(
            ValueError, match=r"^.* is not a whole checkpoint .*: delete it or give another path$"
        ):
            train(small(), grasps(), grasps(12, 1), epochs=1, checkpoint=path)


def test_a_history_prints_in_a_line_and_survives_json():
    history = train(small(), grasps(), grasps(12, 1), epochs=2, evaluate_start=True)
    assert "2 epochs in" in str(history)
    assert "\n" not in str(history)
    assert History.from_dict(json.loads(json.dumps(history.to_dict()))) == history


def test_progress_goes_to_stderr_and_can_be_hidden(capsys: pytest.CaptureFixture[str]):
    train(small(), grasps(), grasps(12, 1), epochs=1, progress=True)
    shown = capsys.readouterr()
    assert "accuracy=" in shown.err
    assert not shown.out
    train(small(), grasps(), grasps(12, 1), epochs=1, progress=False)
    assert not capsys.readouterr().err
