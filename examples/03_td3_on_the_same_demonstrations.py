"""SB3's TD3 on the sparse HalfCheetah with the same demonstrations in its replay buffer, for comparison with ActPC."""

import sys

import gymnasium as gym
import numpy as np
from stable_baselines3 import TD3
from stable_baselines3.common.noise import NormalActionNoise

import sb3_actpc
from sb3_actpc.experiments.runs import play_episodes

ENV_ID, STEPS = "SparseHalfCheetah-v5", int(sys.argv[1]) if len(sys.argv) > 1 else 12_000

demonstrations = sb3_actpc.Demonstrations.load(sb3_actpc.shipped_demonstrations(ENV_ID))
noise = NormalActionNoise(np.zeros(6), 0.1 * np.ones(6))
model = TD3("MlpPolicy", ENV_ID, policy_kwargs={"net_arch": [256, 256]}, learning_starts=0, action_noise=noise, seed=0)
ends = demonstrations.episode_bounds[:, 1] - 1
for i in range(len(demonstrations)):  # the cheetah's actions lie in [-1, 1], as TD3 stores them
    model.replay_buffer.add(
        demonstrations.observations[i],
        demonstrations.next_observations[i],
        demonstrations.actions[i],
        demonstrations.rewards[i],
        np.array([i in ends]),
        [{"TimeLimit.truncated": bool(i in ends and not demonstrations.terminations[i])}],
    )
envs = [gym.make(ENV_ID) for _ in range(10)]
while model.num_timesteps < STEPS:
    model.learn(2_000, reset_num_timesteps=False)
    episodes = play_episodes(model, envs, n_episodes=10, seed=1_000_000)
    print(f"step {model.num_timesteps}: dense return {episodes.dense_returns.mean():.0f}", flush=True)
