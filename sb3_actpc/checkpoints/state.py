"""What a checkpoint holds of an SB3 algorithm, and how it is put back."""

import inspect
import json
import random
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import CSVOutputFormat, TensorBoardOutputFormat, configure
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.checkpoints.bundle import Bundle, Report, Write
from sb3_actpc.checkpoints.encoding import Decoder, Encoder
from sb3_actpc.checkpoints.simulators import capture_vec_env, env_name, restore_vec_env, set_attributes, vec_env_layers
from sb3_actpc.utils.extras import installed_version
from sb3_actpc.utils.weights import check_weights

STATE, ARRAYS = "state.json", "arrays.safetensors"
_COUNTERS = (
    *("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_n_updates", "_n_calls", "_episode_num"),
    *("_current_progress_remaining", "exploration_rate", "_last_obs", "_last_original_obs", "_last_episode_starts"),
    *("ep_info_buffer", "ep_success_buffer"),
)
_BUFFER_CURSORS = ("pos", "full", "_current_ep_start")
_NOISE_MATRICES = ("exploration_mat", "exploration_matrices")  # of SB3's state-dependent exploration
_CALLBACK_SKIPPED = {"model", "locals", "globals", "parent", "callback", "callbacks", "logger"}
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


def capture_model(model: BaseAlgorithm, callbacks: Sequence[BaseCallback], write: Write) -> None:
    """Write everything that the rest of the training depends on, between two rollouts, or between two updates before the
    first; ValueError when a weight is not finite."""
    check_weights(model)
    encoder = Encoder()
    assert model.env is not None
    dicts, variables = model._get_torch_save_params()
    values = {
        "counters": {name: vars(model)[name] for name in _COUNTERS if name in vars(model)},
        "dicts": {name: dict(recursive_getattr(model, name).state_dict()) for name in dicts},
        "variables": {name: recursive_getattr(model, name) for name in variables},
        "matrices": {name: getattr(_action_dist(model), name, None) for name in _NOISE_MATRICES},
        "generators": _generators(model),
        "spaces": [model.action_space, model.observation_space],
        "noise": getattr(model, "action_noise", None),
        "own": _own_state(model),
    }
    state = {
        "env": capture_vec_env(model.env, encoder, "env"),
        **{name: encoder.encode(value, name) for name, value in values.items()},
        "buffer": _capture_buffer(model, encoder, write),
        "callbacks": {name: _capture_callback(one, encoder, name) for name, one in _named(callbacks).items()},
        "logger": _capture_logger(model, encoder),
    }
    arrays = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in encoder.arrays.items()}
    write(ARRAYS, safetensors.numpy.save(arrays))
    write(STATE, json.dumps({**state, "nodes": encoder.nodes}).encode())


def describe_model(model: BaseAlgorithm) -> dict[str, Any]:
    """Plain values by which a checkpoint of another agent or task is recognised, and the versions."""
    buffer = replay_buffer(model)
    arrays = {} if buffer is None else buffer_arrays(buffer)
    assert model.env is not None
    return {
        "agent": {
            "algorithm": type(model).__name__,
            "env": env_name(model.env),
            "n_envs": model.n_envs,
            "observation_space": str(model.observation_space),
            "action_space": str(model.action_space),
            "replay_buffer": None if buffer is None else type(buffer).__name__,
            "buffer_size": None if buffer is None else buffer.buffer_size,
            **{f"replay buffer's {name}": f"{array.dtype} {array.shape}" for name, array in arrays.items()},
            **{f"shape of {name}": list(tensor.shape) for name, tensor in model.policy.state_dict().items()},
        },
        "versions": {name: installed_version(name) for name in _RECORDED_PACKAGES},
    }


