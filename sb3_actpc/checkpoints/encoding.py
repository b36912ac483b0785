"""Values to JSON and arrays, and back. Reading them runs no code from the file.

A value that JSON does not have becomes a node in a table and is referred to by its number, ``[number]``. So what is held twice
is written once, and a value may hold itself. What cannot be written becomes a node that says so. Functions and classes go by
their names, and objects by their attributes: the program that reads must have them.
"""

import functools
import inspect
import logging
import pathlib
import random
import sys
import types
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import torch as th
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import VecEnv

Node = dict[str, Any]
_DICTS: tuple[type, ...] = (dict, OrderedDict, Counter)
_CONTAINERS: dict[str, Any] = {kind.__name__: kind for kind in (list, tuple, set, frozenset, deque, *_DICTS)}
# constructors make these again, or they never change
_UNCHANGED: tuple[Any, ...] = (
    *(type, np.dtype, th.device, types.ModuleType, logging.Logger, pathlib.PurePath),
    *(EnvSpec, ResultsWriter, mujoco.MjModel),
)
# how a class says that its objects are copied in another way than by their attributes
_COPIED_BY = ("__reduce__", "__reduce_ex__", "__getnewargs__", "__getnewargs_ex__", "__getstate__", "__setstate__")
_METHODS = (types.MethodType, types.BuiltinFunctionType)
# attributes of environments that the constructors make again, or the next step, and the time of the clock
_SKIPPED = {"metadata", "_metadata", "spec", "_cached_spec", "results_writer", "t_start"}
_SKIPPED_OF_VEC_ENVS = {"metadata", "class_attributes", "buf_infos", "reset_infos", "results_writer", "t_start"}
# each step of MuJoCo makes these again, and their memory is not always that of the data
_IN_ARENA = ("efc_", "contact", "iefc_", "iM", "iLD", "iacc", "ifrc_")
_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION


def _class_name(value: Any) -> str:
    return type(value.bit_generator if isinstance(value, np.random.Generator) else value).__qualname__


def _module_of(thing: Any) -> str:
    """Types of C libraries, such as Box2D's, may have none."""
    return getattr(thing, "__module__", None) or "builtins"


def _name_of(thing: Any) -> str:
    """What a function, a class or a module goes by, and others by their class."""
    thing = thing.func if isinstance(thing, functools.partial) else thing
    if isinstance(thing, types.ModuleType):
        return thing.__name__
    thing = thing if hasattr(thing, "__qualname__") else type(thing)
    line = f":{thing.__code__.co_firstlineno}" if isinstance(thing, types.FunctionType) else ""
    return f"{_module_of(thing)}.{thing.__qualname__}{line}"


def _is_plain(value: Any) -> bool:
    """Whether an object holds nothing but its attributes, by what Python's ``copy`` would do. Those of Python's own library
    may stand for processes or files."""
    kind = type(value)
    is_of_python = _module_of(kind).partition(".")[0] in sys.stdlib_module_names
    copies_itself = any(getattr(kind, name, None) is not getattr(object, name, None) for name in _COPIED_BY)
    if is_of_python or copies_itself or not hasattr(value, "__dict__"):
        return False
    try:
        _, arguments, state, *items = value.__reduce_ex__(2)
    except TypeError:  # object's own: it cannot be copied
        return False
    return arguments == (kind,) and isinstance(state, (dict, types.NoneType)) and items == [None, None]


def _filled_cells(function: Any) -> list[Any]:
    """Its closure's cells without those that hold nothing yet."""
    return [cell for cell in function.__closure__ or () if cell != types.CellType()]


def physics_arrays(data: mujoco.MjData) -> dict[str, np.ndarray]:
    """MuJoCo's real arrays whose sizes the model sets, by name; indices are scratch memory."""
    named = {name: getattr(data, name) for name in dir(data) if not name.startswith(("_", *_IN_ARENA))}
    arrays = {name: value for name, value in named.items() if isinstance(value, np.ndarray)}
    return {name: value for name, value in arrays.items() if value.dtype.kind == "f" and value.size}


def capture_physics(data: mujoco.MjData) -> dict[str, np.ndarray]:
    """The full integration state, (n,) float64 under "", and copies of the other arrays, since some lag behind the state."""
    state = np.empty(mujoco.mj_stateSize(data.model, _INTEGRATION))
    mujoco.mj_getState(data.model, data, state, _INTEGRATION)
    return {"": state, **{name: np.array(value) for name, value in physics_arrays(data).items()}}


def restore_physics(data: mujoco.MjData, arrays: dict[str, np.ndarray]) -> None:
    """Put back what :func:`capture_physics` returned; ValueError when it is of another simulation."""
    size = len(arrays[""])
    own = mujoco.mj_stateSize(data.model, _INTEGRATION)
    if size != own:
        raise ValueError(f"the simulator had {size} state variables, this one has {own}")
    mujoco.mj_setState(data.model, data, arrays[""], _INTEGRATION)
    mujoco.mj_forward(data.model, data)
    for name, value in physics_arrays(data).items():
        if name in arrays and arrays[name].shape == value.shape:
            value[...] = arrays[name]


