"""Single equations of the agent, each by itself."""

import numpy as np
import pytest
import torch as th

from sb3_actpc import ActPC
from sb3_actpc.actpc.reward_signals import InternalSignals, RewardWeights, RunningQuantile
from tests.actpc.agents import make
from tests.actpc.envs import CountingEnv, demonstrations

SGD = {"optimizer_class": th.optim.SGD}  # its steps are the changes themselves


def test_the_actors_step_is_proportional_to_the_weight_of_the_critics_pressure():
    untouched = {"refresh_weight": 0.0, "learning_starts": 60, "learning_rate": 1.0, "policy_kwargs": SGD}
    steps = []
    for weight in (0.5, 1.0):
        model = make(critic_weight=weight, **untouched)
        model.learn(50)  # nothing is learned yet: both agents are the same
        before = [parameter.clone() for parameter in model.actor.circuit.parameters()]
        model._n_updates = 1
        model.update_actor(next(model.sample_batches(1, 16)))
        steps.append([new - old for new, old in zip(model.actor.circuit.parameters(), before, strict=True)])
    assert any(bool(step.abs().max() > 1e-9) for step in steps[1])
    for half, whole in zip(*steps, strict=True):
        th.testing.assert_close(2 * half, whole, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("quantile", [0.9, 0.5])
def test_the_running_quantile_is_passed_by_as_many_values_as_it_says(quantile):
    drawn = np.random.default_rng(0).exponential(size=20_000)
    normalizer = RunningQuantile(quantile)
    for value in drawn:
        normalizer(np.array([value]))
    assert np.mean(drawn <= normalizer.estimate) == pytest.approx(quantile, abs=0.05)


def test_signals_outlive_the_surprises_of_the_first_steps_by_default():
    """The first transition surprises a thousand times as much as all that follow: by the paper's maximum nothing is new again,
    while the quantile falls by exp(-0.02 * 0.1) a step, and is where they are after 3454."""
    first, later = np.full(1, 1000.0), np.ones(1)
    for settings, expected in (({}, 1.0), ({"normalizer": "max", "normalization": "stored"}, 0.001)):
        signals = InternalSignals(**settings)
        for raw in (first, *[later] * 4000):
            signals.score(raw, np.zeros(1), RewardWeights(epistemic=1.0))
        assert signals.rewards_of_errors[0](later) == pytest.approx(expected, rel=0.02)


def test_demonstrated_steps_are_rewarded_by_surprise_and_punished_for_leaving_the_prior(tmp_path):
    """What the generator does not foresee draws on, what the prior does not know keeps back; after loading too."""
    model = make(demonstrations=demonstrations(), demonstration_fraction=0.5).learn(40)
    model.save(tmp_path / "agent")
    loaded = ActPC.load(tmp_path / "agent", env=CountingEnv()).learn(20, reset_num_timesteps=False)
    for agent in (model, loaded):
        assert agent.expert.epistemic.min() > 0.0 > agent.expert.instrumental.max()


def test_the_bootstrapped_action_is_that_of_the_next_observation_with_the_memory_it_will_have():
    """μ'(o_t+1, m_t+1), where m_t+1 holds o_t: with m_t the target actor would act on what it had forgotten."""
    model = make(learning_starts=20, policy_kwargs={"memory_history": 3})
    model.learn(60)
    batch = next(model.sample_batches(1, 32))
    next_actions = model.actor_target.project(batch.bootstrap_features, batch.next_memory)
    forgetful = model.actor_target.project(batch.bootstrap_features, batch.memory)
    assert (next_actions - forgetful).abs().max() > 1e-3
    values = model.critic_target.project(th.cat([batch.bootstrap_features, next_actions], dim=1))
    expected = batch.rewards + (1.0 - batch.dones) * model.gamma * values
    th.testing.assert_close(model.critic_targets(batch), expected)
