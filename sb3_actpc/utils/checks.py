"""Checks of what the user passes and of what circuits and environments produce."""

import difflib
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from numbers import Integral, Real
from os import PathLike
from types import NoneType
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.utils import get_device

LARGEST_NUMBER = float(np.finfo(np.float32).max)
LARGEST_WHOLE = 2**63 - 1
LARGEST_SIZE = 2**31 - 1
Settings = dict[str, Any]


def _is(kind: type, largest: float, value: Any) -> bool:
    """Whether it is a number of the kind, finite and not too large (whole numbers of any size can be compared)."""
    is_kind = isinstance(value, kind)
    return is_kind and bool(abs(value) <= largest)


_is_number = partial(_is, Real, LARGEST_NUMBER)
_is_whole = partial(_is, Integral, LARGEST_WHOLE)


# annotation -> (whether a value is of this kind, what it must be)
KINDS: dict[Any, tuple[Callable[[Any], bool], str]] = {
    float: (_is_number, "a finite number"),
    int: (_is_whole, "a whole number"),
    float | None: (lambda value: value is None or _is_number(value), "a finite number or None"),
    int | None: (lambda value: value is None or _is_whole(value), "a whole number or None"),
    bool: (lambda value: isinstance(value, (bool, np.bool_)), "True or False"),
    str | None: (lambda value: isinstance(value, (str, PathLike, NoneType)), "a path or None"),
    Settings | None: (
        lambda value: value is None or (isinstance(value, Mapping) and all(isinstance(key, str) for key in value)),
        "a dictionary with text keys, or None",
    ),
}


def check_kind(name: str, value: Any, kind: Any) -> None:
    """ValueError that names a keyword and its value, where that is not of the kind: one of ``KINDS``."""
    is_kind, wanted = KINDS[kind]
    if not is_kind(value):
        raise ValueError(f"{name}={value!r} must be {wanted}")


def nearest(name: str, known: Iterable[str]) -> str:
    """``" (did you mean 'gamma'?)"``, or nothing where no known name is near."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


@contextmanager
def named_in_errors(what: str, *passed_on: type[Exception]) -> Iterator[None]:
    """What a class of another package does not take becomes a ValueError that says where the user gave it: ``what``, the
    keywords with their values. Errors of the kinds ``passed_on`` are clear already."""
    try:
        yield
    except passed_on:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:500] or type(error).__name__
        raise ValueError(f"{what[:1000]}: {reason}") from error


def check_device(name: str, device: Any) -> None:
    """ValueError when it is no torch device, or one that this machine cannot compute on. Warns where SB3 will silently take
    the CPU: for a CUDA device on a machine without one."""
    try:
        if not isinstance(device, (str, th.device)):
            raise RuntimeError(f"found a {type(device).__name__}")
        chosen = get_device(device)
        th.zeros(1, device=chosen).item()
    except (RuntimeError, AssertionError, NotImplementedError, ImportError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:150]
        raise ValueError(
            f"{name}={device!r} must be 'auto' or a torch device of this machine, such as 'cpu' or 'cuda:0': {reason}"
        ) from error
    if device != "auto" and th.device(device).type != chosen.type:
        warnings.warn(f"{name}={str(device)!r}: torch finds none here, the agent runs on the CPU", stacklevel=2)


def check_finite(where: str, what: str, values: np.ndarray, step: int) -> None:
    """ValueError when one of the values, of a circuit or of the environment, is NaN or infinite at an environment step."""
    if not np.isfinite(values).all():
        raise ValueError(
            f"{where}: {what} are not finite at step {step}; "
            + ("check the environment" if where == "environment" else "lower its learning rate or bound its synapses")
        )
