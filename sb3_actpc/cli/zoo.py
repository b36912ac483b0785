"""``sb3-actpc zoo``: rl-zoo3's own command line, with our algorithms, settings and tasks (see docs/baselines.md).

What rl_zoo3 gets is a settings file with one entry, made from the preset, because rl_zoo3

* takes its own settings file unless it is given one, and evaluates texts in it as Python: ours hold plain values only;
* knows nothing of demonstrations: the file's path is a setting like any other;
* logs the success rate only where it is told to (``monitor_kwargs``), and its plots need it;
* begins a continued run (``-i model.zip``) with the random warm-up again: ``learning_starts`` is then 0.

The settings of a search's best trial are written as a preset, which ``sb3-actpc train`` takes too. (rl_zoo3's ``--trial-id``
takes the number 0, the first trial, for none.)

rl_zoo3 gives its training and its evaluation environments one seed, so that an agent is evaluated on the starts that it
trained on; here the evaluation has another, as in ``sb3-actpc train``.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import yaml

from sb3_actpc.utils.extras import import_extra

# name -> rl-zoo3's function, and what it does
SCRIPTS = {
    "train": ("rl_zoo3.train:train", "train an agent; --preset and --demonstrations as in sb3-actpc train"),
    "optimize": ("rl_zoo3.train:train", "search for settings with Optuna"),
    "enjoy": ("rl_zoo3.enjoy:enjoy", "play a trained agent"),
    "plot": ("rl_zoo3.plots:plot_train", "plot the training, also called plot_train; --output FILE to write it"),
    "plot_train": ("rl_zoo3.plots:plot_train", "the same"),
    "all_plots": ("rl_zoo3.plots:all_plots", "evaluations of several algorithms and tasks"),
    "plot_from_file": ("rl_zoo3.plots:plot_from_file", "plot what all_plots has written"),
}
LOG_FOLDER = "logs"  # rl_zoo3's own default when it trains
NET_ARCHS = {"small": [64, 64], "medium": [256, 256], "big": [400, 300]}


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    commands = "\n".join(f"  {name:15s} {about}" for name, (_, about) in SCRIPTS.items())
    parser = subparsers.add_parser(
        "zoo",
        help="train, enjoy, optimize and plot with rl-zoo3",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="rl-zoo3's scripts with this package's algorithms, settings and tasks:\n\n"
        f"{commands}\n\nEvery option of theirs works: sb3-actpc zoo train --help.\n"
        "rl-zoo3 unpickles models and evaluates settings: use it on runs that you trust.",
        usage="sb3-actpc zoo COMMAND ...",
    )
    parser.add_argument("zoo_command", metavar="COMMAND", choices=SCRIPTS, help=argparse.SUPPRESS)
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)


def run(args: argparse.Namespace) -> int:
    """Run one of rl_zoo3's scripts."""
    command, arguments = args.zoo_command, args.arguments
    if command.startswith(("plot", "all")):
        return _plot(SCRIPTS[command][0], arguments)
    register_algorithms()
    if {"-h", "--help"} & set(arguments):
        return _run(SCRIPTS[command][0], ["--help"])
    if command == "enjoy":
        return _run(SCRIPTS[command][0], _playing_arguments(arguments))
    with tempfile.TemporaryDirectory(prefix="sb3_actpc_zoo_") as folder:
        return _run(SCRIPTS[command][0], _training_arguments(arguments, Path(folder), optimize=command == "optimize"))


def register_algorithms() -> None:
    """Put our algorithms, and what samples their settings, into rl_zoo3's tables; ``td3`` and ``ddpg`` are then ours."""
    from sb3_actpc.experiments.runs.algorithms import ALGORITHMS, load_algorithm

    zoo, hyperparams = import_extra("rl_zoo3", "zoo"), import_extra("rl_zoo3.hyperparams_opt", "zoo")
    if "actpc" in zoo.ALGOS:
        return
    for name in ALGORITHMS:
        with suppress(ImportError):  # of an extra that is not installed
            zoo.ALGOS[name] = load_algorithm(name)
    samplers, converters = hyperparams.HYPERPARAMS_SAMPLER, hyperparams.HYPERPARAMS_CONVERTER
    samplers["actpc"], converters["actpc"] = sample_actpc_params, convert_actpc_params
    for name, like in (("her", "td3"), ("logo", "trpo")):
        samplers.setdefault(name, samplers[like])
        converters.setdefault(name, converters[like])
    for name in ("td3", "ddpg", "her"):
        samplers[name] = _with_one_learning_rate(samplers[name])
        converters[name] = _with_one_learning_rate(converters[name])
    manager = import_extra("rl_zoo3.exp_manager", "zoo").ExperimentManager
    _evaluate_on_other_seeds(manager)
    _keep_the_best_trial(manager)


