"""Demonstrations of FetchPush-v4 by a scripted arm, as docs/results.md has them: ``python benchmarks/push_demonstrations.py``.

Needs pip install -e ".[fetch]". Writes ``push.npz``, 40 episodes.
"""

import gymnasium as gym
import gymnasium_robotics
import numpy as np

from sb3_actpc.demonstrations import Demonstrations

gym.register_envs(gymnasium_robotics)
ENV_ID, N_EPISODES = "FetchPush-v4", 40


def push(observation: dict[str, np.ndarray]) -> np.ndarray:
    """Behind the cube as seen from the goal, down, and towards the goal."""
    cube, goal, hand = observation["achieved_goal"], observation["desired_goal"], observation["observation"][:3]
    distance = np.linalg.norm((goal - cube)[:2])
    if distance < 0.02:
        return np.zeros(4, dtype=np.float32)
    way = (goal - cube)[:2] / distance
    side = np.array([way[1], -way[0]])
    offset = hand[:2] - cube[:2]
    start = cube[:2] - 0.06 * way
    if offset @ way < -0.02 and abs(offset @ side) < 0.02 and hand[2] < cube[2] + 0.02:
        velocity = np.append(8.0 * (way * min(distance, 0.06) - 3.0 * (offset @ side) * side), 8.0 * (cube[2] - hand[2]))
    elif np.linalg.norm(hand[:2] - start) < 0.015:
        velocity = np.append(8.0 * (start - hand[:2]), 10.0 * (cube[2] - hand[2]))
    else:
        velocity = np.append(8.0 * (start - hand[:2]), 10.0 * (cube[2] + 0.07 - hand[2]))
        if hand[2] < cube[2] + 0.05 and np.linalg.norm(offset) < 0.09:  # up before it moves beside the cube
            velocity[:2] *= 0.1
    return np.append(np.clip(velocity, -1.0, 1.0), 0.0).astype(np.float32)


if __name__ == "__main__":
    shown = Demonstrations.record(push, ENV_ID, n_episodes=N_EPISODES, seed=1000)
    print(shown)
    shown.save("push.npz")
