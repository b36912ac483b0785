"""What strangers bring: units, wrappers, processes, extractors, optimisers, policies, buffers and files of their own."""

import re

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import TD3
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_actpc import ActPC
from sb3_actpc.actpc.policies import ActPCPolicy, ObservationNormalizer
from sb3_actpc.utils.tasks import task_id
from tests.actpc.agents import QUICK, SMALL, imitating, make
from tests.actpc.envs import CountingEnv, demonstrations

# ---------------------------------------------------------------------- units


@pytest.mark.parametrize("unit", [1e-5, 1.0, 1e5])
def test_features_are_normalised_in_any_unit(unit):
    normalizer, features = ObservationNormalizer(2), th.randn(200, 2) * th.tensor([1.0, 3.0]) + 2.0
    normalizer.fit(unit * features)
    assert th.allclose(normalizer(unit * features).std(0, correction=0), th.ones(2), atol=1e-3)


@pytest.mark.parametrize("value", [1234.567, 101325.3, 0.1])
def test_a_large_constant_has_not_changed(value):
    """Its mean, in float32, is another number, so that all rows deviate from it."""
    normalizer = ObservationNormalizer(1)
    normalizer.fit(th.full((6000, 1), value))
    assert normalizer.scale.item() == 1.0 and normalizer.mean.item() == pytest.approx(value, rel=1e-6)


def test_numerical_noise_is_no_change():
    normalizer = ObservationNormalizer(2)
    normalizer.fit(th.stack([1e-12 * th.randn(100), 0.8 + 1e-6 * th.randn(100)], dim=1))
    assert normalizer.scale.tolist() == [1.0, 1.0]


def test_observations_beyond_what_circuits_see_are_the_environments_fault():
    class Far(CountingEnv):
        def __init__(self):
            super().__init__()
            self.observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)

        def _observation(self):
            return np.array([1e200, 0.0, 1.0])

    with pytest.raises(ValueError, match="environment: observations are not finite"):
        make(DummyVecEnv([Far])).learn(5)


def test_the_largest_number_is_no_bound_of_an_action():
    env, largest = CountingEnv(), np.finfo(np.float32).max
    env.action_space = gym.spaces.Box(-largest, largest, (2,), np.float32)
    with pytest.raises(ValueError, match="must have finite bounds"):
        make(DummyVecEnv([lambda: env]))


# ---------------------------------------------------------------------- wrappers and processes


@pytest.mark.parametrize("dict_observations", [False, True])
def test_vec_normalize_knows_the_demonstrations_before_they_are_imitated(dict_observations):
    env = VecNormalize(DummyVecEnv([lambda: CountingEnv(dict_observations=dict_observations)]), norm_reward=False)
    data = demonstrations(n_episodes=2, length=700)  # shown in two parts
    if dict_observations:
        twice = [np.concatenate([part, 2 * part], axis=1) for part in (data.observations, data.next_observations)]
        data = type(data)(**{**vars(data), "observations": twice[0], "next_observations": twice[1]})
    model = ActPC("MultiInputPolicy" if dict_observations else "MlpPolicy", env, demonstrations=data, **QUICK)
    with pytest.warns(UserWarning, match="drift"):
        model.learn(1)
    shown = data.observations[:, :3]
    first = env.obs_rms["a"] if dict_observations else env.obs_rms
    assert first.mean == pytest.approx(shown.mean(0), abs=0.02) and first.var == pytest.approx(shown.var(0), rel=0.02)
    if dict_observations:
        assert env.obs_rms["b"].mean == pytest.approx(2 * shown.mean(0), abs=0.02)


def test_the_first_step_sees_what_vec_normalize_knows_by_then():
    env = VecNormalize(DummyVecEnv([CountingEnv]), norm_reward=False)
    model = imitating(env)
    seen = []
    original = model._sample_action
    model._sample_action = lambda *args, **kwargs: (
        seen.append((model._last_obs.copy(), env.normalize_obs(model._last_original_obs))) or original(*args, **kwargs)
    )
    with pytest.warns(UserWarning, match="drift"):
        model.learn(1)
    ((first, expected),) = seen
    assert np.array_equal(first, expected) and env.obs_rms.count > 60


def test_statistics_that_are_held_stay():
    env = VecNormalize(DummyVecEnv([CountingEnv]), norm_reward=False, training=False)
    before = env.obs_rms.mean.copy()
    with pytest.warns(UserWarning, match="drift"):
        imitating(env).learn(1)
    assert np.array_equal(env.obs_rms.mean, before)


