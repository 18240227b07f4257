"""A policy that needs touch, and what its repairs are worth: python examples/mujoco_policy.py
[--quick] [--seeds 2] [--out FOLDER]

Two policies learn the task of ``mujoco_lift.py`` from demonstrations: a small transformer that
gives chunks of actions (as ACT: Zhao, Kumar, Levine and Finn 2023, without its latent variable),
and the same one with mask tokens: a cell that does not read gives a learnt vector of its own, and
random cells, rows and pads are masked while it learns.

Then cells die: 10 % at random, a third each at 0, half and full scale; a row at full scale; a pad
that floats. For each, the table has the share of episodes in which the object is
lifted: with nothing done; filled, with a new head, and fine-tuned by :class:`adaptfault.Adapter`;
trained anew on the healthy cells as the first time; and of the policy with mask tokens, with
nothing done and with F masked. All see the same objects. Intervals are Wilson's, of 95 %. Touch
that reads 0 everywhere shows whether the task needs it. A head may be better than what the policy
ends with; without a fault it shows how much of a gain is no repair. Training anew has other initial
weights, and without a fault shows how much they matter. Each seed draws demonstrations, initial
weights, F and objects of its own.

``OUT/results.csv`` gets a line for each row as it is found; ``OUT/results.md`` is the table, over
all seeds.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from joblib import Parallel, delayed
from mujoco_gripper import LAYOUT, Floats
from mujoco_lift import FRAMES, HORIZON, Demonstration, Policy, demonstrate, rollouts
from statsmodels.stats.proportion import proportion_confint
from torch import Tensor, nn

import adaptfault as af
from adaptfault.adaptation.stages import Method
from adaptfault.imputation.dropout import random_fault_set
from diagnostics import Fault, FaultKind, FaultSet, Line

D = LAYOUT.n_cells
WIDTH = 32
BRIGHT = 4.0  # a cell that is pressed reads about a quarter of full scale
DEAD = 22  # cells: 10 %
FIRST_ROLLOUT = 10_000  # seeds of demonstrations lie below


class Act(nn.Module):
    """Touch ``[N, FRAMES, D]`` and state ``[N, FRAMES, 2]`` to actions ``[N, HORIZON, 2]``.

    Args:
        masks: a cell that reads NaN gives a learnt vector instead of its reading.
    """

    def __init__(self, *, masks: bool = False) -> None:
        super().__init__()
        self.masks = masks
        inputs = 2 * D if masks else D
        self.see = nn.Sequential(nn.Linear(inputs, 96), nn.GELU(), nn.Linear(96, WIDTH))
        self.tell = nn.Linear(2, WIDTH)
        self.frame = nn.Embedding(FRAMES, WIDTH)
        self.step = nn.Embedding(HORIZON, WIDTH)
        block = {"batch_first": True, "norm_first": True, "dropout": 0.0}
        self.encoder = nn.TransformerEncoderLayer(WIDTH, 4, 2 * WIDTH, **block)
        self.decoder = nn.TransformerDecoderLayer(WIDTH, 4, 2 * WIDTH, **block)
        self.last = nn.Linear(WIDTH, 2)

    def forward(self, touch: Tensor, state: Tensor) -> Tensor:
        """Return the next actions, in the units of ``mujoco_lift``."""
        seen = BRIGHT * touch
        if self.masks:
            masked = touch.isnan()
            # the weights of an input that is 1 where a cell is masked are the token of this cell
            seen = torch.cat([seen.nan_to_num(0.0), masked.to(seen)], dim=2)
        told = self.tell(state) + self.frame.weight
        tokens = self.encoder(self.see(seen) + told)
        return self.last(self.decoder(self.step.weight.expand(len(touch), -1, -1), tokens))


class RandomMasks:
    """The ``augment`` of training: half of each batch loses random cells, lines, a block or a
    pad."""

    def __call__(self, x: Tensor, generator: torch.Generator) -> Tensor:
        """Map windows ``[B, T, D]`` to windows with NaN where a cell is masked."""
        rng = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator)))
        for part in torch.chunk(x[: len(x) // 2], 8):
            masked = random_fault_set(LAYOUT, rng).mask
            part[..., torch.from_numpy(masked.copy())] = torch.nan
        return x


@dataclass(frozen=True)
class Damage:
    """What happens to the sensor.

    Attributes:
        name: in the table.
        faults: from the start of each episode on.
    """

    name: str
    faults: tuple[Fault, ...]

    @property
    def cells(self) -> FaultSet:
        """F."""
        return FaultSet(tuple(sorted(c for fault in self.faults for c in fault.cells)), D)


HEALTHY = Damage("none", ())


def damages(seed: int) -> list[Damage]:
    """Return the damages; the seed draws which cells die."""
    rng = np.random.default_rng([seed, 72])
    dead = np.split(rng.permutation(D)[:DEAD], (DEAD // 3, 2 * DEAD // 3))
    kinds = (
        (FaultKind.OPEN, None),
        (FaultKind.STUCK, LAYOUT.full_scale / 2),
        (FaultKind.SHORT, None),
    )
    some = tuple(
        Fault(kind, tuple(sorted(cells.tolist())), value=value)
        for (kind, value), cells in zip(kinds, dead, strict=True)
    )
    row = Line(0, "row", LAYOUT.rows // 2)
    of_row = tuple(LAYOUT.cells_on(row).tolist())
    pad = tuple(range(D // 2, D))
    return [
        Damage("10 % of the cells dead", some),
        Damage("a row at full scale", (Fault(FaultKind.SHORT, of_row, line=row),)),
        Damage("a pad floats", (Fault(FaultKind.FLOATING, pad),)),
    ]


def demonstrations(count: int, seed: int) -> list[Demonstration]:
    """Return the demonstrations, of ``count``, that ended well, from all CPUs."""
    every = Parallel(n_jobs=-1)(delayed(demonstrate)(1000 * seed + i) for i in range(count))
    return [shown for shown, outcome in every if outcome == "lifted"]


def windows_of(shown: Sequence[Demonstration]) -> af.Windows:
    """Return windows of touch and state, with the chunk of actions that begins at their last
    frame; the last action of an episode goes on."""
    chunks = []
    for one in shown:
        longer = np.concatenate([one.actions, np.repeat(one.actions[-1:], HORIZON - 1, axis=0)])
        views = np.lib.stride_tricks.sliding_window_view(longer, HORIZON, axis=0)
        chunks.append(np.moveaxis(views, -1, 1))
    return af.make_windows(
        [one.touch for one in shown],
        chunks,
        LAYOUT,
        length=FRAMES,
        stride=1,
        extra={"state": [one.state for one in shown]},
    )


def learn(
    training: af.Windows, validation: af.Windows, epochs: int, seed: int, *, masks: bool = False
) -> Act:
    """Return a trained policy."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        policy = Act(masks=masks)
    af.train(
        policy,
        training,
        validation,
        epochs=epochs,
        learning_rate=2e-3,
        batch_size=256,
        averaging=0.98,
        patience=None,
        loss=nn.functional.l1_loss,
        augment=RandomMasks() if masks else None,
        seed=seed,
        progress=False,
    )
    return policy


