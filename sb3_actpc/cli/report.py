"""``sb3-actpc report``: what a comparison has come to."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the sub-command.

    :param subparsers: where to add it
    """
    parser = subparsers.add_parser(
        "report",
        help="tables and figures of a comparison",
        description="Write report.md, report.html, results.csv and figures about the finished runs of a comparison. Trains "
        "nothing; can be given while the comparison goes on.",
    )
    parser.add_argument("folder", metavar="DIR", help="folder of sb3-actpc compare")


def run(args: argparse.Namespace) -> int:
    """Write the report.

    :param args: parsed arguments
    :return: exit code: 0, or 1 when an ablation has changed not one action, which is an error of the agent's
    :raises FileNotFoundError: when the folder holds no runs
    :raises OSError: when a file cannot be written
    """
    from sb3_actpc.experiments.report.ablations import without_effect
    from sb3_actpc.experiments.report.build import write_report
    from sb3_actpc.experiments.report.results import group_runs, load_runs

    folder = Path(args.folder)
    for path in write_report(folder):
        print(path)
    groups = group_runs(load_runs(folder))
    idle = {
        task: without_effect([group for group in groups if group.task == task]) for task in {group.task for group in groups}
    }
    for task, names in sorted(idle.items()):
        if names:
            print(
                f"sb3-actpc: error: {task}: not one action changed in {', '.join(names)}: the part does nothing",
                file=sys.stderr,
            )
    return 1 if any(idle.values()) else 0
