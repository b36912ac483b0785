"""``sb3-actpc demos``: make, fetch, convert and look at demonstration files."""

import argparse
import re
import shlex
import sys
from collections.abc import Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

from sb3_actpc.cli import count
from sb3_actpc.envs import ROBOSUITE_IDS, SPARSE_IDS, sparse_env_id
from sb3_actpc.utils.files import folder_name

Subparsers = Any  # argparse's own type is private
OBS_HELP = "observations of the task, paper or robomimic (default: paper)"
ROBOSUITE_HELP = f"one of {', '.join(ROBOSUITE_IDS)}"
_report = partial(print, flush=True)


def add_parser(subparsers: Subparsers) -> None:
    parser = subparsers.add_parser("demos", help="make or look at demonstration files")
    commands = parser.add_subparsers(dest="demos_command", required=True, metavar="{collect,convert,download,info}")
    _add_collect(commands)
    about = "make an .npz file of an HDF5 one of robomimic (low-dimensional) or robosuite (demo.hdf5, replayed)"
    add = commands.add_parser("convert", help=about, description=about).add_argument
    add("file", type=Path, metavar="FILE", help="the HDF5 file")
    add("--env", required=True, metavar="ID", help=ROBOSUITE_HELP)
    add("--obs", default="paper", metavar="LAYOUT", help=OBS_HELP)
    add("--filter-key", metavar="KEY", help="only robomimic's mask/KEY, such as better or 20_percent")
    add("--output", type=Path, metavar="FILE", help=".npz file to write (default: FILE with this suffix)")
    about = "fetch robomimic's 300 human demonstrations (MIT licence, 30 to 130 MB), check and convert them"
    add = commands.add_parser("download", help=about, description=about).add_argument
    add("--env", required=True, metavar="ID", help=ROBOSUITE_HELP)
    add("--url", help="another address of such a file")
    add("--obs", default="paper", metavar="LAYOUT", help=OBS_HELP)
    add("--output", type=Path, metavar="FILE", help=".npz file to write (default: <task>_mh.npz)")
    info = commands.add_parser("info", help="print what a demonstration file holds")
    info.add_argument("file", type=Path, metavar="FILE")


def _add_collect(commands: Subparsers) -> None:
    about = "record successful episodes of a demonstrator: trained (of a sparse MuJoCo task: on its dense one), or scripted "
    about += "(of robosuite's tasks)"
    collect = commands.add_parser("collect", help=about, description=f"{about}. A training that was stopped goes on.")
    add = collect.add_argument
    add("--env", required=True, metavar="ID", help="Gymnasium id, such as SparseHopper-v5 (of a goal task: its sparse one)")
    add("--episodes", type=count, help="episodes to record (default: 20; scripted 50, or 300 when mixed)")
    add("--max-tries", type=count, help="episodes to play at most (default: ten times --episodes)")
    several = "a trained one and itself when it stood at half the return, or six scripted ones of three levels"
    add("--mixed", action="store_true", help=f"several demonstrators in turn: {several}")
    add("--seed", type=int, default=0, help="of the demonstrator and of the recording (default: 0)")
    add("--output", type=Path, metavar="FILE", help="file to write (default: sparse_<task>.npz)")
    add = collect.add_argument_group("trained demonstrators").add_argument
    add("--algo", default="ppo", metavar="{ppo,sac,td3,trpo}", help="algorithm (default: ppo)")
    add("--steps", type=float, help="training steps (default: 2000 full episodes)")
    add("--target-return", type=float, help="stop training at this mean dense return (default: never)")
    add("--quality", type=float, help="stop training at this share of the dense return of the package's demonstrations")
    add("--stochastic", action="store_true", help="sample the actions, not the most likely ones")
    add("--work-dir", type=Path, metavar="DIR", help="of the training run (default: demonstrators/<task>_<algo>_<seed>)")
    add("--save-every", type=int, default=50_000, help="steps between two evaluations (default: 50000)")
    add("--n-envs", type=int, default=1, help="parallel environments of the training (default: 1)")
    add("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules that register the task")
    add = collect.add_argument_group("scripted demonstrators").add_argument
    add("--proficiency", type=float, metavar="P", help="from 0 (clumsy) to 1 (sure, the default)")
    add("--obs", metavar="LAYOUT", help=OBS_HELP)


