"""Plain values to JSON and arrays, and back: what a checkpoint can hold without running code when it is read."""

import math
import random
import types
from collections import OrderedDict, defaultdict, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from enum import Enum
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

_NOT_NUMBERS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
_ARRAY_KINDS = "biuf"
_BIT_GENERATORS = ("MT19937", "PCG64", "Philox")
# what a value of these types holds is made anew by the constructors, or never changes
_LEFT_ALONE: tuple[type, ...] = (type, np.dtype, th.device, Enum, EnvSpec, ResultsWriter)
_LEFT_ALONE += (types.FunctionType, types.MethodType, types.BuiltinFunctionType, types.ModuleType)
_LEFT_ALONE_NAMES = ("mujoco._structs.MjModel", "gymnasium.envs.mujoco.mujoco_rendering.MujocoRenderer")
# objects whose attributes are written one by one into an object of the same class that is there already
_TRANSPARENT: tuple[type, ...] = (RunningMeanStd, StackedObservations, ActionNoise)


class OpaqueValue(ValueError):
    """A value that cannot be written without running code when it is read."""

    def __init__(self, where: str, value: Any) -> None:
        super().__init__(f"{where}: a {type(value).__module__}.{type(value).__qualname__} cannot be stored as plain data")


class Encoder:
    """Turns values into JSON; the arrays and tensors in them are collected beside it.

    Kinds: None, bool, int, float, str, list, tuple, dict, deque, set, bytes, NumPy scalars and arrays of numbers, tensors,
    NumPy's and Python's random generators, spaces (their generators), and objects of a few known classes.
    """

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray] = {}
        self.tensors: dict[str, th.Tensor] = {}
        self._open: set[int] = set()

    def encode(self, value: Any, where: str) -> Any:
        """JSON of a value; its path names the arrays in it. OpaqueValue when it, or something in it, is of another kind or
        contains itself."""
        if value is None or isinstance(value, (bool, str)) or type(value) is int:
            return value
        if type(value) is float:
            return value if math.isfinite(value) else {"number": str(value)}
        if isinstance(value, (np.ndarray, np.generic, th.Tensor)):
            return self._array(value, where)
        if isinstance(value, (list, tuple, deque, set, dict)):
            return self._container(value, where)
        return self._object(value, where)

    def encode_some(self, values: Mapping[str, Any], where: str) -> dict[str, Any]:
        """JSON of those values that can be stored, by name; the others are for their owner to make anew."""
        stored = {}
        for name, value in values.items():
            with suppress(OpaqueValue):
                stored[name] = self.encode(value, f"{where}.{name}")
        return stored

    def _array(self, value: np.ndarray | np.generic | th.Tensor, where: str) -> dict[str, Any]:
        if isinstance(value, th.Tensor):
            name = f"{where}#{len(self.tensors)}"
            self.tensors[name] = value.detach()
            return {"tensor": name}
        if isinstance(value, np.ndarray) and value.dtype == object and value.size == 0:
            return {"empty": list(value.shape)}
        if value.dtype.kind not in _ARRAY_KINDS or value.dtype.itemsize > 8:
            raise OpaqueValue(where, value)
        name = f"{where}#{len(self.arrays)}"
        self.arrays[name] = np.asarray(value)
        return {"scalar" if isinstance(value, np.generic) else "array": name}

    def _container(self, value: Any, where: str) -> Any:
        if id(value) in self._open:
            raise OpaqueValue(where, value)
        self._open.add(id(value))
        try:
            if isinstance(value, dict):
                kind = "ordered" if type(value) is OrderedDict else "dict"
                pairs = value.items()
                return {kind: [[self.encode(key, where), self.encode(part, f"{where}.{key}")] for key, part in pairs]}
            parts = [self.encode(part, f"{where}.{index}") for index, part in enumerate(value)]
        finally:
            self._open.discard(id(value))
        if isinstance(value, deque):
            return {"deque": parts, "maxlen": value.maxlen}
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            raise OpaqueValue(where, value)
        return parts if isinstance(value, list) else {"tuple" if isinstance(value, tuple) else "set": parts}

    def _object(self, value: Any, where: str) -> dict[str, Any]:
        if isinstance(value, np.random.Generator):
            return {"generator": self.encode(value.bit_generator.state, where)}
        if isinstance(value, np.random.RandomState):
            return {"random_state": self.encode(value.get_state(legacy=False), where)}
        if isinstance(value, random.Random):
            return {"random": self.encode(value.getstate(), where)}
        if isinstance(value, bytes):
            return {"bytes": value.hex()}
        if isinstance(value, spaces.Space):
            generators = [part._np_random for part in _subspaces(value)]  # None where it has not been used
            states = [None if one is None else dict(one.bit_generator.state) for one in generators]
            return {"space": self.encode(states, where)}
        if isinstance(value, _LEFT_ALONE) or f"{type(value).__module__}.{type(value).__qualname__}" in _LEFT_ALONE_NAMES:
            return {"left": type(value).__qualname__}
        if isinstance(value, _TRANSPARENT):
            return {"object": type(value).__qualname__, "attributes": self.encode(vars(value), where)}
        raise OpaqueValue(where, value)


