"""What functions and classes remember between two calls, and what they are called."""

import dis
import random
import sys
import types
import zlib
from contextlib import suppress
from typing import Any

import numpy as np

# functions and classes of these, and of Python itself, remember nothing
_LIBRARIES = ("gymnasium", "stable_baselines3", "sb3_contrib", "sb3_actpc", "numpy", "torch", "mujoco", "robosuite")
_RANDOM = (np.random.Generator, np.random.RandomState, random.Random)
_CONSTANTS = (bool, int, float, str, bytes, type, types.NoneType)


def is_library(module: str | None) -> bool:
    """Whether functions and classes of a module remember nothing."""
    root = (module or "").partition(".")[0]
    return root in _LIBRARIES or root in sys.stdlib_module_names


def function_state(function: types.FunctionType) -> dict[str, Any]:
    """What a function can remember between two calls.

    :return: ``variables`` of the functions around it, ``defaults`` and ``keywords`` (those of a library's function left out),
        its ``attributes``, and ``globals``: of its module's variables the random generators and those that it assigns
    """
    state: dict[str, Any] = {"variables": {}, "attributes": {}, "globals": {}}
    if is_library(function.__module__):
        return state
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # not assigned yet
            state["variables"][name] = cell.cell_contents
    state["variables"].pop("__class__", None)
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
            if _remembers(function):
                held[name] = function
        elif not hasattr(type(value), "__get__"):
            held[name] = value
    return held


def name_of(thing: Any) -> str | None:
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


def _remembers(function: types.FunctionType) -> bool:
    state = function_state(function)
    defaults = [*(state.get("defaults") or ()), *(state.get("keywords") or {}).values()]
    is_changing = any(not isinstance(one, _CONSTANTS) for one in defaults)
    return is_changing or any(state[name] for name in ("variables", "attributes", "globals"))


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
