"""Files of settings, and what they make of a run: everything that is not said comes from the preset."""

import copy
import re
from collections.abc import Iterable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import yaml
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from sb3_actpc.checkpoints import why_no_checkpoints
from sb3_actpc.demonstrations import is_minari_id, shipped_demonstrations
from sb3_actpc.demonstrations.minari import minari_files
from sb3_actpc.envs import sparse_env_id
from sb3_actpc.experiments.runs.algorithms import check_keywords, default_preset, load_algorithm
from sb3_actpc.experiments.runs.environments import make_env
from sb3_actpc.experiments.runs.schema import Run, merged
from sb3_actpc.utils.arguments import check_settings
from sb3_actpc.utils.checks import Settings, check_device, check_kind
from sb3_actpc.utils.constructors import constructor_keywords
from sb3_actpc.utils.files import file_hash
from sb3_actpc.utils.preset_files import preset_path

# keys of a preset, as rl-zoo3 has them, that are not the algorithm's
RUN_KEYS = ("n_timesteps", "n_envs", "policy", "env_kwargs", "noise_type", "noise_std", "normalize")
CAN_BE_NONE = ("noise_type", "noise_std", "normalize")  # None, where a run says it, leaves the preset's out
_ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh, "elu": nn.ELU, "leaky_relu": nn.LeakyReLU}