def _evaluate_on_other_seeds(manager: Any) -> None:
    """Replace the method of rl_zoo3's class that makes environments."""
    from sb3_actpc.experiments.runs.run import EVALUATION_SEED_OFFSET

    create_envs = manager.create_envs

    def create_envs_with_other_seeds(self: Any, n_envs: int, eval_env: bool = False, no_log: bool = False) -> Any:
        seed = self.seed
        self.seed = (seed + EVALUATION_SEED_OFFSET) % 2**32 if eval_env else seed
        try:
            return create_envs(self, n_envs, eval_env=eval_env, no_log=no_log)
        finally:
            self.seed = seed

    manager.create_envs = create_envs_with_other_seeds


def _keep_the_best_trial(manager: Any) -> None:
    """Let the search of rl_zoo3's class also write a preset."""
    from sb3_actpc.experiments.runs.presets import load_preset

    search = manager.hyperparameters_optimization

    def search_and_keep(self: Any) -> None:
        search(self)
        if not self.storage or Path(self.config).suffix not in (".yml", ".yaml"):
            return
        env_id, best = self.env_name.gym_id, self.load_trial(self.storage, self.study_name)
        settings = {**load_preset(self.config, env_id), **(self.custom_hyperparams or {}), **best}
        sampled = self.load_trial(self.storage, self.study_name, convert=False)
        if "activation_fn" in sampled:  # the class has no place in a preset, its name has
            settings["policy_kwargs"]["activation_fn"] = sampled["activation_fn"]
        for name in ("demonstrations", "monitor_kwargs"):
            settings.pop(name, None)
        preset = Path(self.log_folder, self.algo, f"{self.study_name}.yml")
        try:
            preset.write_text(yaml.safe_dump({env_id: settings}, sort_keys=False), encoding="utf-8")
        except yaml.YAMLError as error:
            print(f"The best trial makes no preset: {' '.join(str(error).split())}")
        else:
            print(f"The best trial as a preset: sb3-actpc train --algo {self.algo} --env {env_id} --preset {preset}")

    manager.hyperparameters_optimization = search_and_keep


