"""Settling: what moves, where it comes to rest, and what stays put. Expectations from the energy, by autograd or algebra."""

import numpy as np
import pytest
import torch as th

from sb3_actpc.ngc import NGCCircuit
from sb3_actpc.ngc.activations import HIDDEN_ACTIVATIONS
from sb3_actpc.ngc.dynamics import DYNAMICS
from tests.ngc import oracle

ITERATIVE = {"feedback": "tied", "n_settling_steps": 1}


def make(hidden=(12, 9), dtype=th.float64, **keywords) -> tuple[NGCCircuit, th.Tensor, th.Tensor]:
    circuit = NGCCircuit(5, 3, hidden, **{"dynamics": "state", **keywords}).to(dtype)
    return circuit, th.randn(7, 5, dtype=dtype), 0.5 * th.randn(7, 3, dtype=dtype)


@pytest.mark.parametrize("activation", HIDDEN_ACTIVATIONS)
@pytest.mark.parametrize("output_activation", ["identity", "tanh"])
def test_one_step_of_eq_1_and_the_hebbian_change_are_minus_gradients_of_the_energy(activation, output_activation):
    """Settle k and k + 1 steps: every hidden state must have moved by β times minus ∂F/∂z, at a state with errors. There the
    change of a synapse is minus ∂F/∂W, the mean over the batch."""
    rate = 0.05
    circuit, x, target = make(activation=activation, output_activation=output_activation, settling_rate=rate, **ITERATIVE)
    circuit.n_settling_steps = 6
    before = circuit.settle(x, target)
    latents = [z.clone().requires_grad_() for z in before.latents[:-1]]
    circuit.n_settling_steps = 7
    after = circuit.settle(x, target)
    weights, biases = oracle.synapses(circuit)
    oracle.energy(circuit, weights, biases, latents, target).backward()
    for old, new in zip(latents[1:], after.latents[1:-1], strict=True):
        assert old.grad.abs().max() > 1e-4
        assert th.allclose(new - old, -rate * old.grad, atol=1e-12)
    changes = circuit.hebbian_update(before)
    for change, synapse in zip(changes.tensors(), [*weights, *biases], strict=True):
        assert th.allclose(change, -synapse.grad / len(x), atol=1e-12)


@pytest.mark.parametrize("dynamics", DYNAMICS)
@pytest.mark.parametrize("hidden", [(8,), (8, 6), (8, 6, 7)])
def test_a_linear_circuit_settles_to_the_solution_of_its_linear_system(dynamics, hidden):
    """Stationarity of the quadratic energy, (I + W_below^T W_below) z = z̄ + W_below^T (z_below - b), solved at once."""
    circuit, x, target = make(hidden=hidden, activation="identity", dynamics=dynamics, **ITERATIVE)
    circuit.n_settling_steps, circuit.settling_tolerance = (3 if dynamics == "krylov" else 4000), 0.0  # 3 outputs
    sizes, n = list(hidden), len(x)
    weights, biases = list(circuit.weights), list(circuit.biases)
    offsets = [sum(sizes[:i]) for i in range(len(sizes) + 1)]
    matrix, right = th.eye(offsets[-1], dtype=x.dtype), th.zeros(n, offsets[-1], dtype=x.dtype)
    for layer in range(len(sizes)):
        block = slice(offsets[layer], offsets[layer + 1])
        below_w, below_b = weights[layer + 1], biases[layer + 1]
        matrix[block, block] += below_w.t() @ below_w
        right[:, block] += biases[layer] + (x @ weights[0].t() if layer == 0 else 0.0) - below_b @ below_w
        if layer + 1 < len(sizes):
            lower = slice(offsets[layer + 1], offsets[layer + 2])
            matrix[block, lower], matrix[lower, block] = -below_w.t(), -below_w
        else:
            right[:, block] += target @ below_w
    solution = th.linalg.solve(matrix, right.t()).t()
    state = circuit.settle(x, target)
    assert th.allclose(th.cat(state.latents[1:-1], dim=1), solution, atol=1e-8)