def restore_model(model: BaseAlgorithm, bundle: Bundle, report: Report) -> Restored:
    """Put everything back into an agent that was made with the same settings, but for what :func:`restore_learning` puts back
    once ``learn(..., reset_num_timesteps=False)`` has begun. ValueError, and nothing is changed, when the checkpoint is of
    another algorithm, task, network or buffer."""
    assert model.env is not None
    _check_fit(describe_model(model)["agent"], bundle)
    state, arrays = json.loads(bundle.read_bytes(STATE)), safetensors.numpy.load(bundle.read_bytes(ARRAYS))
    decoder = Decoder(state["nodes"], arrays)
    lost = restore_vec_env(model.env, state["env"], decoder)
    for name, values in decoder.decode(state["dicts"]).items():
        recursive_getattr(model, name).load_state_dict(values)
    for name, value in decoder.decode(state["variables"]).items():
        recursive_getattr(model, name).data = value.to(model.device)
    _restore_buffer(model, state["buffer"], bundle, decoder)
    vars(model).update(decoder.decode(state["counters"]))
    _restore_own_state(model, decoder.decode(state["own"]))
    restored = Restored(model, state, Decoder(state["nodes"], arrays), bool(lost))
    _restore_noise(model, state["noise"], decoder)
    _restore_random(model, state, decoder)
    if lost:
        _start_episodes_again(model, lost, report)
    return restored


def restore_learning(restored: Restored, callbacks: Sequence[BaseCallback]) -> None:
    """Put back what the beginning of ``learn`` has changed or made: callbacks, logger, action noise, generators. Callbacks
    with ``cut_running_episodes`` are told where episodes start again."""
    model, state, decoder = restored.model, restored.state, restored.decoder
    for name, callback in _named(callbacks).items():
        if name in state["callbacks"]:
            _restore_callback(callback, state["callbacks"][name], decoder)
            if restored.starts_again and hasattr(callback, "cut_running_episodes"):
                callback.cut_running_episodes()
    if state["logger"] is not None:
        _restore_logger(model, state["logger"], decoder)
    _restore_noise(model, state["noise"], decoder)
    for name, value in decoder.decode(state["matrices"]).items():
        if value is not None:
            setattr(_action_dist(model), name, value.to(model.device))
    _restore_random(model, state, decoder)


def _check_fit(mine: dict[str, Any], bundle: Bundle) -> None:
    stored = bundle.manifest["agent"]
    for name in {**mine, **stored}:
        if stored.get(name) != mine.get(name):
            raise ValueError(
                f"{bundle.path} is a checkpoint with {name}={stored.get(name)!r}, the agent has {name}={mine.get(name)!r}: "
                "resume with the settings and the task of the stopped run"
            )


# ------------------------------------------------------------------ the agent


def _named(callbacks: Sequence[BaseCallback]) -> dict[str, BaseCallback]:
    """Each callback by its class's name and its number among those of that class."""
    kinds = [type(callback).__qualname__ for callback in callbacks]
    return {f"{kind}{1 + kinds[:index].count(kind)}": callbacks[index] for index, kind in enumerate(kinds)}


def _own_state(thing: Any) -> Any:
    """What an agent, a buffer or a callback keeps beside SB3's; None where it keeps nothing."""
    return thing.checkpoint_state() if hasattr(thing, "checkpoint_state") else None


def _restore_own_state(thing: Any, state: Any) -> None:
    if state is not None:
        thing.restore_checkpoint_state(state)


def _action_dist(model: BaseAlgorithm) -> Any:
    """What draws state-dependent exploration; None without it."""
    return getattr(getattr(model, "actor", model.policy), "action_dist", None) if model.use_sde else None


def _restore_noise(model: BaseAlgorithm, node: Any, decoder: Decoder) -> None:
    if node is None:
        return
    noise, kind = getattr(model, "action_noise", None), decoder.nodes[node[0]]["name"]
    if noise is None:
        raise ValueError(f"the checkpoint's agent has the action noise {kind}, this one none: pass action_noise=")
    if kind == VectorizedActionNoise.__name__ and not isinstance(noise, VectorizedActionNoise):
        noise = model.action_noise = VectorizedActionNoise(noise, model.n_envs)
    decoder.decode(node, noise)


