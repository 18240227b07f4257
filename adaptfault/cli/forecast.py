"""adaptfault forecast: the accuracy to expect after a repair, for a fault set or for the worst
faults of the array."""

from __future__ import annotations

import argparse

from adaptfault.cli.adapt import open_adapter
from adaptfault.cli.options import (
    Commands,
    add_device,
    add_recordings,
    add_trust,
    command,
    device,
    emit,
    fault_set,
    say,
)
from adaptfault.cli.paths import Read, Stated, Written

_EXAMPLE = """  adaptfault forecast robot.bundle --worst --picture worst.png
      which wire, which two wires and which pad would cost most accuracy after a repair
  adaptfault forecast model grasps/ --faults diagnosis.json
  adaptfault forecast robot.bundle --faults 3,17 --classes"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = command(
        commands,
        "forecast",
        "forecast the accuracy after a repair, before anything breaks",
        _EXAMPLE,
    )
    parser.add_argument(
        "model",
        type=Read,
        metavar="MODEL",
        help="folder written by adaptfault train or adapt --keep, or a bundle",
    )
    add_recordings(parser, least=0, targets=True)
    parser.add_argument(
        "--faults", type=Stated, metavar="F", help="a diagnosis (JSON), or cell indices as 3,17,200"
    )
    parser.add_argument(
        "--new",
        type=float,
        metavar="N",
        help=(
            "with --faults: number of new recordings that the intervals are for (default: as many"
            " as validation has; inf: the expected accuracy itself)"
        ),
    )
    parser.add_argument(
        "--classes",
        action="store_true",
        help="with --faults: the recall of each class as well, and what it is confused with",
    )
    parser.add_argument(
        "--worst",
        action="store_true",
        help="forecast each wire, each pad and pairs of the worst wires; lists the worst",
    )
    parser.add_argument(
        "--among",
        type=int,
        default=5,
        metavar="N",
        help="forecast all pairs of the N worst wires (default 5)",
    )
    parser.add_argument(
        "--picture", type=Written, metavar="PNG", help="with --worst: a map of what each wire costs"
    )
    add_device(parser)
    add_trust(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Forecast."""
    if (args.faults is None) == (not args.worst):
        raise ValueError("give --faults F, or --worst")
    if args.picture is not None and not args.worst:
        raise ValueError("--picture needs --worst: it is a map of all wires")
    if args.new is not None and args.worst:
        raise ValueError("--new needs --faults")
    if args.classes and args.worst:
        raise ValueError("--classes needs --faults")
    adapter = open_adapter(args).to(device(args))
    if not args.worst:
        forecast = adapter.forecast(fault_set(args.faults, adapter.layout), recordings=args.new)
        text = str(forecast)
        if args.classes:
            text += f"\nclasses at the best measured stage:\n{forecast.by_class(_names(args))}"
        emit(args, forecast.to_dict(), text)
        return 0
    from adaptfault.adaptation.worst import worst_faults

    worst = worst_faults(adapter, among=args.among, say=lambda text: say(args, text))
    if args.picture is not None:
        from adaptfault.data.atomic import atomic_figure

        atomic_figure(args.picture, worst.plot(), dpi=120)
    emit(args, worst.to_dict(), str(worst))
    return 0


def _names(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the names of the classes, where the model is stored with names."""
    from adaptfault.cli.trained_model import open_bundle
    from adaptfault.models.store import SCHEMA, read_manifest, schema_of

    bundle = open_bundle(args, args.model)
    if bundle is not None:
        return bundle.class_names
    if schema_of(args.model) != SCHEMA:
        return ()
    return tuple(read_manifest(args.model, SCHEMA)["class_names"])
