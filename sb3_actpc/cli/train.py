"""``sb3-actpc train``: train an agent and watch it being evaluated."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_actpc.cli import steps

if TYPE_CHECKING:
    from sb3_actpc.experiments.runs import Run


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the sub-command."""
    parser = subparsers.add_parser(
        "train",
        help="train an agent on a sparse-reward task",
        description="Train an agent; evaluate it on the dense task as it goes; write the model, CSV files and a plot.",
    )
    task = parser.add_mutually_exclusive_group(required=True)
    task.add_argument("--env", help="Gymnasium id, such as SparseHalfCheetah-v5")
    task.add_argument(
        "--resume",
        metavar="DIR",
        help="go on with the run in this folder, with its settings; a finished one with --steps MORE",
    )
    parser.add_argument("--algo", default="actpc", help="algorithm (default: %(default)s)")
    parser.add_argument("--preset", metavar="NAME", help="file of hyperparams/, or a path ending in .yml (default: ALGO)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="replace a setting of the preset, such as gamma=0.98 or policy_kwargs.net_arch=[64,64]",
    )
    parser.add_argument("--env-kwarg", action="append", default=[], metavar="KEY=VALUE", help="keyword of the environment")
    parser.add_argument(
        "--demonstrations",
        default="shipped",
        metavar="FILE",
        help="file, id of a Minari dataset, 'weak' (the package's weaker ones) or 'none' (default: the ones in the package)",
    )
    parser.add_argument(
        "--gym-packages", nargs="+", metavar="MODULE", help="import these, which register environments; also from this folder"
    )
    parser.add_argument("--steps", type=steps, metavar="N", help="environment steps (default: the preset's), such as 1e5")
    parser.add_argument("--seed", type=int, default=0, help="seed (default: %(default)s)")
    parser.add_argument("--eval-freq", type=steps, metavar="N", help="steps between evaluations (default: a tenth of all)")
    parser.add_argument("--eval-episodes", type=int, default=5, metavar="N", help="episodes in each (default: %(default)s)")
    parser.add_argument("--output", metavar="DIR", help="run folder (default: runs/ENV/ALGO_PRESET_seedSEED)")
    parser.add_argument("--device", default="cpu", help="torch device (default: %(default)s)")
    parser.add_argument("--n-envs", type=int, metavar="N", help="parallel environments (default: the preset's, or 1)")
    parser.add_argument("--threads", type=int, default=1, help="torch threads (default: %(default)s)")
    parser.add_argument("--no-progress", action="store_true", help="no progress bar")
    parser.add_argument(
        "--checkpoint-freq", type=steps, metavar="N", help="steps between checkpoints, 0 for none (default: as --eval-freq)"
    )
    parser.set_defaults(default_of=parser.get_default)


def run(args: argparse.Namespace) -> int:
    """Train, then print the table; 75 when a signal stopped the run after everything was saved."""
    from sb3_actpc.checkpoints import EXIT_STOPPED, TrainingStopped
    from sb3_actpc.experiments.runs import resume_run, train_run
    from sb3_actpc.experiments.runs.summary import result_table

    try:
        if args.resume is None:
            result = train_run(_run(args), report=_report)
        else:
            _check_only_resume(args)
            result = resume_run(Path(args.resume), _report, not args.no_progress, more_steps=args.steps or 0)
    except TrainingStopped as stop:
        run_folder = Path(stop.checkpoint).parents[1]
        print(f"sb3-actpc: {stop}; go on with: sb3-actpc train --resume {shlex.quote(str(run_folder))}", file=sys.stderr)
        return EXIT_STOPPED
    written = "model.zip, progress.csv, episodes.csv, learning_curve.png"
    print(f"\n{result_table(result)}\n\nwritten to {result['folder']}: {written}")
    return 0


def _report(line: str) -> None:
    print(line, flush=True)


def _check_only_resume(args: argparse.Namespace) -> None:
    """:raises ValueError: when an option is given that the run's own settings decide"""
    others = set(vars(args)) - {"resume", "steps", "no_progress", "command", "debug", "default_of"}
    given = sorted(name for name in others if getattr(args, name) != args.default_of(name))
    if given:
        option = "--" + given[0].replace("_", "-")
        raise ValueError(f"{option} cannot be given with --resume: the run goes on with its own settings, leave it out")


def _run(args: argparse.Namespace) -> Run:
    from sb3_actpc.experiments.runs import Run
    from sb3_actpc.experiments.runs.presets import parse_assignments

    names = ["env", "algo", "preset", "steps", "seed", "demonstrations", "eval_freq", "eval_episodes", "checkpoint_freq"]
    names += ["output", "device", "n_envs", "threads", "gym_packages"]
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    settings, env_kwargs = parse_assignments(args.set), parse_assignments(args.env_kwarg)
    return Run(**given, settings=settings, env_kwargs=env_kwargs, progress=not args.no_progress)
