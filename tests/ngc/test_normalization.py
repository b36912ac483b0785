"""Layer normalization and ensembles: autograd and finite differences are the oracles."""

import pytest
import torch as th

from sb3_actpc.ngc import NGCCircuit, settle_coupled
from sb3_actpc.ngc.normalization import EPSILON


def reference(circuit: NGCCircuit, x: th.Tensor, synapses: list[th.Tensor], member: int | None = None) -> th.Tensor:
    """The circuit's projection, written with autograd's own functions."""
    weights, biases = synapses[: len(synapses) // 2], synapses[len(synapses) // 2 :]
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        x = th.nn.functional.linear(x, weight, bias.flatten())
        if layer < len(weights) - 1:
            x = th.nn.functional.layer_norm(x, x.shape[-1:], eps=EPSILON)
            x = x.clamp(0.0, 6.0) if circuit.activation.name == "relu6" else th.tanh(x)
    return x


def leaves(circuit: NGCCircuit, member: int | None = None) -> list[th.Tensor]:
    every = [*circuit.weights, *circuit.biases]
    chosen = every if member is None else [synapses[member] for synapses in every]
    return [synapses.detach().clone().requires_grad_() for synapses in chosen]


@pytest.mark.parametrize("hidden", [(16,), (16, 12), (16, 12, 10, 8)])
@pytest.mark.parametrize("activation", ["relu6", "tanh"])
def test_the_tied_sweep_through_normalized_layers_is_the_gradient_of_the_output_loss(hidden, activation):
    th.manual_seed(0)
    circuit = NGCCircuit(5, 3, hidden, settling="scheduled", normalization="layer", activation=activation)
    x, target = th.randn(32, 5), th.randn(32, 3)
    changes = circuit.hebbian_update(circuit.settle(x, target))
    synapses = leaves(circuit)
    output = reference(circuit, x, synapses)
    assert th.allclose(circuit.project(x), output, atol=1e-6)
    (0.5 * (target - output).square().sum(1).mean()).backward()
    for mine, leaf in zip([*changes.weights, *changes.biases], synapses, strict=True):
        assert th.allclose(mine, -leaf.grad, atol=1e-6)


def test_every_member_of_a_normalized_ensemble_changes_as_a_circuit_of_its_own():
    th.manual_seed(0)
    ensemble = NGCCircuit(5, 3, (16, 12), settling="scheduled", normalization="layer", n_members=4)
    x, target = th.randn(32, 5), th.randn(4, 32, 3)
    changes = ensemble.hebbian_update(ensemble.settle(x, target))
    for member in range(4):
        synapses = leaves(ensemble, member)
        output = reference(ensemble, x, synapses)
        assert th.allclose(ensemble.project(x)[member], output, atol=1e-6)
        (0.5 * (target[member] - output).square().sum(1).mean()).backward()
        for mine, leaf in zip([*changes.weights, *changes.biases], synapses, strict=True):
            assert th.allclose(mine[member].flatten(), -leaf.grad.flatten(), atol=1e-6)


@pytest.mark.parametrize("dynamics", ["state", "krylov"])
@pytest.mark.parametrize("n_members", [0, 3])
def test_settling_lowers_the_energy_of_a_normalized_circuit(dynamics, n_members):
    th.manual_seed(0)
    rate = {"settling_rate": 0.05} if dynamics == "state" else {}
    circuit = NGCCircuit(
        5,
        3,
        (16, 12),
        normalization="layer",
        activation="tanh",
        n_settling_steps=20,
        dynamics=dynamics,
        n_members=n_members,
        **rate,
    )
    x, target = th.randn(64, 5), th.randn(64, 3)
    settled = circuit.settle(x, target).total_discrepancy().mean()
    projected = 0.5 * (target - circuit.project(x)).square().sum(-1).mean()
    assert settled < 0.98 * projected


def test_the_actor_follows_the_mean_of_an_ensemble_as_autograd_has_it():
    th.manual_seed(0)
    actor = NGCCircuit(4, 2, (16,), settling="scheduled", output_activation="tanh", activation="tanh", normalization="layer")
    critic = NGCCircuit(
        6, 2, (16, 12), settling="scheduled", activation="tanh", normalization="layer", n_feedback_inputs=2, n_members=3
    )
    x = th.randn(32, 4)
    changes = actor.hebbian_update(settle_coupled(actor, critic, x).actor)
    synapses = leaves(actor)
    inputs = th.cat([x, th.tanh(reference(actor, x, synapses))], dim=1)
    values = th.stack([reference(critic, inputs, leaves(critic, member)) for member in range(3)])
    values.mean((0, 2)).mean().backward()
    for mine, leaf in zip([*changes.weights, *changes.biases], synapses, strict=True):
        assert th.allclose(mine, leaf.grad, atol=1e-6)
