"""Values to JSON and arrays, and back. Reading them runs no code from the file.

A value that JSON does not have becomes a node in a table and is referred to by its number, ``[number]``. So what is held twice
is written once, and a value may hold itself. Functions and classes go by their names: the program that reads must have them.
"""

import functools
import random
import sys
import types
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from enum import Enum, Flag
from typing import Any

import mujoco
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import utils as gymnasium_utils
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from sb3_actpc.checkpoints.callables import function_state, name_of
from sb3_actpc.checkpoints.physics import capture_physics, restore_physics

Node = dict[str, Any]
_DICTS: tuple[type, ...] = (dict, OrderedDict, Counter, defaultdict)
_CONTAINERS: dict[str, Any] = {kind.__name__: kind for kind in (list, tuple, set, frozenset, deque, *_DICTS)}
_PLAIN_TYPES = {f"builtins.{kind.__name__}": kind for kind in (int, float, bool, str, list, dict, set, tuple)}
# constructors make these again, or they never change
_UNCHANGED: tuple[type, ...] = (type, np.dtype, th.device, EnvSpec, ResultsWriter, types.ModuleType, mujoco.MjModel)
_METHODS = (types.MethodType, types.BuiltinFunctionType)
# made from one array
_FROM_ARRAY: dict[str, Callable[[np.ndarray], Any]] = {
    "array": np.copy,
    "scalar": lambda array: array[()],
    "tensor": lambda array: th.from_numpy(array.copy()),
    "bytes": lambda array: array.tobytes(),
    "empty": lambda array: array.astype(object),
}


def _new_generator(kind: Callable[[], Any]) -> np.random.Generator:
    return np.random.Generator(kind())


_BIT_GENERATORS: tuple[Any, ...] = (np.random.MT19937, np.random.PCG64, np.random.PCG64DXSM, np.random.Philox, np.random.SFC64)
_NEW: dict[str, Callable[[], Any]] = {
    **{kind.__name__: functools.partial(_new_generator, kind) for kind in _BIT_GENERATORS},
    "RandomState": np.random.RandomState,
    "Random": random.Random,
}


class OpaqueValue(ValueError):
    """A value that cannot be written without running code when it is read."""

    def __init__(self, where: str, value: Any) -> None:
        super().__init__(f"{where}: a {type(value).__module__}.{type(value).__qualname__} cannot be stored as plain data")


class LostValue(ValueError):
    """A stored value that cannot be made from what is there now."""


def _subspaces(space: Any) -> list[Any]:
    """The space and all spaces in it, in a fixed order."""
    parts: Any = space.spaces if isinstance(space, (spaces.Dict, spaces.Tuple, spaces.OneOf)) else ()
    parts = parts.values() if isinstance(space, spaces.Dict) else parts
    return [space, *(inner for part in parts for inner in _subspaces(part))]


def _space_state(space: Any) -> list[Any]:
    generators = [part._np_random for part in _subspaces(space)]  # None where it has not been used
    return [None if one is None else dict(one.bit_generator.state) for one in generators]


def _set_space_state(space: Any, states: list[Any]) -> None:
    for part, state in zip(_subspaces(space), states, strict=True):
        if state is not None:
            part.np_random.bit_generator.state = state


# what is changed in place: the classes, how to get the state and how to put it back
_STATES: dict[str, tuple[Any, Callable[[Any], Any], Callable[[Any, Any], None]]] = {
    "generator": (
        np.random.Generator,
        lambda one: one.bit_generator.state,
        lambda one, state: setattr(one.bit_generator, "state", state),
    ),
    "random_state": (np.random.RandomState, lambda one: one.get_state(legacy=False), np.random.RandomState.set_state),
    "random": (random.Random, random.Random.getstate, random.Random.setstate),
    "space": (spaces.Space, _space_state, _set_space_state),
    "physics": (mujoco.MjData, capture_physics, restore_physics),
    "attributes": (
        (RunningMeanStd, gymnasium_utils.RunningMeanStd, StackedObservations, ActionNoise),
        vars,
        lambda one, state: vars(one).update(state),
    ),
}


def _class_name(value: Any) -> str:
    return type(value.bit_generator if isinstance(value, np.random.Generator) else value).__qualname__


