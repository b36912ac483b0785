"""The algorithms by name, and what their constructors take."""

import importlib
import os
import re
import sys
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
# constructor keywords that have an option of their own
_OPTION_OF = {name: f"--{name}" for name in ("env", "seed", "device", "demonstrations")}


def known_algorithm(name: str) -> str:
    """The name; ValueError, with the nearest known one, when it is no key of ``ALGORITHMS`` and not ``MODULE:CLASS``."""
    if name not in ALGORITHMS and not re.fullmatch(r"\w+(\.\w+)*:\w+", name):
        hint = f"{nearest(name, ALGORITHMS)}: choose one of {', '.join(sorted(ALGORITHMS))}, or give MODULE:CLASS"
        raise ValueError(f"algo={name!r} is no algorithm{hint}")
    return name


def load_algorithm(name: str) -> type[BaseAlgorithm]:
    """Import an algorithm, a key of ``ALGORITHMS`` or ``MODULE:CLASS``; a module is looked for in the working folder, too.
    ValueError when it is no algorithm of SB3, ImportError when the module is missing."""
    module, _, class_name = ALGORITHMS.get(known_algorithm(name), name).partition(":")
    find_in_working_folder()
    found = getattr(importlib.import_module(module), class_name, None)
    if not (isinstance(found, type) and issubclass(found, BaseAlgorithm)):
        raise ValueError(f"algo={name!r}: {class_name} of {module} must be a subclass of SB3's BaseAlgorithm, found {found!r}")
    return found


def find_in_working_folder() -> None:
    """Let modules be imported from the working folder, as with ``python -m``."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())


def default_preset(name: str) -> str | None:
    """The algorithm's own preset; of ``MODULE:CLASS`` that of the class it extends, None where that has none."""
    if name in ALGORITHMS:
        return name
    targets = {known: re.split("[.:]", target) for known, target in ALGORITHMS.items()}
    known_classes = {(parts[0], parts[-1]): known for known, parts in targets.items()}
    bases = [(base.__module__.partition(".")[0], base.__name__) for base in load_algorithm(name).__mro__]
    return next((known_classes[base] for base in bases if base in known_classes), None)


def check_keywords(algorithm: type[BaseAlgorithm], settings: Mapping[str, Any]) -> None:
    """ValueError for the first of the settings that a class does not take, or that has an option of its own."""
    known = constructor_keywords(algorithm)
    for name in settings:
        if name in _OPTION_OF:
            raise ValueError(f"{name!r} is not set here: use {_OPTION_OF[name]}")
        if name not in known:
            raise ValueError(f"{algorithm.__name__} has no setting {name!r}{nearest(name, known)}")
