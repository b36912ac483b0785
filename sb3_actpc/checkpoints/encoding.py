"""Plain values to JSON and arrays, and back: what a checkpoint can hold without running code when it is read."""

import dis
import functools
import math
import random
import sys
import types
import zlib
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from enum import Enum, Flag
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import utils as gymnasium_utils
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

_NOT_NUMBERS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
_ARRAY_KINDS = "biuf"
_BIT_GENERATORS = ("MT19937", "PCG64", "Philox")
# what a value of these types holds is made anew by the constructors, or never changes
_LEFT_ALONE: tuple[type, ...] = (type, np.dtype, th.device, EnvSpec, ResultsWriter)
_LEFT_ALONE += (types.BuiltinFunctionType, types.ModuleType)
_METHODS = (types.MethodType, types.BuiltinFunctionType)
_RANDOM = (np.random.Generator, np.random.RandomState, random.Random)
# functions and classes of these, and of Python itself, remember nothing
_LIBRARIES = ("gymnasium", "stable_baselines3", "sb3_contrib", "sb3_actpc", "numpy", "torch", "mujoco", "robosuite")
_LEFT_ALONE_NAMES = ("mujoco._structs.MjModel", "gymnasium.envs.mujoco.mujoco_rendering.MujocoRenderer")
# objects whose attributes are written one by one into an object of the same class that is there already
_TRANSPARENT: tuple[type, ...] = (RunningMeanStd, gymnasium_utils.RunningMeanStd, StackedObservations, ActionNoise)
_DICTS: dict[type, str] = {dict: "dict", OrderedDict: "ordered", Counter: "counter", defaultdict: "default"}
# of an environment: two attributes may hold one of these, and what changes in one then changes in the other
_SHARED: tuple[type, ...] = (np.ndarray, th.Tensor, list, dict, deque, set, *_TRANSPARENT)
_SHARED += _RANDOM
_FACTORIES: dict[str, Any] = {f"builtins.{kind.__name__}": kind for kind in (int, float, bool, str, list, dict, set, tuple)}


class OpaqueValue(ValueError):
    """A value that cannot be written without running code when it is read."""

    def __init__(self, where: str, value: Any) -> None:
        super().__init__(f"{where}: a {type(value).__module__}.{type(value).__qualname__} cannot be stored as plain data")


class LostValue(ValueError):
    """A stored value of an environment that cannot be made from what is there now."""


