"""Keywords: numbers of NumPy, noise, buffers that fit, and what ``learn`` says of them."""

import numpy as np
import pytest
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise

from sb3_actpc import ActPC
from sb3_actpc.utils.settings import constructor_settings
from tests.actpc.agents import SMALL, imitating, make
from tests.actpc.envs import CountingEnv

NO_SIGNALS = {"epistemic": 0.0, "instrumental": 0.0}


def test_numpys_numbers_are_numbers():
    settings = {"seed": np.int64(3), "learning_rate": np.float32(1e-3), "gamma": np.float64(0.9)}
    model = make(train_freq=np.int64(2), **settings).learn(15)
    assert model.num_timesteps == 16 and model._n_updates > 0
    assert [type(getattr(model, name)) for name in settings] == [int, float, float]
    assert make(train_freq=(np.int64(2), "episode")).learn(15).train_freq.frequency == 2


def test_a_number_is_the_standard_deviation_of_the_action_noise():
    model = make(action_noise=0.3)
    assert np.std([model.action_noise() for _ in range(2000)], axis=0) == pytest.approx([0.3, 0.3], rel=0.1)
    assert constructor_settings(model)["keywords"]["action_noise"] == 0.3
    assert make(action_noise=None).action_noise is None and make(action_noise=0).action_noise is None


@pytest.mark.parametrize("kind", ["ReplayBuffer", "NStepReplayBuffer", "DictReplayBuffer", "HerReplayBuffer"])
@pytest.mark.parametrize("dict_observations", [False, True])
def test_a_buffer_must_fit_the_observations(kind, dict_observations):
    env = CountingEnv(dict_observations=dict_observations)
    fits = dict_observations == (kind in ("DictReplayBuffer", "HerReplayBuffer"))
    policy = "MultiInputPolicy" if dict_observations else "MlpPolicy"
    if fits and kind != "HerReplayBuffer":
        assert ActPC(policy, env, replay_buffer_class=kind, **SMALL).learn(15).replay_buffer.pos == 15
        return
    with pytest.raises(ValueError, match="goal environment" if fits else "does not keep observations of"):
        ActPC(policy, env, replay_buffer_class=kind, **SMALL)


def test_a_buffer_that_keeps_no_signals_is_named():
    with pytest.raises(ValueError, match=r"replay_buffer_class=.* must be None, one of .* or a subclass of ActPC's own"):
        make(replay_buffer_class=type("Mine", (ReplayBuffer,), {}))


@pytest.mark.parametrize(
    ("settings", "imitates"), [({}, False), ({"replay_buffer_kwargs": {"self_imitation_size": 50}}, True)]
)
def test_without_demonstrations_an_agent_imitates_its_own_episodes_only_if_told_to(settings, imitates):
    learned = [
        ActPC("MlpPolicy", CountingEnv(), learning_starts=4, batch_size=8, refresh_weight=weight, seed=0, **settings).learn(60)
        for weight in (0.0, 1.0)
    ]
    actions = [model.predict(np.eye(3, dtype=np.float32))[0] for model in learned]
    assert np.array_equal(*actions) != imitates


def test_noise_is_of_the_shape_of_an_action():
    with pytest.raises(ValueError, match=r"action_noise=.* does not fit an action of shape \(2,\)"):
        make(action_noise=NormalActionNoise(np.zeros(3), np.ones(3)))
    with pytest.raises(ValueError, match="give a number for each dimension"):
        make(action_noise=NormalActionNoise(0.0, 0.1))


def test_whole_episodes_are_collected_from_one_environment():
    with pytest.raises(ValueError, match=r"train_freq=\(1, 'episode'\) needs one environment, not 2"):
        make(n_envs=2, train_freq=(1, "episode"))
    model = make().learn(15)
    model.train_freq = 5
    assert model.learn(11, reset_num_timesteps=False).num_timesteps == 30


def test_a_tuple_is_no_observation():
    for history in (0, 2):
        with pytest.raises(ValueError, match=r"passed a tuple to the predict\(\) function"):
            make(policy_kwargs={"memory_history": history}).predict(CountingEnv().reset())


def late_and_early(**keywords):
    """Agents that have not learned: one whose signals get their weight after 10 steps, and one that has it from the start."""
    keywords = {"n_envs": 2, "signal_kwargs": {"normalization": "sampled"}, "learning_starts": 90, **keywords}
    late, early = (make(reward_weights=weights, **keywords) for weights in (NO_SIGNALS, {}))
    late.learn(20)
    assert not late.replay_buffer.epistemic.any()
    late.reward_weights = {"epistemic": 1.0}
    return late.learn(10, reset_num_timesteps=False), early.learn(30)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_what_was_stored_before_a_signal_had_its_weight_is_scored(n_steps):
    late, early = (model.replay_buffer.epistemic[:15] for model in late_and_early(n_steps=n_steps))
    assert (early > 0.0).all()
    np.testing.assert_allclose(late, early, rtol=1e-5)


def test_a_signal_that_had_its_weight_keeps_what_was_stored():
    """Another one gets a weight; and one that loses its weight is scored anew when it has it again."""
    model = imitating(reward_weights={"epistemic": 1.0}, signal_kwargs={"prior_updates": 5})
    model.learn(40)
    stored = model.replay_buffer.epistemic[:40].copy()
    model.reward_weights = {"epistemic": 1.0, "instrumental": 1.0}
    model.learn(10, reset_num_timesteps=False)
    buffer, shown = model.replay_buffer, model.expert
    assert np.array_equal(buffer.epistemic[:40], stored) and (stored > 0.0).all()
    assert (buffer.instrumental[:50] > 0.0).all() and (shown.instrumental > 0.0).all()
    for weights in ({}, {"epistemic": 1.0}):
        model.reward_weights = weights
        model.learn(10, reset_num_timesteps=False)
    assert (buffer.epistemic[:70] > 0.0).all()


def test_signals_that_get_a_weight_late_need_the_ends_of_episodes():
    model = imitating(optimize_memory_usage=True, replay_buffer_kwargs={"handle_timeout_termination": False}).learn(20)
    model.reward_weights = {"instrumental": 1.0}
    with pytest.raises(ValueError, match=r"which does not keep the last observations: give them to the constructor"):
        model.learn(5)
