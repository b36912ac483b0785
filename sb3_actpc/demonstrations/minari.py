"""Reading of Minari, the Farama Foundation's format of offline data sets."""

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_actpc.demonstrations.rows import box_paths, field_error, join_observations
from sb3_actpc.utils.extras import import_extra


def minari_episodes(dataset: Any, observation_space: spaces.Space[Any] | None, source: str) -> list[dict[str, Any]]:
    """The columns of each episode of a ``minari.MinariDataset``; see ``Demonstrations.from_minari``."""
    if not isinstance(dataset.action_space, spaces.Box):
        raise field_error(source, "actions", "a Box action space", repr(dataset.action_space))
    paths = box_paths(dataset.observation_space if observation_space is None else observation_space)
    return [_columns(episode, paths, f"{source}: episode {episode.id}") for episode in dataset.iterate_episodes()]


def minari_files(dataset_id: str) -> list[Path]:
    """The files that hold a Minari dataset. ImportError when Minari is not installed, FileNotFoundError, which says how to
    fetch it, when there is no such dataset."""
    import_extra("minari", "minari")
    from minari.storage import get_dataset_path

    files = sorted(path for path in (get_dataset_path(dataset_id) / "data").rglob("*") if path.is_file())
    if not files:
        raise FileNotFoundError(
            f"no Minari dataset {dataset_id!r} on this machine: fetch it with `minari download {dataset_id}`"
        )
    return files


def _columns(episode: Any, paths: list[list[str]], source: str) -> dict[str, Any]:
    """One Minari episode (n + 1 observations for n steps) as columns."""
    columns = {
        "observations": join_observations(episode.observations, paths, source),
        "actions": episode.actions,
        "rewards": episode.rewards,
        "terminations": episode.terminations,
    }
    dense_rewards = (episode.infos or {}).get("dense_reward")
    if dense_rewards is not None:  # one more when the reset's info was recorded
        columns["dense_rewards"] = np.asarray(dense_rewards)[-len(episode.rewards) :]
    return columns