def _generators(model: BaseAlgorithm) -> dict[str, Any]:
    states = {"python": random.getstate(), "numpy": np.random.get_state(legacy=False), "torch": th.get_rng_state()}
    if model.device.type == "cuda":
        states["cuda"] = th.cuda.get_rng_state(model.device)
    return states


def _restore_random(model: BaseAlgorithm, state: dict[str, Any], decoder: Decoder) -> None:
    decoder.decode(state["spaces"], [model.action_space, model.observation_space])
    states = decoder.decode(state["generators"])
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    th.set_rng_state(states["torch"])
    if "cuda" in states and model.device.type == "cuda":
        th.cuda.set_rng_state(states["cuda"], model.device)


# ------------------------------------------------------------------ the buffer


def replay_buffer(model: BaseAlgorithm) -> ReplayBuffer | None:
    """An algorithm that learns on policy has none: its rollouts begin empty."""
    return getattr(model, "replay_buffer", None)


def buffer_arrays(buffer: ReplayBuffer) -> dict[str, np.ndarray]:
    """A replay buffer's arrays with a row per step, (buffer_size, n_envs, ...), by name; dictionaries' as ``name.key``."""
    parts = {name: value for name, value in vars(buffer).items() if name not in _BUFFER_CURSORS}
    for name, value in vars(buffer).items():
        parts |= {f"{name}.{key}": part for key, part in value.items()} if isinstance(value, dict) else {}
    arrays = {name: part for name, part in parts.items() if isinstance(part, np.ndarray) and part.dtype != object}
    return {name: array for name, array in arrays.items() if array.shape[:1] == (buffer.buffer_size,)}


def _capture_buffer(model: BaseAlgorithm, encoder: Encoder, write: Write) -> dict[str, Any] | None:
    buffer = replay_buffer(model)
    if buffer is None:
        return None
    # with ``optimize_memory_usage`` the row after the last holds an observation
    rows = buffer.buffer_size if buffer.full else min(buffer.pos + 1, buffer.buffer_size)
    for index, array in enumerate(buffer_arrays(buffer).values()):
        write(f"buffer_{index:02d}.npy", array[:rows])
    infos = buffer.infos[:rows].tolist() if isinstance(buffer, HerReplayBuffer) and buffer.copy_info_dict else []
    return {
        "rows": rows,
        "cursors": encoder.encode({name: vars(buffer)[name] for name in _BUFFER_CURSORS if name in vars(buffer)}, "cursors"),
        "own": encoder.encode(_own_state(buffer), "buffer"),
        "infos": encoder.encode(infos, "infos"),
    }


def _restore_buffer(model: BaseAlgorithm, record: dict[str, Any] | None, bundle: Bundle, decoder: Decoder) -> None:
    buffer = replay_buffer(model)
    if buffer is None or record is None:
        return
    rows, was_used = record["rows"], buffer.full or buffer.pos > 0
    for index, array in enumerate(buffer_arrays(buffer).values()):
        array[:rows] = bundle.read_array(f"buffer_{index:02d}.npy")
        if was_used:  # a new one's pages need not be touched
            array[rows:] = 0
    vars(buffer).update(decoder.decode(record["cursors"]))
    _restore_own_state(buffer, decoder.decode(record["own"]))
    for row, entries in enumerate(decoder.decode(record["infos"])):
        buffer.infos[row] = entries  # type: ignore[attr-defined]


def _start_episodes_again(model: BaseAlgorithm, lost: list[tuple[int, str]], report: Report) -> None:
    """``learn`` resets the environments when there is no last observation."""
    buffer = replay_buffer(model)
    assert model.env is not None
    if model.seed is not None and not isinstance(vec_env_layers(model.env)[-1], DummyVecEnv):
        model.env.seed((model.seed + model.num_timesteps) % 2**31)  # their generators are out of reach
    for index, reason in lost:
        report(f"environment {index} cannot be restored within its episode, all episodes start again: {reason}")
    if buffer is not None:
        _cut_running_episodes(buffer)
    model._last_obs = None


