"""Keywords: numbers of NumPy, noise, buffers that fit, and what ``learn`` says of them."""

import numpy as np
import pytest
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise

from sb3_actpc import ActPC
from sb3_actpc.utils.settings import constructor_settings
from tests.actpc.agents import SMALL, make
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
    with pytest.raises(ValueError, match=r"action_noise=.* is of shape \(3,\), an action of \(2,\)"):
        make(action_noise=NormalActionNoise(np.zeros(3), np.ones(3)))


def test_whole_episodes_are_collected_from_one_environment():
    with pytest.raises(ValueError, match=r"train_freq=\(1, 'episode'\) needs one environment, not 2"):
        make(n_envs=2, train_freq=(1, "episode"))


def test_a_tuple_is_no_observation():
    for history in (0, 2):
        with pytest.raises(ValueError, match=r"passed a tuple to the predict\(\) function"):
            make(policy_kwargs={"memory_history": history}).predict(CountingEnv().reset())


def test_what_was_stored_before_a_signal_had_its_weight_is_scored():
    """As it would have been with the weight from the first step on, by circuits that have not learned since."""
    late, early = (
        make(n_envs=2, reward_weights=weights, signal_kwargs={"normalization": "sampled"}, learning_starts=50)
        for weights in (NO_SIGNALS, {})
    )
    late.learn(20)
    assert not late.replay_buffer.epistemic.any()
    late.reward_weights = {"epistemic": 1.0}
    for model in (late.learn(10, reset_num_timesteps=False), early.learn(30)):
        assert (model.replay_buffer.epistemic[:15] > 0.0).all()
    np.testing.assert_allclose(late.replay_buffer.epistemic[:15], early.replay_buffer.epistemic[:15], rtol=1e-5)
