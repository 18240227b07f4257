"""The options --take, --leave and --inject of commands that write recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptfault.cli.command import Command, option
from adaptfault.cli.inject_option import INJECT_HELP, parse_faults

if TYPE_CHECKING:
    from adaptfault.data.recordings import Recordings


class Selecting(Command):
    """The options."""

    take: str | None = option("only these recordings, as a Python slice: 0:100, ::5", "SLICE")
    leave: str | None = option("all recordings but these", "SLICE")
    inject: list[str] = option(INJECT_HELP, "FAULT", action="append", default=[])
    fault_seed: int = option("random seed of faults (default 0)", "N", default=0)


def select(args: Selecting, recordings: Recordings) -> Recordings:
    """Return the selected recordings, with the faults injected.

    Raises:
        ValueError: a slice of another form, or one that selects nothing; a fault that the layout
            does not have.
    """
    import numpy as np

    from adaptfault.data.recordings import Recordings
    from diagnostics import inject

    everything = np.arange(len(recordings))
    chosen = everything if args.take is None else everything[_slice("--take", args.take)]
    if args.leave is not None:
        chosen = np.setdiff1d(chosen, everything[_slice("--leave", args.leave)])
    if not chosen.size:
        raise ValueError(
            f"--take {args.take} --leave {args.leave}: none of {len(recordings)} recordings is"
            " selected"
        )
    selected = recordings.select(chosen)
    faults = parse_faults(args.inject, recordings.layout, np.random.default_rng(args.fault_seed))
    if not faults:
        return selected
    seeds = (args.fault_seed + int(i) for i in chosen)
    layout = recordings.layout
    frames = [
        inject(one, faults, layout, seed=seed) for one, seed in zip(selected, seeds, strict=True)
    ]
    return Recordings(
        tuple(one.astype(np.float32) for one in frames),
        layout,
        selected.labels,
        selected.class_names,
        selected.names,
    )


def _slice(option: str, text: str) -> slice:
    try:
        numbers = [int(part) if part.strip() else None for part in text.split(":")]
    except ValueError:
        numbers = []
    if not 1 < len(numbers) < 4:
        raise ValueError(f"{option} {text}: expected a Python slice, as 0:100 or ::5")
    return slice(*numbers)
