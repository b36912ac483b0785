"""What may be passed to the constructor of :class:`~sb3_actpc.actpc.actpc.ActPC`: checked before anything is made of it."""

import inspect
from collections.abc import Collection, Mapping
from numbers import Integral
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.vec_env import VecEnv

from sb3_actpc.actpc.reward_signals import NORMALIZERS, SIGNAL_ERRORS
from sb3_actpc.ngc.circuit import LARGEST_SIZE as LARGEST_LAYER
from sb3_actpc.ngc.circuit import SETTLINGS
from sb3_actpc.utils.checks import LARGEST_SIZE, check_choices, check_device, check_kinds, check_range

BOOTSTRAPS = ("joint", "literal")
TARGET_UPDATES = ("polyak", "hard")
OBSERVATION_NORMALIZATIONS = ("none", "demonstrations")
CIRCUITS = ("actor", "critic", "generator", "prior")
MAX_CRITICS = 100
MAX_SEED = 2**32 - 1  # NumPy's


def check_keywords(given: Mapping[str, Any], policies: Mapping[str, type[BasePolicy]]) -> None:
    """
    :param given: all keywords of the constructor
    :param policies: the policies that have names, all of them subclasses of ``MlpPolicy``
    :raises ValueError: naming the first value that is not allowed, what is allowed, and how to mend it
    """
    check_kinds(
        given,
        numbers="tau gamma learning_starts refresh_weight refresh_noise demonstration_fraction alpha_ep alpha_in "
        "actor_pressure target_policy_noise target_noise_clip",
        whole="buffer_size batch_size n_steps gradient_steps prior_updates actor_warm_start self_imitation_size "
        "critic_warmup n_critics target_update_interval memory_history stats_window_size verbose",
        optional="alpha_ext nudge",
        optional_whole="n_demonstrations n_demonstration_transitions seed",
        flags="optimize_memory_usage scale_pressure combined_replay working_memory",
        paths="tensorboard_log",
        mappings=" ".join(["circuit_kwargs policy_kwargs replay_buffer_kwargs", *(f"{name}_kwargs" for name in CIRCUITS)]),
    )
    check_choices(
        given,
        settling=SETTLINGS,
        signal_normalizer=NORMALIZERS,
        signal_errors=SIGNAL_ERRORS,
        bootstrap=BOOTSTRAPS,
        target_update=TARGET_UPDATES,
        observation_normalization=OBSERVATION_NORMALIZATIONS,
    )
    check_range(
        given,
        "learning_starts prior_updates actor_warm_start refresh_weight refresh_noise actor_pressure critic_warmup "
        "target_policy_noise target_noise_clip",
        0,
    )
    check_range(given, "self_imitation_size", 0, LARGEST_SIZE)
    check_range(given, "buffer_size batch_size n_steps memory_history stats_window_size", 1, LARGEST_SIZE)
    check_range(given, "target_update_interval n_demonstrations n_demonstration_transitions", 1)
    check_range(given, "gradient_steps", -1)
    check_range(given, "n_critics", 1, MAX_CRITICS)
    check_range(given, "tau gamma demonstration_fraction", 0, 1)
    check_range(given, "seed", 0, MAX_SEED)
    if given["nudge"] is not None and not 0.0 < given["nudge"] <= 1.0:
        raise ValueError(f"nudge={given['nudge']!r} must be above 0 and at most 1")
    check_device(given["device"])
    _check_learning_rate(given["learning_rate"])
    _check_train_freq(given["train_freq"])
    _check_objects(given, policies)
    known = set(inspect.signature(policies["MlpPolicy"].__init__).parameters)
    _check_policy_kwargs(given["policy_kwargs"] or {}, known - {"self", "observation_space", "action_space", "lr_schedule"})


def _check_learning_rate(learning_rate: Any) -> None:
    try:
        start = float(learning_rate(1.0)) if callable(learning_rate) else learning_rate
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"learning_rate={learning_rate!r} must be a number, or a function of the remaining progress (1 to 0): {error}"
        ) from error
    check_kinds({"learning_rate": start}, numbers="learning_rate")
    check_range({"learning_rate": start}, "learning_rate", 0)


def _check_train_freq(train_freq: Any) -> None:
    frequency, unit = train_freq if isinstance(train_freq, tuple) and len(train_freq) == 2 else (train_freq, "step")
    is_known = isinstance(train_freq, TrainFreq) or unit in ("step", "episode")
    if not is_known or not isinstance(frequency, int) or not 1 <= frequency <= LARGEST_SIZE:
        raise ValueError(f"train_freq={train_freq!r} must be a whole number of at least 1, or (number, 'step' or 'episode')")