class _PlainLoader(yaml.SafeLoader):
    """YAML 1.1 of plain values, in which ``1e-3`` is a number, as in YAML 1.2, and every key is given once."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """A mapping, with the text of its keys; PyYAML would silently take the last of two values."""
        node = super().compose_mapping_node(anchor)
        known = set()
        for key, _ in node.value:
            text = str(key.value)
            if text in known:
                raise ValueError(f"line {key.start_mark.line + 1}: the key {text!r} is given twice")
            known.add(text)
        return node


_PlainLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def read_yaml(text: str | bytes, source: str) -> Any:
    """The one reader of YAML that users write: plain values, nothing in it is run; a ValueError names the source."""
    try:
        return yaml.load(text, Loader=_PlainLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{source}: not YAML of plain values with unique keys ({' '.join(str(error).split())})") from error


def load_preset(preset: str, env_id: str) -> dict[str, Any]:
    """Settings of one environment in a preset file (a name in ``hyperparams/``, or a path ending in ``.yml`` or ``.yaml``), a
    new dictionary of plain values: its own entry, under the id with its module or without, else ``default`` (never both).
    FileNotFoundError when there is no such preset, ValueError when the file is not a YAML mapping, or has no such entry."""
    path = preset_path(preset)
    entries = read_yaml(path.read_bytes(), str(path))
    if not isinstance(entries, Mapping):
        raise ValueError(f"{path}: expected a mapping from environment ids to settings")
    names = (env_id, env_id.rpartition(":")[2], "default")
    settings = next((entries[name] for name in names if name in entries), None)
    if not isinstance(settings, Mapping):
        raise ValueError(f"{path}: expected a mapping under {env_id!r} or 'default', found {settings!r}")
    return {str(key): value for key, value in settings.items()}


def resolve(run: Run) -> Run:
    """Read the preset, put what the user said in its place, find the demonstrations, and check it all: the run with everything
    filled in; one that is already is returned as it is. FileNotFoundError when the preset or the demonstrations file does not
    exist, ValueError when a setting is unknown or has a wrong value, or a sparse task has no demonstrations, ImportError when
    the algorithm is of another package that is not installed."""
    check_device("device", run.device)  # not where a run is read: elsewhere it plays on the CPU
    if run.is_resolved:
        return run
    if not run.env:
        raise ValueError("env is missing: give a Gymnasium id, such as SparseHopper-v5")
    algorithm = load_algorithm(run.algo)
    preset_name = run.preset or default_preset(run.algo)
    settings = with_changes({} if preset_name is None else load_preset(preset_name, run.env), run.settings)
    entries = {name: settings.pop(name, None) for name in RUN_KEYS}
    preset = Run(**{name: value for name, value in entries.items() if value is not None})
    said = {name: getattr(run, name) for name in run.model_fields_set - {"settings"}}
    chosen = {name: value for name, value in said.items() if value is not None or name in CAN_BE_NONE}
    is_noise_chosen = "noise_type" in {*run.settings, *run.model_fields_set}
    run = Run(**merged(preset, Run(**chosen)))
    if run.n_timesteps is None:
        raise ValueError(f"n_timesteps is neither in the preset {run.preset_name!r} nor given: give --steps")
    check_keywords(algorithm, settings)
    check_settings(algorithm, _parsed(settings))
    getattr(algorithm, "check_installed", lambda: None)()
    if run.noise_type is not None and run.noise_std is None:
        raise ValueError(f"noise_type={run.noise_type!r} needs a standard deviation: give noise_std, such as 0.1")
    if run.noise_std is not None and run.noise_type is None and not is_noise_chosen:
        raise ValueError(f"noise_std={run.noise_std} is of no noise: give noise_type=normal too, or leave it out")
    if run.noise_type is not None and "action_noise" not in constructor_keywords(algorithm):
        raise ValueError(f"{algorithm.__name__} takes no action noise: leave noise_type and noise_std out")
    eval_freq = run.eval_freq or max(1, run.n_timesteps // 10)
    checkpoint_freq = eval_freq if run.checkpoint_freq is None else run.checkpoint_freq
    without = why_no_checkpoints(algorithm)
    if without and run.checkpoint_freq:
        raise ValueError(f"{run.algo} {without}: leave --checkpoint-freq out, or give 0")
    if without:
        checkpoint_freq = 0
    normalize = run.normalize
    if normalize is not None and "gamma" in settings:
        normalize = {"gamma": settings["gamma"], **normalize}
    filled = {
        "settings": settings,
        "policy": run.policy or "MlpPolicy",
        "n_envs": run.n_envs or 1,
        "noise_std": None if run.noise_type is None else run.noise_std,
        "normalize": normalize,
        "eval_freq": eval_freq,
        "checkpoint_freq": checkpoint_freq,
        "demonstrations_sha256": demonstrations_hash(run),
        "is_resolved": True,
    }
    return Run(**{**merged(run), **filled})


def preset(env_id: str, name: str | None = None, algo: str = "actpc") -> dict[str, Any]:
    """A preset (a name as in ``--preset``, by default the algorithm's own) as keywords of the agent's constructor, without the
    environment: ``ActPC(env=env, **preset("SparseHopper-v5"))``.

    ``noise_type`` and ``noise_std`` become ``action_noise``, ``lin_4e-4`` a schedule, and the demonstrations are those in the
    package. Left out is what is not the agent's: ``n_timesteps`` (of ``learn``), ``n_envs``, ``env_kwargs`` and ``normalize``
    (of the environment). FileNotFoundError when there is no such preset, ValueError when one of its settings is unknown or
    wrong.
    """
    run = resolve(Run(env=env_id, algo=algo, preset=name))
    with closing(make_env(env_id, run.env_kwargs)) as env:
        return agent_keywords(run, env.observation_space, env.action_space)


def preset_entry(run: Run) -> dict[str, Any]:
    """What a filled run's settings file would say of its task."""
    said = {name: getattr(run, name) for name in RUN_KEYS}
    entry = {name: value for name, value in said.items() if value not in (None, {})} | run.settings
    if run.normalize == {}:
        entry["normalize"] = True
    return entry


def agent_keywords(run: Run, observation_space: gym.Space[Any], action_space: gym.Space[Any]) -> dict[str, Any]:
    """Keywords of a filled run's algorithm's constructor, all but the environment, the seed and the device."""
    keywords = _parsed(run.settings)
    check_kind("policy_kwargs", keywords.get("policy_kwargs"), Settings | None)
    activation = (keywords.get("policy_kwargs") or {}).get("activation_fn")
    if isinstance(activation, str):
        if activation not in _ACTIVATIONS:
            raise ValueError(f"activation_fn={activation!r} is unknown: choose one of {', '.join(_ACTIVATIONS)}")
        keywords["policy_kwargs"]["activation_fn"] = _ACTIVATIONS[activation]
    found = find_demonstrations(run.env, run.demonstrations) if takes_demonstrations(run) else None
    if found is not None:
        keywords["demonstrations"] = found
    if run.noise_type is not None:
        size = int(np.prod(action_space.shape or (1,)))
        kind = NormalActionNoise if run.noise_type == "normal" else OrnsteinUhlenbeckActionNoise
        keywords["action_noise"] = kind(np.zeros(size), np.full(size, run.noise_std))
    return {"policy": fitting_policy(run.policy or "MlpPolicy", observation_space), **keywords}


def _parsed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings with what YAML has no word for."""
    keywords = copy.deepcopy(dict(settings))  # SB3 adds keys of its own to the dictionaries it is given
    if "learning_rate" in keywords:
        keywords["learning_rate"] = parse_schedule(keywords["learning_rate"])
    if isinstance(keywords.get("train_freq"), list):
        keywords["train_freq"] = tuple(keywords["train_freq"])
    return keywords


def fitting_policy(policy: str, observation_space: gym.Space[Any]) -> str:
    """The policy; for observations of several parts the one that takes them."""
    return "MultiInputPolicy" if policy == "MlpPolicy" and isinstance(observation_space, gym.spaces.Dict) else policy


def parse_schedule(value: float | str) -> float | LinearSchedule:
    """A learning rate, or as in rl-zoo3 ``"lin_3e-4"``: falling linearly to zero at the end of training."""
    if not isinstance(value, str):
        return value
    try:
        return LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0) if value.startswith("lin_") else float(value)
    except ValueError as error:
        raise ValueError(f"learning_rate={value!r} must be a number or lin_<number>, such as lin_3e-4") from error


def parse_assignments(assignments: Iterable[str]) -> dict[str, Any]:
    """Turn texts such as ``"policy_kwargs.net_arch=[64, 64]"`` into a dictionary; the values are read as YAML."""
    values = {}
    for assignment in assignments:
        key, separator, text = assignment.partition("=")
        if not separator or not key.strip():
            raise ValueError(f"expected key=value, found {assignment!r}")
        values[key.strip()] = read_yaml(text, f"the value of {assignment!r}")
    return values


def with_changes(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The settings with changes; a dotted key, such as ``"policy_kwargs.net_arch"``, changes a value in a mapping."""
    changed = copy.deepcopy(dict(settings))
    for key, value in changes.items():
        *parents, last = key.split(".")
        place = changed
        for parent in parents:
            if place.get(parent) is None:
                place[parent] = {}
            place = place[parent]
            if not isinstance(place, dict):
                raise ValueError(f"{key}={value!r}: {parent}={place!r} is no mapping")
        place[last] = value
    return changed


def find_demonstrations(env_id: str, choice: str) -> Path | str | None:
    """The demonstrations of a run, a file or the id of a Minari dataset, None for none: ``"shipped"`` (for a task whose name
    begins with ``Sparse``, or its goal version), ``"none"``, a path, or such an id.
    FileNotFoundError when the path does not exist, or a sparse task has no shipped file."""
    if choice == "none":
        return None
    if is_minari_id(choice):
        return choice
    if choice != "shipped":
        if not Path(choice).is_file():
            raise FileNotFoundError(f"no demonstrations file at {choice}")
        return Path(choice)
    env_id = sparse_env_id(env_id)
    return shipped_demonstrations(env_id) if env_id.rpartition(":")[2].startswith("Sparse") else None


def takes_demonstrations(run: Run) -> bool:
    """Whether the run's algorithm has a keyword for them."""
    return "demonstrations" in constructor_keywords(load_algorithm(run.algo))


def missing_demonstrations(run: Run) -> str:
    """A sentence where the algorithm would take shipped demonstrations and the task has none, else an empty string."""
    if run.demonstrations != "shipped" or not takes_demonstrations(run) or find_demonstrations(run.env, "shipped") is not None:
        return ""
    return f"{run.env}: no demonstrations are shipped for it, so there are none (--demonstrations FILE gives some)"


def demonstrations_hash(run: Run) -> str | None:
    """SHA-256 of what a run's demonstrations hold, None for none; FileNotFoundError when they are not there."""
    try:
        found = find_demonstrations(run.env, run.demonstrations)
    except FileNotFoundError:
        if takes_demonstrations(run):
            raise
        return None
    if found is None:
        return None
    files = minari_files(found) if isinstance(found, str) else [found]
    return file_hash(*files)
