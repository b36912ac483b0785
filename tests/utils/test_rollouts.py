"""Other callers in the training environment, and environments that return one and the same array: no transition is wrong."""

import copy
import pickle
from typing import ClassVar

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_actpc import ActPC
from sb3_actpc.baselines.her import HER
from sb3_actpc.baselines.logo import LOGO
from sb3_actpc.baselines.td3 import TD3Demo
from tests.utils.one_array import LENGTH, OneArray, agent, assert_no_transition_is_wrong


class Plays(BaseCallback):
    """Moves the training environment at every fifth step, in one of SB3's hooks."""

    def __init__(self, move, when: str) -> None:
        super().__init__()
        self.move, self.when, self.infos_of_ends = move, when, []

    def _maybe(self, when: str) -> bool:
        if when == self.when and self.num_timesteps % 10 in (4, 9):
            self.move(self.model)
        return True

    def _on_step(self) -> bool:
        self.infos_of_ends += [self.locals["infos"][env]["is_last"] for env in np.flatnonzero(self.locals["dones"])]
        return self._maybe("step")

    def _on_rollout_start(self) -> None:
        self._maybe("rollout start")

    def _on_rollout_end(self) -> None:
        self._maybe("rollout end")


def vec_env(kind="box", n_envs=1, is_truncated=True, monitor=True, vec=DummyVecEnv, wrapper=None):
    def make():
        env = OneArray(kind, is_truncated)
        return Monitor(env) if monitor else env

    quick = {"start_method": "fork"} if vec is SubprocVecEnv else {}
    env = vec([make for _ in range(n_envs)], **quick)
    if wrapper == "normalize":
        return VecNormalize(env, norm_reward=False, clip_obs=1e6)
    return VecMonitor(env) if wrapper == "monitor" else env


def test_the_environment_of_these_tests_misleads_sb3_itself():
    """Without this package the stored last observation is the first one of the next episode."""
    env = DummyVecEnv([OneArray])
    env.reset()
    for _ in range(LENGTH):
        _, _, _, infos = env.step(np.zeros((1, 1), np.float32))
    assert infos[0]["terminal_observation"][1] == 0.0


