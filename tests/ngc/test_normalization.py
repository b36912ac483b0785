"""Layer normalization and ensembles: autograd and finite differences are the oracles."""

import pytest
import torch as th

from sb3_actpc.ngc import NGCCircuit, settle_coupled
from tests.ngc import oracle


def test_every_member_of_a_normalized_ensemble_changes_as_a_circuit_of_its_own():
    th.manual_seed(0)
    ensemble = NGCCircuit(5, 3, (16, 12), settling="scheduled", normalization="layer", n_members=4)
    x, target = th.randn(32, 5), th.randn(4, 32, 3)
    changes = ensemble.hebbian_update(ensemble.settle(x, target))
    for member in range(4):
        weights, biases = oracle.synapses(ensemble, member=member)
        output = oracle.forward(ensemble, weights, biases, x)
        assert th.allclose(ensemble.project(x)[member], output, atol=1e-6)
        (0.5 * (target[member] - output).square().sum(1).mean()).backward()
        for mine, leaf in zip([*changes.weights, *changes.biases], [*weights, *biases], strict=True):
            assert th.allclose(mine[member].flatten(), -leaf.grad.flatten(), atol=1e-6)


@pytest.mark.parametrize("dynamics", ["state", "krylov"])
@pytest.mark.parametrize("n_members", [0, 3])
def test_settling_lowers_the_energy_of_a_normalized_circuit(dynamics, n_members):
    th.manual_seed(0)
    rate = {"settling_rate": 0.05} if dynamics == "state" else {}
    given = {"normalization": "layer", "activation": "tanh", "n_settling_steps": 20, "n_members": n_members, **rate}
    circuit = NGCCircuit(5, 3, (16, 12), dynamics=dynamics, **given)
    x, target = th.randn(64, 5), th.randn(64, 3)
    settled = circuit.settle(x, target).total_discrepancy().mean()
    projected = 0.5 * (target - circuit.project(x)).square().sum(-1).mean()
    assert settled < 0.98 * projected


def test_the_actor_follows_the_mean_of_an_ensemble_as_autograd_has_it():
    th.manual_seed(0)
    given = {"settling": "scheduled", "activation": "tanh", "normalization": "layer"}
    actor = NGCCircuit(4, 2, (16,), output_activation="tanh", **given)
    critic = NGCCircuit(6, 2, (16, 12), n_feedback_inputs=2, n_members=3, **given)
    x = th.randn(32, 4)
    changes = actor.hebbian_update(settle_coupled(actor, critic, x).actor)
    weights, biases = oracle.synapses(actor)
    inputs = th.cat([x, oracle.forward(actor, weights, biases, x)], dim=1)
    members = [oracle.synapses(critic, member=member) for member in range(3)]
    values = th.stack([oracle.forward(critic, *member, inputs) for member in members])
    values.mean((0, 2)).mean().backward()
    for mine, leaf in zip([*changes.weights, *changes.biases], [*weights, *biases], strict=True):
        assert th.allclose(mine, leaf.grad, atol=1e-6)
