"""Arrays to the device: as they were, in the containers that they were in."""

from typing import NamedTuple

import numpy as np
import pytest
import torch as th

from sb3_actpc.actpc.batches import to_device


class Pair(NamedTuple):
    seen: object
    done: object


@pytest.mark.parametrize("device", ["cpu", "meta", *(["cuda"] if th.cuda.is_available() else [])])
def test_structure_shapes_and_kinds_are_kept(device):
    image, place = np.arange(12, dtype=np.uint8).reshape(2, 2, 3).swapaxes(0, 1), np.ones((2, 0), np.float32)
    done, numbers = np.array([[0.0], [1.0]], np.float32), np.array([2.5, 3.5])
    found = to_device((Pair({"image": image, "place": place}, done), None, (done, numbers)), th.device(device))
    assert isinstance(found[0], Pair) and found[1] is None and list(found[0].seen) == ["image", "place"]
    moved = found[0].seen["image"], found[0].seen["place"], found[0].done, *found[2]
    for mine, theirs in zip(moved, (image, place, done, done, numbers), strict=True):
        assert mine.device.type == device and tuple(mine.shape) == theirs.shape and str(mine.dtype).endswith(str(theirs.dtype))
        assert device == "meta" or np.array_equal(mine.cpu().numpy(), theirs)
