"""The page of a run: claims and verdicts, each figure with its table, versions and settings."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from adaptfault.data.atomic import atomic_write
from adaptfault.paper.bench import Bench, Setup
from adaptfault.paper.claims import judge
from adaptfault.paper.figures import TITLES, Row, draw, force_maps, rows, table
from adaptfault.paper.ledger import Ledger

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NOTES = {
    2: (
        "Every test recording gets faults of its own, so that each figure averages over as many"
        " fault sets; open and short ones hit the same cells."
    ),
    4: (
        "Fault-aware networks, by the number of training windows with faults (5 or 10 cells, open"
        " or short) that were added; tested with faults of their own kind, with short ones alone,"
        " and with whole lines and blocks (up to 4 x 4 cells) open or short. *fault-free* is the"
        " control: the same windows were added without faults, so it took as many steps."
    ),
    5: (
        "One F for each seed, the smaller ones part of the larger. *adapted*: the missing cells are"
        " filled in, and where that is not enough a head is fitted in closed form; it sees the"
        " healthy cells besides the network's features, and may do better than the network's own."
        " *trained anew*: the paper's protocol."
    ),
    6: (
        "*to 0* as in the paper; *to half*: its other proposal, 2.5 N, for full scale alone; *to"
        " the mean*: the conditional mean given the other cells, for full scale alone; *wait 5*:"
        " only a cell that has stayed at a rail for 5 frames."
    ),
    7: (
        "The same faulty cells in all recordings of a seed; also two broken lines or blocks, each"
        " open or short. *adapted* is given the faulty cells. *combined* is not: it corrects to the"
        " mean while a log is recorded, diagnoses the log, and adapts. Drift starts anew with each"
        " recording."
    ),
}

_ERRATA = """\
## Where the paper errs, or is silent

- It prints 2^n - 1 fault combinations. Each cell is healthy, open or short: 3^n - 1, and its
  10^105 is 3^220.
- Correcting short cells to 0 gives the very input that open cells give, so that Figure 6 equals the
  open half of Figure 2 by construction, unless healthy cells press to the rail: then it costs
  accuracy. The conditional mean given the other cells is better.
- Its other neutral value, 2.5 N for 0 *and* 5 N, ruins a healthy sensor: cells that nothing touches
  read exactly 0. Here 2.5 N stands for full scale alone.
- "Equal to 5.0" is 1.0 after its own scaling, and no equality survives calibration:
  a tolerance of 1.5 converter steps.
- More fault-aware samples also mean more training steps. The paper does not separate the
  two; here the control does.
- Its faults are scattered cells. Arrays lose lines and patches: Figure 4 and the last
  comparison have those as well.
- The D - k inputs of its reduced model do not fill the grid of its convolutions: a front
  end imputes the missing cells.
- The feed-forward block must return to width d for the residual sum. Text and tensors disagree
  on rows and columns: here the first axis has 11. Padding, initial weights and |F| of Figures
  2 and 6 are not stated.
