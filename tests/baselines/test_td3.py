"""TD3 and DDPG with demonstrations: SB3's own without them, and what the paper's tables and Nair et al. add."""

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_actpc.baselines import DDPGDemo, TD3Demo
from tests.checkpoints.runs import assert_same, learn_in_two, learn_straight
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
    model = TD3Demo(
        "MlpPolicy",
        "Pendulum-v1",
        **SMALL,
        learning_rate=lambda left: 1e-3 * left,
        policy_delay=1,
        actor_kwargs={"learning_rate": 1e-4, "optimizer": "adamw", "tau": 1.0},
        critic_kwargs={"tau": 0.0},
    )
    before = [parameter.clone() for parameter in model.critic_target.parameters()]
    model.learn(40)
    assert isinstance(model.actor.optimizer, th.optim.AdamW) and not isinstance(model.critic.optimizer, th.optim.AdamW)
    left = model._current_progress_remaining
    assert model.actor.optimizer.param_groups[0]["lr"] == pytest.approx(1e-4 * left)
    assert model.critic.optimizer.param_groups[0]["lr"] == pytest.approx(1e-3 * left)
    for target, parameter in zip(model.actor_target.parameters(), model.actor.parameters(), strict=True):
        assert th.equal(target, parameter)
    assert all(th.equal(*pair) for pair in zip(before, model.critic_target.parameters(), strict=True))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"actor_kwargs": {"lr": 1.0}}, "unknown keys \\['lr'\\]: choose from learning_rate"),
        ({"critic_kwargs": {"optimizer": "sgd"}}, "optimizer='sgd' is unknown; choose one of"),
        ({"critic_kwargs": {"tau": "fast"}}, "tau='fast' must be a finite number"),
        ({"demonstration_fraction": 1.5}, "demonstration_fraction=1.5 must be between 0 and 1"),
        ({"demonstrations": 3}, "demonstrations must be a file path"),
    ],
)
def test_wrong_settings_are_named(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TD3Demo("MlpPolicy", "Pendulum-v1", **options)


def demonstrating(**options: object) -> DDPGDemo:
    given = {"demonstrations": record("Pendulum-v1"), "demonstration_fraction": 0.5, **options}
    return DDPGDemo("MlpPolicy", "Pendulum-v1", **{**SMALL, **given})


def test_the_cloning_loss_is_the_mean_squared_distance_of_the_demonstrations_that_the_critic_prefers() -> None:
    model = demonstrating(policy_gradient_weight=0.25, cloning_weight=2.0)
    assert model.replay_buffer is not None
    fill(model)
    batch = model.replay_buffer.sample(16)
    actions = model.actor(batch.observations)
    loss = model._actor_loss(batch, actions)
    with th.no_grad():
        value = -model.critic.q1_forward(batch.observations, actions).mean()
        theirs = model.critic.q1_forward(batch.observations[8:], batch.actions[8:])
        better = theirs > model.critic.q1_forward(batch.observations[8:], actions[8:])
        distances = ((actions[8:] - batch.actions[8:]) ** 2).sum(1, keepdim=True)
    assert 0 < better.sum() < 8  # otherwise the filter shows nothing
    assert loss.item() == pytest.approx((0.25 * value + 2.0 * (distances * better).sum() / 8).item(), rel=1e-5)
    model.q_filter = False
    unfiltered = model._actor_loss(batch, actions)
    assert unfiltered.item() == pytest.approx((0.25 * value + 2.0 * distances.mean()).item(), rel=1e-5)


def fill(model: DDPGDemo) -> None:
    """A few transitions of the agent's, before any update."""
    model.learning_starts = 1000
    model.learn(20)


def test_cloning_alone_brings_the_actor_to_the_demonstrations() -> None:
    model = demonstrating(policy_gradient_weight=0.0, q_filter=False, learning_rate=1e-2)
    fill(model)
    shown = model.replay_buffer.demonstrated.sample(64)

    def distance() -> float:
        return (model.actor(shown.observations) - shown.actions).square().mean().item()

    before = distance()
    model.train(300, 32)
    assert distance() < 0.7 * before


@pytest.mark.parametrize("kind", [TD3Demo, DDPGDemo])
def test_a_stopped_run_goes_on_bit_for_bit(kind: type, tmp_path) -> None:
    shown = record("Pendulum-v1")

    def make() -> TD3Demo:
        given = {"demonstrations": shown, "buffer_size": 100, "actor_kwargs": {"optimizer": "adamw"}}
        return kind("MlpPolicy", "Pendulum-v1", **given, **SMALL)

    straight = learn_straight(make, tmp_path / "straight", 40)
    assert_same(straight, learn_in_two(make, tmp_path / "two", 40, 25))


def test_a_checkpoint_of_other_demonstrations_is_refused() -> None:
    model = demonstrating()
    with pytest.raises(ValueError, match="5 demonstrated transitions, this one 24: pass the same demonstrations="):
        model.restore_checkpoint_state({"n_demonstrated": 5})


def test_the_number_of_demonstrations_can_be_limited() -> None:
    model = demonstrating(n_demonstration_transitions=7)
    assert model.replay_buffer.demonstrated.buffer_size == 7
    assert np.array_equal(model.replay_buffer.demonstrated.observations[:, 0], record("Pendulum-v1").observations[:7])


def test_a_start_from_behavior_cloning_acts_as_demonstrated() -> None:
    shown = record("Pendulum-v1")

    def error(bc_steps: int) -> float:
        options = {**SMALL, "learning_starts": 1000, "policy_kwargs": {"net_arch": [64]}}
        model = TD3Demo("MlpPolicy", "Pendulum-v1", demonstrations=shown, bc_steps=bc_steps, **options).learn(1)
        return float(np.square(model.predict(shown.observations, deterministic=True)[0] - shown.actions).mean())

    assert error(500) < 0.7 * error(0)


def test_normalized_values_make_the_loss_independent_of_the_scale_of_rewards() -> None:
    model = demonstrating(policy_gradient_weight=2.5, normalize_values=True, q_filter=False)
    fill(model)
    batch = model.replay_buffer.sample(16)
    actions = model.actor(batch.observations)
    loss = model._actor_loss(batch, actions).item()
    for network in model.critic.q_networks:
        for parameter in network[-1].parameters():
            parameter.data *= 10.0
    assert model._actor_loss(batch, actions).item() == pytest.approx(loss, rel=1e-4)