def run(args: argparse.Namespace) -> int:
    from sb3_actpc.checkpoints import EXIT_STOPPED, TrainingStopped

    commands = {"collect": _collect, "convert": _convert, "download": _download, "info": _info}
    try:
        commands[args.demos_command](args)
    except TrainingStopped as stop:  # of a demonstrator
        print(f"sb3-actpc: {stop}; the same command goes on with it", file=sys.stderr)
        return EXIT_STOPPED
    return 0


def _collect(args: argparse.Namespace) -> None:
    known = sparse_env_id(args.env.rpartition(":")[2])  # what is recorded in it serves the goal task
    if known in SPARSE_IDS:
        args.env = known
    is_scripted = args.env in ROBOSUITE_IDS
    if not is_scripted and (args.proficiency is not None or args.obs is not None):
        raise ValueError("--proficiency and --obs are for scripted demonstrators of robosuite tasks: leave them out")
    if is_scripted and (args.stochastic or args.quality is not None or args.target_return is not None):
        raise ValueError("--stochastic, --quality and --target-return are for trained demonstrators: give --proficiency")
    output = args.output or _default_output(args.env)
    if output.is_dir():
        raise IsADirectoryError(f"--output {output} is a folder: give the file in it, such as {output / 'demos.npz'}")
    _save(_collect_scripted(args) if is_scripted else _collect_trained(args), output)


def _default_output(env_id: str, suffix: str = "") -> Path:
    name = re.sub(r"-v\d+$", "", env_id.rpartition(":")[2]).lower().replace("/", "_")
    return Path(f"{name.replace('sparse', 'sparse_', 1)}{suffix}.npz")


def _save(demonstrations: Any, output: Path) -> None:
    demonstrations.save(output)
    _report(repr(demonstrations))
    _report(f"wrote {output} ({output.stat().st_size / 1e6:.2f} MB)")


def _collect_scripted(args: argparse.Namespace) -> Any:
    from sb3_actpc.demonstrations import MIXED_PROFICIENCIES, collect_scripted

    n_episodes = 50
    proficiency = 1.0 if args.proficiency is None else args.proficiency
    if args.mixed:
        if args.proficiency is not None:
            raise ValueError(f"--proficiency {args.proficiency} and --mixed, which has six of them: give one of the two")
        proficiency = "mixed"
        n_episodes *= len(MIXED_PROFICIENCIES)
    _report(f"scripted demonstrators in {args.env}, proficiency: {proficiency}")
    metadata = {"command": command_line(args, ("env", "proficiency", "mixed", "obs", "episodes", "max_tries", "seed"))}
    given = (args.env, proficiency, args.episodes or n_episodes, args.seed, args.obs or "paper", metadata)
    return collect_scripted(*given, max_tries=args.max_tries, report=_report)


