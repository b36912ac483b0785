"""What a checkpoint holds of an SB3 algorithm, and how it is put back."""

import hashlib
import inspect
import json
import random
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import safetensors.torch
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import CSVOutputFormat, TensorBoardOutputFormat, configure
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.checkpoints.bundle import Bundle, BundleWriter, Report
from sb3_actpc.checkpoints.encoding import Decoder, Encoder, OpaqueValue
from sb3_actpc.checkpoints.simulators import capture_vec_env, env_name, restore_vec_env, set_attribute, vec_env_layers
from sb3_actpc.utils.extras import installed_version

_COUNTERS = (
    "num_timesteps",
    "_total_timesteps",
    "_num_timesteps_at_start",
    "_n_updates",
    "_n_calls",
    "_episode_num",
    "_current_progress_remaining",
    "exploration_rate",
    "_last_obs",
    "_last_original_obs",
    "_last_episode_starts",
    "ep_info_buffer",
    "ep_success_buffer",
)
_BUFFER_CURSORS = ("pos", "full", "_current_ep_start")
_NOISE_MATRICES = ("exploration_mat", "exploration_matrices")  # of SB3's state-dependent exploration
_CALLBACK_SKIPPED = {"model", "locals", "globals", "parent", "callback", "callbacks", "logger"}
_LOGGER_VALUES = ("name_to_value", "name_to_count", "name_to_excluded")
# by the callback's id, what the attributes were made with that are named as arguments of its constructor
MadeWith = Mapping[int, Mapping[str, str]]
_RECORDED_PACKAGES = ("sb3-actpc", "stable-baselines3", "torch", "gymnasium", "mujoco", "numpy", "safetensors")


@dataclass
class Restored:
    """An agent that a checkpoint was put back into, and what can only be put back once ``learn`` has begun: the
    checkpoint's plain values, what decodes them, and whether the episodes that had begun start again."""

    model: BaseAlgorithm
    state: dict[str, Any]
    decoder: Decoder
    starts_again: bool = False


# ------------------------------------------------------------------ writing


def capture_model(model: BaseAlgorithm, callbacks: Sequence[BaseCallback], made_with: MadeWith, writer: BundleWriter) -> None:
    """Write everything that the rest of the training depends on, between two rollouts, or between two updates before the
    first; ValueError when a weight is not finite."""
    check_weights(model)
    encoder = Encoder()
    assert model.env is not None
    buffer = replay_buffer(model)
    state = {
        "counters": {name: encoder.encode(vars(model)[name], name) for name in _COUNTERS if name in vars(model)},
        "torch": _capture_torch(model, encoder),
        "generators": encoder.encode(_generators(model), "generators"),
        "spaces": encoder.encode([model.action_space, model.observation_space], "spaces"),
        "noise": encoder.encode(getattr(model, "action_noise", None), "noise"),
        "env": capture_vec_env(model.env, encoder, "env"),
        "buffer": None if buffer is None else _capture_buffer(buffer, encoder, writer),
        "own": encoder.encode(own_state(model), "own"),
        "callbacks": [[name, _capture_callback(one, encoder, name, made_with[id(one)])] for name, one in named(callbacks)],
        "logger": _capture_logger(model, encoder),
    }
    tensors = {name: tensor.cpu().contiguous().clone() for name, tensor in encoder.tensors.items()}
    writer.add_bytes("tensors.safetensors", safetensors.torch.save(tensors))
    arrays = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in encoder.arrays.items()}
    writer.add_bytes("arrays.safetensors", safetensors.numpy.save(arrays))
    writer.add_json("state.json", state)


def describe_model(model: BaseAlgorithm, env_id: str) -> dict[str, Any]:
    """Plain values by which a checkpoint of another agent or task is recognised, and the versions."""
    buffer = replay_buffer(model)
    return {
        "agent": {
            "algorithm": type(model).__name__,
            "env": env_id,
            "n_envs": model.n_envs,
            "observation_space": str(model.observation_space),
            "action_space": str(model.action_space),
            "replay_buffer": None if buffer is None else type(buffer).__name__,
            "buffer_size": None if buffer is None else buffer.buffer_size,
            "weights": {name: list(tensor.shape) for name, tensor in model.policy.state_dict().items()},
        },
        "versions": {name: installed_version(name) for name in _RECORDED_PACKAGES},
    }