@pytest.mark.parametrize("algorithm", [ActPC, TD3Demo])
@pytest.mark.parametrize("kind", ["box", "dict"])
@pytest.mark.parametrize("wrapper", [None, "normalize"])
@pytest.mark.parametrize("is_truncated", [True, False])
def test_an_observation_that_is_changed_in_place_is_stored_as_it_was(algorithm, kind, wrapper, is_truncated):
    callback = Plays(lambda model: None, "")
    model = agent(algorithm, vec_env(kind, 2, is_truncated, monitor=False, wrapper=wrapper))
    model.learn(60, callback=callback)
    assert_no_transition_is_wrong(model)
    assert all(callback.infos_of_ends) and len(callback.infos_of_ends) == 2 * (30 // LENGTH)


@pytest.mark.parametrize("algorithm", [ActPC, HER, TD3Demo])
@pytest.mark.parametrize("vec", [DummyVecEnv, SubprocVecEnv])
def test_in_place_observations_of_goal_tasks_in_other_processes(algorithm, vec):
    env = vec_env("goal", 2, vec=vec)
    model = agent(algorithm, env, learning_starts=40)
    model.learn(60)
    assert_no_transition_is_wrong(model)
    env.close()


def test_an_environment_without_a_wrapper_in_another_process_cannot_be_mended_and_is_named():
    env = vec_env(monitor=False, vec=SubprocVecEnv)
    with pytest.warns(UserWarning, match="must return a copy of it, or be wrapped in stable_baselines3's Monitor"):
        agent(TD3Demo, env).learn(20)
    env.close()


@pytest.mark.parametrize("vec", [DummyVecEnv, SubprocVecEnv])
def test_logo_values_the_last_observation_of_an_episode_that_a_time_limit_cut(vec):
    class LooksAtEnds(BaseCallback):
        steps: ClassVar[list[float]] = []

        def _on_step(self) -> bool:
            infos = [self.locals["infos"][env] for env in np.flatnonzero(self.locals["dones"])]
            self.steps.extend(float(info["terminal_observation"][1]) for info in infos)
            return True

    env = vec_env(n_envs=2, vec=vec)
    callback = LooksAtEnds()
    LOGO("MlpPolicy", env, n_steps=16, batch_size=16, n_critic_updates=1).learn(32, callback=callback)
    assert callback.steps == [LENGTH] * 4
    env.close()


def test_observations_of_a_vectorized_environment_that_reuses_its_own_array():
    class OneBuffer(DummyVecEnv):
        def _obs_from_buf(self):
            return self.buf_obs[None]

    for algorithm in (ActPC, TD3Demo):
        for wrap in (lambda env: env, lambda env: VecNormalize(env, norm_reward=False, clip_obs=1e6)):
            model = agent(algorithm, wrap(OneBuffer([OneArray])))
            model.learn(30)
            assert_no_transition_is_wrong(model)


def evaluates(model) -> None:
    evaluate_policy(model, model.get_env(), n_eval_episodes=1, warn=False)


def resets(model) -> None:
    model.get_env().reset()


def steps_one_directly(model) -> None:
    env = model.get_env().unwrapped.envs[-1].unwrapped
    env.step(env.action_space.sample())


def resets_by_name(model) -> None:
    model.get_env().env_method("reset")


MOVES = [evaluates, resets, steps_one_directly, resets_by_name]


class KeepsRollouts(Plays):
    """Also keeps what the rollout buffer holds before it is used."""

    def __init__(self, move, when: str) -> None:
        super().__init__(move, when)
        self.rollouts = []

    def _on_rollout_end(self) -> None:
        buffer = self.model.rollout_buffer
        self.rollouts.append((buffer.observations.copy(), buffer.episode_starts.copy(), buffer.rewards.copy()))
        super()._on_rollout_end()


def assert_steps_follow(observations, starts) -> None:
    """``observations`` (n, n_envs, 2) of OneArray: within an episode the step rises by one."""
    first = starts[1:].astype(bool)
    assert np.allclose(observations[1:, :, 1][first], 0.0, atol=1e-3)
    assert np.allclose((observations[1:] - observations[:-1])[~first], (0.0, 1.0), atol=1e-3)


@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize("when", ["step", "rollout start", "rollout end", "between"])
@pytest.mark.parametrize("monitor", [False, True])
def test_no_transition_of_logo_joins_two_episodes(move, when, monitor):
    model = LOGO("MlpPolicy", vec_env(n_envs=2, monitor=monitor), n_steps=20, batch_size=20, n_critic_updates=1)
    for _ in range(3):
        callback = KeepsRollouts(move, when)
        model.learn(40, callback=callback, reset_num_timesteps=False)
        if when == "between":
            move(model)
        for observations, starts, _ in callback.rollouts:
            assert_steps_follow(observations, starts)


def test_an_episode_of_logo_that_was_cut_is_bootstrapped():
    """As SB3 does at a time limit: the last reward has γ V(s') added, where all rewards are 0."""
    model = LOGO("MlpPolicy", vec_env(), n_steps=20, batch_size=20, n_critic_updates=1)
    callback = KeepsRollouts(resets, "step")
    model.learn(20, callback=callback)
    [(_, starts, rewards)] = callback.rollouts
    ends = np.append(starts[1:, 0], 0.0).astype(bool)
    assert ends.sum() >= 4
    assert (rewards[ends, 0] != 0.0).all() and (rewards[~ends, 0] == 0.0).all()


@pytest.mark.parametrize("algorithm", [ActPC, TD3Demo])
@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize(("monitor", "wrapper"), [(False, None), (True, None), (False, "monitor"), (False, "normalize")])
def test_no_transition_joins_two_episodes_when_others_play_between_two_learns(algorithm, move, monitor, wrapper):
    model = agent(algorithm, vec_env(n_envs=2, monitor=monitor, wrapper=wrapper))
    for _ in range(4):
        model.learn(10, reset_num_timesteps=False)
        move(model)
    assert_no_transition_is_wrong(model)
    model.learn(10, reset_num_timesteps=False)
    if wrapper == "monitor" or monitor:
        assert all(episode["l"] <= LENGTH for episode in model.ep_info_buffer)


@pytest.mark.parametrize("algorithm", [ActPC, TD3Demo])
@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize("when", ["step", "rollout start", "rollout end"])
@pytest.mark.parametrize("wrapper", [None, "normalize"])
def test_no_transition_joins_two_episodes_when_a_callback_plays(algorithm, move, when, wrapper):
    model = agent(algorithm, vec_env(monitor=False, wrapper=wrapper), train_freq=3)
    model.learn(40, callback=Plays(move, when))
    assert_no_transition_is_wrong(model)


@pytest.mark.parametrize("algorithm", [ActPC, HER])
@pytest.mark.parametrize("vec", [DummyVecEnv, SubprocVecEnv])
@pytest.mark.parametrize("move", [evaluates, resets_by_name])
def test_hindsight_relabels_within_an_episode_when_a_callback_plays(algorithm, vec, move):
    keywords = {"replay_buffer_class": "HerReplayBuffer"} if algorithm is ActPC else {}
    env = vec_env("goal", vec=vec)
    model = agent(algorithm, env, learning_starts=30, **keywords)
    model.learn(50, callback=Plays(move, "step"))
    assert_no_transition_is_wrong(model)
    buffer = model.replay_buffer
    for start in np.flatnonzero(buffer.ep_length[: buffer.pos, 0]):
        episode = slice(buffer.ep_start[start, 0], buffer.ep_start[start, 0] + buffer.ep_length[start, 0])
        assert len(set(buffer.observations["observation"][episode, 0, 0])) == 1
    env.close()


@pytest.mark.parametrize("algorithm", [ActPC, TD3Demo])
def test_returns_of_several_steps_stay_within_an_episode_when_others_play(algorithm):
    model = agent(algorithm, vec_env(n_envs=2, monitor=False), n_steps=3)
    for _ in range(4):
        model.learn(10, reset_num_timesteps=False)
        resets(model)
    model.learn(10, reset_num_timesteps=False)
    for _ in range(20):
        batch = model.replay_buffer.sample(8)
        assert (batch.observations[:, 0] == batch.next_observations[:, 0]).all()


def test_the_environment_that_was_passed_is_played_below_the_monitor_that_sb3_adds():
    """``evaluate_policy(model, env)`` steps the passed environment, of which the agent's Monitor knows nothing."""
    env = OneArray()
    for algorithm in (ActPC, TD3Demo):
        model = agent(algorithm, env)
        for _ in range(4):
            model.learn(10, reset_num_timesteps=False)
            evaluate_policy(model, Monitor(env), n_eval_episodes=1)
        assert_no_transition_is_wrong(model)


def test_an_episode_goes_on_where_nobody_else_played():
    for algorithm in (ActPC, TD3Demo):
        model = agent(algorithm, vec_env(n_envs=2))
        for _ in range(9):
            model.learn(6, reset_num_timesteps=False)
        assert_no_transition_is_wrong(model)
        assert [episode["l"] for episode in model.ep_info_buffer] == [LENGTH] * 2 * (27 // LENGTH)


def test_a_copy_of_a_training_environment_is_an_environment_of_its_own():
    """Copies, of memory or of a pickle, step themselves, and playing them is no disturbance."""
    env = OneArray()
    model = agent(ActPC, env)
    model.learn(10)
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        step = env.row.copy()
        twin.reset()
        twin.step(np.zeros(1, np.float32))
        assert np.array_equal(env.row, step)
        assert twin.row[1] == 1.0
    model.learn(10, reset_num_timesteps=False)
    assert model.replay_buffer.dones[:20, 0].tolist() == [float(step % LENGTH == 0) for step in range(1, 21)]


def test_frame_stacks_hold_frames_of_one_episode():
    for algorithm in (ActPC, TD3Demo):
        model = agent(algorithm, VecFrameStack(DummyVecEnv([OneArray]), 2))
        model.learn(16)
        resets(model)
        model.learn(16, reset_num_timesteps=False)
        buffer = model.replay_buffer
        rows = buffer.next_observations[: buffer.pos, 0]  # (episode, step) twice, the older first
        assert all(row[0] in (0.0, row[2]) for row in rows)
        assert (rows[:, 3] == buffer.observations[: buffer.pos, 0, 3] + 1.0).all()


class Shifts(VecEnvWrapper):
    """Adds to observations or rewards, of the same space."""

    def __init__(self, venv, observation: float = 0.0, reward: float = 0.0) -> None:
        super().__init__(venv)
        self.observation, self.reward = observation, reward

    def reset(self):
        return self.venv.reset() + self.observation

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations + self.observation, rewards + self.reward, dones, infos


@pytest.mark.parametrize("algorithm", [ActPC, TD3Demo])
@pytest.mark.parametrize(
    ("wrap", "name", "changed"),
    [
        (lambda env: VecFrameStack(env, 2), "VecFrameStack", "observations"),
        (lambda env: Shifts(env, observation=1.0), "Shifts", "observations"),
        (lambda env: Shifts(env, reward=1.0), "Shifts", "rewards"),
        (lambda env: VecMonitor(VecFrameStack(env, 2)), "VecFrameStack", "observations"),
    ],
)
def test_a_wrapper_outside_vec_normalize_that_changes_something_is_refused(algorithm, wrap, name, changed):
    """The example of SB3 issue 693."""
    model = agent(algorithm, wrap(VecNormalize(DummyVecEnv([OneArray]))))
    message = rf"changes the {changed}, .*VecNormalize goes outside: VecNormalize\({name}\(...\)\)"
    with pytest.raises(ValueError, match=message):
        model.learn(10)


@pytest.mark.parametrize("algorithm", [ActPC, TD3Demo])
def test_a_wrapper_outside_vec_normalize_that_changes_nothing_is_none_of_our_business(algorithm):
    for wrap in (VecMonitor, VecCheckNan, Shifts):
        model = agent(algorithm, wrap(VecNormalize(DummyVecEnv([OneArray]), clip_obs=1e6)))
        model.learn(20)
        assert_no_transition_is_wrong(model)
    model = agent(algorithm, VecNormalize(VecFrameStack(DummyVecEnv([OneArray]), 2)))
    model.learn(20)
    assert model.replay_buffer.observations.shape[-1] == 4


@pytest.mark.parametrize("algorithm", [ActPC, TD3Demo])
@pytest.mark.parametrize("kind", ["box", "dict"])
@pytest.mark.parametrize("plays", [False, True])
def test_the_last_observation_of_an_episode_is_stored_unclipped(algorithm, kind, plays):
    """VecNormalize clips what it normalizes; evaluation in a callback moves its statistics before the storage."""
    env = VecNormalize(DummyVecEnv([lambda: OneArray(kind)] * 2), norm_reward=False, clip_obs=0.5)
    model = agent(algorithm, env, train_freq=3)
    model.learn(60, callback=Plays(evaluates if plays else lambda model: None, "step"))  # first at the fifth step
    assert_no_transition_is_wrong(model)
