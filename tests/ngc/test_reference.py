"""The fast circuit against the readable one: settling, sweeps, errors and Hebbian changes are the same numbers."""

import pytest
import torch as th

from sb3_actpc.ngc import NGCCircuit
from sb3_actpc.ngc.reference import ReferenceCircuit


def pair(n_memory=0, **keywords):
    """A circuit, its reference, inputs, targets and a memory, in float64."""
    th.manual_seed(0)
    circuit = NGCCircuit(5, 3, (12, 9, 7), n_memory=n_memory, memory_weight=0.5, **keywords).double()
    x, target = th.randn(16, 5).double(), th.randn(16, 3).double()
    memory = th.randn(16, n_memory).double() if n_memory else None
    return circuit, ReferenceCircuit(circuit), x, target, memory


def assert_same(circuit, reference, state, latents, errors):
    th.testing.assert_close(state.postsynaptic, errors)
    th.testing.assert_close(state.latents[:-1], latents[:-1])
    th.testing.assert_close(circuit.hebbian_update(state).weights, reference.changes(latents, errors))


@pytest.mark.parametrize("activation", ["relu6", "relu", "tanh", "identity"])
@pytest.mark.parametrize("feedback", ["tied", "learned"])
@pytest.mark.parametrize("n_memory", [0, 4])
def test_settling_is_eq_1(activation, feedback, n_memory):
    keywords = {"dynamics": "state", "n_settling_steps": 6, "settling_rate": 0.1, "leak": 0.02, "feedback_scale": 0.8}
    given = {"activation": activation, "output_activation": "tanh", "feedback": feedback}
    circuit, reference, x, target, memory = pair(n_memory, **keywords, **given)
    expected = reference.settle(x, target, [0.1] * 3, memory)
    assert_same(circuit, reference, circuit.settle(x, target, memory), *expected)


@pytest.mark.parametrize("activation", ["relu6", "relu", "tanh", "identity"])
@pytest.mark.parametrize("feedback", ["tied", "learned"])
@pytest.mark.parametrize("n_memory", [0, 4])
def test_scheduled_settling_is_one_sweep_of_the_errors(activation, feedback, n_memory):
    given = {"activation": activation, "output_activation": "tanh", "feedback": feedback, "settling": "scheduled"}
    circuit, reference, x, target, memory = pair(n_memory, **given)
    assert_same(circuit, reference, circuit.settle(x, target, memory), *reference.sweep(x, target, memory))


def test_projection_is_eq_6():
    circuit, reference, x, _, memory = pair(4, output_activation="tanh")
    th.testing.assert_close(circuit.project(x, memory), th.tanh(reference.project(x, memory)[-1]))
