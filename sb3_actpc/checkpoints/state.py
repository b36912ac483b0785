"""What a checkpoint holds of an SB3 algorithm, and how it is put back."""

import inspect
import json
import os
import random
import warnings
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
import safetensors.numpy
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import CSVOutputFormat
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.checkpoints.bundle import Bundle, Report, Write, find_bundle
from sb3_actpc.checkpoints.encoding import Decoder, Encoder
from sb3_actpc.utils.extras import installed_version
from sb3_actpc.utils.noise import noise_with_state
from sb3_actpc.utils.tasks import task_id
from sb3_actpc.utils.weights import check_weights

STATE = "state.json"
ARRAYS = "arrays.safetensors"
_COUNTERS = (
    *("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_n_updates", "_n_calls", "_episode_num"),
    *("_current_progress_remaining", "exploration_rate", "_last_obs", "_last_original_obs", "_last_episode_starts"),
    *("ep_info_buffer", "ep_success_buffer"),
)
_BUFFER_CURSORS = ("pos", "full", "_current_ep_start")
_NOISE_MATRICES = ("exploration_mat", "exploration_matrices")  # of SB3's state-dependent exploration
# of attributes of callbacks, and of logged values
_KEPT = (bool, int, float, str, NoneType, list, tuple, dict, set, deque, np.ndarray, np.generic, th.Tensor, VecEnv)
_LOGGER_VALUES = ("name_to_value", "name_to_count", "name_to_excluded")
_RECORDED_PACKAGES = ("sb3-actpc", "stable-baselines3", "torch", "gymnasium", "mujoco", "numpy", "safetensors")


@dataclass
class Restored:
    """An agent that a checkpoint was put back into, and what can only be put back once ``learn`` has begun: the
    checkpoint's plain values, what decodes them, and whether the episodes that had begun start again."""

    model: BaseAlgorithm
    state: dict[str, Any]
    decoder: Decoder
    starts_again: bool = False

    def put_back(self, callbacks: Sequence[BaseCallback]) -> None:
        """Put back what the beginning of ``learn`` has changed or made: callbacks, logger, action noise, generators. Callbacks
        with ``cut_running_episodes`` are told where episodes start again."""
        model = self.model
        decoder = self.decoder
        for name, callback in _named(callbacks).items():
            kept = self.state["callbacks"].get(name)
            if kept is None:
                continue
            if hasattr(callback, "restore_checkpoint_state"):
                callback.restore_checkpoint_state({key: decoder.decode(node) for key, node in kept.items()})
            else:
                decoder.decode_into(callback, kept)
            if self.starts_again and hasattr(callback, "cut_running_episodes"):
                callback.cut_running_episodes()
        _restore_logger(model, decoder.decode(self.state["logger"]))
        if self.state["noise"] is not None:
            decoder.decode(self.state["noise"], model.action_noise)
        for name, value in decoder.decode(self.state["matrices"]).items():
            if value is not None:
                setattr(_action_dist(model), name, value.to(model.device))
        decoder.decode(self.state["spaces"], [model.action_space, model.observation_space])
        generators = decoder.decode(self.state["generators"])
        random.setstate(generators["python"])
        np.random.set_state(generators["numpy"])
        th.set_rng_state(generators["torch"])
        if generators["cuda"] is not None and model.device.type == "cuda":
            th.cuda.set_rng_state(generators["cuda"], model.device)


def capture_model(model: BaseAlgorithm, callbacks: Sequence[BaseCallback], write: Write) -> None:
    """Write everything that the rest of the training depends on, between two rollouts; ValueError when a weight is not finite,
    or the agent holds what cannot be stored."""
    check_weights(model)
    encoder = Encoder()
    buffer = getattr(model, "replay_buffer", None)
    dicts, variables = model._get_torch_save_params()
    values = {
        "counters": {name: vars(model)[name] for name in _COUNTERS if name in vars(model)},
        "dicts": {name: dict(recursive_getattr(model, name).state_dict()) for name in dicts},
        "variables": {name: recursive_getattr(model, name) for name in variables},
        "matrices": {name: getattr(_action_dist(model), name, None) for name in _NOISE_MATRICES},
        "generators": {
            "python": random.getstate(),
            "numpy": np.random.get_state(legacy=False),
            "torch": th.get_rng_state(),
            "cuda": th.cuda.get_rng_state(model.device) if model.device.type == "cuda" else None,
        },
        "spaces": [model.action_space, model.observation_space],
        "noise": noise_with_state(getattr(model, "action_noise", None)),
        "own": model.checkpoint_state() if hasattr(model, "checkpoint_state") else None,
        "buffer": None if buffer is None else _buffer_state(buffer, write),
    }
    state = encoder.encode_each(values)
    if encoder.lost:
        raise ValueError(f"the agent holds what no checkpoint can: {'; '.join(encoder.lost)}")
    state |= {
        "env": encoder.encode(model.env),
        "callbacks": {name: encoder.encode_each(_callback_state(one)) for name, one in _named(callbacks).items()},
        "logger": encoder.encode(_logger_state(model)),
    }
    arrays = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in encoder.arrays.items()}
    write(ARRAYS, safetensors.numpy.save(arrays))
    write(STATE, json.dumps({**state, "nodes": encoder.nodes}).encode())


