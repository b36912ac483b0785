"""Demonstrations of the robosuite tasks that need no simulator, and robomimic's files of them."""

import json
from pathlib import Path

import h5py
import numpy as np

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.envs import ROBOSUITE_IDS
from sb3_actpc.envs.robosuite_layouts import OBSERVATIONS, ROBOSUITE_TASKS


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
    )


def unit(quats: np.ndarray) -> np.ndarray:
    """Quaternions, (N, 4), scaled to a norm of 1."""
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def write_robomimic(shown: Demonstrations, path: Path) -> None:
    """What robomimic 0.5 writes (docs/datasets/overview), with three masks."""
    task = ROBOSUITE_TASKS[shown.env_id]
    [layout] = [task.layout(obs) for obs in OBSERVATIONS if task.obs_dim(obs) == shown.observations.shape[1]]
    controller = {"type": "BASIC", "body_parts": {"right": {"type": "OSC_POSE", "input_type": "delta"}}}
    keywords = {"robots": ["Panda"], "controller_configs": controller, "control_freq": 20}
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": task.name, "type": 1, "env_kwargs": keywords})
        for index, episode in enumerate(shown.episodes):
            demo = data.create_group(f"demo_{index}")
            demo["actions"] = episode["actions"]
            demo["rewards"] = episode["rewards"]
            demo["dones"] = episode["terminations"].astype(np.int64)
            for part, columns in layout.items():
                demo[f"obs/{part}"] = episode["observations"][:, columns]
                demo[f"next_obs/{part}"] = episode["next_observations"][:, columns]
        for key, names in (("better", ["demo_0", "demo_2"]), ("worse", ["demo_1"]), ("20_percent", ["demo_2"])):
            file[f"mask/{key}"] = np.array(names, dtype="S")
