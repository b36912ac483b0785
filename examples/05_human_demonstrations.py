"""Human demonstrations: 25 episodes of a hand that opens a door (Rajeswaran et al., arXiv 1709.10087). Only seven succeed.

Needs pip install -e ".[fetch,minari]" "minari[hf]" and `minari download D4RL/door/human-v2`. Half an hour on one core.
"""

import dataclasses

import gymnasium as gym
import gymnasium_robotics
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_actpc import ActPC
from sb3_actpc.demonstrations import Demonstrations

gym.register_envs(gymnasium_robotics)
ENV_ID, N_EPISODES = "AdroitHandDoorSparse-v1", 50
OPEN = 1.35  # angle of the hinge, in rad


def success(model: ActPC) -> float:
    """Share of the evaluation episodes that end with an open door."""
    env = DummyVecEnv([lambda: gym.make(ENV_ID)])
    env.seed(2_000_000)
    n = 0
    for _ in range(N_EPISODES):
        observations, dones = env.reset(), [False]
        while not dones[0]:
            observations, _, dones, infos = env.step(model.predict(observations, deterministic=True)[0])
        n += infos[0]["success"]
    return n / N_EPISODES


human = Demonstrations.from_minari("D4RL/door/human-v2")
# The recorded rewards are dense. With the task's own, ActPC imitates an episode by how long its door is open
is_open = human.next_observations[:, 28] >= OPEN
demonstrations = dataclasses.replace(
    human, env_id=ENV_ID, actions=human.actions.clip(-1.0, 1.0), rewards=np.where(is_open, 10.0, -0.1)
)
demonstrations.save("door.npz")  # sb3-actpc train --env gymnasium_robotics:AdroitHandDoorSparse-v1 --demonstrations door.npz
print(demonstrations)

# Up to 30,000 steps critic_weight=0.0, action_noise=0.03 is better: the policy then imitates its own successes alone
model = ActPC("MlpPolicy", ENV_ID, demonstrations=demonstrations, seed=0)
for steps in (1, 50_000):
    model.learn(steps, reset_num_timesteps=False)
    print(f"success after {model.num_timesteps} steps: {success(model):.2f}")
