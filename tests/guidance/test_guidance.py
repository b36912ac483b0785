"""The default guidance as an agent lives it: BC first, warm-up, gate, self-imitation; and hooks of one's own."""

import dataclasses

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_actpc import ActPC
from sb3_actpc.guidance import ActorGuidance, BehaviorGuidance, GuidanceConfig
from tests.actpc.agents import QUICK, differ, imitating, make, weights_of
from tests.actpc.envs import CountingEnv, demonstrations


def test_bc_imitates_before_any_step_and_starts_target_and_deployed_policy():
    data = demonstrations()
    errors = {}
    for n_updates in (0, 400):
        model = imitating(learning_starts=50, guidance_kwargs={"bc_updates": n_updates})
        model.learn(1)
        features = model.inputs.features(model.inputs.observations(data.observations))
        actions = model.actor.circuit.project(features)
        errors[n_updates] = float((actions - th.as_tensor(data.actions / 2)).square().mean())
        for circuit in (model.actor_target, model.actor.deployed):
            assert not differ(weights_of(circuit), weights_of(model.actor.circuit)) or n_updates == 0
    assert errors[400] < 0.5 * errors[0]


def test_the_critic_term_waits_for_the_end_of_the_warm_up():
    settings = {"bc_updates": 1, "critic_warmup": 20}
    model = imitating(guidance_kwargs=settings, refresh_weight=0.0, gradient_steps=1, policy_delay=1)
    model.learn(1)
    before = weights_of(model.actor.circuit)
    model.train(19, 16)
    assert not differ(before, weights_of(model.actor.circuit))
    model.train(1, 16)
    assert differ(before, weights_of(model.actor.circuit))


def test_the_imitation_term_halves_after_its_half_life():
    guidance = BehaviorGuidance(GuidanceConfig(critic_warmup=100, imitation_half_life=50))
    assert [guidance.imitation_weight(n) for n in (0, 100, 150, 200)] == [1.0, 1.0, 0.5, 0.25]


@pytest.mark.parametrize(("weighting", "share"), [("returns", 0.0), ("uniform", 0.5)])
def test_steps_are_imitated_by_the_return_of_their_episode(weighting, share):
    """Of two demonstrations one has a return; half of the steps are of the other."""
    data = demonstrations(n_episodes=2)
    data = dataclasses.replace(data, rewards=data.rewards * (np.arange(len(data)) < 20))
    model = imitating(demonstrations=data, guidance_kwargs={"weighting": weighting}, observation_normalization="none")
    first_length = int(data.episode_bounds[0, 1])
    features = model.sample_imitated(2000)[0]
    of_second = model.inputs.tensor(data.observations[first_length:])
    drawn = (features[:, None] == of_second[None]).all(2).any(1).float().mean()
    assert abs(float(drawn) - share) < 0.1


@pytest.mark.parametrize("n_envs", [1, 2])
def test_predict_uses_the_deployed_policy_and_evaluation_episodes_have_no_noise(n_envs):
    env = DummyVecEnv([CountingEnv] * n_envs)
    model = imitating(env, exploration_noise=0.5, train_freq=50)
    model.learn(40)
    observations = np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32)
    with th.no_grad():
        features = model.actor.features(model.actor.obs_to_tensor(observations)[0])
        deployed = model.actor.deployed.project(features).numpy()
    assert np.allclose(model.policy.scale_action(model.predict(observations)[0]), deployed, atol=1e-6)


def test_the_actor_policy_is_the_one_that_learns():
    model = imitating()
    model.learn(60)
    observations = np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32)
    with th.no_grad():
        features = model.actor.features(model.actor.obs_to_tensor(observations)[0])
        learned = model.policy.unscale_action(model.actor.circuit.project(features).numpy())
    assert np.allclose(model.actor_policy.predict(observations)[0], learned, atol=1e-6)
    assert not np.allclose(model.predict(observations)[0], learned, atol=1e-6)  # nothing was promoted
    assert model.actor.deployed is not None  # the view took nothing away


def test_guidance_none_has_no_deployed_policy_and_no_bc():
    keywords = {**QUICK, "guidance_kwargs": None}
    model = ActPC("MlpPolicy", CountingEnv(), demonstrations=demonstrations(), guidance="none", **keywords)
    before = weights_of(model.actor.circuit)
    model.pretrain()
    assert model.actor.deployed is None
    assert not differ(before, weights_of(model.actor.circuit))


def test_a_guidance_of_ones_own_takes_part():
    class HalfImitation(ActorGuidance):
        def critic_weight(self, n_updates: int) -> float:
            return 0.0

        def imitation_weight(self, n_updates: int) -> float:
            return 0.0

    model = make(demonstrations=demonstrations(), guidance=HalfImitation(), learning_starts=5)
    before = weights_of(model.actor.circuit)
    model.learn(30)
    assert not differ(before, weights_of(model.actor.circuit))


@pytest.mark.parametrize("method", ["update_actor", "update_critic", "update_generator"])
def test_an_overridden_update_always_runs(method):
    class Own(ActPC):
        n_calls = 0

    def count(self, batch):
        self.n_calls += 1

    setattr(Own, method, count)
    small = {"learning_starts": 5, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    model = Own("MlpPolicy", CountingEnv(), alpha_ep=0.5, **small)
    model.learn(20)
    assert model.n_calls > 10


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"bc_updates": -1}, r"guidance_kwargs\['bc_updates'\]=-1 must be a whole number"),
        ({"evaluation_share": 2.0}, r"guidance_kwargs\['evaluation_share'\]=2.0 must be a number from 0 to 1"),
        ({"weighting": "best"}, r"'weighting'\]='best' must be 'returns' or 'uniform'"),
        ({"gate": 1}, r"'gate'\]=1 must be True or False"),
        ({"warmup": 1}, r"guidance_kwargs has 'warmup'.*choose from"),
    ],
)
def test_wrong_guidance_keywords_are_named(wrong, named):
    with pytest.raises(ValueError, match=named):
        imitating(guidance_kwargs=wrong)


def test_an_unknown_guidance_is_named():
    with pytest.raises(ValueError, match="guidance='best' must be None, 'default', 'none' or an ActorGuidance"):
        imitating(guidance="best", guidance_kwargs=None)
