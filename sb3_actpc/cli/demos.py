"""``sb3-actpc demos``: make, fetch, convert and look at demonstration files."""

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_actpc.envs import ROBOSUITE_IDS, SPARSE_IDS

if TYPE_CHECKING:
    from sb3_actpc.demonstrations.dataset import Demonstrations

Subparsers = Any  # argparse's own type is private

HDF5_SUFFIXES = (".hdf5", ".h5")
MIXED = "mixed"


def add_parser(subparsers: Subparsers) -> None:
    """Add ``demos`` with its sub-commands ``collect``, ``convert``, ``download`` and ``info``.

    :param subparsers: what ``ArgumentParser.add_subparsers()`` returned
    """
    parser = subparsers.add_parser("demos", help="make or look at demonstration files")
    commands = parser.add_subparsers(dest="demos_command", required=True, metavar="{collect,convert,download,info}")
    _add_collect(commands)
    _add_convert(commands)
    _add_download(commands)
    info = commands.add_parser("info", help="print what a demonstration file holds")
    info.add_argument("file", type=Path, metavar="FILE")


def _add_collect(commands: Subparsers) -> None:
    collect = commands.add_parser(
        "collect",
        help="record an expert's successful episodes of a sparse task",
        description="MuJoCo tasks: train an expert on the dense task and record its successful episodes of the sparse one. "
        "A stopped training goes on from its newest checkpoint when the same command is given again. "
        "Robosuite tasks: record scripted operators (--expert scripted).",
    )
    collect.add_argument("--env", required=True, metavar="ID", help=f"one of {', '.join(SPARSE_IDS)}")
    collect.add_argument(
        "--expert", metavar="{trained,scripted}", help="who demonstrates (default: scripted for robosuite tasks, else trained)"
    )
    collect.add_argument(
        "--proficiency",
        metavar="P",
        help="of scripted operators, from 0 to 1, or 'mixed' for six operators of three levels (default: 1)",
    )
    collect.add_argument("--obs", metavar="LAYOUT", help="of a robosuite task, paper or robomimic (default: paper)")
    collect.add_argument("--algo", default="ppo", metavar="{ppo,td3,sac}", help="the expert's algorithm (default: ppo)")
    collect.add_argument("--steps", type=int, help="the expert's training steps (default: 2000 full episodes)")
    collect.add_argument("--target-return", type=float, help="stop training at this mean dense return (default: never)")
    collect.add_argument(
        "--episodes", type=int, help="successful episodes to record (default: 20; scripted 50, or 6 times 50 when mixed)"
    )
    collect.add_argument("--max-tries", type=int, help="episodes to play at most (default: ten times --episodes)")
    collect.add_argument("--output", type=Path, metavar="FILE", help="file to write (default: sparse_<task>.npz)")
    collect.add_argument("--seed", type=int, default=0, help="seed of the expert and of the recording (default: 0)")
    collect.add_argument(
        "--work-dir", type=Path, metavar="DIR", help="the expert's checkpoints (default: experts/<task>_<algo>_<seed>)"
    )
    collect.add_argument("--save-every", type=int, default=50_000, help="steps between two checkpoints (default: 50000)")
    collect.add_argument("--n-envs", type=int, default=1, help="parallel environments of the training (default: 1)")


def _add_convert(commands: Subparsers) -> None:
    convert = commands.add_parser(
        "convert",
        help="HDF5 of robomimic or robosuite to .npz, or .npz to robomimic's HDF5",
        description="Reads robomimic's low-dimensional files and robosuite's demo.hdf5 (its states are replayed), "
        "or writes a .npz file as a robomimic file.",
    )
    convert.add_argument("file", type=Path, metavar="FILE", help=".hdf5 or .npz")
    convert.add_argument("--env", metavar="ID", help=f"task of an .hdf5 file, one of {', '.join(ROBOSUITE_IDS)}")
    convert.add_argument("--obs", default="paper", metavar="LAYOUT", help="observations, paper or robomimic (default: paper)")
    convert.add_argument("--filter-key", metavar="KEY", help="only robomimic's mask/KEY, such as better or 20_percent")
    convert.add_argument("--output", type=Path, metavar="FILE", help="file to write (default: FILE with the other suffix)")