def without(windows: af.Windows, cells: FaultSet) -> af.Windows:
    """Return windows whose cells in F read 0."""
    x = windows.x.copy()
    x[..., cells.mask] = 0.0
    return af.Windows(x, windows.y, windows.recording, windows.extra)


def acting(policy: nn.Module, put: Callable[[Floats], Floats] = lambda touch: touch) -> Policy:
    """Return a policy for rollouts; ``put`` changes touch before."""

    def act(touch: Floats, state: Floats) -> Floats:
        with torch.no_grad():
            return policy(torch.from_numpy(put(touch)), torch.from_numpy(state)).numpy()

    return act


def set_to(cells: FaultSet, value: float) -> Callable[[Floats], Floats]:
    """Return what sets the cells in F to a value, NaN to mask them."""
    return lambda touch: np.where(cells.mask, np.float32(value), touch)


@dataclass(frozen=True)
class Row:
    """How the episodes of a seed under a damage ended with a policy."""

    seed: int
    damage: str
    policy: str
    seconds: float
    outcomes: tuple[str, ...]

    @property
    def lifted(self) -> int:
        """Number of episodes that succeeded."""
        return self.outcomes.count("lifted")

    def cells(self) -> list[str]:
        """Return the line of the CSV file."""
        ended = [self.outcomes.count(name) for name in ENDS]
        shares = [f"{share:.3f}" for share in success([self])]
        about = [str(self.seed), self.damage, self.policy]
        return [*about, *shares, *map(str, ended), f"{self.seconds:.1f}"]


def success(rows: Sequence[Row]) -> tuple[float, float, float]:
    """Return the success rate over rows, and Wilson's interval of it."""
    lifted = sum(row.lifted for row in rows)
    count = sum(len(row.outcomes) for row in rows)
    low, high = proportion_confint(lifted, count, method="wilson")
    return lifted / count, float(low), float(high)


ENDS = ("lifted", "dropped", "crushed", "not lifted")
HEADS = ("seed", "damage", "policy", "success", "low", "high", *ENDS, "seconds of the repair")
REPAIRS: tuple[Method, ...] = ("fill", "head", "finetune")