class Encoder:
    """Turns values into JSON; the arrays and tensors in them are collected beside it.

    Kinds: None, bool, int, float, str, list, tuple, dict, deque, set, bytes, members of enumerations, NumPy scalars and arrays
    of numbers, tensors, NumPy's and Python's random generators, spaces (their generators), and objects of a few known classes.
    Functions and classes go by their names: the new environment must hold the same.
    """

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray] = {}
        self.tensors: dict[str, th.Tensor] = {}
        self._open: set[int] = set()
        self._layers: Sequence[Any] | None = None  # while one environment is written
        self._met: dict[int, tuple[Any, Any, int]] = {}  # by id its values that may be shared, what was written, a number
        self._owners: list[np.ndarray] = []  # its arrays of their own memory
        self._views: list[np.ndarray] = []  # and those of another's
        self._memory: list[np.ndarray] = []  # the arrays of its simulators

    @contextmanager
    def environment(self, layers: Sequence[Any]) -> Iterator[None]:
        """While one environment of these layers is written: what it holds twice is written once and then referred to, and
        layers and their methods go by their places."""
        self._layers = layers
        try:
            yield
        finally:
            self._layers, self._met, self._owners, self._views, self._memory = None, {}, [], [], []

    def encode_alone(self, value: Any, where: str) -> Any:
        """As :meth:`encode`; after an OpaqueValue nothing refers to parts of it."""
        before = dict(self._met)
        try:
            return self.encode(value, where)
        except OpaqueValue:
            self._met = before
            raise

    def add_memory(self, arrays: Mapping[str, np.ndarray], where: str) -> None:
        """The memory of a simulator, whose views no other attribute may hold: they would become copies."""
        self._memory += arrays.values()
        for view in self._views:
            self._check_memory(view, where)

    def encode(self, value: Any, where: str) -> Any:
        """JSON of a value; its path names the arrays in it. OpaqueValue when it, or something in it, is of another kind or
        contains itself."""
        if isinstance(value, Enum):
            kind, name = type(value), value.value if isinstance(value, Flag) else value.name  # of flags together
            return {"enum": kind.__qualname__, "module": kind.__module__, "member": name}
        if value is None or isinstance(value, (bool, str)) or type(value) is int:
            return value
        if type(value) is float:
            return value if math.isfinite(value) else {"number": str(value)}
        if id(value) in self._met:
            return self._refer(value)
        if isinstance(value, (np.ndarray, np.generic, th.Tensor)):
            node = self._array(value, where)
        elif isinstance(value, (list, tuple, deque, set, frozenset, dict)):
            node = self._container(value, where)
        else:
            node = self._object(value, where)
        if self._layers is not None and isinstance(value, _SHARED):
            self._met[id(value)] = value, node, len(self._met)
        return node

    def encode_some(self, values: Mapping[str, Any], where: str) -> dict[str, Any]:
        """JSON of those values that can be stored, by name; the others are for their owner to make anew."""
        stored = {}
        for name, value in values.items():
            with suppress(OpaqueValue):
                stored[name] = self.encode(value, f"{where}.{name}")
        return stored

    def _refer(self, value: Any) -> dict[str, Any]:
        """To what was written before, which gets its number where it is the first time."""
        _, node, number = self._met[id(value)]
        if isinstance(node, dict):
            node["as"] = number
        elif node[:1] != [{"as": number}]:
            node.insert(0, {"as": number})
        return {"same": number, "kind": "list" if isinstance(node, list) else next(iter(node))}

    def _check_memory(self, value: np.ndarray, where: str) -> None:
        """OpaqueValue where an array and another one are views of the same memory."""
        owners = self._owners if value.base is not None else []
        others = [*self._memory, *(other for other in (*self._views, *owners) if other is not value)]
        if any(np.shares_memory(value, other) for other in others):
            raise OpaqueValue(f"{where}, which shares memory with another array", value)

    def _array(self, value: np.ndarray | np.generic | th.Tensor, where: str) -> dict[str, Any]:
        if isinstance(value, th.Tensor):
            name = f"{where}#{len(self.tensors)}"
            self.tensors[name] = value.detach()
            return {"tensor": name}
        if isinstance(value, np.ndarray) and value.dtype == object and value.size == 0:
            return {"empty": list(value.shape)}
        if value.dtype.kind not in _ARRAY_KINDS or value.dtype.itemsize > 8:
            raise OpaqueValue(where, value)
        if self._layers is not None and isinstance(value, np.ndarray):
            self._check_memory(value, where)
            (self._owners if value.base is None else self._views).append(value)
        name = f"{where}#{len(self.arrays)}"
        self.arrays[name] = np.asarray(value)
        return {"scalar" if isinstance(value, np.generic) else "array": name}

    def _container(self, value: Any, where: str) -> Any:
        if id(value) in self._open:
            raise OpaqueValue(where, value)
        self._open.add(id(value))
        try:
            if isinstance(value, dict):
                return self._mapping(value, where)
            parts = [self.encode(part, f"{where}.{index}") for index, part in enumerate(value)]
        finally:
            self._open.discard(id(value))
        if isinstance(value, deque):
            return {"deque": parts, "maxlen": value.maxlen}
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            raise OpaqueValue(where, value)
        if isinstance(value, list):
            return parts
        return {"tuple" if isinstance(value, tuple) else "set" if isinstance(value, set) else "frozenset": parts}

    def _mapping(self, value: dict[Any, Any], where: str) -> dict[str, Any]:
        if type(value) not in _DICTS and self._layers is not None:
            raise OpaqueValue(where, value)
        pairs = [[self.encode(key, where), self.encode(part, f"{where}.{key}")] for key, part in value.items()]
        factory = {"factory": self.encode(value.default_factory, where)} if isinstance(value, defaultdict) else {}
        return {_DICTS.get(type(value), "dict"): pairs, **factory}

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
        if isinstance(value, _TRANSPARENT):
            return {"object": type(value).__qualname__, "attributes": self.encode(vars(value), where)}
        return self._named(value, where)

    def _named(self, value: Any, where: str) -> dict[str, Any]:
        """What goes by a place or a name."""
        place = self._place(value)
        if place is not None:
            return {"layer": place}
        if isinstance(value, types.MethodType):
            owner, name = value.__self__, getattr(value, "__name__", "")
            if self._place(owner) is not None and getattr(type(owner), name, None) is value.__func__:
                return {"method": name, "of": self._place(owner)}
        if isinstance(value, _METHODS) and not isinstance(value.__self__, (type, types.ModuleType, types.NoneType)):
            return {"bound": value.__name__, "of": self.encode(value.__self__, f"{where}.__self__")}
        if isinstance(value, functools.partial):
            parts = {"args": value.args, "keywords": value.keywords}
            return {"partial": self.encode(value.func, f"{where}.func"), "with": self.encode(parts, where)}
        if isinstance(value, types.FunctionType) and id(value) not in self._open:  # which may hold itself
            self._open.add(id(value))
            try:
                return {"function": _name_of(value), "state": self.encode(function_state(value), where)}
            finally:
                self._open.discard(id(value))
        if isinstance(value, (types.FunctionType, types.MethodType)):
            return {"left": type(value).__qualname__, "name": _name_of(value)}
        if isinstance(value, _LEFT_ALONE) or f"{type(value).__module__}.{type(value).__qualname__}" in _LEFT_ALONE_NAMES:
            return {"left": type(value).__qualname__, "name": _name_of(value)}
        raise OpaqueValue(where, value)

    def _place(self, value: Any) -> int | None:
        return next((place for place, layer in enumerate(self._layers or ()) if layer is value), None)