def _add_download(commands: Subparsers) -> None:
    download = commands.add_parser(
        "download",
        help="fetch robomimic's human demonstrations and convert them",
        description="Fetches robomimic's file of low-dimensional observations (MIT licence, 30 to 130 MB), checks it and "
        "converts it. Without a network: download the address it names elsewhere, and use `sb3-actpc demos convert`.",
    )
    download.add_argument("--env", required=True, metavar="ID", help=f"one of {', '.join(ROBOSUITE_IDS)}")
    download.add_argument(
        "--kind", default="mh", metavar="{mh,ph}", help="mh: 300 by six humans of three levels (default); ph: 200 by one"
    )
    download.add_argument("--url", help="another address of such a file")
    download.add_argument("--obs", default="paper", metavar="LAYOUT", help="observations, paper or robomimic (default: paper)")
    download.add_argument("--output", type=Path, metavar="FILE", help=".npz file to write (default: <task>_<kind>.npz)")


def run(args: argparse.Namespace) -> int:
    """Run the sub-command chosen by the arguments of :func:`add_parser`.

    :return: the exit code, 0
    :raises ValueError: for an unknown task, algorithm or expert, an expert that does not succeed often enough, or a bad file
    :raises FileNotFoundError: if the file to look at or convert does not exist
    :raises OSError: if a file cannot be fetched
    :raises ImportError: if robosuite or h5py is needed and not installed
    """
    commands = {"collect": _collect, "convert": _convert, "download": _download, "info": _info}
    return commands[args.demos_command](args)


def _report(line: str) -> None:
    print(line, flush=True)


def _collect(args: argparse.Namespace) -> int:
    """Record and save."""
    expert = args.expert or ("scripted" if args.env in ROBOSUITE_IDS else "trained")
    if expert not in ("trained", "scripted"):
        raise ValueError(f"--expert {expert} is unknown: choose trained or scripted")
    if expert == "trained" and (args.proficiency is not None or args.obs is not None):
        raise ValueError("--proficiency and --obs are for scripted operators of robosuite tasks: leave them out")
    output = args.output or Path(args.env.split("-")[0].lower().replace("sparse", "sparse_") + ".npz")
    demonstrations = _collect_scripted(args) if expert == "scripted" else _collect_trained(args)
    demonstrations.save(output)
    _report_returns(demonstrations)
    _report(f"wrote {output} ({output.stat().st_size / 1e6:.2f} MB)")
    return 0


def _collect_scripted(args: argparse.Namespace) -> "Demonstrations":
    from sb3_actpc.demonstrations import MIXED_DEMONSTRATORS, collect_scripted

    proficiency = _proficiency(args.proficiency)
    n_episodes = args.episodes or (50 * len(MIXED_DEMONSTRATORS) if proficiency == MIXED else 50)
    words = {"env": args.env, "expert": "scripted", "proficiency": proficiency, "obs": args.obs, "episodes": n_episodes}
    metadata = {"command": _command({**words, "max_tries": args.max_tries, "seed": args.seed})}
    _report(f"scripted operators of proficiency {proficiency} in {args.env}")
    return collect_scripted(
        args.env, proficiency, n_episodes, args.seed, args.max_tries, metadata, _report, obs=args.obs or "paper"
    )


def _proficiency(text: str | None) -> float | str:
    if text == MIXED:
        return MIXED
    try:
        return 1.0 if text is None else float(text)
    except ValueError:
        raise ValueError(f"--proficiency {text} must be a number from 0 (clumsy) to 1 (sure), or {MIXED}") from None


def _collect_trained(args: argparse.Namespace) -> "Demonstrations":
    """Train and roll out."""
    from sb3_actpc.demonstrations.experts import ExpertTraining, collect_demonstrations, default_expert_steps, train_expert

    n_episodes = 20 if args.episodes is None else args.episodes
    training = ExpertTraining(args.env, args.algo, args.seed, args.n_envs)
    n_steps = default_expert_steps(args.env) if args.steps is None else args.steps
    work_dir = args.work_dir or Path("experts") / f"{training.dense_id}_{args.algo}_{args.seed}"
    _report(f"expert: {args.algo} on {training.dense_id} for {n_steps} steps; checkpoints in {work_dir}")
    expert = train_expert(training, n_steps, work_dir, args.save_every, args.target_return, _report)
    _report(f"expert of {expert.n_steps} steps: mean dense return {expert.mean_return:.1f}")
    metadata = {"command": command_line(args), "algorithm": args.algo}
    return collect_demonstrations(expert, args.env, n_episodes, args.seed, args.max_tries, metadata, _report)