@dataclass(frozen=True)
class Study:
    """The policies, and the episodes on which they are compared.

    Attributes:
        training, validation: windows of demonstrations; no episode is in both.
        plain: the policy without mask tokens.
        seeds: of the episodes.
        epochs: of a training.
        seed: of everything else.
    """

    training: af.Windows
    validation: af.Windows
    plain: Act
    seeds: Sequence[int]
    epochs: int
    seed: int

    def rows(self) -> Iterator[Row]:
        """Yield the lines of the table, the quickest first."""
        every = FaultSet(tuple(range(D)), D)
        yield self.tried(HEALTHY, "touch reads 0", acting(self.plain, set_to(every, 0.0)))
        for damage in (HEALTHY, *damages(self.seed)):
            yield self.tried(damage, "nothing done", acting(self.plain))
        adapter = af.Adapter(
            self.plain, self.training, self.validation, layout=LAYOUT, loss=nn.functional.l1_loss
        )
        for method in REPAIRS:
            for damage in damages(self.seed):
                yield self.repaired(adapter, damage, method)
        yield self.repaired(adapter, HEALTHY, "head")
        yield from self.of_masks()
        for damage in (HEALTHY, *damages(self.seed)):
            yield self.anew(damage)

    def of_masks(self) -> Iterator[Row]:
        """Yield the lines of the policy with mask tokens."""
        longer = 3 * self.epochs // 2
        masked = learn(self.training, self.validation, longer, self.seed, masks=True)
        for damage in (HEALTHY, *damages(self.seed)):
            yield self.tried(damage, "mask tokens, nothing done", acting(masked))
        for damage in damages(self.seed):
            put = set_to(damage.cells, np.nan)
            yield self.tried(damage, "mask tokens, F masked", acting(masked, put))

    def repaired(self, adapter: af.Adapter, damage: Damage, method: Method) -> Row:
        """Return the line of a repair."""
        began = time.perf_counter()
        adapted = adapter.adapt(damage.cells, method=method, seed=self.seed, progress=False)
        took = time.perf_counter() - began
        print(adapted, flush=True)

        def act(touch: Floats, state: Floats) -> Floats:
            return adapted.predict(touch, state=state)

        return self.tried(damage, method, act, took)

    def anew(self, damage: Damage) -> Row:
        """Return the line of a policy that was trained on the healthy cells, as the first time."""
        began = time.perf_counter()
        training = without(self.training, damage.cells)
        validation = without(self.validation, damage.cells)
        policy = learn(training, validation, self.epochs, self.seed + 1)
        took = time.perf_counter() - began
        blind = set_to(damage.cells, 0.0)
        return self.tried(damage, "trained anew", acting(policy, blind), took)

    def tried(self, damage: Damage, what: str, policy: Policy, seconds: float = 0.0) -> Row:
        """Return the line of a policy under a damage."""
        outcomes = rollouts(policy, self.seeds, damage.faults)
        return Row(self.seed, damage.name, what, seconds, tuple(outcomes))


def prepared(count: int, epochs: int, episodes: int, seed: int) -> Study:
    """Record demonstrations and train the policy."""
    shown = demonstrations(count, seed)
    held = max(2, len(shown) // 6)
    windows = windows_of(shown)
    validated = windows.recording >= len(shown) - held
    training, validation = windows.select(~validated), windows.select(validated)
    print(f"training {training}; validation {validation}", flush=True)
    plain = learn(training, validation, epochs, seed)
    reached = af.evaluate(plain, validation).r2
    print(f"policy: R2 {reached:.3f} of its actions on held-out episodes", flush=True)
    first = FIRST_ROLLOUT + 1000 * seed
    return Study(training, validation, plain, range(first, first + episodes), epochs, seed)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--demonstrations", type=int, default=150)
    parser.add_argument("--epochs", type=int, default=50, help="of a training")
    parser.add_argument("--episodes", type=int, default=50, help="for each line of the table")
    parser.add_argument("--seeds", type=int, default=2, help="of everything; 0 is the first")
    parser.add_argument("--out", type=Path, default=Path("policy"), help="folder for the table")
    parser.add_argument("--quick", action="store_true", help="seconds: too few of everything")
    args = parser.parse_args()
    if args.quick:
        args.demonstrations, args.epochs, args.episodes, args.seeds = 12, 1, 2, 1
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    with (args.out / "results.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(HEADS)
        for seed in range(args.seeds):
            for row in prepared(args.demonstrations, args.epochs, args.episodes, seed).rows():
                rows.append(row)
                writer.writerow(row.cells())
                file.flush()
                (args.out / "results.md").write_text(table(rows))
                print(*row.cells(), flush=True)


def table(rows: Sequence[Row]) -> str:
    """Return the table as Markdown: damages down, policies across."""
    names = list(dict.fromkeys(row.damage for row in rows))
    policies = list(dict.fromkeys(row.policy for row in rows))
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.damage, row.policy), []).append(row)
    lines = [f"| damage | {' | '.join(policies)} |", "|---" * (len(policies) + 1) + "|"]
    for name in names:
        cells = [_cell(found.get((name, policy), [])) for policy in policies]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _cell(rows: Sequence[Row]) -> str:
    """Return the success rate, its interval, and that of each seed where there are several."""
    if not rows:
        return ""
    share, low, high = success(rows)
    text = f"{share:.2f} ({low:.2f} to {high:.2f})"
    each = [f"{success([row])[0]:.2f}" for row in rows]
    return text if len(each) == 1 else f"{text}: {', '.join(each)}"


if __name__ == "__main__":
    main()
