"""Exchange with Minari, the Farama Foundation's format of offline data sets; episodes as arrays, in and out."""

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_actpc.demonstrations.rows import box_paths, field_error, join_observations, split_observations, transition_columns
from sb3_actpc.utils.extras import import_extra


def read_minari(
    dataset: Any, env_id: str | None = None, observation_space: spaces.Space[Any] | None = None
) -> tuple[list[dict[str, np.ndarray]], dict[str, Any]]:
    """
    :return: the columns of each episode, and the further arguments of ``Demonstrations.from_episodes``; for the parameters and
        the errors see ``Demonstrations.from_minari``
    """
    if isinstance(dataset, str):
        minari_files(dataset)
        dataset = import_extra("minari", "minari").load_dataset(dataset)
    source = f"Minari dataset {dataset.spec.dataset_id}"
    metadata = dataset.storage.metadata
    paths = metadata.get("observation_keys", box_paths(dataset.observation_space))
    if observation_space is not None:
        paths = box_paths(observation_space)
    if not isinstance(dataset.action_space, spaces.Box):
        raise field_error(source, "actions", "a Box action space", repr(dataset.action_space))
    episodes = []
    for episode in dataset.iterate_episodes():
        where = f"{source}: episode {episode.id}"
        _check_stored(episode.observations, dataset.observation_space, "observations", where)
        _check_stored(episode.actions, dataset.action_space, "actions", where)
        episodes.append(_columns(episode, paths, source))
    if not episodes:
        raise field_error(source, "observations", "at least one episode", "none")
    n_dense = sum("dense_rewards" in episode for episode in episodes)
    if n_dense not in (0, len(episodes)):
        found = f"it in {n_dense} of {len(episodes)}"
        raise field_error(source, "dense_rewards", "infos['dense_reward'] in every episode or none", found)
    recorded_id = dataset.env_spec.id if dataset.env_spec is not None else metadata.get("env_id", "")
    return episodes, {
        "env_id": env_id or recorded_id,
        "metadata": metadata.get("demonstrations_metadata", {}),
        "source": source,
    }


def write_minari(
    dataset_id: str,
    episodes: Sequence[dict[str, Any]],
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    env: gym.Env[Any, Any] | None,
    metadata: dict[str, Any],
    options: dict[str, Any],
) -> Any:
    """The ``minari.MinariDataset`` of the columns of each episode, with further metadata; for the rest see
    ``Demonstrations.to_minari``."""
    minari = import_extra("minari", "minari")
    images = list(filter(import_module("minari.dataset.minari_storage").is_image_space, _boxes(observation_space)))
    if images:
        raise ValueError(f"Minari stores images such as {images[0]} as JPEG, which changes them: keep them with save(path)")
    dataset = minari.create_dataset_from_buffers(
        dataset_id,
        [episode_buffer(episode, observation_space, action_space) for episode in episodes],
        env=env if _has_json_spec(env) else None,
        observation_space=observation_space,
        action_space=action_space,
        **options,
    )
    dataset.storage.update_metadata({**metadata, "observation_keys": box_paths(observation_space)})
    return dataset


def _boxes(space: spaces.Space[Any]) -> list[spaces.Box]:
    """The Boxes in a space of such."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.values() if isinstance(space, spaces.Dict) else space
        return [box for part in parts for box in _boxes(part)]
    return [space] if isinstance(space, spaces.Box) else []


def episode_buffer(episode: dict[str, Any], observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> Any:
    """The columns of one episode of n steps as a ``minari.data_collector.EpisodeBuffer`` with n + 1 observations."""
    from minari.data_collector import EpisodeBuffer

    observations = np.concatenate([episode["observations"], episode["next_observations"][-1:]])
    terminations = episode["terminations"]
    truncations = np.zeros(len(terminations), dtype=bool)
    truncations[-1] = not terminations[-1]
    dense_rewards = episode.get("dense_rewards")
    if dense_rewards is not None:  # Minari records infos at the reset too
        dense_rewards = {"dense_reward": np.concatenate([np.zeros(1, dtype=np.float32), dense_rewards])}
    return EpisodeBuffer(
        observations=split_observations(observation_space, observations),
        actions=split_observations(action_space, episode["actions"]),
        rewards=episode["rewards"],
        terminations=terminations,
        truncations=truncations,
        infos=dense_rewards,
    )


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


def _has_json_spec(env: gym.Env[Any, Any] | None) -> bool:
    """Whether Minari can record how the environment is made; it cannot for entry points that are not text."""
    try:
        return env is not None and env.spec is not None and bool(env.spec.to_json())
    except (TypeError, ValueError):
        return False


def _check_stored(stored: Any, space: spaces.Space[Any], name: str, where: str) -> None:
    """ValueError when the stored rows of a space have another shape than its elements. Minari writes uint8 vectors and
    matrices as JPEG, and gives back the compressed bytes unless it takes the space for an image."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.items() if isinstance(space, spaces.Dict) else enumerate(space)
        for key, part in parts:
            _check_stored(stored[key], part, f"{name}/{key}", where)
        return
    shapes = {np.shape(row) for row in stored}
    if not isinstance(space, spaces.Box) or shapes == {space.shape}:
        return
    found = f"shape {', '.join(map(str, sorted(shapes)))}"
    if space.dtype == np.uint8:
        found += ": Minari has stored them as JPEG, which changes them; record them again as float32"
    raise field_error(where, name, f"rows of shape {space.shape}, as the dataset's own {space}", found)


def _columns(episode: Any, paths: list[list[str]], source: str) -> dict[str, np.ndarray]:
    """One Minari episode (n + 1 observations for n steps) as columns."""
    rows = join_observations(episode.observations, paths, source)
    columns = transition_columns(rows, episode.actions, f"{source}: episode {episode.id}")
    columns |= {"rewards": np.asarray(episode.rewards), "terminations": np.asarray(episode.terminations)}
    dense_rewards = (episode.infos or {}).get("dense_reward")
    if dense_rewards is not None:  # one more when the reset's info was recorded
        columns["dense_rewards"] = np.asarray(dense_rewards)[-len(episode.rewards) :]
    return columns
