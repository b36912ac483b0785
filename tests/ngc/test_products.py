"""Products of circuits and ensembles against plain sums."""

import pytest
import torch as th

from sb3_actpc.ngc.products import NARROW, TALL, add_product, affine, sum_outer


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


def test_an_ensemble_predicts_and_adds_member_by_member():
    bias, x, weights = th.randn(3, 1, 5), th.randn(3, 8, 4), th.randn(3, 5, 4)
    total = th.randn(3, 8, 5)
    predicted = affine(bias, x, weights)
    added = add_product(total.clone(), x, weights.mT, sign=-1.0)
    for member in range(3):
        product = x[member] @ weights[member].t()
        assert th.allclose(predicted[member], product + bias[member], atol=1e-6)
        assert th.allclose(added[member], total[member] - product, atol=1e-6)