def describe_model(model: BaseAlgorithm) -> dict[str, Any]:
    """Plain values by which a checkpoint of another agent or task is recognised, and the versions."""
    buffer = getattr(model, "replay_buffer", None)
    arrays = {**model.policy.state_dict(), **({} if buffer is None else buffer_arrays(buffer))}
    assert model.env is not None
    return {
        "agent": {
            "algorithm": type(model).__name__,
            "env": task_id(model.env),
            "n_envs": model.n_envs,
            "observation_space": str(model.observation_space),
            "action_space": str(model.action_space),
            **{f"shape of {name}": f"{array.dtype} {tuple(array.shape)}" for name, array in arrays.items()},
        },
        "versions": {name: installed_version(name) for name in _RECORDED_PACKAGES},
    }


def restore(model: BaseAlgorithm, path: str | os.PathLike[str] | Bundle, report: Report = warnings.warn) -> Restored:
    """
    Put a checkpoint back into an agent made with the settings of the stopped run; ``continue_learning`` goes on with it.

    :param model: the agent, with an environment made as the stopped run's
    :param path: a checkpoint, or the folder of several: the newest whole one is taken
    :param report: given a line for each damaged checkpoint, and when episodes must start again
    :return: the agent (``model``), and what :meth:`Restored.put_back` puts back when it learns
    :raises FileNotFoundError: when there is no checkpoint
    :raises ValueError: when it is damaged, was written in another version of the format, or is of another algorithm, task,
        network or buffer; nothing is changed then
    """
    bundle = path if isinstance(path, Bundle) else find_bundle(path, report)
    mine = describe_model(model)["agent"]
    stored = bundle.manifest["agent"]
    for name in {**mine, **stored}:
        if stored.get(name) != mine.get(name):
            raise ValueError(
                f"{bundle.path} is a checkpoint with {name}={stored.get(name)!r}, the agent has {name}={mine.get(name)!r}: "
                "resume with the settings and the task of the stopped run"
            )
    state = json.loads((bundle.path / STATE).read_bytes())
    arrays = safetensors.numpy.load_file(bundle.path / ARRAYS)
    decoder = Decoder(state["nodes"], arrays)
    decoder.decode(state["env"], model.env)
    lost = list(decoder.lost)
    for name, values in decoder.decode(state["dicts"]).items():
        recursive_getattr(model, name).load_state_dict(values)
    for name, value in decoder.decode(state["variables"]).items():
        recursive_getattr(model, name).data = value.to(model.device)
    buffer = decoder.decode(state["buffer"])
    if buffer is not None:
        _restore_buffer(getattr(model, "replay_buffer", None), buffer, bundle)
    vars(model).update(decoder.decode(state["counters"]))
    own = decoder.decode(state["own"])
    if own is not None:
        model.restore_checkpoint_state(own)  # type: ignore[attr-defined]
    if lost:
        report(f"environments cannot be restored within their episodes, all episodes start again: {'; '.join(lost)}")
        _start_episodes_again(model)
    return Restored(model, state, Decoder(state["nodes"], arrays), bool(lost))


def _named(callbacks: Sequence[BaseCallback]) -> dict[str, BaseCallback]:
    """Each callback by its class's name and its number among those of that class."""
    kinds = [type(callback).__qualname__ for callback in callbacks]
    return {f"{kind}{1 + kinds[:index].count(kind)}": callbacks[index] for index, kind in enumerate(kinds)}


def _action_dist(model: BaseAlgorithm) -> Any:
    """What draws state-dependent exploration; None without it."""
    return getattr(getattr(model, "actor", model.policy), "action_dist", None) if model.use_sde else None


