"""Saved agents: without their demonstrations, with other keywords, and files of others."""

import pickle
import re

import numpy as np
import pytest
from stable_baselines3 import TD3
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_actpc import ActPC
from sb3_actpc.pretrained import load_agent, save_agent
from tests.actpc.agents import imitating, make
from tests.actpc.envs import CountingEnv, demonstrations


@pytest.mark.parametrize("found", ["another task", "damaged", "minari"])
def test_a_trained_agent_acts_whatever_has_become_of_its_demonstrations(found, tmp_path, monkeypatch):
    data, path = demonstrations(), tmp_path / "shown.npz"
    data.save(path)
    model = imitating(demonstrations=path)
    model.learn(20)
    if found == "minari":
        model.demonstrations = "nobodys/data-v0"
    model.save(tmp_path / "agent")
    if found == "another task":
        wider = np.concatenate([data.observations, data.observations], axis=1)
        type(data)(**{**vars(data), "observations": wider, "next_observations": wider}).save(path)
    elif found == "damaged":
        path.write_bytes(b"rubbish")
    observations = np.ones((4, 3), dtype=np.float32)
    loaded = ActPC.load(tmp_path / "agent")
    assert np.array_equal(loaded.predict(observations)[0], model.predict(observations)[0])
    with pytest.raises((ValueError, FileNotFoundError, ImportError)):
        loaded.set_env(DummyVecEnv([CountingEnv]))
        loaded.learn(5)


def test_a_trained_agent_goes_on_without_demonstrations_where_that_is_asked(tmp_path):
    model = imitating()
    model.learn(20)
    model.save(tmp_path / "agent")
    loaded = ActPC.load(tmp_path / "agent", env=CountingEnv(), demonstrations=None)
    observations = np.ones((4, 3), dtype=np.float32)
    assert np.array_equal(loaded.predict(observations)[0], model.predict(observations)[0])
    with pytest.warns(UserWarning, match="continues without"):
        loaded.learn(10)
    with pytest.raises(ValueError, match="give demonstrations="):
        ActPC("MlpPolicy", CountingEnv(), demonstration_fraction=0.5)


def test_a_loaded_agent_weighs_filtered_steps_as_before(tmp_path):
    model = imitating()
    model.learn(20)
    model.save(tmp_path / "agent")
    loaded = ActPC.load(tmp_path / "agent", env=CountingEnv(), demonstrations=demonstrations())
    loaded.learn(10, reset_num_timesteps=False)
    weight = loaded.actor_guidance.filtered_weight(1000)
    assert 0.0 < weight == model.actor_guidance.filtered_weight(1000)


def test_a_buffer_loaded_before_there_is_an_environment_keeps_its_episodes(tmp_path):
    model = imitating()
    model.learn(40)
    model.save(tmp_path / "agent")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = ActPC.load(tmp_path / "agent")
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.set_env(DummyVecEnv([CountingEnv]))
    assert len(loaded.replay_buffer.self_imitation) == len(model.replay_buffer.self_imitation) > 0


def test_a_circuits_own_learning_rate_outlasts_another_of_the_agent(tmp_path):
    make(policy_kwargs={"actor_kwargs": {"learning_rate": 1e-4}}, learning_rate=4e-4).save(tmp_path / "agent")
    loaded = ActPC.load(tmp_path / "agent", env=CountingEnv(), learning_rate=1e-3)
    loaded.learn(15)
    assert loaded.actor.circuit.optimizer.param_groups[0]["lr"] == pytest.approx(1e-4)
    assert loaded.critic.optimizer.param_groups[0]["lr"] == pytest.approx(1e-3)