def check_weights(model: BaseAlgorithm) -> None:
    """:raises ValueError: naming the first weight that is NaN or infinite"""
    for name, parameter in model.policy.named_parameters():
        if not bool(th.isfinite(parameter).all()):
            raise ValueError(
                f"{name}: weights are not finite at step {model.num_timesteps}; lower the learning rate, bound the weights or "
                "normalise the observations, and go on from the last good checkpoint"
            )


def named(callbacks: Sequence[BaseCallback]) -> list[tuple[str, BaseCallback]]:
    """Each callback with its class's name and its number among those of that class."""
    kinds = [type(callback).__qualname__ for callback in callbacks]
    return [(f"{kind}{1 + kinds[:index].count(kind)}", callbacks[index]) for index, kind in enumerate(kinds)]


def _generators(model: BaseAlgorithm) -> dict[str, Any]:
    states = {"python": random.getstate(), "numpy": np.random.get_state(legacy=False), "torch": th.get_rng_state()}
    if model.device.type == "cuda":
        states["cuda"] = th.cuda.get_rng_state(model.device)
    return states


def _capture_torch(model: BaseAlgorithm, encoder: Encoder) -> dict[str, Any]:
    dicts, variables = model._get_torch_save_params()
    matrices = _noise_matrices(model)
    return {
        "dicts": {name: encoder.encode(dict(recursive_getattr(model, name).state_dict()), name) for name in dicts},
        "variables": {name: encoder.encode(recursive_getattr(model, name), name) for name in variables},
        "noise": {name: encoder.encode(getattr(matrices, name), name) for name in _NOISE_MATRICES if matrices},
    }


def _noise_matrices(model: BaseAlgorithm) -> Any:
    return getattr(getattr(model, "actor", model.policy), "action_dist", None) if model.use_sde else None


def own_state(thing: Any) -> Any:
    """What an agent, a buffer or a callback keeps beside SB3's, from its method ``checkpoint_state``; None without one."""
    return thing.checkpoint_state() if hasattr(thing, "checkpoint_state") else None


# ------------------------------------------------------------------ buffers


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


def _capture_buffer(buffer: ReplayBuffer, encoder: Encoder, writer: BundleWriter) -> dict[str, Any]:
    # with ``optimize_memory_usage`` the row after the last holds an observation
    rows = buffer.buffer_size if buffer.full else min(buffer.pos + 1, buffer.buffer_size)
    files: dict[str, str] = {}
    for name, array in buffer_arrays(buffer).items():
        files[name] = f"buffer_{len(files):02d}.npy"
        writer.add_array(files[name], array[:rows])
    infos = buffer.infos[:rows].tolist() if isinstance(buffer, HerReplayBuffer) and buffer.copy_info_dict else None
    return {
        "rows": rows,
        "files": files,
        "cursors": {name: encoder.encode(vars(buffer)[name], name) for name in _BUFFER_CURSORS if name in vars(buffer)},
        "own": encoder.encode(own_state(buffer), "buffer"),
        "infos": encoder.encode(infos, "infos"),
    }


def _restore_buffer(buffer: ReplayBuffer, record: dict[str, Any], bundle: Bundle, decoder: Decoder) -> None:
    rows = record["rows"]
    was_used = buffer.full or buffer.pos > 0
    for name, array in buffer_arrays(buffer).items():
        array[:rows] = bundle.read_array(record["files"][name])
        if was_used:  # a new one's pages need not be touched
            array[rows:] = 0
    for name, node in record["cursors"].items():
        setattr(buffer, name, decoder.decode(node))
    own = decoder.decode(record["own"])
    if own is not None:
        buffer.restore_checkpoint_state(own)  # type: ignore[attr-defined]
    for row, entries in enumerate(decoder.decode(record["infos"]) or []):
        buffer.infos[row] = entries  # type: ignore[attr-defined]