def sample_actpc_params(trial: Any, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """Settings of ActPC for one trial of a search: those that matter under either settling."""
    trial.suggest_float("learning_rate", 1e-5, 2e-3, log=True)
    trial.suggest_float("one_minus_gamma", 1e-4, 0.03, log=True)
    trial.suggest_float("tau", 1e-3, 0.15, log=True)
    trial.suggest_int("batch_size_pow", 6, 9)
    trial.suggest_categorical("net_arch", list(NET_ARCHS))
    trial.suggest_float("critic_weight", 0.01, 3.0, log=True)
    trial.suggest_float("refresh_weight", 0.1, 3.0, log=True)
    trial.suggest_categorical("alpha_ep", [0.0, 0.1, 1.0])
    trial.suggest_categorical("alpha_in", [0.0, 0.1, 1.0])
    trial.suggest_categorical("weight_decay", [0.0, 0.1, 0.3, 1.0])
    params = convert_actpc_params(trial.params)
    trial.set_user_attr("gamma", params["gamma"])
    trial.set_user_attr("batch_size", params["batch_size"])
    return params


def convert_actpc_params(sampled: dict[str, Any]) -> dict[str, Any]:
    """Keywords of ActPC from the parameters of a trial, as :func:`sample_actpc_params` named them."""
    as_they_are = ("learning_rate", "tau", "critic_weight", "refresh_weight", "alpha_ep", "alpha_in")
    return {
        **{name: sampled[name] for name in as_they_are},
        "gamma": 1.0 - sampled["one_minus_gamma"],
        "batch_size": 2 ** sampled["batch_size_pow"],
        "policy_kwargs": {
            "net_arch": NET_ARCHS[sampled["net_arch"]],
            "circuit_kwargs": {"weight_decay": sampled["weight_decay"]},
        },
    }


def _with_one_learning_rate(sample: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
    """The sampled learning rate and tau are those of both networks, whatever the settings file gives each."""

    def sample_params(*arguments: Any) -> dict[str, Any]:
        return {**sample(*arguments), "actor_kwargs": None, "critic_kwargs": None}

    return sample_params


def _training_arguments(arguments: Sequence[str], folder: Path, optimize: bool) -> list[str]:
    from sb3_actpc.experiments.runs.algorithms import ALGORITHMS
    from sb3_actpc.experiments.runs.environments import check_env_id

    parser = _parser()
    parser.add_argument("--preset")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("--demonstrations")
    parser.add_argument("-conf", "--conf-file", dest="conf_file")
    parser.add_argument("-i", "--trained-agent", default="")
    parser.add_argument("-f", "--log-folder", default=LOG_FOLDER)
    parser.add_argument("--storage")
    parser.add_argument("--study-name")
    ours, rest = parser.parse_known_args(list(arguments))
    if ours.env is None:
        raise ValueError("--env is missing: give a Gymnasium id, such as --env SparseHalfCheetah-v5")
    check_env_id(ours.env, ours.gym_packages)
    for option in ("preset", "demonstrations"):
        if ours.conf_file is not None and getattr(ours, option) is not None:
            raise ValueError(
                f"--{option} {getattr(ours, option)} is for presets, and --conf-file {ours.conf_file} takes the place of one: "
                "leave one of the two out; such a file can hold demonstrations: FILE"
            )
    if ours.conf_file is None:
        conf_file = folder / f"{ours.algo}.yml"
        conf_file.write_text(yaml.safe_dump({ours.env: _zoo_settings(ours)}, sort_keys=False), encoding="utf-8")
        ours.conf_file = str(conf_file)
    passed = ["--gym-packages", *ours.gym_packages] if ours.gym_packages else []
    if optimize:
        samplers = import_extra("rl_zoo3.hyperparams_opt", "zoo").HYPERPARAMS_SAMPLER
        if ours.algo not in samplers:
            known = ", ".join(sorted(set(samplers) & set(ALGORITHMS)))
            raise ValueError(f"zoo optimize does not know what to vary for {ours.algo!r}: choose one of {known}")
        passed.append("--optimize-hyperparameters")
        ours.study_name = ours.study_name or f"{ours.algo}_{ours.env}"
        # a journal: several processes can work on it, and a stopped search goes on
        ours.storage = ours.storage or os.path.join(ours.log_folder, ours.algo, f"{ours.study_name}.log")
    for option in ("algo", "env", "conf_file", "log_folder", "trained_agent", "storage", "study_name"):
        passed += [f"--{option.replace('_', '-')}", getattr(ours, option)] if getattr(ours, option) else []
    return [*passed, *rest]


def _playing_arguments(arguments: Sequence[str]) -> list[str]:
    """rl_zoo3 looks for runs in a folder of its own, and downloads what is not there; ours are in ``logs``."""
    from sb3_actpc.experiments.runs.environments import check_env_id

    parser = _parser()
    parser.add_argument("-f", "--folder", default=LOG_FOLDER)
    parser.add_argument("--gym-packages", nargs="+", default=[])
    ours, rest = parser.parse_known_args(list(arguments))
    if ours.env is None:
        raise ValueError("--env is missing: give the Gymnasium id of the trained agent's task")
    check_env_id(ours.env, ours.gym_packages)
    if not Path(ours.folder, ours.algo).is_dir():
        raise FileNotFoundError(f"no runs of {ours.algo} in {ours.folder}: sb3-actpc zoo train makes one; or give --folder")
    packages = ["--gym-packages", *ours.gym_packages] if ours.gym_packages else []
    return [*packages, "--algo", ours.algo, "--env", ours.env, "--folder", ours.folder, *rest]


def _parser() -> argparse.ArgumentParser:
    """What every script takes; the rest is left to rl_zoo3."""
    parser = argparse.ArgumentParser(prog="sb3-actpc zoo", add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default="actpc")
    parser.add_argument("--env")
    return parser


def _zoo_settings(ours: argparse.Namespace) -> dict[str, Any]:
    """The entry of rl_zoo3's settings file: the preset's, and what rl_zoo3 would not know."""
    from sb3_actpc.actpc.buffers import relabels
    from sb3_actpc.experiments.runs import Run, resolve
    from sb3_actpc.experiments.runs.algorithms import load_algorithm
    from sb3_actpc.experiments.runs.environments import make_env
    from sb3_actpc.experiments.runs.presets import RUN_KEYS, find_demonstrations, fitting_policy
    from sb3_actpc.utils.constructors import constructor_keywords

    choices = Run(env=ours.env, algo=ours.algo, preset=ours.preset, demonstrations=ours.demonstrations or "shipped")
    resolved, known = resolve(choices), constructor_keywords(load_algorithm(ours.algo))
    entries = {name: getattr(resolved, name) for name in RUN_KEYS}
    settings = {**{name: value for name, value in entries.items() if value}, **resolved.settings}
    if resolved.normalize is not None:
        settings["normalize"] = resolved.normalize or True
    if "demonstrations" in known:
        demonstrations = find_demonstrations(ours.env, choices.demonstrations)
        settings["demonstrations"] = str(demonstrations.absolute()) if isinstance(demonstrations, Path) else demonstrations
    with closing(make_env(ours.env, resolved.env_kwargs)) as env:
        settings["policy"] = fitting_policy(settings["policy"], env.observation_space)
        env.reset(seed=0)
        if "is_success" in env.step(env.action_space.sample())[4]:
            # the Monitor wants a tuple, which a settings file cannot hold but as the Python that rl_zoo3 evaluates
            settings["monitor_kwargs"] = "dict(info_keywords=('is_success',))"
    # hindsight cannot sample before its first whole episode
    uses_hindsight = ours.algo == "her" or relabels(settings.get("replay_buffer_class"))
    if ours.trained_agent and "learning_starts" in known and not uses_hindsight:
        settings["learning_starts"] = 0
    return settings


def _plot(script: str, arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="sb3-actpc zoo plot", add_help=False, allow_abbrev=False)
    parser.add_argument("--output", type=Path)
    ours, rest = parser.parse_known_args(list(arguments))
    if script.endswith(":plot_train"):
        rest = _plotted_runs(rest)
    if ours.output is None:
        return _run(script, rest)
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    shown, pyplot.show = pyplot.show, lambda *_, **__: None
    try:
        _run(script, rest)
    finally:
        pyplot.show = shown
    ours.output.parent.mkdir(parents=True, exist_ok=True)
    pyplot.savefig(ours.output)
    print(f"written to {ours.output}")
    return 0


def _plotted_runs(arguments: Sequence[str]) -> list[str]:
    """The arguments, with ids such as ``ns/Line-v0`` written as rl_zoo3 names their run folders.

    :raises FileNotFoundError: when there is no run, where rl_zoo3 would draw an empty figure
    """
    parser = argparse.ArgumentParser(prog="sb3-actpc zoo plot", add_help=False, allow_abbrev=False)
    parser.add_argument("-a", "--algo")
    parser.add_argument("-e", "--env", nargs="+", default=[])
    parser.add_argument("-f", "--exp-folder", default=LOG_FOLDER)
    ours, rest = parser.parse_known_args(list(arguments))
    if not ours.algo or not ours.env:
        return list(arguments)
    naming = import_extra("huggingface_sb3", "zoo")
    names = [str(naming.EnvironmentName(env_id)) for env_id in ours.env]
    for env_id, name in zip(ours.env, names, strict=True):
        if not list(Path(ours.exp_folder, ours.algo).glob(f"*{name}*/*monitor.csv")):
            raise FileNotFoundError(
                f"no runs of {ours.algo} on {env_id} in {ours.exp_folder}: make one with sb3-actpc zoo train"
            )
    return ["-a", ours.algo, "-f", ours.exp_folder, "-e", *names, *rest]


def _run(script: str, arguments: Sequence[str]) -> int:
    """Call one of rl_zoo3's functions, which read their arguments from the process."""
    module, _, name = script.partition(":")
    function = getattr(import_extra(module, "zoo"), name)
    given = sys.argv
    sys.argv = [script.replace(":", " "), *arguments]
    try:
        function()
    finally:
        sys.argv = given
    return 0