class Decoder:
    """The inverse of :class:`Encoder`, given the arrays and tensors by the names that it gave them."""

    def __init__(self, arrays: Mapping[str, np.ndarray], tensors: Mapping[str, th.Tensor]) -> None:
        self.arrays, self.tensors = arrays, tensors
        self._layers: Sequence[Any] | None = None
        self._met: dict[int, Any] = {}
        self._used: set[int] = set()  # generators that have been given a state

    @contextmanager
    def environment(self, layers: Sequence[Any]) -> Iterator[None]:
        """While an environment is put back that was written as one, of these layers, None where one is another; there a value
        that cannot be made raises LostValue. Elsewhere what is there now stays."""
        self._layers, self._met, self._used = layers, {}, set()
        try:
            yield
        finally:
            self._layers, self._met, self._used = None, {}, set()

    def decode(self, node: Any, existing: Any = None) -> Any:
        """The value of JSON that :meth:`Encoder.encode` returned, new where it can be; of ``existing``, the value that is
        there now, generators, spaces and objects are changed in place. ValueError for JSON of another form, or an existing
        value of another kind."""
        if not isinstance(node, (dict, list)):
            return node
        if isinstance(node, list):
            mark = node[0] if node and isinstance(node[0], dict) and node[0].keys() == {"as"} else {}
            value: Any = self._parts(node[len(mark) :], existing)
        else:
            mark, value = node, self._made(node, existing)
        if "as" in mark:
            self._met[mark["as"]] = value
        return value

    def _made(self, node: dict[str, Any], existing: Any) -> Any:
        kind = str(next(iter(node), ""))
        if kind in _PLAIN_KINDS:
            return _PLAIN_KINDS[kind](self, node)
        method = getattr(self, f"_decode_{kind}", None)
        if method is None:
            raise ValueError(f"a value of the unknown kind {kind!r} is stored: the file was written by another version")
        return method(node, existing)

    def _parts(self, nodes: list[Any], existing: Any) -> list[Any]:
        old = list(existing) if isinstance(existing, (list, tuple, deque)) else []
        return [self.decode(part, old[index] if index < len(old) else None) for index, part in enumerate(nodes)]

    def _pairs(self, nodes: list[Any], existing: Any) -> dict[Any, Any]:
        old = existing if isinstance(existing, dict) else {}
        new = {}
        for key_node, part in nodes:
            key = self.decode(key_node)
            new[key] = self.decode(part, old.get(key))
        return new

    def _lose(self, reason: str, existing: Any) -> Any:
        if self._layers is not None:
            raise LostValue(reason)
        return existing

    def _unused(self, existing: Any, kind: type) -> Any:
        """A generator that is there now, or None: where it is of another kind, or two hold it now that were not the same."""
        if not isinstance(existing, kind) or id(existing) in self._used:
            return None
        if self._layers is not None:
            self._used.add(id(existing))
        return existing

    def _decode_same(self, node: dict[str, Any], existing: Any) -> Any:
        if node["same"] not in self._met:
            return self._lose("it was held by something else, too, which cannot be restored", existing)
        return self._met[node["same"]]

    def _decode_left(self, node: dict[str, Any], existing: Any) -> Any:
        kind, name = type(existing).__qualname__, _name_of(existing)
        if kind == node["left"] and node.get("name", name) == name:
            return existing
        stored = node.get("name") or f"a {node['left']}"
        return self._lose(f"it was {stored}, and is {name or f'a {kind}'} when made anew", existing)

    def _decode_function(self, node: dict[str, Any], existing: Any) -> Any:
        if not isinstance(existing, types.FunctionType) or _name_of(existing) != node["function"]:
            return self._decode_left({"left": "function", "name": node["function"]}, existing)
        state = self.decode(node["state"], function_state(existing))
        for name, cell in zip(existing.__code__.co_freevars, existing.__closure__ or (), strict=True):
            if name in state["variables"]:
                cell.cell_contents = state["variables"][name]
        if not is_library(existing.__module__):
            existing.__defaults__, existing.__kwdefaults__ = state["defaults"], state["keywords"]
        vars(existing).update(state["attributes"])
        existing.__globals__.update(state["globals"])
        return existing

    def _decode_bound(self, node: dict[str, Any], existing: Any) -> Any:
        if not isinstance(existing, _METHODS) or existing.__name__ != node["bound"]:
            return self._decode_left({"left": "method", "name": node["bound"]}, existing)
        return getattr(self.decode(node["of"], existing.__self__), node["bound"])

    def _decode_partial(self, node: dict[str, Any], existing: Any) -> Any:
        held = existing if isinstance(existing, functools.partial) else functools.partial(lambda: None)
        parts = self.decode(node["with"], {"args": held.args, "keywords": held.keywords})
        return functools.partial(self.decode(node["partial"], held.func), *parts["args"], **parts["keywords"])

    def _decode_layer(self, node: dict[str, Any], existing: Any) -> Any:
        layer = dict(enumerate(self._layers or ())).get(node["layer"])
        return self._lose("it was an environment that is another now", existing) if layer is None else layer

    def _decode_method(self, node: dict[str, Any], existing: Any) -> Any:
        layer = self._decode_layer({"layer": node["of"]}, existing)
        function = getattr(type(layer), node["method"], None)
        if not isinstance(function, types.FunctionType):
            return self._lose(f"it was the method {node['method']}, which is not there now", existing)
        return types.MethodType(function, layer)

    def _decode_enum(self, node: dict[str, Any], existing: Any) -> Any:
        kind, member = _find_enum(node["module"], node["enum"], existing), node["member"]
        with suppress(KeyError, ValueError, TypeError):
            return kind(member) if issubclass(kind, Flag) else kind[member]
        return self._lose(f"it was {node['enum']}.{member}, which is not there now", existing)

    def _decode_tuple(self, node: dict[str, Any], existing: Any) -> tuple[Any, ...]:
        return tuple(self._parts(node["tuple"], existing))

    def _decode_deque(self, node: dict[str, Any], existing: Any) -> deque[Any]:
        return deque(self._parts(node["deque"], existing), maxlen=node["maxlen"])

    def _decode_dict(self, node: dict[str, Any], existing: Any) -> dict[Any, Any]:
        new = self._pairs(node["dict"], existing)
        if isinstance(existing, defaultdict):  # of a checkpoint that did not tell them apart
            existing.clear()
            existing.update(new)
            return existing
        return new

    def _decode_ordered(self, node: dict[str, Any], existing: Any) -> OrderedDict[Any, Any]:
        return OrderedDict(self._pairs(node["ordered"], existing))

    def _decode_counter(self, node: dict[str, Any], existing: Any) -> Counter[Any]:
        return Counter(self._pairs(node["counter"], existing))

    def _decode_default(self, node: dict[str, Any], existing: Any) -> defaultdict[Any, Any]:
        factory = node["factory"]
        known = _FACTORIES.get(str(factory.get("name"))) if isinstance(factory, dict) else None
        made = known or self.decode(factory, getattr(existing, "default_factory", None))
        return defaultdict(made, self._pairs(node["default"], existing))

    def _decode_generator(self, node: dict[str, Any], existing: Any) -> np.random.Generator:
        state = self.decode(node["generator"])
        name = state["bit_generator"]
        existing = self._unused(existing, np.random.Generator)
        if existing is None or type(existing.bit_generator).__name__ != name:
            if name not in _BIT_GENERATORS:
                raise ValueError(f"the generator {name!r} is unknown; expected one of {sorted(_BIT_GENERATORS)}")
            existing = np.random.Generator(getattr(np.random, name)())
        existing.bit_generator.state = state
        return existing

    def _decode_random_state(self, node: dict[str, Any], existing: Any) -> np.random.RandomState:
        made: np.random.RandomState = self._unused(existing, np.random.RandomState) or np.random.RandomState()
        made.set_state(self.decode(node["random_state"]))
        return made

    def _decode_random(self, node: dict[str, Any], existing: Any) -> random.Random:
        made: random.Random = self._unused(existing, random.Random) or random.Random()
        made.setstate(self.decode(node["random"]))
        return made

    def _decode_space(self, node: dict[str, Any], existing: Any) -> Any:
        if isinstance(existing, spaces.Space):
            for part, state in zip(_subspaces(existing), self.decode(node["space"]), strict=True):
                if state is not None:
                    part.np_random.bit_generator.state = state
        return existing

    def _decode_object(self, node: dict[str, Any], existing: Any) -> Any:
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
    "set": lambda decoder, node: {decoder.decode(part) for part in node["set"]},
    "frozenset": lambda decoder, node: frozenset(decoder.decode(part) for part in node["frozenset"]),
    "bytes": lambda decoder, node: bytes.fromhex(node["bytes"]),
}


