"""``sb3-actpc zoo``: rl-zoo3's own command line, with our algorithms, settings and tasks (see docs/baselines.md).
The algorithms are entered in ``rl_zoo3.ALGOS``; a preset and its demonstrations become a file for ``--conf-file``.
rl_zoo3 evaluates agents on the seed they train on, and continues one (``-i``) with random actions first.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import yaml

from sb3_actpc.utils.extras import import_extra

SCRIPTS = {"train": "train:train", "optimize": "train:train", "enjoy": "enjoy:enjoy", "plot": "plots:plot_train"}
OPTIMIZABLE = ("actpc", "ppo", "sac", "trpo")  # no setting in their presets overrides a sampled one
RANGES = {"learning_rate": (1e-5, 2e-3), "tau": (1e-3, 0.15), "refresh_weight": (0.1, 3.0)}
CHOICES = {"gamma": [0.95, 0.98, 0.99, 0.995], "batch_size": [64, 128, 256, 512]}


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    about = "train, enjoy, optimize and plot with rl-zoo3, which unpickles models: use it on runs that you trust"
    parser = subparsers.add_parser("zoo", help=about, description=about)
    parser.add_argument("zoo_command", metavar="COMMAND", choices=SCRIPTS, help=", ".join(SCRIPTS))
    arguments = "rl-zoo3's options; also --preset and --demonstrations (train, optimize), --output FILE (plot)"
    parser.add_argument("arguments", nargs=argparse.REMAINDER, metavar="...", help=arguments)


def run(args: argparse.Namespace) -> int:
    """Call one of rl_zoo3's functions, which read their arguments from the process."""
    parser = argparse.ArgumentParser(prog=f"sb3-actpc zoo {args.zoo_command}", add_help=False, allow_abbrev=False)
    parser.add_argument("-a", "--algo", default="actpc")
    parser.add_argument("-e", "--env", nargs="+", default=[])
    parser.add_argument("--gym-packages", nargs="+", default=[])
    for options in (["-conf", "--conf-file"], ["--preset"], ["--demonstrations"], ["--output"]):
        parser.add_argument(*options)
    ours, rest = parser.parse_known_args(args.arguments)
    if len(ours.env) > 1 and args.zoo_command != "plot":
        raise ValueError(f"--env {' '.join(ours.env)}: zoo {args.zoo_command} takes one environment, only plot takes several")
    module, _, name = SCRIPTS[args.zoo_command].partition(":")
    function = getattr(import_extra(f"rl_zoo3.{module}", "zoo"), name)
    given = sys.argv
    with tempfile.TemporaryDirectory(prefix="sb3_actpc_zoo_") as folder:
        sys.argv = [f"sb3-actpc zoo {args.zoo_command}", *_arguments(args.zoo_command, ours, rest, Path(folder))]
        try:
            function()
        finally:
            sys.argv = given
    if ours.output is not None:
        import_extra("matplotlib.pyplot", "experiments").savefig(ours.output)
        print(f"written to {ours.output}")
    return 0


def _arguments(command: str, ours: argparse.Namespace, rest: Sequence[str], folder: Path) -> list[str]:
    """rl_zoo3's arguments. An id ``module:Name-v0`` becomes ``--gym-packages module``, a preset ``--conf-file``."""
    from sb3_actpc.experiments.runs.environments import check_env_id
    from sb3_actpc.experiments.runs.presets import read_yaml

    _register_algorithms()
    if {"-h", "--help"} & set(rest):
        return ["--help"]
    if not ours.env:
        raise ValueError("--env is missing: give a Gymnasium id, such as --env SparseHalfCheetah-v5")
    if (ours.preset or ours.demonstrations) and (ours.conf_file or command in ("enjoy", "plot")):
        raise ValueError("--preset and --demonstrations are for training without --conf-file: leave them out")
    if command == "plot":
        if ours.output is not None:
            import_extra("matplotlib", "experiments").use("Agg")  # shows nothing
        names = [env_id.rpartition(":")[2].replace("/", "-") for env_id in ours.env]  # of the run folders
        return ["-a", ours.algo, "-f", "logs", "-e", *names, *rest]
    check_env_id(ours.env[0], ours.gym_packages)
    *modules, env_id = ours.env[0].split(":")
    packages = ["--gym-packages", *ours.gym_packages, *modules] if ours.gym_packages or modules else []
    passed = [*packages, "--algo", ours.algo, "--env", env_id, "-f", "logs", *rest]
    if command == "enjoy":
        return passed
    if command == "optimize" and ours.algo not in OPTIMIZABLE:
        raise ValueError(f"zoo optimize does not know what to vary for {ours.algo!r}: choose one of {', '.join(OPTIMIZABLE)}")
    settings = Path(ours.conf_file or folder / "settings.yml")
    if ours.conf_file is None:
        settings.write_text(yaml.safe_dump({env_id: _settings(env_id, ours)}, sort_keys=False), encoding="utf-8")
    elif settings.suffix in (".yml", ".yaml"):
        read_yaml(settings.read_bytes(), str(settings))  # rl_zoo3 takes the last value of a key that is given twice
    return [*passed, "--conf-file", str(settings), *(["--optimize-hyperparameters"] if command == "optimize" else [])]


def _register_algorithms() -> None:
    from sb3_actpc.experiments.runs.algorithms import ALGORITHMS, load_algorithm

    zoo = import_extra("rl_zoo3", "zoo")
    search = import_extra("rl_zoo3.hyperparams_opt", "zoo")
    for name in ALGORITHMS:
        with suppress(ImportError):  # of an extra that is not installed
            zoo.ALGOS[name] = load_algorithm(name)
    search.HYPERPARAMS_SAMPLER["actpc"] = _sample_actpc
    search.HYPERPARAMS_CONVERTER["actpc"] = dict


def _sample_actpc(trial: Any, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    settings = {name: trial.suggest_float(name, *bounds, log=True) for name, bounds in RANGES.items()}
    return settings | {name: trial.suggest_categorical(name, values) for name, values in CHOICES.items()}


def _settings(env_id: str, ours: argparse.Namespace) -> dict[str, Any]:
    """The entry of rl_zoo3's settings file: the preset's, the demonstrations, and the log of successes."""
    from sb3_actpc.experiments.runs import Run, resolve
    from sb3_actpc.experiments.runs.environments import make_env
    from sb3_actpc.experiments.runs.presets import find_demonstrations, fitting_policy, preset_entry, takes_demonstrations

    run = resolve(Run(env=env_id, algo=ours.algo, preset=ours.preset, demonstrations=ours.demonstrations or "shipped"))
    settings = preset_entry(run)
    found = find_demonstrations(env_id, run.demonstrations) if takes_demonstrations(run) else None
    if found is not None:
        settings["demonstrations"] = str(found.absolute()) if isinstance(found, Path) else found
    with closing(make_env(env_id, run.env_kwargs)) as env:
        settings["policy"] = fitting_policy(settings["policy"], env.observation_space)
        env.reset(seed=0)
        if "is_success" in env.step(env.action_space.sample())[4]:
            settings["monitor_kwargs"] = "dict(info_keywords=('is_success',))"  # rl_zoo3 evaluates it
    return settings