class Encoder:
    """Collects the table of nodes and the arrays in it."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.arrays: dict[str, np.ndarray] = {}
        self.keeps_views = False  # whether views of the same memory stay views, as an environment may need
        self._numbers: dict[int, tuple[int, Any]] = {}  # by id; the value is kept, so that no other one gets its id

    def add(self, value: Any, node: Node) -> int:
        """Enter a node for a value into the table; the number of the value's first node where it has one."""
        number, _ = self._numbers.setdefault(id(value), (len(self.nodes), value))
        if number == len(self.nodes):
            self.nodes.append(node)
        return number

    def encode(self, value: Any, where: str) -> Any:
        """
        :param value: what to write
        :param where: its path, for the error
        :return: itself or a reference, as JSON
        :raises OpaqueValue: when it, or something in it, cannot be written; the table is as before then
        """
        if value is None or type(value) in (bool, int, float) or (isinstance(value, str) and not isinstance(value, Enum)):
            return value
        if id(value) in self._numbers:
            return [self._numbers[id(value)][0]]
        node: Node = {}
        number = self.add(value, node)
        try:
            node.update(self._node(value, where))
        except OpaqueValue:
            del self.nodes[number:]
            while self._numbers and next(reversed(self._numbers.values()))[0] >= number:
                self._numbers.popitem()
            raise
        return [number]

    def encode_some(self, values: Mapping[str, Any], where: str) -> dict[str, Any]:
        """JSON of those values that can be stored, by name."""
        stored = {}
        for name, value in values.items():
            with suppress(OpaqueValue):
                stored[name] = self.encode(value, f"{where}.{name}")
        return stored

    def _node(self, value: Any, where: str) -> Node:
        if isinstance(value, Enum):
            member = value.value if isinstance(value, Flag) else value.name  # of flags together
            return {"kind": "enum", "module": type(value).__module__, "name": type(value).__qualname__, "member": member}
        if isinstance(value, th.Tensor):
            return self._stored("tensor", value.detach().cpu().numpy())
        if isinstance(value, bytes):
            return self._stored("bytes", np.frombuffer(value, np.uint8))
        if isinstance(value, (np.ndarray, np.generic)):
            return self._array(value, where)
        if type(value) in _CONTAINERS.values():
            return self._container(value, where)
        for kind, (classes, get_state, _) in _STATES.items():
            if isinstance(value, classes):
                return {"kind": kind, "name": _class_name(value), "state": self.encode(get_state(value), where)}
        return self._callable(value, where)

    def _stored(self, kind: str, array: np.ndarray) -> Node:
        name = str(len(self.arrays))
        self.arrays[name] = array
        return {"kind": kind, "array": name}

    def _array(self, value: Any, where: str) -> Node:
        if value.dtype == object and value.size == 0:
            return self._stored("empty", value.astype(bool))
        if value.dtype.kind not in "biuf" or value.dtype.itemsize > 8:
            raise OpaqueValue(where, value)
        if isinstance(value, np.generic):
            return self._stored("scalar", np.asarray(value))
        owner = value
        while self.keeps_views and isinstance(owner.base, np.ndarray):
            owner = owner.base
        if self.keeps_views and type(owner.base).__name__ == "PyCapsule":
            raise OpaqueValue(f"{where}, which shares memory with another object", value)
        if owner is value or not owner.flags.c_contiguous or owner.dtype != value.dtype:
            return self._stored("array", value)
        place = {"offset": value.ctypes.data - owner.ctypes.data, "shape": value.shape, "strides": value.strides}
        return {"kind": "view", "of": self.encode(owner, where), **place}

    def _container(self, value: Any, where: str) -> Node:
        node: Node = {"kind": type(value).__name__}
        if isinstance(value, dict):
            node["items"] = [[self.encode(key, where), self.encode(part, f"{where}.{key}")] for key, part in value.items()]
        else:
            node["items"] = [self.encode(part, f"{where}.{index}") for index, part in enumerate(value)]
        if isinstance(value, deque):
            node["maxlen"] = value.maxlen
        if isinstance(value, defaultdict):
            node["factory"] = self.encode(value.default_factory, where)
        return node

    def _callable(self, value: Any, where: str) -> Node:
        if isinstance(value, types.FunctionType):
            return {"kind": "function", "name": name_of(value), "state": self.encode(function_state(value), where)}
        if isinstance(value, functools.partial):
            parts = [value.func, value.args, value.keywords]
            return {"kind": "partial", "parts": self.encode(parts, f"{where}.partial")}
        is_method = isinstance(value, _METHODS)
        if is_method and not isinstance(value.__self__, (type, types.ModuleType, types.NoneType)):
            return {"kind": "method", "name": value.__name__, "of": self.encode(value.__self__, f"{where}.__self__")}
        if is_method or isinstance(value, _UNCHANGED) or type(value).__name__ == "MujocoRenderer":
            return {"kind": "unchanged", "class": type(value).__qualname__, "name": name_of(value)}
        raise OpaqueValue(where, value)