def _cut_running_episodes(buffer: ReplayBuffer) -> None:
    """The episodes begun will not be finished: as ``cut_running_episodes`` of this package's buffers does it."""
    if hasattr(buffer, "cut_running_episodes"):
        buffer.cut_running_episodes()
    elif isinstance(buffer, HerReplayBuffer):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            buffer.truncate_last_trajectory()
    elif buffer.full or buffer.pos > 0:
        newest = (buffer.pos - 1) % buffer.buffer_size
        open_ends = buffer.dones[newest] == 0
        buffer.dones[newest][open_ends] = 1.0
        buffer.timeouts[newest][open_ends] = 1.0


# ------------------------------------------------------------------ callbacks and logger


def _capture_callback(callback: BaseCallback, encoder: Encoder, where: str) -> dict[str, Any]:
    if hasattr(callback, "checkpoint_state"):
        return {"own": encoder.encode(_own_state(callback), where)}
    envs = {name: value for name, value in vars(callback).items() if isinstance(value, VecEnv)}
    left_out = {*inspect.signature(type(callback).__init__).parameters, *_CALLBACK_SKIPPED, *envs}
    kept = {name: value for name, value in vars(callback).items() if name not in left_out}
    return {
        "attributes": encoder.encode_some(kept, where),  # of bars, figures and open files the new callback has its own
        "envs": {name: capture_vec_env(env, encoder, f"{where}.{name}") for name, env in envs.items()},
    }


def _restore_callback(callback: BaseCallback, record: dict[str, Any], decoder: Decoder) -> None:
    if "own" in record:
        _restore_own_state(callback, decoder.decode(record["own"]))
        return
    set_attributes(callback, record["attributes"], decoder)
    for name, env_record in record["envs"].items():
        restore_vec_env(vars(callback)[name], env_record, decoder)


def _csv_formats(model: BaseAlgorithm) -> list[CSVOutputFormat]:
    return [output for output in model.logger.output_formats if isinstance(output, CSVOutputFormat)]


def _capture_logger(model: BaseAlgorithm, encoder: Encoder) -> dict[str, Any] | None:
    if not hasattr(model, "_logger"):
        return None
    texts = []
    for output in _csv_formats(model):
        output.file.flush()
        texts.append(Path(output.file.name).read_text(encoding="utf-8"))
    boards = [one.writer.log_dir for one in model.logger.output_formats if isinstance(one, TensorBoardOutputFormat)]
    return {
        # figures and videos, which cannot be stored, belong to the next dump only
        "values": {name: encoder.encode_some(getattr(model.logger, name), "logger") for name in _LOGGER_VALUES},
        "csv": texts,
        "tensorboard": Path(boards[0]).name if boards else None,
    }


def restore_tensorboard(restored: Restored) -> None:
    """Let the curves go on in the folder of the stopped run, unless the agent has its own logger or no folder for them."""
    model, name = restored.model, (restored.state["logger"] or {}).get("tensorboard")
    if name is not None and model.tensorboard_log is not None and not model._custom_logger:
        shown = ["stdout"] if model.verbose else []
        model.set_logger(configure(str(Path(model.tensorboard_log) / name), [*shown, "tensorboard"]))


def _restore_logger(model: BaseAlgorithm, record: dict[str, Any], decoder: Decoder) -> None:
    for name, values in record["values"].items():
        target = getattr(model.logger, name)
        target.clear()
        target.update({key: decoder.decode(node) for key, node in values.items()})
    for output, text in zip(_csv_formats(model), record["csv"], strict=False):
        output.file.seek(0)
        output.file.truncate()
        output.file.write(text)
        output.file.flush()
        output.keys = list(filter(None, text.partition("\n")[0].split(",")))
