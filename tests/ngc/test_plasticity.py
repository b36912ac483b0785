"""Synapses: the optimiser gets minus the change, error synapses align, bounds bind."""

import pytest
import torch as th

from sb3_actpc.ngc import NGCCircuit
from sb3_actpc.ngc.plasticity import mirrored


def teacher_batch(n=128):
    x = th.randn(n, 8)
    return x, th.stack([th.sin(x[:, 0]) + x[:, 1], x[:, 2] * x[:, 3], th.tanh(x.sum(1))], dim=1)


def train(circuit, optimizer, n_updates, batch=teacher_batch):
    circuit.optimizer = optimizer
    for _ in range(n_updates):
        circuit.apply_changes(circuit.hebbian_update(circuit.settle(*batch())))


def apply_nothing(circuit, memory=None):
    """Changes of zero, at a learning rate of 0.1: what is left is what the circuit does on its own."""
    changes = circuit.hebbian_update(circuit.settle(*teacher_batch(), memory=memory))
    th._foreach_zero_(changes.tensors())
    circuit.optimizer = th.optim.SGD(circuit.parameter_groups(0.1))
    circuit.apply_changes(changes)


def test_plain_sgd_adds_the_change():
    """That of error synapses times γ_e, which is a ratio of rates: Adam would cancel a factor on the change."""
    circuit = NGCCircuit(8, 3, (16, 16), feedback="learned", feedback_rate=0.5, n_memory=6)
    groups = circuit.parameter_groups(0.1)
    assert [group["lr"] for group in groups] == [0.1, 0.05]
    circuit.optimizer = th.optim.SGD(groups)
    synapses = [*circuit.weights, *circuit.biases, *circuit.memory_weights]
    before = [p.clone() for p in synapses]
    error_synapses = [p.clone() for p in circuit.feedback_weights]
    changes = circuit.hebbian_update(circuit.settle(*teacher_batch(), th.randn(128, 6)))
    circuit.apply_changes(changes)
    for old, new, change in zip(before, synapses, changes.tensors(), strict=True):
        assert change.abs().max() > 0 and th.allclose(new, old + 0.1 * change, atol=1e-7)
    for old, new, change in zip(error_synapses, circuit.feedback_weights, changes.weights[1:], strict=True):
        assert th.allclose(new, old + 0.05 * change, atol=1e-7)


@pytest.mark.parametrize("optimizer_class", [th.optim.SGD, th.optim.Adam])
@pytest.mark.parametrize("weight_decay", [0.0, 5.0])
def test_the_gap_between_error_synapses_and_weights_shrinks_by_the_decay_alone(optimizer_class, weight_decay):
    """Kolen & Pollack (1994): with equal changes and rates E^T - W is multiplied by 1 - ηλ at every change, exactly."""
    circuit = NGCCircuit(8, 3, (16, 16), settling="scheduled", feedback="learned", weight_decay=weight_decay).double()
    rate, n_updates = 0.01, 20
    optimizer = optimizer_class(circuit.parameter_groups(rate))

    def gaps():
        return [e - w for e, w in zip(circuit.feedback_weights, list(circuit.weights)[1:], strict=True)]

    def batch():
        return [tensor.double() for tensor in teacher_batch()]

    kept = (1.0 - rate * weight_decay) ** n_updates
    start, before = gaps(), [p.clone() for p in circuit.weights]
    train(circuit, optimizer, n_updates, batch)
    assert not any(th.allclose(new, old * kept, atol=1e-3) for old, new in zip(before, circuit.weights, strict=True))
    for old, new in zip(start, gaps(), strict=True):
        assert old.abs().max() > 0.1 and th.allclose(new, old * kept, atol=1e-12)


def test_a_synapse_at_its_soft_bound_still_decays():
    circuit = NGCCircuit(8, 3, (16,), synaptic_scaling="soft_bound", weight_bound=0.4, weight_decay=0.5)
    circuit.weights[0].fill_(0.4)
    apply_nothing(circuit)
    assert th.allclose(circuit.weights[0], th.full_like(circuit.weights[0], 0.38))


def test_weight_decay_spares_the_biases():
    circuit = NGCCircuit(8, 3, (16,), weight_decay=0.5, n_memory=2)
    before = {name: p.clone() for name, p in circuit.named_parameters()}
    apply_nothing(circuit, memory=th.zeros(128, 2))
    for name, parameter in circuit.named_parameters():
        assert th.allclose(parameter, before[name] * (1.0 if name.startswith("biases") else 0.95))