def test_buffers_of_others_are_refused(tmp_path):
    other = TD3("MlpPolicy", CountingEnv(), buffer_size=50, learning_starts=10)
    other.save_replay_buffer(tmp_path / "td3")
    make(n_envs=2).save_replay_buffer(tmp_path / "two")
    model = make()
    model.learn(12)
    mine = model.replay_buffer
    for name, kind in (("td3", "a ReplayBuffer of 1"), ("two", "a CombinedReplayBuffer of 2")):
        with pytest.raises(ValueError, match=kind):
            model.load_replay_buffer(tmp_path / name)
        assert model.replay_buffer is mine
    with open(tmp_path / "numbers.pkl", "wb") as file:
        pickle.dump([1, 2], file)
    with pytest.raises(ValueError, match=r"numbers\.pkl: .*inherit from ReplayBuffer"):
        model.load_replay_buffer(tmp_path / "numbers.pkl")
    assert model.replay_buffer is mine
    model.save_replay_buffer(tmp_path / "own")
    model.load_replay_buffer(tmp_path / "own")
    assert model.replay_buffer is not mine and model.replay_buffer.pos == 12
    pendulum = ActPC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [4]})
    with pytest.raises(ValueError, match=r"observations of \(3,\) and 2 actions: this agent is of .* and 1 actions"):
        pendulum.load_replay_buffer(tmp_path / "own")


def test_a_buffer_remembers_as_much_as_the_agent_that_loads_it(tmp_path):
    model = make().learn(12)
    model.save_replay_buffer(tmp_path / "own")
    remembers = make(policy_kwargs={"memory_history": 3})
    remembers.load_replay_buffer(tmp_path / "own")
    remembers.learn(20, reset_num_timesteps=False)
    assert remembers.replay_buffer.history == 3 and remembers.replay_buffer.sample(4).history.shape == (4, 3, 3)


def test_the_keywords_of_an_agents_policy_are_those_of_the_loaded_one(tmp_path):
    """The deployment gate is guidance's, not the user's."""
    imitating().save(tmp_path / "agent")
    assert ActPC.load(tmp_path / "agent", policy_kwargs={"net_arch": [16, 16]}).policy.is_gated
    with pytest.raises(ValueError, match=re.escape("specified kwargs: {'net_arch': [8]}")):
        ActPC.load(tmp_path / "agent", policy_kwargs={"net_arch": [8]})


def test_a_loaded_replay_buffer_joins_no_two_episodes(tmp_path):
    """The buffer ends in mid-episode, and the agent has gone on since: its last transition is cut, as by a time limit."""
    model = ActPC("MlpPolicy", "Pendulum-v1", seed=0, learning_starts=1000)
    model.learn(50)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    model.learn(30, reset_num_timesteps=False)
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    model.learn(5, reset_num_timesteps=False)
    buffer = model.replay_buffer
    assert buffer.size() == 55
    assert buffer.dones[49, 0] and buffer.timeouts[49, 0]
    np.testing.assert_array_equal(buffer.observations[51, 0], buffer.next_observations[50, 0])


def test_a_loaded_agent_keeps_what_its_circuits_depend_on(tmp_path):
    """Another settling has other defaults of the critic, and without a gate no policy is deployed."""
    model = imitating()
    model.save(tmp_path / "agent")
    model.save_weights(tmp_path / "agent")
    for name, value in (("settling", "iterative"), ("guidance", "none")):
        with pytest.raises(ValueError, match=r"was made with .*, not .*: leave settling, guidance and guidance_kwargs out"):
            ActPC.load(tmp_path / "agent", env=CountingEnv(), **{name: value})
        with pytest.raises(ValueError, match=name):
            ActPC.from_weights(tmp_path / "agent", CountingEnv(), demonstrations=demonstrations(), **{name: value})
    assert ActPC.load(tmp_path / "agent", settling="scheduled", guidance="default").policy.is_gated


def test_a_clamped_output_reaches_the_bounds_and_is_loaded(tmp_path):
    model = imitating(policy_kwargs={"actor_kwargs": {"output_activation": "clamp"}})
    model.actor.acting.weights[-1].mul_(100.0)
    rows = np.random.default_rng(0).normal(size=(50, *model.observation_space.shape)).astype(np.float32)
    actions, _ = model.predict(rows)
    assert (np.abs(model.policy.scale_action(actions)) == 1.0).mean() > 0.5
    model.save(tmp_path / "agent")
    model.save_weights(tmp_path / "weights")
    save_agent(model, tmp_path / "small.safetensors")
    loaded = [
        ActPC.load(tmp_path / "agent"),
        ActPC.from_weights(tmp_path / "weights", CountingEnv(), demonstrations=demonstrations()),
    ]
    for one in (*loaded, load_agent(tmp_path / "small.safetensors", CountingEnv())):
        assert np.array_equal(one.predict(rows)[0], actions)
