"""``sb3-actpc train``: train an agent and watch it being evaluated."""

from __future__ import annotations

import argparse


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the sub-command.

    :param subparsers: where to add it
    """
    parser = subparsers.add_parser(
        "train",
        help="train an agent on a sparse-reward task",
        description="Train an agent; evaluate it on the dense task as it goes; write the model, CSV files and a plot.",
    )
    parser.add_argument("--env", required=True, help="Gymnasium id, such as SparseHalfCheetah-v5")
    parser.add_argument("--algo", default="actpc", help="algorithm (default: %(default)s)")
    parser.add_argument("--preset", metavar="NAME", help="file of hyperparams/, or a path ending in .yml (default: ALGO)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="replace a setting of the preset")
    parser.add_argument("--env-kwarg", action="append", default=[], metavar="KEY=VALUE", help="keyword of the environment")
    parser.add_argument(
        "--demonstrations", default="shipped", metavar="FILE", help="file, or 'none' (default: the one in the package)"
    )
    parser.add_argument("--steps", type=int, metavar="N", help="environment steps (default: the preset's)")
    parser.add_argument("--seed", type=int, default=0, help="seed (default: %(default)s)")
    parser.add_argument("--eval-freq", type=int, metavar="N", help="steps between evaluations (default: a tenth of all)")
    parser.add_argument("--eval-episodes", type=int, default=5, metavar="N", help="episodes in each (default: %(default)s)")
    parser.add_argument("--output", metavar="DIR", help="run folder (default: runs/ENV/ALGO_PRESET_seedSEED)")
    parser.add_argument("--device", default="cpu", help="torch device (default: %(default)s)")
    parser.add_argument("--n-envs", type=int, metavar="N", help="parallel environments (default: the preset's, or 1)")
    parser.add_argument("--threads", type=int, default=1, help="torch threads (default: %(default)s)")
    parser.add_argument("--no-progress", action="store_true", help="no progress bar")


def run(args: argparse.Namespace) -> int:
    """Train, then print the table.

    :param args: parsed arguments
    :return: exit code
    :raises ValueError: when an argument or a setting is wrong
    :raises FileNotFoundError: when the preset or the demonstrations do not exist
    """
    from sb3_actpc.training import RunConfig, train_run
    from sb3_actpc.training.config import parse_assignments
    from sb3_actpc.training.report import result_table

    config = RunConfig(
        env=args.env,
        algo=args.algo,
        preset=args.preset,
        n_timesteps=args.steps,
        seed=args.seed,
        demonstrations=args.demonstrations,
        overrides=parse_assignments(args.set),
        env_kwargs=parse_assignments(args.env_kwarg),
        eval_freq=args.eval_freq,
        eval_episodes=args.eval_episodes,
        output=args.output,
        device=args.device,
        n_envs=args.n_envs,
        threads=args.threads,
        progress=not args.no_progress,
    )
    result = train_run(config, report=lambda line: print(line, flush=True))
    print(f"\n{result_table(result)}\n\nwritten to {result['folder']}: model.zip, evaluations.csv, learning_curve.png")
    return 0