@pytest.mark.parametrize("scaling", ["none", "soft_bound", "column_norm"])
def test_bounds_bind_under_adam(scaling):
    bound = 1.0 if scaling == "column_norm" else 0.4
    circuit = NGCCircuit(8, 3, (32, 32), feedback="learned", synaptic_scaling=scaling, weight_bound=bound)
    train(circuit, th.optim.Adam(circuit.parameter_groups(0.02)), 200)
    synapses = [*circuit.weights, *circuit.feedback_weights]
    sizes = th.cat([p.norm(dim=0) if scaling == "column_norm" else p.abs().flatten() for p in synapses])
    assert sizes.max() > 0.75 * bound and (sizes.max() <= bound + 1e-5) == (scaling != "none")


def test_auto_rates_follow_the_spectral_norms():
    circuit = NGCCircuit(8, 3, (32, 32), feedback="tied", dynamics="state")
    norms = [float(th.linalg.matrix_norm(w, 2)) for w in list(circuit.weights)[1:]]
    for rate, norm in zip(circuit.rates.tolist(), norms, strict=True):
        assert rate == pytest.approx(min(0.3, 1 / (1 + norm**2)), rel=0.02)
    before = circuit.rates.clone()
    for weights in circuit.weights:
        weights.mul_(10.0)
    circuit.update_settling_rates(20)
    assert (circuit.rates < 0.2 * before).all()


def test_a_memory_without_weight_counts_for_nothing_and_learns_nothing():
    circuit = NGCCircuit(8, 3, (16, 16), n_memory=6)
    circuit.optimizer = th.optim.SGD(circuit.parameter_groups(0.1))
    (x, target), memory = teacher_batch(), th.randn(128, 6)
    assert not th.allclose(circuit.project(x, memory), circuit.project(x, 2 * memory))
    circuit.memory_weight = 0.0
    assert th.equal(circuit.project(x, memory), circuit.project(x, 2 * memory))
    before = [m.clone() for m in circuit.memory_weights]
    circuit.apply_changes(circuit.hebbian_update(circuit.settle(x, target, memory)))
    assert all(map(th.equal, circuit.memory_weights, before))


@pytest.mark.parametrize(("n_out", "n_in"), [(3, 256), (60, 50), (8, 1100)])
def test_mirroring_with_orthogonal_noise_leaves_rounding_alone(n_out, n_in):
    weights = th.randn(n_out, n_in, dtype=th.float64)
    assert th.allclose(mirrored(weights), weights, rtol=0.0, atol=1e-10)


def test_mirrored_error_synapses_carry_the_gradient_while_the_weights_change():
    """After 200 updates of a normalized ensemble, its change is still that of the tied circuit with the same weights."""
    options = {"settling": "scheduled", "normalization": "layer", "n_members": 2, "n_feedback_inputs": 3}
    learned = NGCCircuit(8, 3, (32, 32), feedback="learned", feedback_start="mirrored", **options)
    learned.optimizer = th.optim.Adam(learned.parameter_groups(1e-3))
    x, target = teacher_batch()
    for _ in range(200):
        learned.apply_changes(learned.hebbian_update(learned.settle(x, target)))
    tied = NGCCircuit(8, 3, (32, 32), feedback="tied", **options)
    for kind in ("weights", "biases"):
        for own, other in zip(getattr(tied, kind), getattr(learned, kind), strict=True):
            own.copy_(other)
    mine, theirs = (c.hebbian_update(c.settle(x, target)).weights for c in (learned, tied))
    for one, other in zip(mine, theirs, strict=True):
        assert th.nn.functional.cosine_similarity(one.flatten(), other.flatten(), dim=0) > 0.9999


@pytest.mark.parametrize("n_members", [0, 2])
def test_a_projection_copy_projects_as_its_circuit_and_follows_it_without_error_synapses(n_members):
    circuit = NGCCircuit(5, 3, [8, 7], feedback="learned", n_members=n_members)
    copy = circuit.projection_copy()
    x = th.randn(4, 5)
    assert th.equal(copy.project(x), circuit.project(x))
    assert not list(copy.feedback_weights) and list(circuit.feedback_weights)
    for weights in (*circuit.weights, *circuit.biases):
        weights.add_(th.randn_like(weights))
    assert not th.equal(copy.project(x), circuit.project(x))
    copy.move_towards(circuit, 1.0)
    assert th.equal(copy.project(x), circuit.project(x))
