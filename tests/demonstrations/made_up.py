"""Demonstrations of the robosuite tasks that need neither the simulator nor a file."""

import numpy as np

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.envs import ROBOSUITE_IDS
from sb3_actpc.envs.robosuite_layouts import ROBOSUITE_TASKS


def made_up(env_id: str, lengths: tuple[int, ...] = (4, 3, 5), obs: str = "paper", seed: int = 0) -> Demonstrations:
    """Episodes of a robot that nobody simulated, the last step of each a success."""
    task, rng = ROBOSUITE_TASKS[env_id], np.random.default_rng(seed)
    layout, blocks = task.layout(obs), []
    for length in lengths:
        rows = rng.normal(size=(length + 1, task.obs_dim(obs)))
        eef = rng.uniform([-0.1, -0.1, 1.0], [0.1, 0.1, 1.1], (length + 1, 3))
        positions = np.tile([0.02, 0.01, 0.82], (length + 1, 1))
        positions[-1] = [0.02, 0.01, 0.9] if env_id == ROBOSUITE_IDS[0] else [0.2, 0.4, 0.86]
        quats, eef_quats = (unit(rng.normal(size=(length + 1, 4))) for _ in range(2))
        rows[:, layout["robot0_eef_pos"]], rows[:, layout["robot0_eef_quat"]] = eef, eef_quats
        rows[:, layout["object"]] = task.object_states(positions, quats, eef, eef_quats)
        blocks.append(rows.astype(np.float32))
    n = sum(lengths)
    ends = np.cumsum(lengths) - 1
    rewards = np.zeros(n, np.float32)
    rewards[ends] = 1.0
    return Demonstrations(
        observations=np.concatenate([block[:-1] for block in blocks]),
        actions=rng.uniform(-1.0, 1.0, (n, 7)).astype(np.float32),
        next_observations=np.concatenate([block[1:] for block in blocks]),
        rewards=rewards,
        terminations=rewards > 0,
        episode_starts=np.array([0, *(ends[:-1] + 1)]),
        env_id=env_id,
        metadata={"filter_keys": [["better"], ["worse"], ["better", "20_percent"]]},
    )


def unit(quats: np.ndarray) -> np.ndarray:
    """:param quats: (N, 4)
    :return: the same, each of norm 1"""
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
