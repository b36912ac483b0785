"""The algorithms by name, and what their constructors take."""

import importlib
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_actpc.utils.checks import nearest
from sb3_actpc.utils.constructors import constructor_keywords

# name on the command line -> "module:class", imported only when it is used
ALGORITHMS = {
    "actpc": "sb3_actpc.actpc:ActPC",
    "bc": "sb3_actpc.baselines:BC",
    "bc_rnn": "sb3_actpc.baselines:BCRNN",
    "bcq": "sb3_actpc.baselines:BCQ",
    "cql": "sb3_actpc.baselines:CQL",
    "ddpg": "sb3_actpc.baselines:DDPGDemo",
    "her": "sb3_actpc.baselines:HER",
    "ibrl": "sb3_actpc.baselines:IBRL",
    "logo": "sb3_actpc.baselines:LOGO",
    "ppo": "stable_baselines3:PPO",
    "rlpd": "sb3_actpc.baselines:RLPD",
    "sac": "stable_baselines3:SAC",
    "td3": "sb3_actpc.baselines:TD3Demo",
    "trpo": "sb3_contrib:TRPO",
}
# constructor keywords that have an option of their own, or another name
_OPTION_OF = {
    "env": "--env",
    "seed": "--seed",
    "device": "--device",
    "demonstrations": "--demonstrations",
    "action_noise": "--set noise_type=normal --set noise_std=0.1",
}


def known_algorithm(name: str) -> str:
    """The name; ValueError, with the nearest known one, when it is no key of ``ALGORITHMS``."""
    if name not in ALGORITHMS:
        hint = f"{nearest(name, ALGORITHMS)}: choose one of {', '.join(sorted(ALGORITHMS))}"
        raise ValueError(f"algo={name!r} is no algorithm{hint}")
    return name


def load_algorithm(name: str) -> type[BaseAlgorithm]:
    """Import an algorithm, a key of ``ALGORITHMS``; ValueError when it is none."""
    module, _, class_name = ALGORITHMS[known_algorithm(name)].partition(":")
    return getattr(importlib.import_module(module), class_name)


def check_keywords(algorithm: type[BaseAlgorithm], settings: Mapping[str, Any]) -> None:
    """ValueError for the first of the settings that a class does not take, or that has an option of its own."""
    known = constructor_keywords(algorithm)
    for name in settings:
        if name in _OPTION_OF:
            raise ValueError(f"{name!r} is not set here: use {_OPTION_OF[name]}")
        if name not in known:
            raise ValueError(f"{algorithm.__name__} has no setting {name!r}{nearest(name, known)}")
