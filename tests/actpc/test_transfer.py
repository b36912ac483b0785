"""Arrays to the device: all at once, and as they were."""

from typing import NamedTuple

import numpy as np
import pytest
import torch as th

from sb3_actpc.actpc.transfer import to_device


class Pair(NamedTuple):
    seen: object
    done: object


@pytest.mark.parametrize("device", ["cpu", "meta", *(["cuda"] if th.cuda.is_available() else [])])
def test_structure_shapes_and_kinds_are_kept(device, monkeypatch):
    copies = []
    real = th.as_tensor
    monkeypatch.setattr(th, "as_tensor", lambda array, **keywords: copies.append(array.dtype) or real(array, **keywords))
    seen = {"image": np.arange(12, dtype=np.uint8).reshape(2, 2, 3).swapaxes(0, 1), "place": np.ones((2, 0), np.float32)}
    done = np.array([[0.0], [1.0]], np.float32)
    found = to_device((Pair(seen, done), None, (done, np.array([2.5, 3.5]))), th.device(device))
    assert isinstance(found[0], Pair) and found[1] is None and found[0].done.dtype == found[2][0].dtype == th.float32
    for mine, theirs in (
        (found[0].seen["image"], seen["image"]),
        (found[0].seen["place"], seen["place"]),
        (found[2][0], done),
    ):
        assert mine.device.type == device and tuple(mine.shape) == theirs.shape
        assert device == "meta" or np.array_equal(mine.cpu().numpy(), theirs)
    assert device == "meta" or found[2][1].tolist() == [2.5, 3.5]
    assert device == "cpu" or sorted(map(str, copies)) == ["float32", "float64", "uint8"]
