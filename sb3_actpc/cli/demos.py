"""``sb3-actpc demos``: make and look at demonstration files."""

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_actpc.envs import SPARSE_MUJOCO_IDS

if TYPE_CHECKING:
    from sb3_actpc.common.demonstrations import Demonstrations

Subparsers = Any  # argparse's own type is private


def add_parser(subparsers: Subparsers) -> None:
    """Add ``demos`` with its sub-commands ``collect`` and ``info``.

    :param subparsers: what ``ArgumentParser.add_subparsers()`` returned
    """
    parser = subparsers.add_parser("demos", help="make or look at demonstration files")
    commands = parser.add_subparsers(dest="demos_command", required=True, metavar="{collect,info}")

    collect = commands.add_parser(
        "collect",
        help="train an expert on the dense task and record its successful episodes of the sparse one",
        description="Train an expert on the dense task and record its successful episodes of the sparse one. "
        "A stopped training goes on from its newest checkpoint when the same command is given again.",
    )
    collect.add_argument("--env", required=True, metavar="ID", help=f"one of {', '.join(SPARSE_MUJOCO_IDS)}")
    collect.add_argument("--algo", default="ppo", metavar="{ppo,td3,sac}", help="the expert's algorithm (default: ppo)")
    collect.add_argument("--steps", type=int, help="the expert's training steps (default: 2000 full episodes)")
    collect.add_argument("--target-return", type=float, help="stop training at this mean dense return (default: never)")
    collect.add_argument("--episodes", type=int, default=20, help="successful episodes to record (default: 20)")
    collect.add_argument("--max-tries", type=int, help="episodes to play at most (default: ten times --episodes)")
    collect.add_argument("--output", type=Path, metavar="FILE", help="file to write (default: sparse_<task>.npz)")
    collect.add_argument("--seed", type=int, default=0, help="seed of the expert and of the recording (default: 0)")
    collect.add_argument(
        "--work-dir", type=Path, metavar="DIR", help="the expert's checkpoints (default: experts/<task>_<algo>_<seed>)"
    )
    collect.add_argument("--save-every", type=int, default=50_000, help="steps between two checkpoints (default: 50000)")
    collect.add_argument("--n-envs", type=int, default=1, help="parallel environments of the training (default: 1)")

    info = commands.add_parser("info", help="print what a demonstration file holds")
    info.add_argument("file", type=Path, metavar="FILE")


def run(args: argparse.Namespace) -> int:
    """Run the sub-command chosen by the arguments of :func:`add_parser`.

    :return: the exit code, 0
    :raises ValueError: for an unknown task or algorithm, or an expert that does not succeed often enough
    :raises FileNotFoundError: if the file to look at does not exist
    """
    return _collect(args) if args.demos_command == "collect" else _info(args)


def _report(line: str) -> None:
    print(line, flush=True)


def _collect(args: argparse.Namespace) -> int:
    """Train, roll out, save."""
    from sb3_actpc.experts import ExpertTraining, collect_demonstrations, default_expert_steps, train_expert

    training = ExpertTraining(args.env, args.algo, args.seed, args.n_envs)
    n_steps = default_expert_steps(args.env) if args.steps is None else args.steps
    work_dir = args.work_dir or Path("experts") / f"{training.dense_id}_{args.algo}_{args.seed}"
    output = args.output or Path(args.env.split("-")[0].lower().replace("sparse", "sparse_") + ".npz")
    _report(f"expert: {args.algo} on {training.dense_id} for {n_steps} steps; checkpoints in {work_dir}")
    expert = train_expert(training, n_steps, work_dir, args.save_every, args.target_return, _report)
    _report(f"expert of {expert.n_steps} steps: mean dense return {expert.mean_return:.1f}")
    metadata = {"command": command_line(args), "algorithm": args.algo}
    demonstrations = collect_demonstrations(expert, args.env, args.episodes, args.seed, args.max_tries, metadata, _report)
    demonstrations.save(output)
    _report_returns(demonstrations)
    _report(f"wrote {output} ({output.stat().st_size / 1e6:.2f} MB)")
    return 0


def command_line(args: argparse.Namespace) -> str:
    """The command that repeats a collection, without the paths of the machine it ran on."""
    words = ["sb3-actpc", "demos", "collect"]
    for option in ("env", "algo", "steps", "target_return", "episodes", "max_tries", "seed", "save_every", "n_envs"):
        value = getattr(args, option)
        if value is not None:
            words += ["--" + option.replace("_", "-"), str(value)]
    return shlex.join(words)


def _info(args: argparse.Namespace) -> int:
    """Print what a file holds."""
    from sb3_actpc.common.demonstrations import Demonstrations

    if not args.file.is_file():
        raise FileNotFoundError(f"no demonstration file {args.file}: make one with `sb3-actpc demos collect`")
    demonstrations = Demonstrations.load(args.file)
    _report(f"env: {demonstrations.env_id}")
    _report(f"episodes: {demonstrations.n_episodes}")
    _report(f"transitions: {len(demonstrations.rewards)}")
    _report(f"observations: {demonstrations.observations.shape[1:]}, actions: {demonstrations.actions.shape[1:]}")
    _report_returns(demonstrations)
    for key, value in demonstrations.metadata.items():
        _report(f"{key}: {value}")
    return 0


def _report_returns(demonstrations: "Demonstrations") -> None:
    for name, returns in (("sparse", demonstrations.episode_returns), ("dense", demonstrations.dense_returns)):
        if returns is not None:
            _report(f"{name} return: mean {np.mean(returns):.1f}, min {np.min(returns):.1f}, max {np.max(returns):.1f}")
