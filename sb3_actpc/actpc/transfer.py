"""Arrays to the agent's device: to a GPU all of them at once."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th


def to_device(arrays: Any, device: th.device) -> Any:
    """
    Arrays as tensors; to a GPU in one copy for each kind of number, as a small copy takes as long as a large one.

    :param arrays: arrays and Nones in (named) tuples and dicts
    :param device: where the tensors are; on the CPU they share the arrays' memory
    :return: the same, of tensors
    """
    if not isinstance(arrays, (dict, tuple)):
        return th.as_tensor(arrays, device=device)
    if device.type == "cpu":
        return map_nested(th.as_tensor, arrays)
    kinds: dict[np.dtype, list[np.ndarray]] = {}
    map_nested(lambda array: kinds.setdefault(array.dtype, []).append(array), arrays)
    moved: dict[int, th.Tensor] = {}
    for kind in kinds.values():
        together = th.as_tensor(np.concatenate([array.ravel() for array in kind]), device=device)
        pieces = together.split([array.size for array in kind])
        moved |= {id(array): piece.view(array.shape) for array, piece in zip(kind, pieces, strict=True)}
    return map_nested(lambda array: moved[id(array)], arrays)


def map_nested(function: Callable[[Any], Any], part: Any) -> Any:
    """Apply ``function`` to every array or tensor in (named) tuples and dicts; None stays None."""
    if isinstance(part, dict):
        return dict(zip(part, map_nested(function, tuple(part.values())), strict=True))
    mapped: list[Any] = []
    for value in part:
        if isinstance(value, (dict, tuple)):
            mapped.append(map_nested(function, value))
        else:
            mapped.append(None if value is None else function(value))
    return type(part)(*mapped) if hasattr(part, "_fields") else tuple(mapped)