def _check_buffer(buffer: ReplayBuffer, record: dict[str, Any], bundle: Bundle) -> None:
    arrays = buffer_arrays(buffer)
    if arrays.keys() != record["files"].keys():
        raise ValueError(f"{bundle.path}: its replay buffer holds {sorted(record['files'])}, this one {sorted(arrays)}")
    for name, array in arrays.items():
        stored = bundle.read_array(record["files"][name])
        if (stored.shape[1:], stored.dtype) != (array.shape[1:], array.dtype):
            raise ValueError(
                f"{bundle.path}: its replay buffer's {name} have shape {stored.shape[1:]} and type {stored.dtype}, this one's "
                f"{array.shape[1:]} and {array.dtype}"
            )


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


def callback_arguments(callback: BaseCallback) -> dict[str, str]:
    """A digest of each attribute that is named as an argument of the constructor, where it can be stored."""
    digests = {}
    for name in inspect.signature(type(callback).__init__).parameters.keys() & vars(callback).keys() - _CALLBACK_SKIPPED:
        encoder = Encoder()
        try:
            node = encoder.encode(vars(callback)[name], name)
        except OpaqueValue:
            continue
        digest = hashlib.sha256(json.dumps(node).encode())
        parts: list[Any] = [*encoder.arrays.values(), *encoder.tensors.values()]
        for part in parts:
            digest.update(f"{part.dtype} {part.shape} {part.tolist()}".encode())
        digests[name] = digest.hexdigest()
    return digests


def _capture_callback(callback: BaseCallback, encoder: Encoder, where: str, made_with: Mapping[str, str]) -> dict[str, Any]:
    if hasattr(callback, "checkpoint_state"):
        return {"own": encoder.encode(own_state(callback), where)}
    envs = {name: value for name, value in vars(callback).items() if isinstance(value, VecEnv)}
    left_out = inspect.signature(type(callback).__init__).parameters.keys() | _CALLBACK_SKIPPED | envs.keys()
    kept = {name: value for name, value in vars(callback).items() if name not in left_out}
    return {
        "attributes": encoder.encode_some(kept, where),  # of bars, figures and open files the new callback has its own
        "changed": {
            name: [made_with[name], encoder.encode(vars(callback)[name], f"{where}.{name}")]
            for name, digest in callback_arguments(callback).items()
            if made_with.get(name, digest) != digest
        },
        "envs": {name: capture_vec_env(env, encoder, f"{where}.{name}") for name, env in envs.items()},
    }


def _restore_callback(callback: BaseCallback, record: dict[str, Any], decoder: Decoder, made_with: Mapping[str, str]) -> None:
    if "own" in record:
        callback.restore_checkpoint_state(decoder.decode(record["own"]))  # type: ignore[attr-defined]
        return
    for name, node in record["attributes"].items():
        set_attribute(callback, name, node, decoder)
    for name, (argument, node) in record.get("changed", {}).items():
        if made_with.get(name) == argument:  # else what is asked for now counts
            set_attribute(callback, name, node, decoder)
    for name, env_record in record["envs"].items():
        restore_vec_env(vars(callback)[name], env_record, decoder)


def _csv_formats(model: BaseAlgorithm) -> list[CSVOutputFormat]:
    return [output for output in model.logger.output_formats if isinstance(output, CSVOutputFormat)]


def _capture_logger(model: BaseAlgorithm, encoder: Encoder) -> dict[str, Any] | None:
    if not hasattr(model, "_logger"):
        return None
    # figures and videos, which cannot be stored, belong to the next dump only
    values = {name: encoder.encode_some(getattr(model.logger, name), "logger") for name in _LOGGER_VALUES}
    texts = []
    for output in _csv_formats(model):
        output.file.flush()
        texts.append(Path(output.file.name).read_text(encoding="utf-8"))
    boards = [one.writer.log_dir for one in model.logger.output_formats if isinstance(one, TensorBoardOutputFormat)]
    return {"values": values, "csv": texts, "tensorboard": Path(boards[0]).name if boards else None}


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


# ------------------------------------------------------------------ reading