def _check_objects(given: Mapping[str, Any], policies: Mapping[str, type[BasePolicy]]) -> None:
    policy, env, noise = given["policy"], given["env"], given["action_noise"]
    base = policies["MlpPolicy"]
    is_name = isinstance(policy, str) and policy in policies
    if not is_name and not (isinstance(policy, type) and issubclass(policy, base)):
        raise ValueError(f"policy={policy!r} must be one of {list(policies)}, or a subclass of {base.__name__}")
    if not isinstance(env, (str, gym.Env, VecEnv)) and given["_init_setup_model"]:
        raise ValueError(f"env={env!r} must be an environment or the id of one, such as 'Pendulum-v1'")
    if noise is not None and not isinstance(noise, ActionNoise):
        raise ValueError(f"action_noise={noise!r} must be None or one of SB3's, such as NormalActionNoise(mean, sigma)")


def _check_policy_kwargs(policy_kwargs: Mapping[str, Any], known: Collection[str]) -> None:
    unknown = sorted(set(policy_kwargs) - set(known))
    if unknown:
        raise ValueError(f"policy_kwargs has unknown keys {unknown}; choose from {sorted(known)}")
    check_kinds({"circuit_kwargs": policy_kwargs.get("circuit_kwargs")}, mappings="circuit_kwargs")


# ---------------------------------------------------------------------- the policy's


def check_policy_keywords(given: Mapping[str, Any]) -> None:
    """
    :param given: keywords of :class:`~sb3_actpc.actpc.policies.ActPCPolicy`
    :raises ValueError: naming the first value that is not allowed; circuits check their own
    """
    of_circuits = [f"{name}_kwargs" for name in CIRCUITS]
    check_kinds(
        given,
        whole="n_critics memory_history",
        flags="normalize_images",
        mappings=" ".join(["circuit_kwargs", *of_circuits, "features_extractor_kwargs", "optimizer_kwargs"]),
    )
    check_range(given, "n_critics", 1, MAX_CRITICS)
    check_range(given, "memory_history", 0, LARGEST_SIZE)
    _check_arch(given["net_arch"])
    _check_classes(given["features_extractor_class"], given["optimizer_class"])
    for name in of_circuits:
        _check_own_settings(name, given[name] or {})


def _check_arch(net_arch: Any) -> None:
    parts = net_arch if isinstance(net_arch, dict) else {"pi": net_arch}
    unknown = sorted(set(parts) - {"pi", "qf", "generator", "prior"}, key=str)
    if unknown:
        raise ValueError(f"net_arch has unknown keys {unknown}; choose from pi, qf, generator, prior")
    for sizes in parts.values():
        _check_hidden("net_arch", sizes)


def _check_hidden(where: str, sizes: Any) -> None:
    """Sizes of hidden layers, or None for the default."""
    if sizes is None:
        return
    if not isinstance(sizes, (list, tuple)) or not all(_is_size(size) for size in sizes):
        raise ValueError(f"{where}={sizes!r} must be a list of layer sizes, whole numbers from 1 to {LARGEST_LAYER}")


def _check_classes(features_extractor_class: Any, optimizer_class: Any) -> None:
    for name, value, base in (
        ("features_extractor_class", features_extractor_class, BaseFeaturesExtractor),
        ("optimizer_class", optimizer_class, th.optim.Optimizer),
    ):
        if not isinstance(value, type) or not issubclass(value, base):
            raise ValueError(f"{name}={value!r} must be a subclass of {base.__name__}")


def _check_own_settings(where: str, settings: Mapping[str, Any]) -> None:
    """What a circuit can have of its own beside the keywords of every circuit."""
    own = {f"{where}[{key!r}]": value for key, value in settings.items() if key in ("learning_rate", "batch_size")}
    for name in own:
        is_size = "batch_size" in name
        check_kinds(own, **{"whole" if is_size else "numbers": name})
        check_range(own, name, 1 if is_size else 0, LARGEST_SIZE)
    _check_hidden(f"{where}['net_arch']", settings.get("net_arch"))


def _is_size(value: Any) -> bool:
    is_whole = isinstance(value, Integral)
    return is_whole and 1 <= value <= LARGEST_LAYER
