"""ActPC on a dense task, without demonstrations: the task's own reward takes their place. About a minute or two."""

from stable_baselines3.common.evaluation import evaluate_policy

from sb3_actpc import ActPC

model = ActPC("MlpPolicy", "Pendulum-v1", seed=0)
model.learn(total_timesteps=15_000, progress_bar=True)

mean_return, std_return = evaluate_policy(model, model.get_env(), n_eval_episodes=10)
print(f"mean return {mean_return:.0f} ± {std_return:.0f} (a random policy: about -1200, a good one: about -150)")

model.save("actpc_pendulum")
