"""The command ``sb3-actpc``. Sub-commands import what they need when they run, so that ``--help`` is quick."""

import argparse
import importlib
import os
import pkgutil
import sys
from collections.abc import Iterable, Sequence
from typing import Any

from sb3_actpc import __version__


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, by default that of the process. The exit code is 0; 1 where runs failed or nothing is to be
    reported; 2 for a mistake of the user's (one line on stderr says which); 75 where a run was stopped and can go on; 130 when
    interrupted."""
    args = build_parser().parse_args(argv)
    try:
        return int(importlib.import_module(f"{__name__}.{args.command}").run(args))
    except KeyboardInterrupt:
        print("sb3-actpc: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # as with ``| head``: whoever read has read enough, and the interpreter flushes once more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        import gymnasium as gym

        if args.debug or not isinstance(error, (ValueError, OSError, ImportError, gym.error.Error)):
            raise
        print(f"sb3-actpc: error: {' '.join(str(error).split()) or type(error).__name__}", file=sys.stderr)
        return 2


def build_parser() -> argparse.ArgumentParser:
    """The parser with all its sub-commands: the modules of this package, whose names are then its ``command``. Each has
    ``add_parser(subparsers)`` and ``run(args)``, which returns the exit code."""
    parser = argparse.ArgumentParser(prog="sb3-actpc", description="Active predictive coding for Stable-Baselines3.")
    parser.add_argument("--version", action="version", version=f"sb3-actpc {__version__}")
    parser.add_argument("--debug", action="store_true", help="show where an error came from")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}").add_parser(subparsers)
    return parser


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Options that ``train`` and ``compare`` share, keys of a run and ``--no-progress``; what is not given is None."""
    add = parser.add_argument
    add("--steps", metavar="N", help="environment steps of a run, such as 1e5 (default: the preset's)")
    add("--demonstrations", metavar="FILE", help="file, id of a Minari dataset, or 'none' (default: the package's)")
    add("--gym-packages", nargs="+", metavar="MODULE", help="import these, also from this folder: they register environments")
    add("--eval-freq", metavar="N", help="steps between evaluations (default: a tenth of all)")
    add("--eval-episodes", type=int, metavar="N", help="episodes in each (default: 10)")
    add("--checkpoint-freq", metavar="N", help="steps between checkpoints, 0 for none (default: as --eval-freq)")
    add("--device", help="torch device (default: cpu)")
    add("--threads", type=int, metavar="N", help="torch threads of a run (default: 1)")
    add("--no-progress", action="store_true", help="no progress bars")


def count(text: str) -> int:
    """A whole number of at least 1, as argparse asks for it."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} must be at least 1")
    return number


def given(args: argparse.Namespace, keys: Iterable[str]) -> dict[str, Any]:
    """Those of the keys that are options here and that the user gave."""
    return {name: getattr(args, name) for name in keys if getattr(args, name, None) is not None}