def _subspaces(space: spaces.Space) -> list[spaces.Space]:
    """The space and all spaces in it, in a fixed order."""
    parts: Any = space.spaces if isinstance(space, (spaces.Dict, spaces.Tuple, spaces.OneOf)) else ()
    parts = parts.values() if isinstance(space, spaces.Dict) else parts
    return [space, *(inner for part in parts for inner in _subspaces(part))]


def is_library(module: str | None) -> bool:
    """Whether functions and classes of a module remember nothing: those of Python and of a few known packages."""
    root = (module or "").partition(".")[0]
    return root in _LIBRARIES or root in sys.stdlib_module_names


def function_state(function: types.FunctionType) -> dict[str, Any]:
    """What a function can remember between two calls: variables of the functions around it, defaults, its attributes, and of
    its module's variables the random generators and those that it assigns."""
    state: dict[str, Any] = {"variables": {}, "defaults": None, "keywords": None, "attributes": {}, "globals": {}}
    if is_library(function.__module__):
        return state
    variables = state["variables"]
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # not assigned yet
            variables[name] = cell.cell_contents
    variables.pop("__class__", None)
    state |= {"defaults": function.__defaults__, "keywords": function.__kwdefaults__}
    return state | {"attributes": dict(vars(function)), "globals": _module_variables(function)}


