"""``sb3-actpc report``: tables and figures of a comparison."""

import argparse
from pathlib import Path


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = subparsers.add_parser(
        "report",
        help="tables and figures of a comparison",
        description="Write results.csv, curves.csv.gz, report.md and figures from the finished runs of a comparison. Trains "
        "nothing, and can be used while the comparison runs.",
    )
    add = parser.add_argument
    add("folder", type=Path, metavar="DIR", help="folder of sb3-actpc compare, or one with results.csv and curves.csv.gz")
    add("--output", type=Path, metavar="DIR", help="folder for the files (default: the same)")
    steps = "environment steps whose evaluations the tables show (default: 10000 25000 50000)"
    add("--steps", type=int, nargs="+", default=[10_000, 25_000, 50_000], metavar="N", help=steps)
    add("--curves", nargs="+", default=[], metavar="NAME", help="variants to draw, at most six (default: the best)")


def run(args: argparse.Namespace) -> int:
    """Write the report."""
    from sb3_actpc.experiments.report.tables import write_report

    if len(args.curves) > 6:
        raise ValueError(f"--curves names {len(args.curves)} variants: give at most six")
    for path in write_report(args.folder, args.output, args.steps, args.curves):
        print(path)
    return 0
