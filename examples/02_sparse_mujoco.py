"""ActPC on the sparse HalfCheetah from demonstrations, evaluated on the dense task. About a minute."""

import gymnasium as gym
import numpy as np
from stable_baselines3.common.noise import NormalActionNoise

from sb3_actpc import ActPC, Demonstrations, shipped_demonstrations
from sb3_actpc.experiments.runs import play_episodes

ENV_ID = "SparseHalfCheetah-v5"

demonstrations = Demonstrations.load(shipped_demonstrations(ENV_ID))
print(f"{demonstrations.n_episodes} episodes, mean dense return {demonstrations.dense_returns.mean():.0f}")

model = ActPC(
    "MlpPolicy",
    ENV_ID,
    demonstrations=demonstrations,
    settling="scheduled",
    observation_normalization="demonstrations",
    alpha_ext=1.0,  # the task's reward, and a little of both internal signals
    alpha_ep=0.1,
    alpha_in=0.1,
    demonstration_fraction=0.5,  # half of the critic's batch
    policy_kwargs={"n_critics": 2},
    target_policy_noise=0.2,
    actor_pressure=0.1,
    scale_pressure=True,
    critic_warmup=1000,
    action_noise=NormalActionNoise(np.zeros(6), 0.1 * np.ones(6)),
    seed=0,
)
model.learn(total_timesteps=5_000, progress_bar=True)

# the reward is sparse; the dense one is what info["dense_reward"] reports
episodes = play_episodes(model, [gym.make(ENV_ID) for _ in range(5)], n_episodes=5, seed=1000)
print(f"dense return {episodes.dense_returns.mean():.0f} ± {episodes.dense_returns.std():.0f}")
print(f"sparse return {episodes.sparse_returns.mean():.0f}, success rate {episodes.successes.mean():.2f}")
model.save("actpc_sparse_halfcheetah")
