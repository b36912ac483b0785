"""Compares outputs of the actor in behavior cloning, trained by local changes and by backprop.

    python benchmarks/actor_output.py SparseWalker2d-v5
    python benchmarks/actor_output.py SparseHalfCheetah-v5 --file demonstrations.npz --seeds 21 22 23

Each network has two hidden layers of 256 units and gets 3,000 updates with batches of 256 steps, drawn uniformly. Local ones
have a weight decay of 0.1, as ActPC's. Prints for each the error on the demonstrations as a share of the variance of the
actions, and the mean return of ten episodes from the same start states, seed by seed.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th
from torch import nn

import sb3_actpc  # noqa: F401  registers the sparse tasks
from sb3_actpc.demonstrations import Demonstrations, shipped_demonstrations
from sb3_actpc.guidance.behavior_cloning import LEARNING_RATES
from sb3_actpc.ngc import NGCCircuit

UPDATES, BATCH_SIZE, EPISODES, HIDDEN = 3000, 256, 10, 256
NETWORKS = ["local tanh", "local clamp", "backprop tanh", "backprop linear"]
Policy = Callable[[th.Tensor], th.Tensor]


def learning_rate(update: int) -> float:
    """As ActPC's BC: falling geometrically."""
    first, last = LEARNING_RATES
    return first * (last / first) ** (update / UPDATES)


def clone_locally(x: th.Tensor, y: th.Tensor, output: str) -> Policy:
    """ActPC's actor: a sweep with learned error synapses."""
    learned = {"feedback": "learned", "feedback_start": "mirrored", "weight_decay": 0.1}
    hidden = [HIDDEN, HIDDEN]
    circuit = NGCCircuit(x.shape[1], y.shape[1], hidden, settling="scheduled", output_activation=output, **learned)
    circuit.optimizer = th.optim.Adam(circuit.parameter_groups(LEARNING_RATES[0]), fused=True)
    for update in range(UPDATES):
        for group in circuit.optimizer.param_groups:
            group["lr"] = learning_rate(update)
        rows = th.as_tensor(np.random.randint(len(x), size=BATCH_SIZE))
        circuit.apply_changes(circuit.hebbian_update(circuit.settle(x[rows], y[rows])))
    return circuit.project


def clone_by_backprop(x: th.Tensor, y: th.Tensor, output: str) -> Policy:
    """A network of the same size; its linear output is cut to [-1, 1] when it acts."""
    last = [nn.Tanh()] if output == "tanh" else []
    layers = [nn.Linear(x.shape[1], HIDDEN), nn.ReLU6(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU6(), nn.Linear(HIDDEN, y.shape[1])]
    network = nn.Sequential(*layers, *last)
    optimizer = th.optim.Adam(network.parameters(), lr=LEARNING_RATES[0])
    for update in range(UPDATES):
        optimizer.param_groups[0]["lr"] = learning_rate(update)
        rows = th.as_tensor(np.random.randint(len(x), size=BATCH_SIZE))
        loss = (network(x[rows]) - y[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return network.requires_grad_(False)


def play(env: gym.Env, policy: Policy, normalized: Policy) -> float:
    """Mean return of ``EPISODES`` episodes of a policy that acts in [-1, 1]."""
    low, high = env.action_space.low, env.action_space.high
    returns = []
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=1000 + episode)
        total, ends = 0.0, False
        while not ends:
            action = policy(normalized(th.as_tensor(observation, dtype=th.float32)[None])).clamp(-1, 1)[0].numpy()
            observation, reward, terminated, truncated, _ = env.step(low + (action + 1) / 2 * (high - low))
            total, ends = total + float(reward), terminated or truncated
        returns.append(total)
    return float(np.mean(returns))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env", help="Gymnasium id")
    parser.add_argument("--file", type=Path, help="demonstrations (default: the shipped ones)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[21, 22, 23])
    parser.add_argument("--only", nargs="+", choices=NETWORKS, default=NETWORKS)
    given = parser.parse_args()
    shown = Demonstrations.load(given.file or shipped_demonstrations(given.env))
    env = gym.make(given.env)
    x = th.as_tensor(shown.observations, dtype=th.float32)
    mean, std = x.mean(0), x.std(0).clamp_min(1e-6)
    low, high = env.action_space.low, env.action_space.high
    y = th.as_tensor(2 * (shown.actions - low) / (high - low) - 1, dtype=th.float32).clamp(-1, 1)

    def normalized(rows: th.Tensor) -> th.Tensor:
        return (rows - mean) / std

    print(f"{shown}, {float((y.abs() > 0.99).float().mean()):.0%} of the actions at a bound")
    for name in given.only:
        kind, output = name.split()
        errors, returns = [], []
        for seed in given.seeds:
            th.manual_seed(seed)
            np.random.seed(seed)
            policy = (clone_locally if kind == "local" else clone_by_backprop)(normalized(x), y, output)
            error = (policy(normalized(x)).clamp(-1, 1) - y).square().mean() / y.var(0, unbiased=False).mean()
            errors.append(float(error))
            returns.append(play(env, policy, normalized))
        print(
            f"{name:16} error {np.mean(errors):.4f}  return {np.mean(returns):4.0f}:",
            *(f"{one:.0f}" for one in returns),
            flush=True,
        )


if __name__ == "__main__":
    main()
