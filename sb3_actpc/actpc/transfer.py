"""Arrays to the agent's device: to a GPU all of them at once."""

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
    if device.type == "cpu":
        return _replaced(arrays, th.as_tensor)
    kinds: dict[np.dtype, list[np.ndarray]] = {}
    _replaced(arrays, lambda array: kinds.setdefault(array.dtype, []).append(array))
    moved: dict[int, th.Tensor] = {}
    for kind in kinds.values():
        together = th.as_tensor(np.concatenate([array.ravel() for array in kind]), device=device)
        pieces = together.split([array.size for array in kind])
        moved |= {id(array): piece.view(array.shape) for array, piece in zip(kind, pieces, strict=True)}
    return _replaced(arrays, lambda array: moved[id(array)])


def _replaced(part: Any, function: Any) -> Any:
    if part is None:
        return None
    if isinstance(part, dict):
        return {key: _replaced(value, function) for key, value in part.items()}
    if isinstance(part, tuple):
        replaced = [_replaced(value, function) for value in part]
        return type(part)(*replaced) if hasattr(part, "_fields") else tuple(replaced)
    return function(part)
