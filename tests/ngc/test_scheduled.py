"""
Scheduled settling with tied feedback is, numerically, the gradient of the output's loss; coupled, the deterministic policy
gradient. With learned error synapses it is where the error neurons rest under an infinitesimal error.
"""

import pytest
import torch as th

from sb3_actpc.ngc import NGCCircuit, policy_gradient, settle_coupled
from sb3_actpc.ngc.synapses import Synapses
from tests.ngc import oracle


@pytest.mark.parametrize("hidden", [(16,), (16, 12), (16, 12, 9, 14)], ids=["depth 2", "depth 3", "depth 5"])
@pytest.mark.parametrize("output_activation", ["identity", "tanh"])
@pytest.mark.parametrize("activation", ["relu6", "tanh"])
@pytest.mark.parametrize("normalization", ["none", "layer"])
def test_scheduled_changes_equal_backprop(hidden, output_activation, activation, normalization):
    given = {"activation": activation, "output_activation": output_activation, "normalization": normalization}
    circuit = NGCCircuit(6, 3, hidden, settling="scheduled", n_memory=5, **given)
    x, target, memory = th.randn(32, 6), th.randn(32, 3), th.randn(32, 5)
    weights, biases = oracle.synapses(circuit)
    memory_weights = [m.detach().clone().requires_grad_() for m in circuit.memory_weights]
    inputs = [b + memory @ m.t() for b, m in zip(biases, memory_weights, strict=True)]
    output = oracle.forward(circuit, weights, inputs, x)
    assert th.allclose(circuit.project(x, memory), output, atol=1e-6)
    (0.5 * (target - output).square().sum() / len(x)).backward()
    changes = circuit.hebbian_update(circuit.settle(x, target, memory))
    for change, synapse in zip(changes.tensors(), [*weights, *biases, *memory_weights], strict=True):
        assert synapse.grad.abs().max() > 1e-4
        assert th.allclose(change, -synapse.grad, atol=1e-5)


@pytest.mark.parametrize("hidden", [(), (16,), (16, 12)])
def test_a_clamped_output_costs_quadratically_within_its_bounds_and_linearly_outside(hidden):
    """With targets at a bound there is no cost beyond it."""
    circuit = NGCCircuit(6, 3, hidden, settling="scheduled", output_activation="clamp")
    circuit.weights[-1].mul_(8.0)
    x, target = th.randn(64, 6), (2 * th.randn(64, 3)).clamp(-1, 1)
    weights, biases = oracle.synapses(circuit)
    z = oracle.forward(circuit, weights, biases, x, "identity")
    bound = z.detach().clamp(-1, 1)
    assert th.allclose(circuit.project(x), bound, atol=1e-6)
    is_outside = z.abs() > 1
    assert 0.1 < is_outside.float().mean() < 0.9 and (is_outside & (target == bound)).any()
    cost = th.where(is_outside, (bound - target) * (z - bound), 0.5 * (z - target).square())
    (cost.sum() / len(x)).backward()
    changes = circuit.hebbian_update(circuit.settle(x, target))
    for change, synapse in zip(changes.tensors(), [*weights, *biases], strict=True):
        assert th.allclose(change, -synapse.grad, atol=1e-5)


def test_a_clamped_actor_follows_the_projected_policy_gradient():
    """An action at a bound moves into the range where the critic values that more, and never further out."""
    actor = NGCCircuit(17, 6, (32,), settling="scheduled", output_activation="clamp")
    critic = NGCCircuit(23, 6, (32,), settling="scheduled", n_feedback_inputs=6)
    actor.weights[-1].mul_(8.0)
    x = th.randn(64, 17)
    weights, biases = oracle.synapses(actor)
    z = oracle.forward(actor, weights, biases, x, "identity")
    action = z.detach().clamp(-1, 1).requires_grad_()
    value = oracle.forward(critic, *oracle.synapses(critic, False), th.cat([x, action], dim=1)).mean(1).mean()
    (push,) = th.autograd.grad(value, action)
    points_out = (z.abs() > 1) & (push * z > 0)
    assert points_out.any() and ((z.abs() > 1) & ~points_out).any()
    z.backward(push.masked_fill(points_out, 0.0))
    changes = actor.hebbian_update(settle_coupled(actor, critic, x).actor)
    for change, synapse in zip(changes.tensors(), [*weights, *biases], strict=True):
        assert synapse.grad.abs().max() > 1e-4 and th.allclose(change, synapse.grad, atol=1e-6)


def gradient_by_autograd(actor: NGCCircuit, critic: NGCCircuit, x: th.Tensor) -> list[th.Tensor]:
    """∂ mean_a Q(x, μ(x)) by the actor's weights and biases, by autograd."""
    weights, biases = oracle.synapses(actor)
    action = oracle.forward(actor, weights, biases, x)
    value = oracle.forward(critic, *oracle.synapses(critic, False), th.cat([x, action], dim=1))
    value.mean(1).mean().backward()
    return [p.grad for p in [*weights, *biases]]


def make_pair(hidden=(64, 64), n_actions=6, **keywords) -> tuple[NGCCircuit, NGCCircuit, th.Tensor]:
    actor = NGCCircuit(17, n_actions, hidden, output_activation="tanh", **keywords)
    critic = NGCCircuit(17 + n_actions, n_actions, hidden, n_feedback_inputs=n_actions, **keywords)
    return actor, critic, th.randn(64, 17)