def class_state(kind: type) -> dict[str, Any]:
    """What a class holds itself: its plain attributes, and those functions that remember something."""
    held = {}
    for name, value in vars(kind).items():
        function = getattr(value, "__func__", value)
        if name.startswith(("__", "_abc_")):
            continue
        if isinstance(function, types.FunctionType):
            state = function_state(function)
            changing = [
                one for one in (*(state["defaults"] or ()), *(state["keywords"] or {}).values()) if not _is_constant(one)
            ]
            if changing or state["variables"] or state["attributes"] or state["globals"]:
                held[name] = function
        elif not hasattr(type(value), "__get__"):
            held[name] = value
    return held


def _is_constant(value: Any) -> bool:
    return value is None or isinstance(value, (bool, int, float, str, bytes, type))


def _module_variables(function: types.FunctionType) -> dict[str, Any]:
    found, codes = {}, [function.__code__]
    for code in codes:
        codes += [one for one in code.co_consts if isinstance(one, types.CodeType)]  # functions within it
        assigned = {one.argval for one in dis.get_instructions(code) if one.opname == "STORE_GLOBAL"}
        for name in (*code.co_names, *assigned):
            value = function.__globals__.get(name)
            if name in function.__globals__ and (name in assigned or isinstance(value, _RANDOM)):
                found[name] = value
    return found


def _name_of(thing: Any) -> str | None:
    """What a function, a class or a module goes by, None for others; for a function within another, with what it does."""
    if isinstance(thing, types.ModuleType):
        return thing.__name__
    if not isinstance(thing, (type, types.FunctionType, types.MethodType, types.BuiltinFunctionType)):
        return None
    name = f"{getattr(thing, '__module__', None)}.{getattr(thing, '__qualname__', '')}"
    code = getattr(thing, "__code__", None)
    if code is None or "<" not in name:
        return name
    constants = [one for one in code.co_consts if isinstance(one, (int, float, str, bytes))]
    return f"{name}#{zlib.crc32(repr((code.co_code, code.co_names, constants)).encode()):08x}"


def _find_enum(module: str, name: str, existing: Any) -> Any:
    """An enumeration of a module that has been imported, or the one of the value that is there now; None without one."""
    found: Any = type(existing)
    if (found.__module__, found.__qualname__) != (module, name):
        found = sys.modules.get(module)
        for part in name.split("."):
            found = getattr(found, "__dict__", {}).get(part)
    return found if isinstance(found, type) and issubclass(found, Enum) else None
