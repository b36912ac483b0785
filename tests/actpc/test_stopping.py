"""A rollout that is stopped in the middle: every environment step is stored, with its reward and its end."""

import numpy as np
import pytest
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_actpc import ActPC
from tests.actpc.envs import CountingEnv


def assert_one_step_each(buffer):
    """Every stored transition leads from a step of an episode to the next one of the same episode."""
    moved = np.round((buffer.next_observations - buffer.observations)[: buffer.pos, :, :2] * [7, 11])
    assert np.array_equal(moved, np.broadcast_to([0, 1], moved.shape))


@pytest.mark.parametrize("is_truncated", [False, True])
@pytest.mark.parametrize("normalizes", [False, True])
def test_a_callback_that_stops_at_the_end_of_an_episode_loses_nothing(is_truncated, normalizes):
    """The example of SB3 issue 2056: one ``learn`` per episode."""
    env = DummyVecEnv([lambda: CountingEnv(lengths=(7, 8), returns=(1.0,), cut=(is_truncated,))])
    settings = {"learning_starts": 5, "batch_size": 8, "replay_buffer_kwargs": {"self_imitation_size": 100}}
    model = ActPC("MlpPolicy", VecNormalize(env) if normalizes else env, seed=0, **settings)
    for _ in range(6):
        model.learn(1000, callback=StopTrainingOnMaxEpisodes(1), reset_num_timesteps=False)
    buffer = model.replay_buffer
    assert model.num_timesteps == buffer.pos == 3 * (7 + 8)
    assert [rows[: buffer.pos].sum() for rows in (buffer.rewards, buffer.dones, buffer.timeouts)] == [6, 6, 6 * is_truncated]
    assert sorted(buffer.self_imitation.lengths) == [7, 7, 7, 8, 8, 8]
    assert_one_step_each(buffer)
