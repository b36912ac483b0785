"""TD3 and DDPG with demonstrations: SB3's own without them, and what the paper's tables and Nair et al. add."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.baselines import DDPGDemo, TD3Demo
from tests.recordings import record

SMALL = {"policy_kwargs": {"net_arch": [16]}, "learning_starts": 10, "batch_size": 16, "seed": 1}


def weights(model: BaseAlgorithm) -> th.Tensor:
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


@pytest.mark.parametrize(
    ("ours", "theirs", "options"), [(TD3Demo, TD3, {}), (DDPGDemo, DDPG, {"policy_gradient_weight": 1.0})]
)
def test_without_demonstrations_it_is_sb3s_number_by_number(ours: type, theirs: type, options: dict) -> None:
    one = theirs("MlpPolicy", "Pendulum-v1", **SMALL).learn(60)
    other = ours("MlpPolicy", "Pendulum-v1", **SMALL, **options).learn(60)
    assert th.equal(weights(one), weights(other))


def test_actor_and_critic_have_rates_optimisers_and_targets_of_their_own() -> None:
    own = {"actor_kwargs": {"learning_rate": 1e-4, "optimizer": "adamw", "tau": 1.0}, "critic_kwargs": {"tau": 0.0}}
    rate = LinearSchedule(1e-3, 0.5e-3, 1.0)
    model = TD3Demo("MlpPolicy", "Pendulum-v1", **SMALL, learning_rate=rate, policy_delay=1, **own)
    before = [parameter.clone() for parameter in model.critic_target.parameters()]
    model.learn(40)
    assert isinstance(model.actor.optimizer, th.optim.AdamW) and not isinstance(model.critic.optimizer, th.optim.AdamW)
    rates = [network.optimizer.param_groups[0]["lr"] for network in (model.actor, model.critic)]
    assert rates == pytest.approx([0.5e-4, 0.5e-3])
    for target, parameter in zip(model.actor_target.parameters(), model.actor.parameters(), strict=True):
        assert th.equal(target, parameter)
    assert all(th.equal(*pair) for pair in zip(before, model.critic_target.parameters(), strict=True))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"actor_kwargs": {"lr": 1.0}}, "'lr': 1.0.* of a network: choose from .'learning_rate'"),
        ({"critic_kwargs": {"optimizer": "sgd"}}, "sgd.* of a network: choose from .*optimizers .'adam', 'adamw'"),
        ({"demonstration_fraction": 1.5}, "demonstration_fraction=1.5 must be between 0 and 1"),
        ({"demonstrations": 3}, "demonstrations must be a file path"),
        ({"replay_buffer_class": HerReplayBuffer}, "must be None; for hindsight replay use HER"),
    ],
)
def test_wrong_settings_are_named(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TD3Demo("MlpPolicy", "Pendulum-v1", **options)


def demonstrating(env_id: str = "Pendulum-v1", **options: object) -> DDPGDemo:
    """One critic, half of each batch demonstrated, and a few transitions of the agent's, before any update."""
    given = {"demonstrations": record(env_id), "demonstration_fraction": 0.5, "learning_starts": 1000, **options}
    return DDPGDemo("MlpPolicy", env_id, **{**SMALL, **given}).learn(20)


def actor_step(env_id: str, **options: object) -> tuple[th.Tensor, th.Tensor]:
    """The change of the actor's last bias by one update with plain gradient descent of rate 1, and the gradient that the
    equations of Nair et al. give, with weights 0.25 and 2; with ``normalize_values`` those of TD3+BC."""
    model = demonstrating(env_id, policy_gradient_weight=0.25, cloning_weight=2.0, demonstration_fraction=1.0, **options)
    model.actor.optimizer = th.optim.SGD(model.actor.parameters(), lr=1.0)
    model.lr_schedule = lambda _: 1.0
    model.critic.optimizer = th.optim.SGD([th.nn.Parameter(th.zeros(1))], lr=0.0)  # the critic stands still
    bias = model.actor.mu[-2].bias
    before = bias.detach().clone()
    np.random.seed(5)
    batch = model.replay_buffer.sample(16)
    actions = model.actor(batch.observations)
    values = model.critic.q1_forward(batch.observations, actions)
    is_cloned = model.critic.q1_forward(batch.observations, batch.actions) > values
    assert 0 < is_cloned.sum() < 16  # otherwise the filter shows nothing
    distances = (actions - batch.actions).square().sum(dim=1, keepdim=True)
    cloning = distances * is_cloned if model.q_filter else distances
    scale = values.detach().abs().mean() if model.normalize_values else 1.0
    cloning = cloning / actions.shape[1] if model.normalize_values else cloning
    [gradient] = th.autograd.grad(2.0 * cloning.mean() - 0.25 / scale * values.mean(), bias)
    np.random.seed(5)
    model.train(1, 16)
    return before - bias.detach(), gradient


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "SparseReacher-v5"])
@pytest.mark.parametrize("options", [{}, {"q_filter": False}, {"q_filter": False, "normalize_values": True}])
def test_the_actor_climbs_its_value_and_clones_what_the_critic_prefers(options: dict, env_id: str) -> None:
    change, gradient = actor_step(env_id, **options)
    assert change.numpy() == pytest.approx(gradient.numpy(), rel=1e-4)


