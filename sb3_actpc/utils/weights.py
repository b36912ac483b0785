"""Files of weights and settings, which cannot run code, and agents made from them."""

import json
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import safetensors
import safetensors.torch
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import GymEnv

from sb3_actpc.utils.files import atomic_write
from sb3_actpc.utils.settings import constructor_settings, read_settings

SelfAlgorithm = TypeVar("SelfAlgorithm", bound=OffPolicyAlgorithm)

VERSION = 8
_SUFFIX = ".safetensors"
_STATISTICS = ("mean", "var", "count")
_NORMALIZERS = "normalizers."


def check_weights(model: BaseAlgorithm) -> None:
    """:raises ValueError: naming the first weight that is NaN or infinite"""
    for name, parameter in model.policy.named_parameters():
        if not bool(th.isfinite(parameter).all()):
            raise ValueError(
                f"{name}: weights are not finite at step {model.num_timesteps}; lower the learning rate, bound the weights or "
                "normalise the observations, and go on from the last good checkpoint"
            )


def save_weights(model: OffPolicyAlgorithm, path: str | os.PathLike[str]) -> Path:
    """Write an agent's weights and its constructor's settings, by name, into one safetensors file, with VecNormalize's
    statistics: the file; ``.safetensors`` is added to its name where it is missing. ValueError when a weight is not finite, or
    the policy or a setting is of a class without a name."""
    check_weights(model)
    settings = constructor_settings(model)
    settings["keywords"].pop("tensorboard_log", None)  # a folder of this machine
    if callable(getattr(model, "learning_rate", None)) and "learning_rate" in settings["unnamed"]:
        settings["unnamed"].remove("learning_rate")
        settings["keywords"]["learning_rate"] = float(model.lr_schedule(1.0))
    unnamed = [name for name in settings["unnamed"] if name not in ("demonstrations", "action_noise")]
    if settings["policy"] is None or unnamed:
        what = ", ".join(unnamed) or f"policy={model.policy_class.__name__}"
        raise ValueError(f"{what} cannot be written by name: only classes of torch, SB3 and sb3_actpc can; use save() instead")
    if "action_noise" in settings["unnamed"]:
        warnings.warn(
            f"action_noise={model.action_noise!r} has no name and is left out: pass it to from_weights", stacklevel=3
        )
    settings["unnamed"] = []
    settings["keywords"].pop("demonstrations", None)
    header = {
        "version": VERSION,
        "algorithm": type(model).__name__,
        "observation_space": str(model.observation_space),
        "action_space": str(model.action_space),
        "settings": settings,
    }
    tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in model.policy.state_dict().items()}
    for name, statistics in _normalizers(model).items():
        tensors |= {f"{name}.{part}": th.tensor(getattr(statistics, part), dtype=th.float64) for part in _STATISTICS}
    path = _with_suffix(Path(path))
    with atomic_write(path) as file:
        file.write(safetensors.torch.save(tensors, metadata={"sb3_actpc": json.dumps(header)}))
    return path


def load_weights(
    algorithm: type[SelfAlgorithm],
    path: str | os.PathLike[str],
    env: GymEnv | str,
    device: th.device | str = "auto",
    without: tuple[str, ...] = (),
    **overrides: Any,
) -> SelfAlgorithm:
    """Make an agent, with an empty replay buffer, from a file of :func:`save_weights`, whose ``.safetensors`` may be left out.
    Nothing in the file is run: it holds numbers and names. The stored keywords in ``without`` are left at the constructor's
    defaults, ``overrides`` replace the others. FileNotFoundError when there is no such file, ValueError when it is of another
    kind or version, names an unknown class or does not fit the environment."""
    path = Path(path)
    if not path.is_file():
        path = _with_suffix(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file of weights at {path}")
    header, tensors = read_tensors(path, "save_weights")
    if header.get("version") != VERSION:
        raise ValueError(f"{path} has format version {header.get('version')}, this sb3_actpc reads {VERSION}")
    if header["algorithm"] != algorithm.__name__:
        raise ValueError(f"{path} holds weights of {header['algorithm']}, not {algorithm.__name__}")
    for name in without:
        if name not in overrides:
            header["settings"]["keywords"].pop(name, None)
    model = algorithm(env=env, device=device, **read_settings(header["settings"], overrides))
    check_spaces(model, header, path)
    _load_normalizers(model, {name: tensors.pop(name) for name in list(tensors) if name.startswith(_NORMALIZERS)}, path)
    try:
        model.policy.load_state_dict(tensors)
    except RuntimeError as error:
        hint = f"; leave out {', '.join(sorted(overrides))}" if overrides else ""
        raise ValueError(f"{path} does not fit these settings{hint}: {' '.join(str(error).split())}") from error
    return model


def _with_suffix(path: Path) -> Path:
    return path if path.suffix == _SUFFIX else path.with_name(path.name + _SUFFIX)


def read_tensors(path: Path, writer: str) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """Header and tensors of a file of the function ``writer``; ValueError when it is none."""
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("sb3_actpc", ""))
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        if not isinstance(header, dict):
            raise ValueError("its header is no dictionary")
    except (safetensors.SafetensorError, ValueError) as error:
        raise ValueError(f"{path}: not a file of {writer} ({' '.join(str(error).split())})") from error
    return header, tensors


def check_spaces(model: BaseAlgorithm, header: Mapping[str, Any], path: Path) -> None:
    """:raises ValueError: when the environment's spaces are not those of the training"""
    for name in ("observation_space", "action_space"):
        if str(getattr(model, name)) != header[name]:
            raise ValueError(f"{path} was trained with {name}={header[name]}, the environment has {getattr(model, name)}")


def _normalizers(model: OffPolicyAlgorithm) -> dict[str, RunningMeanStd]:
    """VecNormalize's running statistics of returns and, where it normalises them, of observations; empty without one."""
    env = model.get_vec_normalize_env()
    if env is None:
        return {}
    observed = env.obs_rms if env.norm_obs else {}
    parts = observed if isinstance(observed, dict) else {"": observed}
    return {f"{_NORMALIZERS}returns": env.ret_rms, **{f"{_NORMALIZERS}observations{key}": one for key, one in parts.items()}}


def _load_normalizers(model: OffPolicyAlgorithm, stored: dict[str, th.Tensor], path: Path) -> None:
    present = _normalizers(model)
    if {name.rpartition(".")[0] for name in stored} != present.keys():
        norm_obs = any("observations" in name for name in stored)
        saved = f"with VecNormalize(norm_obs={norm_obs})" if stored else "without VecNormalize"
        raise ValueError(f"{path} was saved {saved}: wrap the environment as it was in training")
    for name, statistics in present.items():
        mean, var, count = (stored[f"{name}.{part}"].numpy() for part in _STATISTICS)
        statistics.mean, statistics.var, statistics.count = mean, var, float(count)
