"""A goal task with own demonstrations: a scripted arm shows FetchReach, ActPC imitates it and learns with hindsight.

Needs pip install -e ".[fetch]". Some minutes.
"""

import gymnasium as gym
import gymnasium_robotics
import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_actpc import ActPC, preset
from sb3_actpc.demonstrations import Demonstrations

gym.register_envs(gymnasium_robotics)
ENV_ID = "FetchReach-v4"


def towards_the_goal(observation: dict[str, np.ndarray]) -> np.ndarray:
    """The gripper goes to the goal, the slower the nearer it is; the fingers stay as they are."""
    way = observation["desired_goal"] - observation["achieved_goal"]
    return np.append(np.clip(8.0 * way, -1.0, 1.0), 0.0).astype(np.float32)


demonstrations = Demonstrations.record(towards_the_goal, ENV_ID, n_episodes=40, only_successes=True)
demonstrations.save("fetch_reach.npz")  # sb3-actpc train --env FetchReach-v4 --demonstrations fetch_reach.npz
print(demonstrations)

model = ActPC(env=ENV_ID, **{**preset(ENV_ID), "demonstrations": demonstrations}, seed=0)
for steps in (1, 10_000):
    model.learn(steps, progress_bar=True)  # one step: imitation alone
    mean, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=20)
    print(f"after {model.num_timesteps} steps: mean return {mean:.2f}")