def buffer_arrays(buffer: ReplayBuffer) -> dict[str, np.ndarray]:
    """A replay buffer's arrays with a row per step, (buffer_size, n_envs, ...), by name; dictionaries' as ``name.key``."""
    parts = {name: value for name, value in vars(buffer).items() if name not in _BUFFER_CURSORS}
    for name, value in vars(buffer).items():
        parts |= {f"{name}.{key}": part for key, part in value.items()} if isinstance(value, dict) else {}
    arrays = {name: part for name, part in parts.items() if isinstance(part, np.ndarray) and part.dtype != object}
    return {name: array for name, array in arrays.items() if array.shape[:2] == (buffer.buffer_size, buffer.n_envs)}


def _buffer_state(buffer: ReplayBuffer, write: Write) -> dict[str, Any]:
    # with ``optimize_memory_usage`` the row after the last holds an observation
    rows = buffer.buffer_size if buffer.full else min(buffer.pos + 1, buffer.buffer_size)
    for index, array in enumerate(buffer_arrays(buffer).values()):
        write(f"buffer_{index:02d}.npy", array[:rows])
    infos = buffer.infos[:rows].tolist() if isinstance(buffer, HerReplayBuffer) and buffer.copy_info_dict else []
    cursors = {name: vars(buffer)[name] for name in _BUFFER_CURSORS if name in vars(buffer)}
    own = buffer.checkpoint_state() if hasattr(buffer, "checkpoint_state") else None
    return {"rows": rows, "cursors": cursors, "own": own, "infos": infos}


def _restore_buffer(buffer: Any, state: dict[str, Any], bundle: Bundle) -> None:
    for index, array in enumerate(buffer_arrays(buffer).values()):
        array[: state["rows"]] = np.load(bundle.path / f"buffer_{index:02d}.npy", mmap_mode="r", allow_pickle=False)
    vars(buffer).update(state["cursors"])
    if state["own"] is not None:
        buffer.restore_checkpoint_state(state["own"])
    for row, entries in enumerate(state["infos"]):
        buffer.infos[row] = entries


def _start_episodes_again(model: BaseAlgorithm) -> None:
    """``learn`` resets the environments when there is no last observation."""
    assert model.env is not None
    if model.seed is not None and not isinstance(model.env.unwrapped, DummyVecEnv):
        model.env.seed((model.seed + model.num_timesteps) % 2**31)  # their generators are out of reach
    buffer: Any = getattr(model, "replay_buffer", None)
    if hasattr(buffer, "cut_running_episodes"):
        buffer.cut_running_episodes()
    elif isinstance(buffer, HerReplayBuffer):
        buffer.truncate_last_trajectory()
    model._last_obs = None


def _callback_state(callback: Any) -> dict[str, Any]:
    """What it says itself, or its attributes but arguments of its constructor, bars, figures and open files: of these the new
    callback has its own."""
    if hasattr(callback, "checkpoint_state"):
        return dict(callback.checkpoint_state())
    left_out = {*inspect.signature(type(callback).__init__).parameters, "locals", "globals"}
    held = {name: value for name, value in vars(callback).items() if name not in left_out or isinstance(value, VecEnv)}
    return {name: value for name, value in held.items() if isinstance(value, _KEPT)}


def _csv_formats(model: BaseAlgorithm) -> list[CSVOutputFormat]:
    return [output for output in model.logger.output_formats if isinstance(output, CSVOutputFormat)]


def _logger_state(model: BaseAlgorithm) -> dict[str, Any] | None:
    if not hasattr(model, "_logger"):
        return None
    texts = []
    for output in _csv_formats(model):
        output.file.flush()
        texts.append(Path(output.file.name).read_text(encoding="utf-8"))
    values = {name: getattr(model.logger, name) for name in _LOGGER_VALUES}
    # figures and videos belong to the next dump only
    return {**{name: {k: v for k, v in one.items() if isinstance(v, _KEPT)} for name, one in values.items()}, "csv": texts}


def _restore_logger(model: BaseAlgorithm, state: dict[str, Any] | None) -> None:
    if state is None:
        return
    for name in _LOGGER_VALUES:
        target = getattr(model.logger, name)
        target.clear()
        target.update(state[name])
    for output, text in zip(_csv_formats(model), state["csv"], strict=False):
        output.file.seek(0)
        output.file.truncate()
        output.file.write(text)
        output.file.flush()
        output.keys = list(filter(None, text.partition("\n")[0].split(",")))