@pytest.mark.parametrize("feedback", ["tied", "learned"])
@pytest.mark.parametrize("hidden", [(8,), (8, 6), (8, 6, 7)])
def test_krylov_settling_rests_where_eq_1_does_while_states_move_little(hidden, feedback):
    """Any E, tanh at both ends, an output error of 1e-5: what is left is of second order."""
    circuit, x, _ = make(hidden, activation="tanh", output_activation="tanh", feedback=feedback, dynamics="krylov")
    circuit.n_settling_steps, circuit.settling_tolerance = 3, 0.0
    target = circuit.project(x) + 1e-5 * th.randn(7, 3, dtype=x.dtype)
    mine = circuit.settle(x, target)
    circuit.dynamics, circuit.n_settling_steps = "state", 3000
    circuit.rates.fill_(0.1)
    rest = circuit.settle(x, target)
    assert mine.n_steps == 3 and float(circuit.residual(mine)) < 1e-3
    for a, b in zip([*mine.errors, *mine.latents], [*rest.errors, *rest.latents], strict=True):
        assert th.allclose(a, b, atol=1e-9)


def test_krylov_settling_stops_at_its_tolerance():
    circuit, x, _ = make(hidden=(64, 64), activation="tanh", dynamics="krylov", feedback="tied")
    target = circuit.project(x) + 1e-5 * th.randn(7, 3, dtype=x.dtype)
    steps, residuals = [], []
    for tolerance in (0.9, 0.3, 0.01, 0.0):
        circuit.settling_tolerance = tolerance
        state = circuit.settle(x, target)
        steps.append(state.n_steps)
        residuals.append(float(circuit.residual(state)))
    assert steps[0] == 1 and steps == sorted(steps) and steps[-1] == circuit.n_settling_steps
    assert residuals[0] > residuals[2]


def test_energy_never_rises_while_settling():
    circuit, _, _ = make(hidden=(64, 64), **ITERATIVE)
    x, target = th.randn(256, 5, dtype=th.float64), 0.5 * th.randn(256, 3, dtype=th.float64)
    energies = []
    for steps in range(1, 11):
        circuit.n_settling_steps = steps
        energies.append(float(circuit.settle(x, target).total_discrepancy().mean()))
    start = 0.5 * (target - circuit.project(x)).square().sum() / len(x)
    assert all(new < old for old, new in zip([float(start), *energies], energies, strict=False))


@pytest.mark.parametrize("settling", ["iterative", "scheduled"])
def test_clamped_layers_and_synapses_stay_bit_identical(settling):
    circuit, x, target = make(settling=settling)
    held = [x.clone(), target.clone(), *[p.clone() for p in circuit.state_dict().values()]]
    state = circuit.settle(x, target)
    assert th.equal(state.latents[0], held[0]) and th.equal(state.latents[-1], held[1])
    for now, then in zip([x, target, *circuit.state_dict().values()], held, strict=True):
        assert th.equal(now, then)


def test_derivative_free_settling_rests_elsewhere():
    circuit, x, target = make(feedback="tied", settling_rate=0.1, n_settling_steps=50)
    reference = circuit.settle(x, target).latents[1]
    circuit.derivative_free = True
    assert not th.allclose(circuit.settle(x, target).latents[1], reference)


@pytest.mark.parametrize("dtype", [th.float32, th.float64])
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.skipif("not th.cuda.is_available()"))])
def test_dtype_and_device_are_kept(dtype, device):
    circuit, x, target = make(dtype=dtype, n_memory=4)
    circuit, x, target = circuit.to(device), x.to(device), target.to(device)
    state = circuit.settle(x, target, th.randn(7, 4, dtype=dtype, device=device))
    for tensor in [*state.latents, *state.errors, *circuit.hebbian_update(state).tensors()]:
        assert tensor.dtype == dtype and tensor.device.type == device


