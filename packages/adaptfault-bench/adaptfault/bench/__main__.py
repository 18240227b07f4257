"""``python -m adaptfault.bench``: make, run, score, export."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

BAD_INPUT = 3


def parser() -> argparse.ArgumentParser:
    """Return the parser."""
    parser = argparse.ArgumentParser(prog="python -m adaptfault.bench", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    make = commands.add_parser("make", help="write the logs, and their truth elsewhere")
    make.add_argument("folder", type=Path)
    make.add_argument("--truth", type=Path, metavar="FOLDER", help="default: beside the folder")
    make.add_argument("--seed", type=int, default=0)
    make.add_argument("--small", action="store_true", help="two sensors, a log of each kind")
    run = commands.add_parser("run", help="run a method; started again, it goes on")
    run.add_argument("folder", type=Path)
    method = run.add_mutually_exclusive_group(required=True)
    method.add_argument("--diagnoser", metavar="MODULE:NAME")
    method.add_argument("--repairer", metavar="MODULE:NAME")
    run.add_argument("--out", type=Path, required=True, metavar="FILE")
    score = commands.add_parser("score", help="make the page of results")
    score.add_argument("folder", type=Path)
    score.add_argument("truth", type=Path)
    score.add_argument("submissions", type=Path, nargs="+")
    score.add_argument("--page", type=Path, metavar="FILE", help="default: print it")
    export = commands.add_parser("export", help="write the logs for other benchmarks")
    export.add_argument("folder", type=Path)
    export.add_argument("truth", type=Path)
    export.add_argument("--tsb-ad", type=Path, required=True, metavar="FOLDER")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return 0, 1 where the method failed on a log, 3 for unusable input."""
    args = parser().parse_args(argv)
    try:
        return command(args)
    except (ValueError, OSError, ImportError) as error:
        print(f"adaptfault.bench {args.command}: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT


def command(args: argparse.Namespace) -> int:
    """Run a parsed command."""
    from adaptfault.bench import folder, run, score, tsb_ad
    from adaptfault.data.atomic import atomic_write

    if args.command == "make":
        size = folder.SMALL if args.small else folder.Size()
        print(folder.make(args.folder, args.truth or args.folder.parent, args.seed, size))
        return 0
    if args.command == "run":
        method = args.diagnoser or args.repairer
        missing = run.run(args.folder, method, args.out, repairs=args.repairer is not None)
        return 1 if missing else 0
    bench = folder.Bench(args.folder)
    if args.command == "export":
        bench.check()
        written = tsb_ad.export(bench, args.truth, args.tsb_ad)
        print(f"{len(written)} files in {args.tsb_ad}")
        return 0
    text = score.page(bench, args.truth, args.submissions)
    if args.page is None:
        print(text)
    else:
        atomic_write(args.page, text.encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
