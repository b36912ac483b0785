"""Small agents."""

from typing import Any

import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_actpc import ActPC
from tests.actpc.envs import CountingEnv, demonstrations

SMALL = {
    "policy_kwargs": {"net_arch": [16, 16]},
    "settling": "scheduled",
    "learning_starts": 10,
    "batch_size": 16,
    "seed": 0,
    "device": "cpu",
}
# one critic and tied error synapses, which do not decay; nothing is normalized
PLAIN_POLICY = {
    "net_arch": [16, 16],
    "n_critics": 1,
    "circuit_kwargs": {"feedback": "tied", "weight_decay": 0.0, "normalization": "none", "activation": "relu6"},
}
# Algorithm 1 and nothing else: what a test of one mechanism starts from, so that no other one can be the reason
PLAIN: dict[str, Any] = {
    **SMALL,
    "policy_kwargs": PLAIN_POLICY,
    "tau": 0.005,
    "n_steps": 1,
    "guidance": "none",
    "policy_delay": 1,
    "gradient_steps": 1,
    "demonstration_fraction": 0.0,
    "observation_normalization": "none",
    "action_noise": 0.0,
    "target_policy_noise": 0.0,
    "critic_weight": 2.5,
    "reward_weights": {"epistemic": 1.0, "instrumental": 1.0},
    "signal_kwargs": {"normalizer": "max", "normalization": "stored"},
}
# the constructor's defaults, but for sizes: BC and a critic warm-up of no time
QUICK: dict[str, Any] = {**SMALL, "learning_starts": None, "guidance_kwargs": {"bc_updates": 5, "critic_warmup": 5}}


def plain(**keywords: Any) -> dict[str, Any]:
    """``PLAIN`` with other values; of dictionaries (but ``signal_kwargs``) one by one."""
    policy = {**PLAIN_POLICY, **keywords.pop("policy_kwargs", {})}
    policy["circuit_kwargs"] = {**PLAIN_POLICY["circuit_kwargs"], **policy["circuit_kwargs"]}  # type: ignore[dict-item]
    weights = {**PLAIN["reward_weights"], **keywords.pop("reward_weights", {})}
    signals = {"prior_updates": 5, **keywords.pop("signal_kwargs", PLAIN["signal_kwargs"])}
    return {**PLAIN, **keywords, "reward_weights": weights, "signal_kwargs": signals, "policy_kwargs": policy}


def imitating(env=CountingEnv, policy_kwargs=None, **keywords):
    """The constructor's defaults but for sizes: with demonstrations there is guidance."""
    env = env if isinstance(env, VecEnv) else DummyVecEnv([env])
    policy_kwargs = {"net_arch": [16, 16], **(policy_kwargs or {})}
    keywords = {"demonstrations": demonstrations(), **QUICK, **keywords, "policy_kwargs": policy_kwargs}
    return ActPC("MlpPolicy", env, **keywords)


def make(env=None, n_envs=1, **keywords) -> ActPC:
    env = env or DummyVecEnv([CountingEnv for _ in range(n_envs)])
    return ActPC("MlpPolicy", env, **plain(**keywords))


def weights_of(circuit) -> list[th.Tensor]:
    """All but the error synapses, which a target circuit has not."""
    return [p.clone() for name, p in circuit.named_parameters() if "feedback_weights" not in name]


def differ(one, other) -> bool:
    return any(not th.equal(a, b) for a, b in zip(one, other, strict=True))
