"""The examples of docs/extend.md: each is a program that runs, and does what its text says."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch as th

from sb3_actpc import ActPC
from sb3_actpc.ngc import NGCCircuit
from tests.actpc.agents import make, weights_of

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "extend.md").read_text(encoding="utf-8")


def example(title):
    """The names that an example has defined, after it has run."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.partition(f"\n## {title}")[2].partition("\n## ")[0], re.DOTALL)
    names = {}
    exec(compile(code, f"docs/extend.md: {title}", "exec"), names)
    return names


def batch(circuit):
    th.manual_seed(0)
    return th.randn(8, circuit.sizes[0]), th.randn(8, circuit.sizes[-1])


def test_a_plasticity_rule():
    model = example("A plasticity rule")["model"]
    circuit = model.actor.circuit
    state = circuit.settle(*batch(circuit))
    errors = [error.sign() * error.abs().mean() for error in state.postsynaptic]
    for change, error, activity in zip(circuit.hebbian_update(state).weights, errors, state.activations, strict=True):
        th.testing.assert_close(change, error.t() @ activity / len(error))
    assert all(isinstance(one, type(circuit)) for one in model.policy.circuits().values())


def test_a_feedback_rule():
    names = example("A feedback rule")
    circuit = names["model"].actor.circuit
    state = circuit.settle(*batch(circuit))
    for layer, matrix in enumerate((circuit.direct_0, circuit.direct_1), start=1):
        z = state.latents[layer]
        th.testing.assert_close(state.errors[layer - 1], (state.output_drive @ matrix) * ((z > 0) & (z < 6)))


def test_a_layer_type(tmp_path):
    model = example("A layer type")["model"]
    circuit = model.actor.circuit
    assert 0.0 < circuit.mask.mean() < 1.0
    assert not circuit.weights[0][circuit.mask == 0.0].any() and circuit.weights[0][circuit.mask == 1.0].all()
    assert type(model.critic) is NGCCircuit and type(model.actor_target) is type(circuit)


def test_a_learned_intrinsic_reward(tmp_path):
    names = example("A learned intrinsic reward")
    model, signal = names["model"], names["model"].epistemic
    assert model.replay_buffer.epistemic[:130].any() and model.diagnostics.values["distillation_error"] > 0.0
    seen = next(model.sample_batches(1, 64))
    unseen = seen._replace(next_features=seen.next_features + 10.0)
    assert signal.score(seen).mean() < 0.1 * signal.score(unseen).mean()
    model.save(tmp_path / "agent")
    loaded = ActPC.load(tmp_path / "agent")
    for mine, theirs in zip(weights_of(signal), weights_of(loaded.epistemic), strict=True):
        assert th.equal(mine, theirs)


def test_another_gate():
    """Pendulum's episodes have 200 steps: the first is the best so far, and is deployed when it ends."""
    model = example("Another gate")["model"]
    assert np.isfinite(model.actor_guidance.best)
    assert any(not th.equal(*two) for two in zip(model.actor.deployed.weights, model.actor.circuit.weights, strict=True))


@pytest.mark.parametrize("given", ["NGCCircuit", th.nn.Linear, {"actor": th.nn.Linear}, {"world_model": NGCCircuit}])
def test_what_is_no_circuit_is_refused(given):
    with pytest.raises(ValueError, match=r"circuit_class=.* must be a "):
        make(policy_kwargs={"circuit_class": given})


def test_what_is_no_signal_is_refused():
    with pytest.raises(ValueError, match=r"epistemic_class=.* must be a subclass of RewardSignal"):
        make(signal_kwargs={"epistemic_class": NGCCircuit})


def test_overrides_of_all_updates_run_whatever_the_settings():
    """Also those of circuits that have no role: what an override does is its own affair."""
    ran = []

    class Own(ActPC):
        def update_actor(self, batch):
            ran.append("actor")
            super().update_actor(batch)

        def update_critic(self, batch):
            ran.append("critic")
            super().update_critic(batch)

        def update_generator(self, batch):
            ran.append("generator")
            super().update_generator(batch)

    Own("MlpPolicy", "Pendulum-v1", learning_starts=1, critic_weight=0.0, policy_delay=1).learn(3)
    assert set(ran) == {"actor", "critic", "generator"}