class Decoder:
    """The inverse of :class:`Encoder`, given its table and arrays."""

    def __init__(self, nodes: Sequence[Node], arrays: Mapping[str, np.ndarray]) -> None:
        self.nodes, self.arrays = nodes, arrays
        self._made: dict[int, Any] = {}
        self._open: set[int] = set()
        self._used: set[int] = set()  # ids of what has been given a state

    def add(self, number: int, value: Any) -> None:
        """The value of a node that is there already."""
        self._made[number] = value

    def kind_of(self, reference: Any) -> str:
        """What a reference refers to; empty for a plain value."""
        return self.nodes[reference[0]]["kind"] if isinstance(reference, list) else ""

    def decode(self, value: Any, existing: Any = None) -> Any:
        """
        :param value: what :meth:`Encoder.encode` returned
        :param existing: the value that is there now; generators, spaces, functions and objects are changed in place
        :return: the value, the same one for the same number
        :raises LostValue: when it cannot be made from what is there now
        :raises ValueError: when an existing object is of another class
        """
        if not isinstance(value, list):
            return value
        (number,) = value
        if number in self._made:
            return self._made[number]
        if number in self._open:
            raise LostValue("it holds itself")
        self._open.add(number)
        try:
            self._made[number] = self._make(self.nodes[number], existing, number)
        except LostValue:
            self._made.pop(number, None)
            raise
        finally:
            self._open.discard(number)
        return self._made[number]

    def _make(self, node: Node, existing: Any, number: int) -> Any:
        kind = node["kind"]
        if kind in _FROM_ARRAY:
            return _FROM_ARRAY[kind](self.arrays[node["array"]])
        if kind in _CONTAINERS:
            return self._container(node, existing, number)
        if kind in _STATES:
            return self._put_state(node, existing, number)
        return getattr(self, f"_{kind}")(node, existing, number)

    def _container(self, node: Node, existing: Any, number: int) -> Any:
        kind, items = _CONTAINERS[node["kind"]], node["items"]
        if kind in _DICTS:
            factory = [self.decode(node["factory"], getattr(existing, "default_factory", None))] if "factory" in node else []
            self._made[number] = made = kind(*factory)
            old = existing if isinstance(existing, dict) else {}
            for key_node, part in items:
                key = self.decode(key_node)
                made[key] = self.decode(part, old.get(key))
            return made
        if kind in (list, deque):
            self._made[number] = made = deque(maxlen=node["maxlen"]) if kind is deque else []
            made.extend(self._parts(items, existing))
            return made
        return kind(self._parts(items, existing))

    def _parts(self, items: list[Any], existing: Any) -> list[Any]:
        old = list(existing) if isinstance(existing, (list, tuple, deque)) else []
        return [self.decode(part, old[index] if index < len(old) else None) for index, part in enumerate(items)]

    def _put_state(self, node: Node, existing: Any, number: int) -> Any:
        name = node["name"]
        if _class_name(existing) != name or (name in _NEW and id(existing) in self._used):
            if name not in _NEW:
                raise ValueError(f"expected a {name}, found a {_class_name(existing)}: make it as it was made before")
            existing = _NEW[name]()
        self._used.add(id(existing))
        self._made[number] = existing
        old = vars(existing) if node["kind"] == "attributes" else None
        _STATES[node["kind"]][2](existing, self.decode(node["state"], old))
        return existing

    def _view(self, node: Node, existing: Any, number: int) -> np.ndarray:
        owner = self.decode(node["of"])
        return np.ndarray(tuple(node["shape"]), owner.dtype, owner, node["offset"], tuple(node["strides"]))

    def _layer(self, node: Node, existing: Any, number: int) -> Any:
        raise LostValue("it was an environment that is another now")

    def _unchanged(self, node: Node, existing: Any, number: int) -> Any:
        name = node["name"]
        if name in _PLAIN_TYPES:
            return _PLAIN_TYPES[name]
        if (type(existing).__qualname__, name_of(existing)) == (node["class"], name):
            return existing
        found = name_of(existing) or f"a {type(existing).__qualname__}"
        raise LostValue(f"it was {name or 'a ' + node['class']}, and is {found} when made again")

    def _function(self, node: Node, existing: Any, number: int) -> Any:
        self._made[number] = self._unchanged({"class": "function", "name": node["name"]}, existing, number)
        state = self.decode(node["state"], function_state(existing))
        for name, cell in zip(existing.__code__.co_freevars, existing.__closure__ or (), strict=True):
            if name in state["variables"]:
                cell.cell_contents = state["variables"][name]
        if "defaults" in state:
            existing.__defaults__, existing.__kwdefaults__ = state["defaults"], state["keywords"]
        vars(existing).update(state["attributes"])
        existing.__globals__.update(state["globals"])
        return existing

    def _method(self, node: Node, existing: Any, number: int) -> Any:
        method = getattr(self.decode(node["of"], getattr(existing, "__self__", None)), node["name"], None)
        if not isinstance(method, _METHODS):
            raise LostValue(f"it was the method {node['name']}, which is not there now")
        return method

    def _partial(self, node: Node, existing: Any, number: int) -> Any:
        old = [existing.func, existing.args, existing.keywords] if isinstance(existing, functools.partial) else None
        function, arguments, keywords = self.decode(node["parts"], old)
        return functools.partial(function, *arguments, **keywords)

    def _enum(self, node: Node, existing: Any, number: int) -> Any:
        kind: Any = sys.modules.get(node["module"])
        for part in node["name"].split("."):
            kind = getattr(kind, "__dict__", {}).get(part)
        with suppress(KeyError, ValueError, TypeError):
            if issubclass(kind, Enum):
                return kind(node["member"]) if issubclass(kind, Flag) else kind[node["member"]]
        raise LostValue(f"it was {node['name']}.{node['member']}, which is not there now")
