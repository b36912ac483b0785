"""Checks of what the user passes and of what circuits and environments produce."""

from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from types import NoneType
from typing import Any

import numpy as np


def check_choices(given: Mapping[str, Any], **allowed: Sequence[str]) -> None:
    """
    :param given: keyword -> value
    :param allowed: keyword -> its allowed values
    :raises ValueError: naming the first value that is not allowed
    """
    for name, choices in allowed.items():
        if given[name] not in choices:
            raise ValueError(f"{name}={given[name]!r} is unknown; choose one of {list(choices)}")


def check_numbers(given: Mapping[str, Any], at_least_0: str = "", at_least_1: str = "", fraction: str = "") -> None:
    """
    :param given: keyword -> value
    :param at_least_0: keywords (separated by spaces) that must be 0 or more
    :param at_least_1: keywords that must be 1 or more
    :param fraction: keywords that must lie in [0, 1]
    :raises ValueError: naming the first value out of range
    """
    for names, low, high in ((at_least_0, 0.0, np.inf), (at_least_1, 1.0, np.inf), (fraction, 0.0, 1.0)):
        for name in names.split():
            if not low <= given[name] <= high:
                bounds = f"at least {low:g}" if np.isinf(high) else f"between {low:g} and {high:g}"
                raise ValueError(f"{name}={given[name]!r} must be {bounds}")


def check_kinds(given: Mapping[str, Any], numbers: str = "", whole: str = "", optional: str = "", mappings: str = "") -> None:
    """
    :param given: keyword -> value
    :param numbers: keywords (separated by spaces) that must be finite numbers
    :param whole: keywords that must be whole numbers
    :param optional: keywords that must be finite numbers or None
    :param mappings: keywords that must be dictionaries or None
    :raises ValueError: naming the first value of another kind
    """
    for names, kind, wanted in (
        (numbers, Real, "a finite number"),
        (whole, Integral, "a whole number"),
        (optional, (Real, NoneType), "a finite number or None"),
        (mappings, (Mapping, NoneType), "a dictionary or None"),
    ):
        for name in names.split():
            value = given[name]
            if not isinstance(value, kind) or (isinstance(value, Real) and not np.isfinite(float(value))):
                raise ValueError(f"{name}={value!r} must be {wanted}")


def check_finite(where: str, what: str, values: np.ndarray, step: int) -> None:
    """
    :param where: the circuit's name, or "environment"
    :param what: what ``values`` are
    :param values: any shape
    :param step: environment step to name
    :raises ValueError: when a value is NaN or infinite
    """
    if not np.isfinite(values).all():
        raise ValueError(
            f"{where}: {what} are not finite at step {step}; "
            + ("check the environment" if where == "environment" else "lower its learning rate or bound its synapses")
        )