def made_with_a_function():
    gym.register("Counted-v3", CountingEnv)
    env = gym.make("Counted-v3", returns=(0.0, 1.0), disable_env_checker=True)
    env.spec.kwargs["reward"] = lambda: 0.0  # which no process can send to another
    return env


def test_environments_in_processes_need_not_send_what_they_were_made_with():
    env = SubprocVecEnv([made_with_a_function] * 2, start_method="fork")
    try:
        assert task_id(env) == "Counted-v3"
        imitating(env, demonstrations=demonstrations(env_id="Counted-v2")).learn(4)
        with pytest.raises(ValueError, match=r"dataclasses.replace\(demonstrations, env_id='Counted-v3'\)"):
            imitating(env, demonstrations=demonstrations(env_id="Other-v0"))
    finally:
        env.close()


def test_the_task_of_an_environment():
    assert task_id(DummyVecEnv([made_with_a_function])) == "Counted-v3"
    assert task_id(DummyVecEnv([lambda: TimeLimit(CountingEnv(), 5)])) is None
    in_process = SubprocVecEnv([lambda: TimeLimit(CountingEnv(), 5)], start_method="fork")
    try:
        assert task_id(in_process) is None
    finally:
        in_process.close()


# ---------------------------------------------------------------------- extractors, optimisers, policies


