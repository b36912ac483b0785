"""``sb3-actpc report``: tables and figures of a comparison."""

import argparse
from pathlib import Path


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    about = "write tables and figures of the finished runs of a comparison, also while it runs"
    parser = subparsers.add_parser("report", help=about, description=about)
    add = parser.add_argument
    add("folder", type=Path, metavar="DIR", help="folder of sb3-actpc compare, or one with results.csv and curves.csv.gz")
    add("--output", type=Path, metavar="DIR", help="folder for the files (default: the same)")
    add("--steps", type=int, nargs="+", metavar="N", help="of the evaluations in the tables (10000 25000 50000)")


def run(args: argparse.Namespace) -> int:
    """Write the report."""
    from sb3_actpc.experiments.report.tables import CHOSEN_STEPS, write_report

    for path in write_report(args.folder, args.output, args.steps or CHOSEN_STEPS):
        print(path)
    return 0