@pytest.mark.parametrize("hidden", [(), (32,), (32, 32), (32, 24, 16)])
def test_the_coupled_pair_under_scheduled_is_the_policy_gradient(hidden):
    actor, critic, x = make_pair(hidden, settling="scheduled")
    before = [p.clone() for p in critic.state_dict().values()]
    changes = actor.hebbian_update(settle_coupled(actor, critic, x).actor)
    for change, gradient in zip(changes.tensors(), gradient_by_autograd(actor, critic, x), strict=True):
        assert th.allclose(change, gradient, atol=1e-6)
    assert all(th.equal(a, b) for a, b in zip(before, critic.state_dict().values(), strict=True))


def test_the_coupled_pair_tends_to_the_policy_gradient_as_it_settles_and_the_nudge_shrinks():
    actor, critic, x = (m.double() for m in make_pair(n_settling_steps=1000, dynamics="state", settling_rate=0.1))
    changes = actor.hebbian_update(settle_coupled(actor, critic, x, nudge=1e-6).actor)
    for change, gradient in zip(changes.tensors(), gradient_by_autograd(actor, critic, x), strict=True):
        assert th.allclose(change, gradient, rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("feedback", ["tied", "learned"])
def test_a_nudged_pair_rests_where_eq_1_does(feedback):
    """With a nudge of 1 the states move: sweeps that follow them end where the error neurons come to rest."""
    actor, critic, x = (m.double() for m in make_pair((16, 12), activation="tanh", feedback=feedback))
    states = []
    for dynamics, steps in (("krylov", 50), ("state", 2000)):
        for circuit in (actor, critic):
            circuit.dynamics, circuit.n_settling_steps, circuit.settling_tolerance = dynamics, steps, 1e-9
            circuit.rates.fill_(0.1)
        states.append(settle_coupled(actor, critic, x, nudge=1.0).actor)
    assert 1 < states[0].n_steps < 50
    for mine, rest in zip(states[0].postsynaptic, states[1].postsynaptic, strict=True):
        assert mine.abs().max() > 1e-4 and th.allclose(mine, rest, rtol=1e-5, atol=1e-9)


def test_the_actor_change_raises_the_action_values():
    """The paper prints -1/A for the clamped error; with changes that are added that would lower Q."""
    for keywords in ({"settling": "scheduled"}, {}):
        actor, critic, x = make_pair(**keywords)
        actor.optimizer = th.optim.SGD(actor.parameter_groups(0.5))
        before = settle_coupled(actor, critic, x)
        actor.apply_changes(actor.hebbian_update(before.actor))
        assert settle_coupled(actor, critic, x).action_values.mean() > before.action_values.mean() + 1e-4


def test_a_pair_that_does_not_fit_is_named():
    actor, critic, x = make_pair()
    with pytest.raises(ValueError, match="n_feedback_inputs=0"):
        settle_coupled(actor, NGCCircuit(23, 6), x)
    with pytest.raises(ValueError, match="must agree"):
        settle_coupled(make_pair(settling="scheduled")[0], critic, x)
    critic.n_settling_steps = 7
    with pytest.raises(ValueError, match=r"n_settling_steps=10 and critic n_settling_steps=7 must agree.*give both circuits"):
        settle_coupled(actor, critic, x)


def test_policy_gradient_is_exact_whatever_the_feedback():
    actor, critic, x = make_pair(feedback="learned", derivative_free=True)
    exact = policy_gradient(actor, critic, x)
    for change, gradient in zip(exact.tensors(), gradient_by_autograd(actor, critic, x), strict=True):
        assert th.allclose(change, gradient, atol=1e-6)


LEARNED = {"settling": "scheduled", "feedback": "learned", "activation": "tanh"}


@pytest.mark.parametrize("hidden", [(16,), (16, 12), (16, 12, 9)])
def test_the_learned_sweep_is_where_error_neurons_rest_under_an_infinitesimal_error(hidden):
    circuit = NGCCircuit(6, 3, hidden, output_activation="tanh", **LEARNED).double()
    x, error = th.randn(32, 6, dtype=th.float64), 1e-8 * th.randn(32, 3, dtype=th.float64)
    swept, circuit.dynamics = circuit.chain(x), "state"
    settled = circuit.chain(x)
    swept.clamp_output_drive(error)
    swept.sweep()
    settled.clamp_output_drive(error)
    settled.start_settling()
    for _ in range(400):
        settled.integrate([0.3] * len(hidden))
        settled.predict(output=False)
    for mine, rest in zip(swept.errors, settled.errors, strict=True):
        assert mine.abs().max() > 1e-10 and th.allclose(mine, rest, rtol=1e-4, atol=1e-13)


@pytest.mark.parametrize("feedback", ["learned", "tied"])
def test_no_transposed_weight_carries_an_error_of_the_learned_sweep(feedback, monkeypatch):
    """With noise in the place of the weights on every way back, learned sweeps stay bit for bit the same; tied ones do not."""
    keywords = {**LEARNED, "feedback": feedback}
    circuit = NGCCircuit(6, 3, (16, 12), **keywords)
    x, target = th.randn(32, 6), th.randn(32, 3)
    actor, critic, observations = make_pair((16, 12), **keywords)

    def changes():
        alone = circuit.hebbian_update(circuit.settle(x, target)).tensors()
        return [*alone, *actor.hebbian_update(settle_coupled(actor, critic, observations).actor).tensors()]

    honest, asked = changes(), Synapses.feedback_matrix

    def from_noise(synapses, *args, **kwargs):
        return asked(synapses._replace(weights=[th.randn_like(w) for w in synapses.weights]), *args, **kwargs)

    monkeypatch.setattr(Synapses, "feedback_matrix", from_noise)
    same = [th.equal(a, b) for a, b in zip(honest, changes(), strict=True)]
    assert all(same) if feedback == "learned" else not all(same)