"""


def write_page(
    setup: Setup, ledger: Ledger, figures: tuple[int, ...], about: dict[str, Any]
) -> Path:
    """Write figures (PNG), tables (CSV) and the page into the run's folder; returns the page's
    path."""
    layout = setup.recordings.layout
    lines = [f"# The paper's experiments on {about['recordings']}", ""]
    lines += [
        (
            f"{len(setup.recordings)} recordings of {layout}; {len(setup.recordings.class_names)}"
            " classes."
        ),
        "",
    ]
    claims = judge(
        ledger,
        setup.settings,
        n_classes=len(setup.recordings.class_names),
        present=int(layout.present.sum()),
    )
    if claims:
        lines += ["| the paper states | here | verdict |", "|---|---|---|"]
        lines += [f"| {c.statement} | {c.here} | **{c.verdict}** ({c.criterion}) |" for c in claims]
        lines.append("")
    lines += [
        (
            f"Accuracies on test recordings, means of up to {len(setup.settings.seeds)} seeds, each"
            " with its own split, weights and faults; in brackets the 95 % interval, clustered by"
            " recording. *spread*: deviation between them."
        ),
        "",
    ]
    for figure in figures:
        lines += _section(setup, ledger, figure)
    if set(figures) >= {2, 3}:
        lines += _single_faults(setup)
    lines += [_ERRATA, "## Made with", "", f"`{about['command']}` on {about['device']}", ""]
    lines += [f"- {name} {version}" for name, version in about["versions"].items()]
    lines += ["", "Settings and seeds: `config.json`; results of each task: `results.jsonl`.", ""]
    path = setup.folder / "README.md"
    atomic_write(path, "\n".join(lines).encode())
    return path


def _section(setup: Setup, ledger: Ledger, figure: int) -> list[str]:
    """Write one figure; return its part of the page."""
    name = f"figure{figure}"
    if figure == 3:
        windows = setup.windows
        layout = setup.recordings.layout
        frames = windows.x.reshape(-1, layout.n_cells) * layout.full_scale
        picture, maps = force_maps(frames, layout, setup.settings.seeds[0])
        header = ",".join(["cell", *maps])
        cells = (
            ",".join([str(i), *(f"{m[i]:.4f}" for m in maps.values())])
            for i in range(layout.n_cells)
        )
        _write(setup.folder, name, picture, "\n".join([header, *cells, ""]))
        return [f"## {TITLES[3]}", "", f"![{TITLES[3]}]({name}.png)", ""]
    found = rows(ledger, figure)
    if not found:
        return []
    _write(setup.folder, name, draw(ledger, figure), table(found))
    return [
        f"## {TITLES[figure]}",
        "",
        _NOTES[figure],
        "",
        f"![{TITLES[figure]}]({name}.png)",
        "",
        *_markdown(found),
    ]


def _markdown(found: Sequence[Row]) -> list[str]:
    lines = [
        "| strategy | faults | k | accuracy | precision | recall | F1 | spread | seeds |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for task, m in found:
        numbers = " | ".join(f"{value:.3f}" for value in (m.precision, m.recall, m.f1))
        spread = f"{m.spread:.3f}" if m.seeds > 1 else "-"
        lines.append(
            f"| {task.strategy} | {task.faults} | {task.k} | {m} | {numbers} | {spread} |"
            f" {m.seeds} |"
        )
    return [*lines, ""]


def _single_faults(setup: Setup) -> list[str]:
    """Write the map of which cell must not fail, unless it is there, for the first seed; return its
    part."""
    from adaptfault.evaluation.sensitivity import analyse

    summary = setup.folder / "single_faults.txt"
    if not summary.exists():
        setup.say("breaking every cell and wire in turn")
        bench = Bench(setup, setup.settings.seeds[0])
        chosen = np.random.default_rng(0).permutation(len(bench.test))[: setup.settings.single]
        result = analyse(bench.base, bench.test.select(chosen), progress=setup.progress)
        names = [
            f"{what}_at_{v:g}" for what in ("accuracy_lost", "gradient") for v in result.values
        ]
        columns = np.column_stack([*result.accuracy_lost, *result.gradient])
        lines = [
            ",".join([str(i), *(f"{number:.5f}" for number in row)])
            for i, row in enumerate(columns)
        ]
        _write(
            setup.folder,
            "single_faults",
            result.plot(),
            "\n".join([",".join(["cell", *names]), *lines, ""]),
        )
        atomic_write(summary, str(result).encode())
    title = "Which cell must not fail"
    return [
        f"## {title}",
        "",
        f"![{title}](single_faults.png)",
        "",
        "```",
        summary.read_text(),
        "```",
        "",
    ]


def _write(folder: Path, name: str, picture: Figure, csv: str) -> None:
    image = io.BytesIO()
    picture.savefig(image, format="png", dpi=110)
    atomic_write(folder / f"{name}.png", image.getvalue())
    atomic_write(folder / f"{name}.csv", csv.encode())
