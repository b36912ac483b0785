"""ActPC on the sparse HalfCheetah from demonstrations, evaluated on the dense task. A few minutes."""

from pathlib import Path

import gymnasium as gym

import sb3_actpc
import sb3_actpc.envs  # registers the sparse tasks
from sb3_actpc import ActPC
from sb3_actpc.common.demonstrations import Demonstrations
from sb3_actpc.training import play_episodes

ENV_ID = "SparseHalfCheetah-v5"

demonstrations = Demonstrations.load(Path(sb3_actpc.__file__).parent / "data" / "sparse_halfcheetah.npz")
if demonstrations.dense_returns is not None:
    print(f"demonstrators: dense return {demonstrations.dense_returns.mean():.0f}")

model = ActPC("MlpPolicy", ENV_ID, demonstrations=demonstrations, seed=0)
model.learn(total_timesteps=20_000, progress_bar=True)

# the reward is sparse; the dense one is what info["dense_reward"] reports
envs = [gym.make(ENV_ID) for _ in range(5)]
episodes = play_episodes(model, envs, n_episodes=5, seed=1000)
print(f"dense return {episodes.dense_returns.mean():.0f} ± {episodes.dense_returns.std():.0f}")
print(f"sparse return {episodes.sparse_returns.mean():.0f}, success rate {episodes.successes.mean():.2f}")

model.save("actpc_sparse_halfcheetah")