def _collect_trained(args: argparse.Namespace) -> Any:
    import gymnasium as gym

    from sb3_actpc.demonstrations.rows import box_paths
    from sb3_actpc.experiments import demonstrators
    from sb3_actpc.experiments.runs.environments import check_env_id, make_env

    target = args.target_return
    if args.quality is not None:
        if target is not None:
            raise ValueError(f"--quality {args.quality} and --target-return {target} both say when to stop: give one")
        target = demonstrators.share_of(demonstrators.reference_return(args.env), args.quality)
    if args.stochastic and args.algo == "td3":
        raise ValueError("--stochastic: the policy of td3 has nothing to sample: choose ppo, sac or trpo")
    options = {"seed": args.seed, "n_envs": args.n_envs, "eval_freq": args.save_every, "progress": False}
    run = demonstrators.demonstrator_run(args.env, args.algo, args.steps, target, args.gym_packages, **options)
    folder = args.work_dir or Path("demonstrators") / f"{folder_name(run.env)}_{args.algo}_{args.seed}"
    check_env_id(run.env, run.gym_packages)
    with closing(make_env(run.env, {})) as env:  # before anybody is trained in it
        if not isinstance(env.action_space, gym.spaces.Box):
            raise ValueError(f"{run.env}: demonstrations need a Box action space, found {env.action_space}")
        box_paths(env.observation_space)
    _report(f"demonstrator: {args.algo} on {run.env} for {run.n_timesteps} steps at most, in {folder}")
    if args.mixed:
        trained = demonstrators.train_mixed(run, folder, _report)
    else:
        trained = [demonstrators.train_demonstrator(run, folder, _report)]
    for one in trained:
        _report(f"demonstrator of {one.n_steps} steps: mean dense return {one.mean_return:.1f}")
    words = ("env", "algo", "steps", "target_return", "quality", "stochastic", "mixed", "episodes", "max_tries", "seed")
    metadata = {"command": command_line(args, (*words, "save_every", "n_envs", "gym_packages")), "algorithm": args.algo}
    recorded = demonstrators.record_demonstrators(
        trained, args.env, args.episodes or 20, args.stochastic, args.seed, metadata, max_tries=args.max_tries, report=_report
    )
    returns = recorded.dense_returns
    with suppress(FileNotFoundError):  # nothing is shipped
        usual = demonstrators.reference_return(args.env)
        if target is None and returns is not None and returns.mean() < demonstrators.share_of(usual, 0.5):
            less = f"mean dense return {returns.mean():.1f} is far below {usual:.1f}, that of the package's"
            _report(f"{less}: train longer (--steps), or say that they are to be weak (--quality)")
    return recorded


def command_line(args: argparse.Namespace, options: Sequence[str]) -> str:
    """The command that repeats a ``demos collect``, of the options that matter: without the paths of the machine it ran on."""
    words = ["sb3-actpc", "demos", "collect"]
    for option in options:
        value = getattr(args, option)
        if value is None or value is False or value == []:
            continue
        words.append("--" + option.replace("_", "-"))
        if option == "steps":
            words.append(f"{value:.0f}")
        elif isinstance(value, list):
            words += value
        elif value is not True:
            words.append(str(value))
    return shlex.join(words)


def _convert(args: argparse.Namespace) -> None:
    from sb3_actpc.demonstrations import read_hdf5

    output = args.output or args.file.with_suffix(".npz")
    _check_suffix(output)
    if output.absolute() == args.file.absolute():
        raise ValueError(f"--output {output} is the file that is read: choose another")
    if args.output is None and output.exists():
        raise FileExistsError(f"{output} is there already: give another --output, what it holds may be more")
    _save(read_hdf5(args.file, args.env, args.obs, args.filter_key), output)


def _download(args: argparse.Namespace) -> None:
    from sb3_actpc.demonstrations.robomimic import download_robomimic

    output = args.output or _default_output(args.env, "_mh")
    _check_suffix(output)  # what is fetched goes beside it, as an .hdf5 file
    _save(download_robomimic(args.env, output.with_suffix(".hdf5"), args.url, args.obs, _report), output)


def _check_suffix(output: Path) -> None:
    if output.suffix != ".npz":
        raise ValueError(f"--output {output} must end in .npz")


def _info(args: argparse.Namespace) -> None:
    from sb3_actpc.demonstrations import Demonstrations

    if not args.file.is_file():
        raise FileNotFoundError(f"no demonstration file {args.file}: make one with `sb3-actpc demos collect`")
    demonstrations = Demonstrations.load(args.file)
    _report(f"env: {demonstrations.env_id}\nepisodes: {demonstrations.n_episodes}\ntransitions: {len(demonstrations)}")
    _report(f"observations: {demonstrations.observations.shape[1:]}, actions: {demonstrations.actions.shape[1:]}")
    for name, returns in (("sparse", demonstrations.episode_returns), ("dense", demonstrations.dense_returns)):
        if returns is not None:
            _report(f"{name} return: mean {returns.mean():.1f}, min {returns.min():.1f}, max {returns.max():.1f}")
    for key, value in demonstrations.metadata.items():
        _report(f"{key}: {value}")