# made from one array
_FROM_ARRAY: dict[str, Callable[[np.ndarray], Any]] = {
    "array": np.copy,
    "scalar": lambda array: array[()],
    "tensor": lambda array: th.from_numpy(array.copy()),
    "bytes": lambda array: array.tobytes(),
}
# generators that are made where there is none yet, by the name of their class
_NEW: dict[str, Callable[[], Any]] = {
    "PCG64": np.random.default_rng,
    "RandomState": np.random.RandomState,
    "Random": random.Random,
}
# what is changed in place: the classes, how to get the state and how to put it back
_STATES: dict[str, tuple[Any, Callable[[Any], Any], Callable[[Any, Any], None]]] = {
    "generator": (
        np.random.Generator,
        lambda one: one.bit_generator.state,
        lambda one, state: setattr(one.bit_generator, "state", state),
    ),
    "random_state": (np.random.RandomState, lambda one: one.get_state(legacy=False), np.random.RandomState.set_state),
    "random": (random.Random, random.Random.getstate, random.Random.setstate),
    "physics": (mujoco.MjData, capture_physics, restore_physics),
}


class Encoder:
    """Collects the table of nodes and the arrays in it, and why some values cannot be stored (``lost``)."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.arrays: dict[str, np.ndarray] = {}
        self.lost: list[str] = []
        self._numbers: dict[int, tuple[int, Any]] = {}  # by id; the value is kept, so that no other one gets its id

    def encode(self, value: Any) -> Any:
        """Itself, or a reference to its node."""
        if value is None or type(value) in (bool, int, float, str):
            return value
        number, _ = self._numbers.setdefault(id(value), (len(self.nodes), value))
        if number == len(self.nodes):
            node: Node = {}
            self.nodes.append(node)
            try:
                node.update(self._node(value))
            except RecursionError:
                node.update(self._lost(f"a {_name_of(value)} holds others too many levels deep"))
        return [number]

    def encode_each(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """JSON of values by name."""
        return {name: self.encode(value) for name, value in values.items()}

    def _node(self, value: Any) -> Node:
        if isinstance(value, th.Tensor):
            return self._stored("tensor", value.detach().cpu().numpy())
        if isinstance(value, (np.ndarray, np.generic)):
            return self._array(value)
        if isinstance(value, bytes):
            return self._stored("bytes", np.array(list(value), dtype=np.uint8))
        if type(value) in _CONTAINERS.values():
            return self._container(value)
        for kind, (classes, get_state, _) in _STATES.items():
            if isinstance(value, classes):
                return {"kind": kind, "name": _class_name(value), "state": self.encode(get_state(value))}
        return self._by_name(value)

    def _by_name(self, value: Any) -> Node:
        if isinstance(value, types.FunctionType):
            cells = [cell.cell_contents for cell in _filled_cells(value)]
            return {"kind": "function", "name": _name_of(value), "cells": self.encode(cells)}
        if isinstance(value, _METHODS) and not isinstance(value.__self__, (type, types.ModuleType, types.NoneType)):
            return {"kind": "method", "name": value.__name__, "of": self.encode(value.__self__)}
        if isinstance(value, Enum):
            return {"kind": "enum", "name": _name_of(value), "value": self.encode(value.value)}
        if isinstance(value, (*_UNCHANGED, *_METHODS, functools.partial)) or type(value).__name__ == "MujocoRenderer":
            return {"kind": "unchanged", "name": _name_of(value)}
        if isinstance(value, (gym.Env, gym.Space, VecEnv)) or _is_plain(value):
            return self._object(value)
        return self._lost(f"a {_name_of(value)} cannot be stored as plain data")

    def _lost(self, reason: str) -> Node:
        self.lost.append(reason)
        return {"kind": "lost", "reason": reason}

    def _stored(self, kind: str, array: np.ndarray) -> Node:
        name = str(len(self.arrays))
        self.arrays[name] = array
        return {"kind": kind, "array": name}

    def _array(self, value: Any) -> Node:
        if value.dtype.kind not in "biuf" or value.dtype.itemsize > 8:
            return self._lost(f"an array of {value.dtype} cannot be stored as plain data")
        if isinstance(value, np.generic):
            return self._stored("scalar", np.asarray(value))
        owner = value
        while isinstance(owner.base, np.ndarray):
            owner = owner.base
        if type(owner.base).__name__ == "PyCapsule":
            return self._lost("an array that shares memory with another object cannot be stored")
        return self._stored("array", value)

    def _container(self, value: Any) -> Node:
        node: Node = {"kind": type(value).__name__}
        if isinstance(value, dict):
            return {**node, "items": [[self.encode(key), self.encode(part)] for key, part in value.items()]}
        return {**node, "maxlen": getattr(value, "maxlen", None), "items": [self.encode(part) for part in value]}

    def _object(self, value: Any) -> Node:
        # statically: SB3's wrappers pass on attributes of what they wrap
        skipped = set(inspect.getattr_static(value, "checkpoint_skipped", ()))
        if isinstance(value, gym.Env):
            skipped |= _SKIPPED
        elif isinstance(value, VecEnv):
            skipped |= _SKIPPED_OF_VEC_ENVS
        kept = {name: one for name, one in vars(value).items() if name not in skipped}
        own = self.encode(value.checkpoint_state()) if hasattr(type(value), "checkpoint_state") else None
        return {"kind": "object", "name": _name_of(value), "own": own, "attributes": self.encode_each(kept)}


class Decoder:
    """The inverse of :class:`Encoder`, given its table and arrays; collects which attributes of objects could not be put back
    and why (``lost``)."""

    def __init__(self, nodes: Sequence[Node], arrays: Mapping[str, np.ndarray]) -> None:
        self.nodes = nodes
        self.arrays = arrays
        self.lost: list[str] = []
        self._made: dict[int, Any] = {}
        self._used: set[int] = set()  # ids of what has been given a state

    def decode(self, value: Any, existing: Any = None) -> Any:
        """
        :param value: what :meth:`Encoder.encode` returned
        :param existing: the value that is there now; generators, spaces, functions and objects are changed in place
        :return: the value, the same one for the same number
        :raises ValueError: when it was not stored, or cannot be made from what is there now
        """
        if not isinstance(value, list):
            return value
        (number,) = value
        if number not in self._made:
            try:
                self._made[number] = self._make(number, existing)
            except ValueError:
                self._made.pop(number, None)  # lost for those who refer to it later, too
                raise
        return self._made[number]

    def decode_into(self, owner: Any, attributes: Mapping[str, Any]) -> None:
        """Put stored attributes of an object back; those that cannot be made stay as they are."""
        for name, node in attributes.items():
            try:
                vars(owner)[name] = self.decode(node, vars(owner).get(name))
            except ValueError as error:
                self.lost.append(f"{type(owner).__qualname__}.{name}: {error}")

    def _make(self, number: int, existing: Any) -> Any:
        node = self.nodes[number]
        kind = node["kind"]
        if kind == "lost":
            raise ValueError(node["reason"])
        if kind in _FROM_ARRAY:
            return _FROM_ARRAY[kind](self.arrays[node["array"]])
        if kind in _CONTAINERS:
            return self._container(number, existing)
        if kind in _STATES:
            return self._with_state(number, existing)
        if kind == "method":
            return self._method(node, existing)
        if _name_of(existing) != node["name"]:
            raise ValueError(f"it was {node['name']}, and is {_name_of(existing)} when made again")
        if kind == "enum":
            return type(existing)(self.decode(node["value"]))
        self._made[number] = existing  # what it holds may refer to it
        if kind == "function":
            self._fill_cells(node, existing)
        if kind == "object":
            self._fill(node, existing)
        return existing

    def _container(self, number: int, existing: Any) -> Any:
        node = self.nodes[number]
        kind = _CONTAINERS[node["kind"]]
        items = node["items"]
        if kind not in (list, deque, *_DICTS):  # it cannot hold itself
            return kind(self._parts(items, existing))
        made = deque(maxlen=node["maxlen"]) if kind is deque else kind()
        self._made[number] = made
        if kind not in _DICTS:
            made.extend(self._parts(items, existing))
            return made
        old = existing if isinstance(existing, dict) else {}
        for key_node, part in items:
            key = self.decode(key_node)
            made[key] = self.decode(part, old.get(key))
        return made

    def _parts(self, items: list[Any], existing: Any) -> list[Any]:
        old = list(existing) if isinstance(existing, (list, tuple, deque)) else []
        return [self.decode(part, old[index] if index < len(old) else None) for index, part in enumerate(items)]

    def _with_state(self, number: int, existing: Any) -> Any:
        node = self.nodes[number]
        name = node["name"]
        if _class_name(existing) != name or (name in _NEW and id(existing) in self._used):
            if name not in _NEW:
                raise ValueError(f"it was a {name}, and is a {_class_name(existing)} when made again")
            existing = _NEW[name]()
        self._used.add(id(existing))
        self._made[number] = existing
        _, _, put_back = _STATES[node["kind"]]
        put_back(existing, self.decode(node["state"]))
        return existing

    def _method(self, node: Node, existing: Any) -> Any:
        method = getattr(self.decode(node["of"], getattr(existing, "__self__", None)), node["name"], None)
        if method is None:
            raise ValueError(f"it was the method {node['name']}, which is not there now")
        return method

    def _fill_cells(self, node: Node, function: Any) -> None:
        cells = _filled_cells(function)
        contents = self.decode(node["cells"], [cell.cell_contents for cell in cells])
        for cell, content in zip(cells, contents, strict=True):
            cell.cell_contents = content

    def _fill(self, node: Node, existing: Any) -> None:
        if id(existing) in self._used:
            raise ValueError(f"it was a second {node['name']}, and is the same one when made again")
        self._used.add(id(existing))
        if node["own"] is not None:
            existing.restore_checkpoint_state(self.decode(node["own"]))
        self.decode_into(existing, node["attributes"])
