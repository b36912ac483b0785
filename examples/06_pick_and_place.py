"""A goal task that is never paid: each step costs 1 until a cube is at its goal. A scripted arm shows FetchPickAndPlace.

Needs pip install -e ".[fetch]". Half an hour on one core; two numbers, of episodes and of the seed, can be given.
Writes the demonstrations to pick.npz.
"""

import sys

import gymnasium as gym
import gymnasium_robotics
import numpy as np

from sb3_actpc import ActPC
from sb3_actpc.demonstrations import Demonstrations

gym.register_envs(gymnasium_robotics)
ENV_ID, N_TRIALS = "FetchPickAndPlace-v4", 100
N_EPISODES, SEED = (int(given) for given in sys.argv[1:] or (40, 0))


def pick_and_place(observation: dict[str, np.ndarray]) -> np.ndarray:
    """Above the cube, down to it, the fingers closed, and to the goal."""
    cube, goal = observation["achieved_goal"], observation["desired_goal"]
    way, opening = cube - observation["observation"][:3], observation["observation"][9:11].sum()
    if np.linalg.norm(way) < 0.02:
        held = np.zeros(3) if opening > 0.056 else 6.0 * (goal - cube)
        return np.append(np.clip(held, -1.0, 1.0), -1.0).astype(np.float32)
    if np.linalg.norm(way[:2]) >= 0.015:
        way = way + np.array([0.0, 0.0, 0.06])
    return np.append(np.clip(8.0 * way, -1.0, 1.0), 1.0).astype(np.float32)


def success(model: ActPC) -> float:
    """Share of the trials, whose starts are always the same, that end at the goal."""
    env, n = gym.make(ENV_ID), 0
    for trial in range(N_TRIALS):
        observation, info = env.reset(seed=5000 + trial)
        is_over = False
        while not is_over:
            observation, _, terminated, truncated, info = env.step(model.predict(observation)[0])
            is_over = terminated or truncated
        n += info["is_success"]
    return n / N_TRIALS


shown = Demonstrations.record(pick_and_place, ENV_ID, n_episodes=N_EPISODES, seed=1000)
print(shown)
shown.save("pick.npz")
hindsight = {"replay_buffer_class": "HerReplayBuffer"}
model = ActPC("MultiInputPolicy", ENV_ID, demonstrations=shown, gamma=0.95, seed=SEED, **hindsight)
model.learn(1)
print(f"success of the BC policy: {success(model):.2f}")
for _ in range(6):
    model.learn(5_000, reset_num_timesteps=False)
    print(f"after {model.num_timesteps} steps: {success(model):.2f}", flush=True)