@pytest.mark.parametrize(
    ("keywords", "named"),
    [
        ({"activation": "gelu"}, "gelu"),
        ({"settling": "fast"}, "fast"),
        ({"settling_rate": 0.0}, "settling_rate"),
        ({"settling_rate": "fast"}, "settling_rate"),
        ({"n_settling_steps": 0}, "n_settling_steps"),
        ({"hidden": (0,)}, "hidden"),
        ({"leak": -1.0}, "leak"),
        ({"synaptic_scaling": "l2"}, "l2"),
        ({"leak": 0.1}, "leak=0.1 .*it needs dynamics='state'"),
        ({"settling_rate": 0.1}, "settling_rate=0.1 .*it needs dynamics='state'"),
        ({"settling_tolerance": -1.0}, "settling_tolerance=-1.0"),
        ({"settling": "scheduled", "leak": 0.1}, "leak=0.1 does not go with settling='scheduled'"),
        ({"settling": "scheduled", "settling_rate": 0.5}, "settling_rate=0.5 does not go with settling='scheduled'"),
        ({"settling": "scheduled", "feedback_scale": 0.5}, "feedback_scale=0.5 does not go with settling='scheduled'"),
        ({"settling": "scheduled", "derivative_free": True}, "derivative_free=True does not go with settling='scheduled'"),
        ({"output_activation": "clamp"}, "output_activation='clamp' does not go with settling='iterative'"),
        ({"activation": "clamp"}, "activation='clamp' is unknown"),
        ({"n_members": 2, "n_memory": 4}, "n_members=2 does not go with n_memory=4"),
        ({"synaptic_scaling": "soft_bound", "weight_bound": 0.0}, "weight_bound=0.0 does not go with synaptic_scaling"),
    ],
)
def test_a_wrong_keyword_is_named(keywords, named):
    with pytest.raises(ValueError, match=named):
        NGCCircuit(5, 3, **{"hidden": (4,), **keywords})


def test_a_missing_or_unwanted_memory_is_named():
    circuit, x, target = make(n_memory=4)
    for given, memory, found in (
        (circuit, None, "n_memory=4 but was given no memory"),
        (circuit, th.zeros(4), r"n_memory=4 but was given a memory of shape \(4,\)"),
        (make()[0], th.zeros(7, 4), r"n_memory=0 but was given a memory of shape \(7, 4\)"),
    ):
        with pytest.raises(ValueError, match=found):
            given.settle(x, target, memory)


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        (th.zeros(7, 6, dtype=th.float64), r"torch.float64 tensor \(7, 6\)"),
        (th.zeros(5, dtype=th.float64), r"torch.float64 tensor \(5,\)"),
        (th.zeros(7, 5), "a torch.float32 tensor"),
        (np.zeros((7, 5)), "a ndarray"),
    ],
)
def test_inputs_that_are_none_are_named(wrong, found):
    circuit, _, target = make()
    for use in (circuit.project, lambda x: circuit.settle(x, target)):
        with pytest.raises(ValueError, match=rf"takes inputs of shape \(B, 5\), a torch.float64 tensor, .*{found}"):
            use(wrong)


@pytest.mark.parametrize("assign", [False, True])
def test_loaded_synapses_are_those_that_are_used(assign):
    circuit, x, _ = make()
    other = make()[0]
    assert not th.equal(circuit.project(x), other.project(x))
    circuit.load_state_dict(other.state_dict(), assign=assign)
    assert th.equal(circuit.project(x), other.project(x))


@pytest.mark.parametrize("settling", ["scheduled", "iterative"])
def test_a_target_of_another_shape_is_refused(settling):
    """It would be broadcast: one target for the whole batch, or one number for all outputs."""
    circuit, x, target = make(settling=settling)
    for wrong in (target[0], target[:1], target[:, :1]):
        with pytest.raises(ValueError, match="target has the shape"):
            circuit.settle(x, wrong)


def test_a_circuit_without_an_optimizer_says_how_to_set_one():
    circuit, x, target = make()
    changes = circuit.hebbian_update(circuit.settle(x, target))
    with pytest.raises(ValueError, match="no optimizer"):
        circuit.apply_changes(changes)
    circuit.optimizer = th.optim.Adam(circuit.parameter_groups(1e-3))
    circuit.apply_changes(changes)
