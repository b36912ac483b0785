"""Working memory: a fixed Gaussian projection of the last observations, oldest first."""

import pytest
import torch as th

from sb3_actpc.ngc import WorkingMemory


def test_memory_is_the_concatenation_of_projected_observations():
    memory = WorkingMemory(5, history=3)
    history = th.randn(4, 3, 5)
    expected = th.cat([history[:, step] @ memory.projection.t() for step in range(3)], dim=1)
    assert th.allclose(memory(history), expected, atol=1e-6)
    assert memory.size == 15 and not th.any(memory(th.zeros(1, 3, 5)))


def test_the_projection_is_fixed_and_gaussian():
    memory = WorkingMemory(100)
    assert not memory.projection.requires_grad
    assert float(memory.projection.std()) == pytest.approx(0.1, rel=0.05)
