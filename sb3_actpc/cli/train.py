"""``sb3-actpc train``: train an agent and watch it being evaluated."""

import argparse
import shlex
import sys
from functools import partial
from pathlib import Path

from sb3_actpc.cli import add_run_options, given


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    about = "train an agent, evaluate it as it goes, and write the model, CSV files and a plot"
    parser = subparsers.add_parser("train", help=about, description=about)
    task = parser.add_mutually_exclusive_group(required=True)
    task.add_argument("--env", help="Gymnasium id, such as SparseHalfCheetah-v5")
    task.add_argument(
        "--resume",
        metavar="DIR",
        help="go on with the run in this folder; a finished one with --steps MORE, if its "
        "demonstrations have moved with --demonstrations",
    )
    add = parser.add_argument
    add("--algo", help="algorithm, or MODULE:CLASS of your own (default: actpc)")
    add("--preset", metavar="NAME", help="file of hyperparams/, or a path ending in .yml (default: ALGO)")
    add("--set", action="append", metavar="KEY=VALUE", help="a setting, such as gamma=0.98 or policy_kwargs.net_arch=[64,64]")
    add("--env-kwarg", action="append", metavar="KEY=VALUE", help="keyword of the environment")
    add("--seed", type=int, help="seed (default: 0)")
    add("--output", metavar="DIR", help="run folder (default: runs/ENV/ALGO_PRESET_seedSEED)")
    add("--n-envs", type=int, metavar="N", help="parallel environments (default: the preset's, or 1)")
    add_run_options(parser)


def run(args: argparse.Namespace) -> int:
    """Train, then print the table; 75 when a signal stopped the run after everything was saved."""
    from sb3_actpc.checkpoints import EXIT_STOPPED, TrainingStopped
    from sb3_actpc.experiments.runs import Run, resume_run, train_run
    from sb3_actpc.experiments.runs.presets import parse_assignments
    from sb3_actpc.experiments.runs.run import result_table

    report = partial(print, flush=True)
    try:
        if args.resume is None:
            chosen = given(args, Run.known_keys())
            chosen["settings"] = parse_assignments(args.set or ())
            chosen["env_kwargs"] = parse_assignments(args.env_kwarg or ())
            result = train_run(Run(**chosen, progress=not args.no_progress), report)
        else:
            others = set(vars(args)) - {"resume", "steps", "demonstrations", "no_progress", "command", "debug"}
            for name in sorted(others):
                if getattr(args, name) is not None:
                    raise ValueError(f"--{name.replace('_', '-')} cannot be given with --resume: leave it out")
            more_steps = Run(**given(args, ["steps"])).n_timesteps or 0
            options = {"more_steps": more_steps, "demonstrations": args.demonstrations}
            result = resume_run(Path(args.resume), report, not args.no_progress, **options)
    except TrainingStopped as stop:
        run_folder = Path(stop.checkpoint).parents[1]
        print(f"sb3-actpc: {stop}; go on with: sb3-actpc train --resume {shlex.quote(str(run_folder))}", file=sys.stderr)
        return EXIT_STOPPED
    written = "model.zip, progress.csv, episodes.csv, learning_curve.png"
    print(f"\n{result_table(result)}\n\nwritten to {result['folder']}: {written}")
    return 0
