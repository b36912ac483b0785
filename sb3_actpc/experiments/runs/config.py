"""From a preset file and the user's choices to everything that one training run needs."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import LinearSchedule

from sb3_actpc.utils.checks import check_device
from sb3_actpc.utils.constructors import constructor_keywords
from sb3_actpc.demonstrations.dataset import shipped_demonstrations
from sb3_actpc.envs import sparse_env_id

# name on the command line -> "module:class", imported only when it is used
ALGORITHMS = {
    "actpc": "sb3_actpc.actpc:ActPC",
    "bc": "sb3_actpc.baselines:BC",
    "bc_rnn": "sb3_actpc.baselines:BCRNN",
    "bcq": "sb3_actpc.baselines:BCQ",
    "cql": "sb3_actpc.baselines:CQL",
    "ddpg": "sb3_actpc.baselines:DDPGDemo",
    "hbc": "sb3_actpc.baselines:HBC",
    "her": "sb3_actpc.baselines:HER",
    "iris": "sb3_actpc.baselines:IRIS",
    "logo": "sb3_actpc.baselines:LOGO",
    "ppo": "stable_baselines3:PPO",
    "sac_rlpd": "sb3_actpc.baselines:RLPD",
    "td3": "sb3_actpc.baselines:TD3Demo",
}

PACKAGE_FOLDER = Path(__file__).resolve().parents[2]
# inside an installed wheel, or beside the package in a source checkout
HYPERPARAMS_FOLDERS = (PACKAGE_FOLDER / "hyperparams", PACKAGE_FOLDER.parent / "hyperparams")

MAX_SEED = 2**31 - 1  # other generators get a seed derived from it, which must be below 2**32
MAX_THREADS = 1024
MAX_ENVS = 1024
NOISE_TYPES = ("normal", "ornstein-uhlenbeck")
# constructor keywords that have an option of their own
_OPTION_OF = {
    "env": "--env",
    "seed": "--seed",
    "device": "--device",
    "demonstrations": "--demonstrations",
    "action_noise": "--set noise_type=normal --set noise_std=0.1",
}
_EXPONENT_FLOAT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")


@dataclass(frozen=True)
class RunConfig:
    """What the user chose for one training run.

    :param env: Gymnasium id of the task
    :param algo: key of ``ALGORITHMS``
    :param preset: name of a file of ``hyperparams/``, or a path ending in ``.yml``; by default the name of the algorithm
    :param n_timesteps: environment steps to train for; by default the preset's
    :param seed: seed of the agent and of the training environment
    :param demonstrations: ``"shipped"`` or ``"weak"`` (the files in the package for a sparse task), ``"none"``, or a path
    :param overrides: settings that replace the preset's
    :param env_kwargs: keywords of the environment, added to the preset's
    :param eval_freq: environment steps between two evaluations; by default a tenth of the training
    :param eval_episodes: episodes in each evaluation
    :param output: run folder; by default ``runs/<env>/<algo>_<preset>_seed<seed>``
    :param device: torch device
    :param n_envs: parallel training environments; by default the preset's, or 1
    :param threads: threads that torch uses
    :param progress: show a progress bar
    :param checkpoint_freq: environment steps between two checkpoints, 0 for none; by default as ``eval_freq``
    :raises ValueError: when a number is too small, or the algorithm or the device is unknown
    """

    env: str
    algo: str = "actpc"
    preset: str | None = None
    n_timesteps: int | None = None
    seed: int = 0
    demonstrations: str = "shipped"
    overrides: dict[str, Any] = field(default_factory=dict)
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    eval_freq: int | None = None
    eval_episodes: int = 5
    output: str | None = None
    device: str = "cpu"
    n_envs: int | None = None
    threads: int = 1
    progress: bool = True
    checkpoint_freq: int | None = None

    def __post_init__(self) -> None:
        if self.algo not in ALGORITHMS:
            raise ValueError(f"unknown algorithm {self.algo!r}: expected one of {', '.join(sorted(ALGORITHMS))}")
        if not 0 <= self.seed <= MAX_SEED:
            raise ValueError(f"seed must be from 0 to {MAX_SEED}, found {self.seed}")
        for name in ("n_timesteps", "eval_freq", "eval_episodes", "n_envs", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1, found {value}")
        if self.threads > MAX_THREADS:
            raise ValueError(f"threads must be at most {MAX_THREADS}, found {self.threads}")
        if self.checkpoint_freq is not None and self.checkpoint_freq < 0:
            raise ValueError(f"checkpoint_freq must be at least 0 (none), found {self.checkpoint_freq}")
        check_device(self.device)

    @property
    def preset_name(self) -> str:
        """Name of the preset without folder and suffix."""
        return Path(self.preset or self.algo).stem


@dataclass(frozen=True)
class RunPlan:
    """Everything resolved: what :func:`resolve_run` makes of a :class:`RunConfig`.

    :param algorithm: the SB3 class
    :param policy: policy name, such as ``"MlpPolicy"``
    :param n_timesteps: environment steps to train for
    :param n_envs: parallel training environments
    :param eval_freq: environment steps between two evaluations
    :param env_kwargs: keywords of the environment
    :param noise: type and standard deviation of the action noise, or None
    :param algorithm_kwargs: constructor keywords of the algorithm
    :param demonstrations: demonstrations file, or None
    :param checkpoint_freq: environment steps between two checkpoints; 0 for none
    :param normalize: keywords of SB3's ``VecNormalize`` around the training environment, or None
    """

    algorithm: type[BaseAlgorithm]
    policy: str
    n_timesteps: int
    n_envs: int
    eval_freq: int
    env_kwargs: dict[str, Any]
    noise: tuple[str, float] | None
    algorithm_kwargs: dict[str, Any]
    demonstrations: Path | None
    checkpoint_freq: int = 0
    normalize: dict[str, Any] | None = None

    @property
    def learns_off_policy(self) -> bool:
        """Whether there is a replay buffer, and so whether checkpoints can be taken."""
        return issubclass(self.algorithm, OffPolicyAlgorithm)

    @property
    def without_checkpoints(self) -> str:
        """Why there are none, where there are none."""
        on_policy = issubclass(self.algorithm, OnPolicyAlgorithm)
        return f"{'learns on policy' if on_policy else 'is quick enough to be run again'} and keeps no checkpoints"

    @property
    def uses_demonstrations(self) -> bool:
        """Whether the algorithm is given the demonstrations (TD3, say, has no keyword for them)."""
        return self.demonstrations is not None and "demonstrations" in constructor_keywords(self.algorithm)


def resolve_run(config: RunConfig) -> RunPlan:
    """Read the preset, apply the overrides, find the demonstrations and check it all.

    :param config: the user's choices
    :return: the plan of the run
    :raises FileNotFoundError: when the preset or the demonstrations file does not exist
    :raises ValueError: when a setting is unknown or has a wrong value, or a sparse task has no demonstrations
    :raises ImportError: when the algorithm is of another package that is not installed
    """
    algorithm = load_algorithm(config.algo)
    settings = {**load_preset(config.preset or config.algo, config.env), **config.overrides}
    n_timesteps = _whole_number("n_timesteps", config.n_timesteps or settings.pop("n_timesteps", None))
    n_envs = _whole_number("n_envs", config.n_envs or settings.pop("n_envs", 1), MAX_ENVS)
    env_kwargs = settings.pop("env_kwargs", None) or {}
    if not isinstance(env_kwargs, Mapping):
        raise ValueError(f"env_kwargs must be a mapping, found {env_kwargs!r}")
    policy = settings.pop("policy", "MlpPolicy")
    if not isinstance(policy, str):
        raise ValueError(f"policy must be a name, found {policy!r}")
    noise = _pop_noise(settings)
    normalize = _pop_normalize(settings)
    if noise is not None and "action_noise" not in constructor_keywords(algorithm):
        raise ValueError(f"{algorithm.__name__} takes no action noise: leave noise_type and noise_std out")
    for name in ("n_timesteps", "n_envs"):
        settings.pop(name, None)
    if isinstance(settings.get("train_freq"), list):
        settings["train_freq"] = tuple(settings["train_freq"])
    check_keywords(algorithm, settings)
    getattr(algorithm, "check_installed", lambda: None)()  # methods of packages in an environment of their own
    eval_freq = config.eval_freq or max(1, n_timesteps // 10)
    plan = RunPlan(
        algorithm=algorithm,
        policy=policy,
        n_timesteps=n_timesteps,
        n_envs=n_envs,
        eval_freq=eval_freq,
        env_kwargs={**env_kwargs, **config.env_kwargs},
        noise=noise,
        algorithm_kwargs=settings,
        demonstrations=find_demonstrations(config.env, config.demonstrations),
        checkpoint_freq=eval_freq if config.checkpoint_freq is None else config.checkpoint_freq,
        normalize=normalize,
    )
    if plan.learns_off_policy:
        return plan
    if config.checkpoint_freq:
        raise ValueError(f"{config.algo} {plan.without_checkpoints}: leave --checkpoint-freq out, or give 0")
    return dataclasses.replace(plan, checkpoint_freq=0)


def load_algorithm(name: str) -> type[BaseAlgorithm]:
    """Import an algorithm of the table.

    :param name: key of ``ALGORITHMS``
    :return: the class
    :raises ValueError: when there is no such name
    """
    if name not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {name!r}: expected one of {', '.join(sorted(ALGORITHMS))}")
    module, _, class_name = ALGORITHMS[name].partition(":")
    return getattr(importlib.import_module(module), class_name)


def load_preset(preset: str, env_id: str) -> dict[str, Any]:
    """Settings of one environment in a preset file: its own entry, else ``default`` (never both).

    :param preset: name of a file of ``hyperparams/`` without suffix, or a path ending in ``.yml`` or ``.yaml``
    :param env_id: Gymnasium id
    :return: a new dictionary of plain values
    :raises FileNotFoundError: when there is no such preset
    :raises ValueError: when the file is not a YAML mapping, or has neither entry
    """
    path = _preset_path(preset)
    entries = read_yaml(path.read_bytes(), str(path))
    if not isinstance(entries, Mapping):
        raise ValueError(f"{path}: expected a mapping from environment ids to settings")
    settings = entries.get(env_id, entries.get("default"))
    if not isinstance(settings, Mapping):
        raise ValueError(f"{path}: expected a mapping under {env_id!r} or 'default', found {settings!r}")
    return {str(key): value for key, value in settings.items()}


def read_yaml(text: str | bytes, source: str) -> Any:
    """Plain values from YAML; nothing in it is run, and ``1e-3`` is a number.

    :param text: YAML, UTF-8 when it is bytes
    :param source: where it is from, for the message
    :return: the values
    :raises ValueError: naming the source, when the text is not YAML or contains itself
    """
    try:
        return _with_floats(yaml.safe_load(text))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{source}: not YAML of plain values ({' '.join(str(error).split())})") from error


def parse_schedule(value: float | str) -> float | LinearSchedule:
    """A learning rate, or as in rl-zoo3 ``lin_3e-4``: falling linearly to zero at the end of training.

    :param value: a number, or a text such as ``"lin_3e-4"``
    :return: the number, or the schedule
    :raises ValueError: when it is neither
    """
    if not isinstance(value, str):
        return value
    prefix, _, number = value.partition("_")
    try:
        start = float(number)
    except ValueError as error:
        raise ValueError(f"learning_rate={value!r} must be a number or lin_<number>, such as lin_3e-4") from error
    if prefix != "lin":
        raise ValueError(f"learning_rate={value!r} must be a number or lin_<number>, such as lin_3e-4")
    return LinearSchedule(start, 0.0, 1.0)


def parse_assignments(assignments: Iterable[str]) -> dict[str, Any]:
    """Turn ``key=value`` texts into a dictionary; the values are read as YAML.

    :param assignments: such as ``["gamma=0.98", "policy_kwargs={net_arch: [64, 64]}"]``
    :return: such as ``{"gamma": 0.98, "policy_kwargs": {"net_arch": [64, 64]}}``
    :raises ValueError: when a text has no ``=`` or no key, or the value is not YAML
    """
    values = {}
    for assignment in assignments:
        key, separator, text = assignment.partition("=")
        if not separator or not key.strip():
            raise ValueError(f"expected key=value, found {assignment!r}")
        values[key.strip()] = read_yaml(text, f"the value of {assignment!r}")
    return values


def check_keywords(algorithm: type[BaseAlgorithm], settings: Mapping[str, Any]) -> None:
    """Check that a class takes these settings.

    :param algorithm: the class
    :param settings: constructor keywords
    :raises ValueError: naming the first one that it does not take, or that has an option of its own
    """
    known = constructor_keywords(algorithm)
    for name in settings:
        if name in _OPTION_OF:
            raise ValueError(f"{name!r} is not set here: use {_OPTION_OF[name]}")
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            raise ValueError(f"{algorithm.__name__} has no setting {name!r}{hint}")


def find_demonstrations(env_id: str, choice: str) -> Path | None:
    """The demonstrations file of a run.

    :param env_id: Gymnasium id of the task
    :param choice: ``"shipped"`` (for a task whose name begins with ``Sparse``, or its goal version), ``"weak"`` (a weaker
        demonstrator's), ``"none"``, or a path
    :return: the file, or None for none
    :raises FileNotFoundError: when the path does not exist, or a sparse task has no shipped file
    """
    if choice == "none":
        return None
    if choice == "weak":
        return shipped_demonstrations(sparse_env_id(env_id), weak=True)
    if choice != "shipped":
        if not Path(choice).is_file():
            raise FileNotFoundError(f"no demonstrations file at {choice}")
        return Path(choice)
    env_id = sparse_env_id(env_id)
    return shipped_demonstrations(env_id) if env_id.rpartition(":")[2].startswith("Sparse") else None


def _preset_path(preset: str) -> Path:
    if Path(preset).suffix in (".yml", ".yaml"):
        if not Path(preset).is_file():
            raise FileNotFoundError(f"no preset file at {preset}")
        return Path(preset)
    for folder in HYPERPARAMS_FOLDERS:
        if (folder / f"{preset}.yml").is_file():
            return folder / f"{preset}.yml"
    names = sorted({path.stem for folder in HYPERPARAMS_FOLDERS for path in folder.glob("*.yml")})
    raise FileNotFoundError(f"no preset {preset!r}: expected one of {', '.join(names)}, or a path ending in .yml")


def _pop_noise(settings: dict[str, Any]) -> tuple[str, float] | None:
    noise_type, noise_std = settings.pop("noise_type", None), settings.pop("noise_std", None)
    if noise_type is None:
        return None
    if noise_type not in NOISE_TYPES:
        raise ValueError(f"noise_type must be one of {', '.join(NOISE_TYPES)}, found {noise_type!r}")
    if not isinstance(noise_std, (int, float)) or isinstance(noise_std, bool) or not 0 <= noise_std < inf:
        raise ValueError(f"noise_std must be a number of at least 0, found {noise_std!r}")
    return noise_type, float(noise_std)


def _pop_normalize(settings: dict[str, Any]) -> dict[str, Any] | None:
    """As in rl-zoo3: true, false, or keywords of ``VecNormalize``; the discount of returns is the algorithm's."""
    given = settings.pop("normalize", None)
    if given is None or given is False:
        return None
    if given is not True and not isinstance(given, Mapping):
        raise ValueError(f"normalize must be true, false or keywords of VecNormalize, found {given!r}")
    own = {"gamma": settings["gamma"]} if "gamma" in settings else {}
    return {**own, **(given if isinstance(given, Mapping) else {})}


def _whole_number(name: str, value: Any, largest: float = inf) -> int:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_number or not 1 <= value < inf or value != int(value) or value > largest:
        bound = "of at least 1" if largest == inf else f"from 1 to {largest}"
        raise ValueError(f"{name} must be a whole number {bound}, found {value!r}")
    return int(value)


def _with_floats(value: Any) -> Any:
    """YAML 1.1 reads 1e-3 as text; here it is a number."""
    if isinstance(value, str) and _EXPONENT_FLOAT.fullmatch(value):
        return float(value)
    if isinstance(value, Mapping):
        return {key: _with_floats(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_with_floats(part) for part in value]
    return value
