"""``sb3-actpc zoo``: rl-zoo3's command line, with this package's algorithms, settings and tasks."""

from __future__ import annotations

import argparse


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the sub-command.

    :param subparsers: where to add it
    """
    parser = subparsers.add_parser(
        "zoo",
        help="train, enjoy, optimize and plot with rl-zoo3",
        description="rl-zoo3's scripts with this package's algorithms, settings and tasks; every option of theirs works "
        "(sb3-actpc zoo train --help). rl-zoo3 unpickles models and evaluates settings: use it on runs that you trust.",
        add_help=False,
    )
    parser.add_argument("arguments", nargs=argparse.REMAINDER, metavar="{train,enjoy,optimize,plot,...} ...")


def run(args: argparse.Namespace) -> int:
    """Hand over to rl-zoo3.

    :param args: parsed arguments
    :return: exit code
    :raises ValueError: when there is no such command, or a setting is unknown or has a wrong value
    :raises ImportError: when rl-zoo3 is not installed
    :raises FileNotFoundError: when the preset, the demonstrations or the runs do not exist
    """
    from sb3_actpc.experiments.zoo import main

    return main(args.arguments)
