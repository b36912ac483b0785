"""Other callers in the training environment, and environments that return one and the same array: no transition is wrong."""

import copy
import pickle

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_actpc import ActPC
from sb3_actpc.baselines.her import HER
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


@pytest.mark.parametrize("algorithm", [ActPC, TD3Demo])
@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize(("monitor", "wrapper"), [(True, None), (False, "monitor"), (False, "normalize")])
def test_no_transition_joins_two_episodes_when_others_play_between_two_learns(algorithm, move, monitor, wrapper):
    model = agent(algorithm, vec_env(n_envs=2, monitor=monitor, wrapper=wrapper))
    for _ in range(4):
        model.learn(10, reset_num_timesteps=False)
        move(model)
    assert_no_transition_is_wrong(model)
    model.learn(10, reset_num_timesteps=False)
    if wrapper == "monitor" or monitor:
        assert all(episode["l"] <= LENGTH for episode in model.ep_info_buffer)


WHEN = [("step", None), ("step", "normalize"), ("rollout start", None), ("rollout end", "normalize")]


@pytest.mark.parametrize("algorithm", [ActPC, TD3Demo])
@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize(("when", "wrapper"), WHEN)
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


class Interrupts(BaseCallback):
    """In the third step."""

    def _on_step(self) -> bool:
        if self.n_calls == 3:
            raise KeyboardInterrupt
        return True


@pytest.mark.parametrize("algorithm", [ActPC, TD3Demo])
@pytest.mark.parametrize("reset_num_timesteps", [True, False])
@pytest.mark.parametrize(("n_envs", "n_steps"), [(1, 1), (1, 3), (3, 3)])
def test_an_interrupted_step_is_stored_and_no_return_is_of_two_episodes(algorithm, reset_num_timesteps, n_envs, n_steps):
    """The interruption falls into the middle of a rollout."""
    model = agent(algorithm, vec_env(n_envs=n_envs, monitor=False), n_steps=n_steps, train_freq=2)
    with pytest.raises(KeyboardInterrupt):
        model.learn(100, callback=Interrupts())
    model.learn(6 * n_envs, reset_num_timesteps=reset_num_timesteps)
    assert_no_transition_is_wrong(model, 9 * n_envs)
    batch = model.replay_buffer.sample(200)
    assert (batch.observations[:, 0] == batch.next_observations[:, 0]).all()
    assert (batch.next_observations[:, 1] - batch.observations[:, 1]).max() <= n_steps


def test_the_environment_that_was_passed_is_played_below_the_monitor_that_sb3_adds():
    """``evaluate_policy(model, env)`` steps the passed environment, of which the agent's Monitor knows nothing."""
    env = OneArray()
    for algorithm in (ActPC, TD3Demo):
        model = agent(algorithm, env)
        for _ in range(4):
            model.learn(10, reset_num_timesteps=False)
            evaluate_policy(model, Monitor(env), n_eval_episodes=1)
        assert_no_transition_is_wrong(model)


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
