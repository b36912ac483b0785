"""Products in bfloat16: as float32's but for the rounding to 8 bits, and only where the processor has them."""

import pytest
import torch as th

from sb3_actpc.ngc import NGCCircuit, settle_coupled
from sb3_actpc.ngc.products import NARROWEST, TALL, add_product, multiply, sum_outer
from tests.ngc import oracle

ROUNDING = 2.0**-8  # of one number, at most half of it


@pytest.fixture(autouse=True)
def processor_with_bfloat16(monkeypatch):
    """Others emulate it: slow, with the same results."""
    monkeypatch.setattr(th.cpu, "_is_avx512_bf16_supported", lambda: True, raising=False)


def test_wide_products_are_rounded_and_narrow_ones_are_not():
    a, b = th.randn(NARROWEST, 100), th.randn(100, NARROWEST)
    assert not th.equal(multiply(a, b, True), a @ b)
    error = (multiply(a, b, True) - a.double() @ b.double()).norm() / (a @ b).norm()
    assert 1e-4 < error < ROUNDING
    for narrow_a, narrow_b in ((a[1:], b), (a[:, :63], b[:63]), (a, b[:, 1:])):
        assert th.equal(multiply(narrow_a, narrow_b, True), narrow_a @ narrow_b)
    total = th.randn(NARROWEST, NARROWEST)
    for sign in (1.0, -1.0):
        expected = total + sign * multiply(a, b, True)
        assert th.equal(add_product(total.clone(), a, b, True, sign), expected)


@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("n, m", [(TALL * 11, 11), (TALL * 11 - 1, 11), (3, 40), (TALL * NARROWEST, NARROWEST)])
def test_outer_products_are_summed_whatever_the_shape(n, m, bfloat16):
    """The optimiser's fused step reads changes as they lie in memory."""
    left, right = th.randn(NARROWEST, n), th.randn(NARROWEST, m)
    found, expected = sum_outer(left, right, bfloat16), th.einsum("bn,bm->nm", left.double(), right.double())
    assert found.is_contiguous() and found.shape == (n, m)
    is_rounded = bfloat16 and m >= NARROWEST
    assert (found - expected).norm() < (ROUNDING if is_rounded else 1e-5) * expected.norm()
    assert th.equal(found, multiply(left.t(), right, True)) if is_rounded else True


def check_directions(changes, exact):
    """Biases' changes are sums of errors that nearly cancel, and keep fewer digits."""
    for mine, theirs in zip(changes.tensors(), exact.tensors(), strict=True):
        assert oracle.cosine(mine, theirs) > (0.999 if mine.dim() == 2 else 0.99)


@pytest.mark.parametrize("kind", ["scheduled", "krylov", "state"])
@pytest.mark.parametrize("feedback", ["tied", "learned"])
def test_changes_are_those_of_float32(kind, feedback):
    keywords = {"settling": "scheduled"} if kind == "scheduled" else {"dynamics": kind}
    circuit = NGCCircuit(20, 6, (128, 128), feedback=feedback, matmul_precision="bfloat16", **keywords)
    x = th.randn(256, 20)
    target = 3 + 3 * th.sin(x[:, :6])
    changes, output = circuit.hebbian_update(circuit.settle(x, target)), circuit.project(x)
    circuit.in_bfloat16 = False
    exact = circuit.hebbian_update(circuit.settle(x, target))
    assert 0.0 < (output - circuit.project(x)).norm() < ROUNDING * output.norm()
    assert all(change.dtype == th.float32 for change in changes.tensors())
    assert not th.equal(changes.weights[1], exact.weights[1])
    check_directions(changes, exact)


def test_the_coupled_pair_asks_for_the_change_of_float32():
    shared = {"settling": "scheduled", "feedback": "learned", "matmul_precision": "bfloat16"}
    actor = NGCCircuit(20, 6, (128, 128), output_activation="tanh", **shared)
    critic, x = NGCCircuit(26, 6, (128, 128), n_feedback_inputs=6, **shared), th.randn(256, 20)
    changes = actor.hebbian_update(settle_coupled(actor, critic, x).actor)
    actor.in_bfloat16 = critic.in_bfloat16 = False
    exact = actor.hebbian_update(settle_coupled(actor, critic, x).actor)
    check_directions(changes, exact)


def test_bfloat16_is_refused_where_it_would_be_emulated(monkeypatch):
    for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"):
        monkeypatch.setattr(th.cpu, name, lambda: False, raising=False)
    monkeypatch.setattr(th.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match=r"matmul_precision='bfloat16' needs .* avx512_bf16 or AMX; found .*'float32'"):
        NGCCircuit(3, 2, matmul_precision="bfloat16")
    with pytest.raises(ValueError, match="matmul_precision='half' is unknown"):
        NGCCircuit(3, 2, matmul_precision="half")
