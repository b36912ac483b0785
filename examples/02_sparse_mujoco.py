"""ActPC on the sparse HalfCheetah from demonstrations, evaluated on the dense task. Two or three minutes."""

import gymnasium as gym

from sb3_actpc import ActPC, Demonstrations, shipped_demonstrations
from sb3_actpc.experiments.runs import play_episodes

ENV_ID = "SparseHalfCheetah-v5"

demonstrations = Demonstrations.load(shipped_demonstrations(ENV_ID))
print(f"{demonstrations.n_episodes} episodes, mean dense return {demonstrations.dense_returns.mean():.0f}")

model = ActPC("MlpPolicy", ENV_ID, demonstrations=demonstrations, seed=0, verbose=1)
model.learn(total_timesteps=15_000, progress_bar=True)

# the reward is sparse; the dense one is what info["dense_reward"] reports
episodes = play_episodes(model, [gym.make(ENV_ID) for _ in range(5)], n_episodes=5, seed=1000)
print(f"dense return {episodes.dense_returns.mean():.0f} ± {episodes.dense_returns.std():.0f}")
print(f"sparse return {episodes.returns.mean():.0f}, success rate {episodes.successes.mean():.2f}")
model.save("actpc_sparse_halfcheetah")