def test_cloning_alone_brings_the_actor_to_the_demonstrations() -> None:
    model = demonstrating(policy_gradient_weight=0.0, q_filter=False, learning_rate=1e-2)
    shown = model.replay_buffer.demonstrated.sample(64)

    def distance() -> float:
        return (model.actor(shown.observations) - shown.actions).square().mean().item()

    before = distance()
    model.train(300, 32)
    assert distance() < 0.7 * before


def test_the_number_of_demonstrations_can_be_limited() -> None:
    model = demonstrating(n_demonstrations=(7, "transitions"))
    assert model.replay_buffer.demonstrated.buffer_size == 7
    assert np.array_equal(model.replay_buffer.demonstrated.observations[:, 0], record("Pendulum-v1").observations[:7])


def test_a_start_from_behavior_cloning_needs_observations_that_stay_as_they_are() -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1"))
    model = TD3Demo("MlpPolicy", env, demonstrations=record("Pendulum-v1"), bc_steps=5, policy_kwargs={"net_arch": [8]})
    with pytest.raises(ValueError, match="bc_steps=5 needs observations that stay as they are"):
        model.learn(1)


def test_all_networks_see_observations_normalized_by_the_demonstrations(tmp_path: Path) -> None:
    shown = record("Pendulum-v1")
    model = demonstrating(demonstrations=shown, observation_normalization="demonstrations")
    for network in (model.actor, model.actor_target, model.critic, model.critic_target):
        features = network.extract_features(th.as_tensor(shown.observations), network.features_extractor)
        th.testing.assert_close(features.mean(dim=0), th.zeros(3), atol=1e-4, rtol=0)
        th.testing.assert_close(features.std(dim=0, correction=0), th.ones(3), atol=1e-3, rtol=0)
    model.save(tmp_path / "normalized")
    played = DDPGDemo.load(tmp_path / "normalized")
    assert np.array_equal(played.predict(shown.observations)[0], model.predict(shown.observations)[0])


def test_an_observation_that_does_not_vary_in_the_demonstrations_keeps_its_scale() -> None:
    """Such as a goal that is the same in all of them: others are relabelled."""
    shown = record("Pendulum-v1")
    still = np.array([[1.0, 1.0, 0.0]], dtype=np.float32)
    columns = {name: getattr(shown, name) * still + 0.5 for name in ("observations", "next_observations")}
    model = demonstrating(demonstrations=replace(shown, **columns), observation_normalization="demonstrations")
    rows = th.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 1.5], [0.0, 0.0, 2.0]])
    features = model.actor.extract_features(rows, model.actor.features_extractor)
    th.testing.assert_close(features[:, 2], th.tensor([0.0, 1.0, 1.5]))


def test_normalization_by_the_demonstrations_needs_them_and_the_features() -> None:
    with pytest.raises(ValueError, match="observation_normalization='demonstrations' needs demonstrations="):
        TD3Demo("MlpPolicy", "Pendulum-v1", **SMALL, observation_normalization="demonstrations").learn(1)
    own = {"policy_kwargs": {"net_arch": [8], "features_extractor_class": FlattenExtractor}}
    with pytest.raises(ValueError, match="features extractor itself: use 'none', or leave features_extractor_class"):
        TD3Demo("MlpPolicy", "Pendulum-v1", **{**SMALL, **own}, observation_normalization="demonstrations")
    env = VecNormalize(make_vec_env("Pendulum-v1"))
    with pytest.raises(ValueError, match="observation_normalization='demonstrations' needs observations that stay"):
        TD3Demo(
            "MlpPolicy", env, **SMALL, demonstrations=record("Pendulum-v1"), observation_normalization="demonstrations"
        ).learn(1)


def test_a_start_from_behavior_cloning_acts_as_demonstrated() -> None:
    shown = record("Pendulum-v1")

    def error(bc_steps: int) -> float:
        options = {**SMALL, "learning_starts": 1000, "policy_kwargs": {"net_arch": [64]}}
        model = TD3Demo("MlpPolicy", "Pendulum-v1", demonstrations=shown, bc_steps=bc_steps, **options).learn(1)
        return float(np.square(model.predict(shown.observations, deterministic=True)[0] - shown.actions).mean())

    assert error(500) < 0.7 * error(0)