class Decoder:
    """The inverse of :class:`Encoder`, given the arrays and tensors by the names that it gave them."""

    def __init__(self, arrays: Mapping[str, np.ndarray], tensors: Mapping[str, th.Tensor]) -> None:
        self.arrays, self.tensors = arrays, tensors

    def decode(self, node: Any, existing: Any = None) -> Any:
        """The value of JSON that :meth:`Encoder.encode` returned, new where it can be; of ``existing``, the value that is
        there now, generators, spaces and objects are changed in place. ValueError for JSON of another form, or an existing
        value of another kind."""
        if not isinstance(node, (dict, list)):
            return node
        if isinstance(node, list):
            old = existing if isinstance(existing, list) else []
            return [self.decode(part, old[index] if index < len(old) else None) for index, part in enumerate(node)]
        kind = str(next(iter(node), ""))
        if kind == "left":
            return existing
        if kind in _PLAIN_KINDS:
            return _PLAIN_KINDS[kind](self, node)
        method = getattr(self, f"_{kind}", None) if not kind.startswith("_") else None
        if method is None:
            raise ValueError(f"a value of the unknown kind {kind!r} is stored: the file was written by another version")
        return method(node, existing)

    def _dict(self, node: dict[str, Any], existing: Any) -> dict[Any, Any]:
        old = existing if isinstance(existing, dict) else {}
        new = {}
        for key_node, part in node["dict"]:
            key = self.decode(key_node)
            new[key] = self.decode(part, old.get(key))
        if isinstance(existing, defaultdict):
            existing.clear()
            existing.update(new)
            return existing
        return new

    def _ordered(self, node: dict[str, Any], existing: Any) -> OrderedDict[Any, Any]:
        return OrderedDict(self._dict({"dict": node["ordered"]}, existing))

    def _generator(self, node: dict[str, Any], existing: Any) -> np.random.Generator:
        state = self.decode(node["generator"])
        name = state["bit_generator"]
        if not isinstance(existing, np.random.Generator) or type(existing.bit_generator).__name__ != name:
            if name not in _BIT_GENERATORS:
                raise ValueError(f"the generator {name!r} is unknown; expected one of {sorted(_BIT_GENERATORS)}")
            existing = np.random.Generator(getattr(np.random, name)())
        existing.bit_generator.state = state
        return existing

    def _random_state(self, node: dict[str, Any], existing: Any) -> np.random.RandomState:
        made = existing if isinstance(existing, np.random.RandomState) else np.random.RandomState()
        made.set_state(self.decode(node["random_state"]))
        return made

    def _random(self, node: dict[str, Any], existing: Any) -> random.Random:
        made = existing if isinstance(existing, random.Random) else random.Random()
        made.setstate(self.decode(node["random"]))
        return made

    def _space(self, node: dict[str, Any], existing: Any) -> Any:
        if isinstance(existing, spaces.Space):
            for part, state in zip(_subspaces(existing), self.decode(node["space"]), strict=True):
                if state is not None:
                    part.np_random.bit_generator.state = state
        return existing

    def _object(self, node: dict[str, Any], existing: Any) -> Any:
        if type(existing).__qualname__ != node["object"]:
            found = type(existing).__qualname__
            raise ValueError(f"expected a {node['object']}, found a {found}: make it as it was made before")
        vars(existing).update(self.decode(node["attributes"], vars(existing)))
        return existing


# kinds that are made new from the JSON alone
_PLAIN_KINDS: dict[str, Callable[[Decoder, dict[str, Any]], Any]] = {
    "number": lambda decoder, node: _NOT_NUMBERS[node["number"]],
    "array": lambda decoder, node: decoder.arrays[node["array"]].copy(),
    "scalar": lambda decoder, node: decoder.arrays[node["scalar"]][()],
    "tensor": lambda decoder, node: decoder.tensors[node["tensor"]].clone(),
    "empty": lambda decoder, node: np.empty(node["empty"], dtype=object),
    "tuple": lambda decoder, node: tuple(decoder.decode(part) for part in node["tuple"]),
    "set": lambda decoder, node: {decoder.decode(part) for part in node["set"]},
    "deque": lambda decoder, node: deque((decoder.decode(part) for part in node["deque"]), maxlen=node["maxlen"]),
    "bytes": lambda decoder, node: bytes.fromhex(node["bytes"]),
}


def _subspaces(space: spaces.Space) -> list[spaces.Space]:
    """The space and all spaces in it, in a fixed order."""
    parts: Any = space.spaces if isinstance(space, (spaces.Dict, spaces.Tuple, spaces.OneOf)) else ()
    parts = parts.values() if isinstance(space, spaces.Dict) else parts
    return [space, *(inner for part in parts for inner in _subspaces(part))]
