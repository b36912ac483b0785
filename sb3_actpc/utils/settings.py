"""Constructor settings as plain values. Classes go by their names; reading one runs no code and imports nothing."""

import os
import sys
from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_actpc.utils.constructors import constructor_keywords
from sb3_actpc.utils.noise import GaussianNoise

# a class can be named when it is of one of these packages and of one of these kinds
_PACKAGES = ("torch", "stable_baselines3", "sb3_contrib", "sb3_actpc")
_KINDS: tuple[type, ...] = (th.nn.Module, th.optim.Optimizer, ReplayBuffer)
# schedules and noises: the attribute that holds each argument of the constructor
_OBJECTS: dict[str, tuple[Any, dict[str, str]]] = {
    "linear": (LinearSchedule, {"start": "start", "end": "end", "end_fraction": "end_fraction"}),
    "constant": (ConstantSchedule, {"val": "val"}),
    "normal": (NormalActionNoise, {"mean": "_mu", "sigma": "_sigma"}),
    "ornstein-uhlenbeck": (OrnsteinUhlenbeckActionNoise, {"mean": "_mu", "sigma": "_sigma", "theta": "_theta", "dt": "_dt"}),
}
# chosen by the program that loads, or stored otherwise
_NOT_STORED = {"env", "policy", "device", "verbose"}
FIXED = ("settling", "policy_kwargs")  # keywords on which the networks depend, unseen in their shapes
_ATTRIBUTE_OF = {"stats_window_size": "_stats_window_size"}


def constructor_settings(model: BaseAlgorithm) -> dict[str, Any]:
    """JSON of an SB3 algorithm's constructor keywords by name, the policy's name among them; a value that cannot be named is
    left out and its keyword listed under ``"unnamed"``."""
    policy = next((name for name, kind in model.policy_aliases.items() if kind is model.policy_class), None)
    record: dict[str, Any] = {"policy": policy, "keywords": {}, "unnamed": []}  # None for a class of the user's
    for name in constructor_keywords(type(model)):
        attribute = _ATTRIBUTE_OF.get(name, name)
        if name in _NOT_STORED or not hasattr(model, attribute):
            continue
        try:
            record["keywords"][name] = _name_value(getattr(model, attribute))
        except ValueError:
            record["unnamed"].append(name)
    return record


def read_settings(record: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Keywords of the constructor, ``policy`` among them, from what :func:`constructor_settings` returned; ``overrides``
    replace them. ValueError when a value has no name in this version, or a keyword that could not be stored is not given."""
    missing = [name for name in record["unnamed"] if name not in overrides]
    if missing:
        raise ValueError(f"{', '.join(missing)} could not be stored as plain values: pass the same again, {missing[0]}=...")
    for name in FIXED:
        stored = _read_value(record["keywords"].get(name))
        if name not in record["unnamed"] and (overrides.get(name, stored) or None) != (stored or None):
            raise ValueError(f"{name}={overrides[name]!r}: what was learned depends on {name}={stored!r}, leave it out")
    keywords = {name: _read_value(value) for name, value in record["keywords"].items() if name not in overrides}
    policy = overrides.get("policy", record["policy"])
    if policy is None:
        raise ValueError("the policy's class could not be stored by name: pass the same again, policy=...")
    return {**keywords, **overrides, "policy": policy}


def _name_value(value: Any) -> Any:
    """JSON of one setting; every JSON object has one key, the kind of the value."""
    if isinstance(value, VectorizedActionNoise):
        value = value.base_noise
    if isinstance(value, GaussianNoise):
        return value.std
    if isinstance(value, Enum):
        return value.name.lower()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, TrainFreq):
        return {"tuple": [value.frequency, value.unit.value]}
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {"dict": {key: _name_value(part) for key, part in value.items()}}
    if isinstance(value, (list, tuple)):
        parts = [_name_value(part) for part in value]
        return parts if isinstance(value, list) else {"tuple": parts}
    return _name_object(value)


def _name_object(value: Any) -> dict[str, Any]:
    if isinstance(value, type):
        name = f"{value.__module__}.{value.__qualname__}"
        if _find_class(name) is value:
            return {"class": name}
    if isinstance(value, FloatSchedule):
        return _name_object(value.value_schedule)
    for name, (kind, attributes) in _OBJECTS.items():
        if type(value) is kind:
            return {"object": [name, {key: np.asarray(vars(value)[part]).tolist() for key, part in attributes.items()}]}
    raise ValueError(f"{value!r} has no name here")


def _read_value(node: Any) -> Any:
    """The value of one keyword as :func:`constructor_settings` stored it; ValueError for a class or an object not allowed."""
    if isinstance(node, list):
        return [_read_value(part) for part in node]
    if not isinstance(node, dict):
        return node
    [(kind, content)] = node.items()
    if kind == "tuple":
        return tuple(_read_value(part) for part in content)
    if kind == "dict":
        return {key: _read_value(part) for key, part in content.items()}
    if kind == "object":
        return _make_object(*content)
    found = _find_class(str(content)) if kind == "class" else None
    if found is None:
        raise ValueError(f"the {kind} {content!r} is not one of those of {', '.join(_PACKAGES)}: it is not loaded")
    return found


def _find_class(name: str) -> type | None:
    """The class of a module and name, if it is among the allowed ones and its module has been imported before; otherwise
    None."""
    module, _, attribute = name.rpartition(".")
    found = getattr(sys.modules.get(module), attribute, None) if module.partition(".")[0] in _PACKAGES else None
    return found if isinstance(found, type) and issubclass(found, _KINDS) else None


def _make_object(name: str, values: Mapping[str, Any]) -> Any:
    if name not in _OBJECTS:
        raise ValueError(f"the schedule or noise {name!r} is not one of {sorted(_OBJECTS)}: it is not loaded")
    make, parameters = _OBJECTS[name]
    arrays = {key: np.asarray(values[key], dtype=np.float64) for key in parameters}
    return make(**{key: array if array.ndim else float(array) for key, array in arrays.items()})