class Dropping(BaseFeaturesExtractor):
    """Half of the observation drops out while it is trained, and it counts what it has seen."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 3)
        self.layers = th.nn.Sequential(th.nn.Flatten(), th.nn.BatchNorm1d(3), th.nn.Dropout(0.5))

    def forward(self, observations):
        return self.layers(observations)


def test_an_extractor_is_fixed():
    model = imitating(policy_kwargs={"features_extractor_class": Dropping})
    norm = model.actor.features_extractor.layers[1]
    before = norm.running_mean.clone()
    observations = th.randn(50, 3)
    features = model.actor.features(observations)
    model.policy.set_training_mode(True)
    assert th.equal(model.actor.features(observations), features)
    model.learn(30)
    assert th.equal(norm.running_mean, before)


@pytest.mark.parametrize("given", [{"foreach": True}, {"fused": False}, {}])
def test_adam_takes_the_form_that_it_is_given(given):
    model = make(policy_kwargs={"optimizer_kwargs": given})
    assert bool(model.actor.circuit.optimizer.defaults["fused"]) == (not given)
    model.learn(15)


def test_an_optimiser_that_asks_for_losses_is_refused():
    with pytest.raises(ValueError, match="asks for a loss"):
        make(policy_kwargs={"optimizer_class": th.optim.LBFGS})


class Closed(ActPCPolicy):
    """Takes nothing but what it names."""

    def __init__(self, observation_space, action_space, lr_schedule, net_arch=None):
        super().__init__(observation_space, action_space, lr_schedule, net_arch=net_arch)


def test_a_policy_has_to_pass_on_what_it_does_not_know():
    with pytest.raises(ValueError, match=r"Closed does not take \['circuit_kwargs'\].*\*\*kwargs"):
        ActPC(Closed, CountingEnv())
    with pytest.raises(ValueError, match=r"Closed does not take \['circuit_kwargs', 'is_gated'\].*\*\*kwargs"):
        ActPC(Closed, CountingEnv(), demonstrations=demonstrations())


def test_misspelt_keywords_of_the_buffer_are_named():
    with pytest.raises(ValueError, match=r"has 'combine', which CombinedReplayBuffer does not take.*'combined'"):
        make(replay_buffer_kwargs={"combine": True})


def test_nothing_is_imitated_where_nothing_is_shown_or_kept():
    assert "self-imitation" in make(replay_buffer_kwargs={"self_imitation_size": 0}).describe().splitlines()[-1]
    assert "self-imitation" not in make().describe()


# ---------------------------------------------------------------------- files


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
    with pytest.warns(UserWarning, match="goes on without"):
        loaded.learn(10)
    with pytest.raises(ValueError, match="need demonstrations="):
        ActPC("MlpPolicy", CountingEnv(), demonstration_fraction=0.5)


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
    model.save_replay_buffer(tmp_path / "own")
    model.load_replay_buffer(tmp_path / "own")
    assert model.replay_buffer is not mine and model.replay_buffer.pos == 12
    pendulum = ActPC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [4]})
    with pytest.raises(ValueError, match=r"observations of \(3,\) and 2 actions: this agent, of .* and 1 actions"):
        pendulum.load_replay_buffer(tmp_path / "own")


def test_a_buffer_remembers_as_much_as_the_agent_that_loads_it(tmp_path):
    model = make().learn(12)
    model.save_replay_buffer(tmp_path / "own")
    remembers = make(policy_kwargs={"memory_history": 3})
    remembers.load_replay_buffer(tmp_path / "own")
    remembers.learn(20, reset_num_timesteps=False)
    assert remembers.replay_buffer.history == 3 and remembers.replay_buffer.sample(4).history.shape == (4, 3, 3)


def test_numpys_numbers_are_numbers():
    settings = {"seed": np.int64(3), "learning_rate": np.float32(1e-3), "gamma": np.float64(0.9)}
    model = make(train_freq=np.int64(2), stats_window_size=np.int64(5), **settings).learn(15)
    assert model.num_timesteps == 16 and model._n_updates > 0
    assert [type(getattr(model, name)) for name in settings] == [int, float, float]
    assert make(train_freq=(np.int64(2), "episode")).learn(15).train_freq.frequency == 2


@pytest.mark.parametrize("kind", ["ReplayBuffer", "NStepReplayBuffer", "DictReplayBuffer", "HerReplayBuffer"])
@pytest.mark.parametrize("dict_observations", [False, True])
def test_a_buffer_must_fit_the_observations(kind, dict_observations):
    env = CountingEnv(dict_observations=dict_observations)
    fits = dict_observations == (kind in ("DictReplayBuffer", "HerReplayBuffer"))
    policy = "MultiInputPolicy" if dict_observations else "MlpPolicy"
    if fits and kind != "HerReplayBuffer":
        assert ActPC(policy, env, replay_buffer_class=kind, **SMALL).learn(15).replay_buffer.pos == 15
        return
    use = "DictReplayBuffer, HerReplayBuffer" if dict_observations else "ReplayBuffer"
    wrong = "goals" if fits else f"replay_buffer_class={kind} does not keep observations of .*: use {use} or None"
    with pytest.raises(ValueError, match=wrong):
        ActPC(policy, env, replay_buffer_class=kind, **SMALL)


def test_noise_of_several_environments_is_that_of_one_in_another_number_of_them(tmp_path):
    noise = NormalActionNoise(np.zeros(2), np.ones(2))
    make(n_envs=2, action_noise=noise).learn(20).save(tmp_path / "agent")
    for n_envs in (1, 3):
        loaded = ActPC.load(tmp_path / "agent", env=DummyVecEnv([CountingEnv] * n_envs)).learn(30)
        assert loaded.num_timesteps == 30 and getattr(loaded.action_noise, "n_envs", 1) == n_envs


def test_the_keywords_of_an_agents_policy_are_those_of_the_loaded_one(tmp_path):
    """The deployment gate is guidance's, not the user's."""
    imitating().save(tmp_path / "agent")
    assert ActPC.load(tmp_path / "agent", policy_kwargs={"net_arch": [16, 16]}).policy.is_gated
    with pytest.raises(ValueError, match=re.escape("specified kwargs: {'net_arch': [8]}")):
        ActPC.load(tmp_path / "agent", policy_kwargs={"net_arch": [8]})
    with pytest.raises(ValueError, match="policy_kwargs has 'is_gated', which guidance sets"):
        imitating(policy_kwargs={"is_gated": False})


@pytest.mark.parametrize("answer", [NotImplementedError, AttributeError, False])
def test_environments_that_nobody_can_ask_what_they_are_wrapped_in_are_learned_in(answer, monkeypatch):
    """As those of some simulators that step many at once."""

    def env_is_wrapped(self, kind, indices=None):
        if answer:
            raise answer
        return False

    env = DummyVecEnv([CountingEnv])
    model = make(env)
    monkeypatch.setattr(DummyVecEnv, "env_is_wrapped", env_is_wrapped)
    assert model.learn(5).learn(5, reset_num_timesteps=False).num_timesteps == 10


def test_a_trained_agent_in_another_task_is_told_that_it_can_do_without_demonstrations(tmp_path):
    gym.register("OtherCounted-v0", CountingEnv)
    other = gym.make("OtherCounted-v0", disable_env_checker=True)
    imitating().learn(10).save(tmp_path / "agent")
    with pytest.raises(ValueError, match=r"env_id.*A trained agent can do without: demonstrations=None"):
        ActPC.load(tmp_path / "agent", env=other)
    assert ActPC.load(tmp_path / "agent", env=other, demonstrations=None).expert is None


def test_a_file_of_another_algorithm_is_refused(tmp_path):
    TD3("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [4]}, buffer_size=10).save(tmp_path / "td3")
    with pytest.raises(ValueError, match=r"td3 holds no ActPC: load it with the class that saved it .policy=<class"):
        ActPC.load(tmp_path / "td3")
