"""Small formulas of the circuits, worked by hand: bounds, energies, rates, products and the working memory."""

import pytest
import torch as th

from sb3_actpc.ngc import NGCCircuit, WorkingMemory
from sb3_actpc.ngc.dynamics import settling_rates
from sb3_actpc.ngc.plasticity import NARROW, TALL, bound_columns_, soft_bound_, sum_outer


def test_a_step_shrinks_in_proportion_to_what_is_left_to_the_soft_bound():
    """M = (w_b - |W|) / w_b: all of it from 0, half of it half way, nothing at the bound, in either direction."""
    old = th.tensor([0.0, 1.0, -1.0, 2.0, -2.0])
    new = old + th.tensor([0.4, 0.4, 0.4, -0.4, -0.4])
    soft_bound_(new, old, 2.0)
    th.testing.assert_close(new - old, th.tensor([0.4, 0.2, 0.2, 0.0, 0.0]))


def test_only_columns_beyond_the_bound_are_shrunk():
    weights = th.tensor([[3.0, 0.3], [4.0, 0.4]])
    bound_columns_(weights, 1.0)
    th.testing.assert_close(weights, th.tensor([[0.6, 0.3], [0.8, 0.4]]))


def test_the_total_discrepancy_is_half_the_summed_squared_errors():
    circuit = NGCCircuit(3, 2, ())
    state = circuit.settle(th.zeros(4, 3), circuit.project(th.zeros(4, 3)) + th.tensor([1.0, -3.0]))
    th.testing.assert_close(state.total_discrepancy(), th.full((4,), 5.0))


@pytest.mark.parametrize("norm", [1.0, 5.0, 20.0])
def test_the_automatic_rate_is_stable_where_every_unit_is_active(norm):
    """One hidden layer: e <- e - β (1 + ||W|| ||E||) e + const settles while β (1 + ||W|| ||E||) < 2."""
    rate = settling_rates([norm], [norm])[0]
    assert 0.0 < rate * (1.0 + norm**2) < 2.0


@pytest.mark.parametrize("n, m", [(TALL * 11, 11), (TALL * 11 - 1, 11), (3, 40), (TALL * NARROW, NARROW)])
@pytest.mark.parametrize("members", [(), (4,)])
def test_outer_products_are_summed_whatever_the_shape(n, m, members):
    """The optimizer's fused step reads changes as they lie in memory."""
    left, right = th.randn(*members, 64, n), th.randn(*members, 64, m)
    found = sum_outer(left, right)
    expected = th.einsum("...bn,...bm->...nm", left.double(), right.double())
    assert found.is_contiguous()
    assert found.shape == (*members, n, m)
    assert (found - expected).norm() < 1e-5 * expected.norm()


def test_memory_is_the_concatenation_of_observations_through_a_fixed_gaussian_projection():
    memory = WorkingMemory(100, history=3)
    history = th.randn(4, 3, 100)
    expected = th.cat([history[:, step] @ memory.projection.t() for step in range(3)], dim=1)
    assert th.allclose(memory(history), expected, atol=1e-5)
    assert memory.size == 300 and not th.any(memory(th.zeros(1, 3, 100)))
    assert not memory.projection.requires_grad
    assert float(memory.projection.std()) == pytest.approx(0.1, rel=0.05)
