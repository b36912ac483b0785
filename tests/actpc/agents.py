"""Small agents."""

import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_actpc import ActPC
from tests.actpc.envs import CountingEnv

SMALL = {
    "policy_kwargs": {"net_arch": [16, 16]},
    "settling": "scheduled",
    "learning_starts": 10,
    "batch_size": 16,
    "seed": 0,
    "device": "cpu",
}


def make(env=None, n_envs=1, **keywords) -> ActPC:
    env = env or DummyVecEnv([CountingEnv for _ in range(n_envs)])
    return ActPC("MlpPolicy", env, **{**SMALL, "prior_updates": 5, **keywords})


def weights_of(circuit) -> list[th.Tensor]:
    return [p.clone() for p in circuit.parameters()]


def differ(one, other) -> bool:
    return any(not th.equal(a, b) for a, b in zip(one, other, strict=True))
