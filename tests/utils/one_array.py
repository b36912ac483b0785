"""An environment that returns one and the same array, and what holds of the transitions that are stored of it."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

LENGTH = 7
GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")


class OneArray(gym.Env):
    """Episodes of seven steps. Observes (episode, step) in an array that is the same one, changed in place, all the time."""

    def __init__(self, kind: str = "box", is_truncated: bool = True) -> None:
        box = spaces.Box(-1.0, 1e4, (2,), np.float32)
        self.kind, self.is_truncated = kind, is_truncated
        keys = {"dict": ("seen", "other"), "goal": GOAL_KEYS}.get(kind, ())
        self.observation_space = spaces.Dict({key: box for key in keys}) if keys else box
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.row = np.zeros(2, np.float32)
        self.seen = {key: self.row for key in keys} or self.row
        self.report = {"is_last": False}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return np.zeros(len(achieved_goal), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.row += (1.0, 0.0)
        self.row[1] = 0.0
        self.report["is_last"] = False
        return self.seen, self.report

    def step(self, action):
        self.row[1] += 1.0
        ends = bool(self.row[1] == LENGTH)
        self.report["is_last"] = ends
        return self.seen, 0.0, ends and not self.is_truncated, ends and self.is_truncated, self.report


def agent(algorithm, env, **keywords):
    policy = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
    common = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 5, "batch_size": 4, "buffer_size": 300, "seed": 0}
    return algorithm(policy, env, gradient_steps=1, **{**common, **keywords})


def assert_no_transition_is_wrong(model, n_steps: int | None = None) -> None:
    buffer = model.replay_buffer
    assert buffer.pos == (n_steps or model.num_timesteps) // model.n_envs
    parts = buffer.observations if isinstance(buffer.observations, dict) else {"": buffer.observations}
    following = buffer.next_observations if isinstance(buffer.observations, dict) else {"": buffer.next_observations}
    for key, observed in parts.items():
        before, after = observed[: buffer.pos], following[key][: buffer.pos]
        assert np.allclose(after[..., 0], before[..., 0], atol=1e-3), "the two observations are of two episodes"
        assert np.allclose(after[..., 1], before[..., 1] + 1.0, atol=1e-3)
        ends = after[..., 1] > LENGTH - 0.5
        assert (buffer.dones[: buffer.pos][ends] == 1.0).all()