def command_line(args: argparse.Namespace) -> str:
    """The command that repeats a collection from a trained expert, without the paths of the machine it ran on."""
    options = ("env", "algo", "steps", "target_return", "episodes", "max_tries", "seed", "save_every", "n_envs")
    return _command({option: getattr(args, option) for option in options})


def _command(options: dict[str, Any]) -> str:
    words = ["sb3-actpc", "demos", "collect"]
    for option, value in options.items():
        if value is not None:
            words += ["--" + option.replace("_", "-"), str(value)]
    return shlex.join(words)


def _convert(args: argparse.Namespace) -> int:
    """Between .npz and HDF5."""
    from sb3_actpc.demonstrations import write_robomimic
    from sb3_actpc.demonstrations.dataset import Demonstrations

    if args.file.suffix == ".npz":
        output = args.output or args.file.with_suffix(".hdf5")
        if output.suffix not in HDF5_SUFFIXES:
            raise ValueError(f"--output {output} must end in {' or '.join(HDF5_SUFFIXES)}: it will be a robomimic file")
        demonstrations = Demonstrations.load(args.file)
        write_robomimic(demonstrations, output)
    else:
        output = args.output or args.file.with_suffix(".npz")
        demonstrations = _read_hdf5(args)
        demonstrations.save(output)
    _report_size(demonstrations)
    _report(f"wrote {output} ({output.stat().st_size / 1e6:.2f} MB)")
    return 0


def _read_hdf5(args: argparse.Namespace) -> "Demonstrations":
    from sb3_actpc.demonstrations import read_robomimic, read_robosuite
    from sb3_actpc.demonstrations.hdf5 import open_hdf5

    if args.env is None:
        raise ValueError(f"--env is needed to convert {args.file}: give one of {', '.join(ROBOSUITE_IDS)}")
    with open_hdf5(args.file) as data:
        is_robomimic = "env_args" in data.attrs
    if is_robomimic:
        return read_robomimic(args.file, args.env, args.obs, args.filter_key)
    if args.filter_key is not None:
        raise ValueError(f"--filter-key {args.filter_key}: {args.file} is not a robomimic file and has no masks; leave it out")
    return read_robosuite(args.file, args.env, args.obs)


def _download(args: argparse.Namespace) -> int:
    """Fetch, check, convert."""
    from sb3_actpc.demonstrations.download import download_robomimic, robomimic_url

    url = args.url or robomimic_url(args.env, args.kind)
    output = args.output or Path(f"{args.env.split('-')[0].lower().replace('sparse', 'sparse_')}_{args.kind}.npz")
    demonstrations = download_robomimic(args.env, output.with_suffix(".hdf5"), url, args.obs, _report)
    demonstrations.save(output)
    _report_size(demonstrations)
    _report(f"wrote {output} ({output.stat().st_size / 1e6:.2f} MB)")
    return 0


def _info(args: argparse.Namespace) -> int:
    """Print what a file holds."""
    from sb3_actpc.demonstrations.dataset import Demonstrations

    if not args.file.is_file():
        raise FileNotFoundError(f"no demonstration file {args.file}: make one with `sb3-actpc demos collect`")
    demonstrations = Demonstrations.load(args.file)
    _report(f"env: {demonstrations.env_id}")
    _report_size(demonstrations)
    _report(f"observations: {demonstrations.observations.shape[1:]}, actions: {demonstrations.actions.shape[1:]}")
    _report_returns(demonstrations)
    for key, value in demonstrations.metadata.items():
        _report(f"{key}: {value}")
    return 0


def _report_size(demonstrations: "Demonstrations") -> None:
    _report(f"episodes: {demonstrations.n_episodes}")
    _report(f"transitions: {len(demonstrations.rewards)}")


def _report_returns(demonstrations: "Demonstrations") -> None:
    for name, returns in (("sparse", demonstrations.episode_returns), ("dense", demonstrations.dense_returns)):
        if returns is not None:
            _report(f"{name} return: mean {np.mean(returns):.1f}, min {np.min(returns):.1f}, max {np.max(returns):.1f}")