def restore_model(model: BaseAlgorithm, bundle: Bundle, report: Report) -> Restored:
    """Put everything back into an agent that was made with the same settings, but for what :func:`restore_learning` puts back
    once ``learn(..., reset_num_timesteps=False)`` has begun. ValueError, and nothing is changed, when the checkpoint is of
    another algorithm, task, network or buffer."""
    assert model.env is not None
    state, buffer = bundle.read_json("state.json"), replay_buffer(model)
    _check_fit(describe_model(model, env_name(model.env))["agent"], bundle)
    if buffer is not None:
        _check_buffer(buffer, state["buffer"], bundle)
    decoder = Decoder(
        safetensors.numpy.load(bundle.read_bytes("arrays.safetensors")),
        safetensors.torch.load(bundle.read_bytes("tensors.safetensors")),
    )
    lost = restore_vec_env(model.env, state["env"], decoder)
    _restore_torch(model, state["torch"], decoder)
    if buffer is not None:
        _restore_buffer(buffer, state["buffer"], bundle, decoder)
    for name, node in state["counters"].items():
        setattr(model, name, decoder.decode(node))
    own = decoder.decode(state["own"])
    if own is not None:
        model.restore_checkpoint_state(own)  # type: ignore[attr-defined]
    _restore_noise(model, state["noise"], decoder)
    _restore_random(model, state, decoder)
    if lost:
        _start_episodes_again(model, lost, report)
    return Restored(model, state, decoder, bool(lost))


def restore_learning(restored: Restored, callbacks: Sequence[BaseCallback], made_with: MadeWith, report: Report) -> None:
    """Put back what the beginning of ``learn`` has changed or made: callbacks, logger, action noise, generators. A line is
    reported for each callback without a match. Callbacks with ``cut_running_episodes`` are told where episodes start again."""
    model, state, decoder = restored.model, restored.state, restored.decoder
    present = dict(named(callbacks))
    for name, record in state["callbacks"]:
        if name in present:
            _restore_callback(present[name], record, decoder, made_with[id(present[name])])
            if restored.starts_again and hasattr(present[name], "cut_running_episodes"):
                present[name].cut_running_episodes()  # type: ignore[attr-defined]
        elif "own" in record:
            report(f"the checkpoint holds the state of a callback {name}, which is not used now")
    if state["logger"] is not None:
        _restore_logger(model, state["logger"], decoder)
    _restore_noise(model, state["noise"], decoder)
    matrices = _noise_matrices(model)
    for name, node in state["torch"]["noise"].items():
        setattr(matrices, name, decoder.decode(node).to(model.device))
    _restore_random(model, state, decoder)


def _check_fit(mine: dict[str, Any], bundle: Bundle) -> None:
    stored = bundle.manifest["agent"]
    for name in ("algorithm", "env", "n_envs", "observation_space", "action_space", "replay_buffer", "buffer_size"):
        if stored[name] != mine[name]:
            raise ValueError(
                f"{bundle.path} is a checkpoint with {name}={stored[name]!r}, the agent has {name}={mine[name]!r}: resume "
                "with the settings and the task of the stopped run"
            )
    theirs, own = stored["weights"], mine["weights"]
    for name in {**own, **theirs}:
        if theirs.get(name) != own.get(name):
            raise ValueError(
                f"{bundle.path} is a checkpoint of another network: {name} has shape {theirs.get(name)}, the agent's "
                f"{own.get(name)}: resume with the settings of the stopped run"
            )


def _restore_torch(model: BaseAlgorithm, record: dict[str, Any], decoder: Decoder) -> None:
    for name, node in record["dicts"].items():
        recursive_getattr(model, name).load_state_dict(decoder.decode(node))
    for name, node in record["variables"].items():
        recursive_getattr(model, name).data = decoder.decode(node).to(model.device)


def _restore_noise(model: BaseAlgorithm, node: Any, decoder: Decoder) -> None:
    if node is None:
        return
    noise = getattr(model, "action_noise", None)
    if noise is None:
        raise ValueError(f"the checkpoint's agent has the action noise {node['object']}, this one none: pass action_noise=")
    if node["object"] == VectorizedActionNoise.__name__ and not isinstance(noise, VectorizedActionNoise):
        noise = model.action_noise = VectorizedActionNoise(noise, model.n_envs)
    decoder.decode(node, noise)


def _restore_random(model: BaseAlgorithm, state: dict[str, Any], decoder: Decoder) -> None:
    decoder.decode(state["spaces"], [model.action_space, model.observation_space])
    states = decoder.decode(state["generators"])
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    th.set_rng_state(states["torch"])
    if "cuda" in states and model.device.type == "cuda":
        th.cuda.set_rng_state(states["cuda"], model.device)


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
