"""Products of circuits and ensembles against plain sums."""

import pytest
import torch as th

from sb3_actpc.ngc.products import NARROW, TALL, sum_outer


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
