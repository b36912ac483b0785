"""ActPC without demonstrations, on the task's own reward. Two minutes."""

from stable_baselines3.common.evaluation import evaluate_policy

from sb3_actpc import ActPC

model = ActPC("MlpPolicy", "Pendulum-v1", seed=0)
model.learn(total_timesteps=15_000, progress_bar=True)
mean, std = evaluate_policy(model, model.get_env(), n_eval_episodes=20)
print(f"mean return {mean:.0f} ± {std:.0f} (-1200 untrained, about -140 at best)")
model.save("actpc_pendulum")
