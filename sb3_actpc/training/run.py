"""One training run and its folder, and the replay of a finished one."""

from __future__ import annotations

import copy
import dataclasses
import importlib.metadata
import json
import platform
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_actpc.checkpoints import CheckpointCallback, list_bundles, restore
from sb3_actpc.common.demonstrations import Demonstrations
from sb3_actpc.common.files import atomic_write
from sb3_actpc.training.config import RunConfig, RunPlan, load_algorithm, parse_schedule, read_yaml, resolve_run
from sb3_actpc.training.environments import check_env_id, make_eval_envs, make_train_env
from sb3_actpc.training.evaluation import EvaluationCallback, NormalizedPredictor, Predictor, play_episodes
from sb3_actpc.training.report import plot_learning_curve

# the evaluation's episodes start from other states than the training's
EVALUATION_SEED_OFFSET = 1_000_000
CHECKPOINTS = "checkpoints"  # folder in the run's folder
_RECORDED_PACKAGES = ("sb3-actpc", "stable-baselines3", "torch", "gymnasium", "mujoco", "numpy")


def train_run(config: RunConfig, report: Callable[[str], None] = lambda line: None) -> dict[str, Any]:
    """Train one agent; its folder then holds the model, the settings, the evaluations, the plot and the result.

    Works with any algorithm of ``ALGORITHMS``; those that learn on policy keep no checkpoints. Sets the number of torch
    threads of the process.

    :param config: what to train
    :param report: given a line of text when the run starts and after each evaluation
    :return: the content of ``result.json``: the last evaluation's means, the demonstrators' mean dense return (or
        None), training steps per second (evaluations left out), seconds, versions, the folder
    :raises FileNotFoundError: when the preset or the demonstrations do not exist
    :raises ValueError: when a setting is unknown or has a wrong value
    :raises gymnasium.error.Error: when the environment is unknown
    """
    check_env_id(config.env)
    return _run(config, resolve_run(config), report, None)


def resume_run(folder: Path, report: Callable[[str], None] = lambda line: None, progress: bool = True) -> dict[str, Any]:
    """Go on with a run that was stopped, from its newest whole checkpoint, with the settings in its ``config.yml``.

    :param folder: run folder
    :param report: given a line of text when the run goes on, after each evaluation and for each damaged checkpoint
    :param progress: show a progress bar
    :return: as :func:`train_run`
    :raises FileNotFoundError: when the folder is not that of a run
    :raises ValueError: when the run is finished, or its checkpoints do not fit or are all damaged
    """
    if (folder / "result.json").exists():
        raise ValueError(f"the run in {folder} is finished: start another with more --steps")
    if not (folder / "config.yml").is_file():
        raise FileNotFoundError(f"no run in {folder}: config.yml is missing")
    config, plan = _read_plan(folder, progress)
    if not plan.learns_off_policy:
        raise ValueError(f"{config.algo} learns on policy and keeps no checkpoints: start the run again, in another folder")
    check_env_id(config.env)
    return _run(config, plan, report, folder)


def _run(config: RunConfig, plan: RunPlan, report: Callable[[str], None], resumed: Path | None) -> dict[str, Any]:
    th.set_num_threads(config.threads)
    eval_envs = make_eval_envs(config.env, plan.env_kwargs, config.eval_episodes)
    train_env = make_train_env(config.env, plan.env_kwargs, plan.n_envs, config.seed, plan.normalize)
    try:
        return _train(config, plan, train_env, eval_envs, report, resumed)
    finally:
        train_env.close()
        for env in eval_envs:
            env.close()


def evaluate_run(folder: Path, n_episodes: int = 10, seed: int = 0) -> dict[str, Any]:
    """Play episodes with the policy of a run. Its ``model.zip`` is unpickled: open only runs that you trust.

    :param folder: run folder
    :param n_episodes: how many episodes
    :param seed: seed of the first episode
    :return: means and standard deviations over the episodes, and what identifies the run
    :raises FileNotFoundError: when the folder is not that of a run
    :raises ValueError: when its files are damaged
    :raises gymnasium.error.Error: when the environment is unknown
    """
    if n_episodes < 1:
        raise ValueError(f"episodes must be at least 1, found {n_episodes}")
    record, model = load_run(folder)
    envs = make_eval_envs(record["env"], record["env_kwargs"], n_episodes)
    try:
        statistics = play_episodes(model, envs, n_episodes, seed)
    finally:
        for env in envs:
            env.close()
    return {
        **statistics.summary(),
        "env": record["env"],
        "algo": record["algo"],
        "seed": record["seed"],
        "eval_episodes": n_episodes,
        "demonstrators_return": record.get("demonstrators_return"),
    }


def load_run(folder: Path) -> tuple[dict[str, Any], Predictor]:
    """The recorded settings and the model of a run. The model is unpickled: open only runs that you trust.

    :param folder: run folder
    :return: the content of ``config.yml``, and the model on the CPU, with its normalisation of observations where it has one
    :raises FileNotFoundError: when the folder, ``config.yml`` or ``model.zip`` does not exist
    :raises ValueError: when one of the two cannot be read
    """
    for name in ("config.yml", "model.zip"):
        if not (folder / name).is_file():
            raise FileNotFoundError(f"no run in {folder}: {name} is missing")
    record = _read_config(folder, {"env", "env_kwargs", "algo", "seed"})
    model = load_algorithm(record["algo"]).load(folder / "model.zip", device="cpu")
    return record, NormalizedPredictor.wrap_saved(model, folder)


def _read_config(folder: Path, needed: set[str]) -> dict[str, Any]:
    record = read_yaml((folder / "config.yml").read_bytes(), str(folder / "config.yml"))
    if not isinstance(record, dict) or not needed <= record.keys():
        raise ValueError(f"{folder / 'config.yml'}: expected the settings of a run ({', '.join(sorted(needed))})")
    return record


def _read_plan(folder: Path, progress: bool) -> tuple[RunConfig, RunPlan]:
    """The choices and the plan of a run from what :func:`_write_config` wrote."""
    choices = {field.name for field in dataclasses.fields(RunConfig)}
    record = _read_config(folder, {*choices, "policy", "noise", "settings"})
    config = RunConfig(**{**{name: record[name] for name in choices}, "output": str(folder), "progress": progress})
    settings = dict(record["settings"])
    if isinstance(settings.get("train_freq"), list):
        settings["train_freq"] = tuple(settings["train_freq"])
    plan = RunPlan(
        algorithm=load_algorithm(record["algo"]),
        policy=record["policy"],
        n_timesteps=record["n_timesteps"],
        n_envs=record["n_envs"],
        eval_freq=record["eval_freq"],
        env_kwargs=record["env_kwargs"],
        noise=None if record["noise"] is None else (record["noise"][0], record["noise"][1]),
        algorithm_kwargs=settings,
        demonstrations=None if record["demonstrations"] is None else Path(record["demonstrations"]),
        checkpoint_freq=record["checkpoint_freq"],
        normalize=record.get("normalize"),
    )
    return config, plan


def run_folder(config: RunConfig) -> Path:
    """The folder of a run: new, or left by a run that stopped before its first checkpoint.

    :param config: the user's choices
    :return: ``config.output``, or ``runs/<env>/<algo>_<preset>_seed<seed>`` with ``_2``, ``_3``, … when it holds a result or
        checkpoints
    :raises ValueError: when ``config.output`` holds a finished run, or one that can be resumed
    """
    if config.output is not None:
        if (Path(config.output) / "result.json").exists():
            raise ValueError(f"{config.output} already holds a finished run: choose another folder")
        if list_bundles(Path(config.output) / CHECKPOINTS):
            raise ValueError(
                f"{config.output} holds a stopped run: go on with --resume {config.output}, or choose another folder"
            )
        return Path(config.output)
    base = Path("runs") / config.env.replace(":", "_") / f"{config.algo}_{config.preset_name}_seed{config.seed}"
    folder, number = base, 1
    while (folder / "result.json").exists() or list_bundles(folder / CHECKPOINTS):
        number += 1
        folder = base.with_name(f"{base.name}_{number}")
    return folder


def demonstrators_return(path: Path | None) -> float | None:
    """Mean dense return of the demonstrated episodes.

    :param path: demonstrations file, or None
    :return: the mean, or None when there is no file or it does not hold dense rewards
    :raises ValueError: when the file is not valid
    """
    returns = None if path is None else Demonstrations.load(path).dense_returns
    return None if returns is None else float(returns.mean())


def build_model(plan: RunPlan, config: RunConfig, env: VecEnv) -> BaseAlgorithm:
    """Make the agent.

    :param plan: the resolved settings
    :param config: the user's choices
    :param env: training environment
    :return: the agent, not trained
    :raises ValueError: when a setting has a wrong value
    """
    kwargs = copy.deepcopy(plan.algorithm_kwargs)  # SB3 adds keys of its own to the dictionaries it is given
    if "learning_rate" in kwargs:
        kwargs["learning_rate"] = parse_schedule(kwargs["learning_rate"])
    if plan.uses_demonstrations:
        kwargs["demonstrations"] = plan.demonstrations
    if plan.noise is not None:
        kwargs["action_noise"] = _action_noise(*plan.noise, size=int(np.prod(env.action_space.shape or (1,))))
    try:
        return plan.algorithm(plan.policy, env, seed=config.seed, device=config.device, **kwargs)
    except (TypeError, AssertionError) as error:
        # SB3 checks some settings by assertion
        raise ValueError(f"{plan.algorithm.__name__}: {error}") from error


def _train(
    config: RunConfig,
    plan: RunPlan,
    train_env: VecEnv,
    eval_envs: list[gym.Env[Any, Any]],
    report: Callable[[str], None],
    resumed: Path | None,
) -> dict[str, Any]:
    reference = demonstrators_return(plan.demonstrations)
    model = build_model(plan, config, train_env)
    folder = run_folder(config) if resumed is None else resumed
    has_checkpoint = resumed is not None and bool(list_bundles(folder / CHECKPOINTS))
    if has_checkpoint:  # before any file of the run is touched
        assert isinstance(model, OffPolicyAlgorithm)
        restore(model, folder / CHECKPOINTS, report)
    folder.mkdir(parents=True, exist_ok=True)
    if resumed is None:
        _write_config(folder, config, plan, reference)
    model.set_logger(configure(str(folder), ["csv"]))
    callback = EvaluationCallback(
        eval_envs, folder, plan.eval_freq, config.eval_episodes, config.seed + EVALUATION_SEED_OFFSET, report
    )
    since = f" from step {model.num_timesteps}" if has_checkpoint else ""
    report(f"{config.env}: {config.algo}, {plan.n_timesteps} steps{since}, into {folder}")
    if not has_checkpoint:
        callback.begin(model)
    _learn(model, plan.n_timesteps, _callbacks(folder, plan, callback, report), config.progress, goes_on=has_checkpoint)
    seconds = callback.wall_seconds
    result = {
        **callback.last_summary,
        "env": config.env,
        "algo": config.algo,
        "preset": config.preset_name,
        "seed": config.seed,
        "timesteps": model.num_timesteps,
        "eval_episodes": config.eval_episodes,
        "demonstrators_return": reference,
        "steps_per_second": model.num_timesteps / max(seconds - callback.evaluation_seconds, 1e-9),
        "wall_seconds": seconds,
        "evaluation_seconds": callback.evaluation_seconds,
        "versions": _versions(),
        "folder": str(folder),
    }
    plot_learning_curve(folder / "evaluations.csv", folder / "learning_curve.png", f"{config.env}, {config.algo}", reference)
    with atomic_write(folder / "result.json", "w") as file:
        json.dump(result, file, indent=2)
    shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)  # there is nothing left to resume
    return result


def _callbacks(
    folder: Path, plan: RunPlan, evaluation: EvaluationCallback, report: Callable[[str], None]
) -> list[BaseCallback]:
    """The checkpoints, where they are wanted, and the evaluation."""
    if not plan.checkpoint_freq:
        return [evaluation]
    return [CheckpointCallback(folder / CHECKPOINTS, plan.checkpoint_freq, at_end=False, report=report), evaluation]


def _learn(model: BaseAlgorithm, n_timesteps: int, callbacks: list[BaseCallback], progress: bool, goes_on: bool) -> None:
    # what progress_bar=True does, but closed when training stops early
    bar = [ProgressBarCallback()] if progress else []
    left = n_timesteps - model.num_timesteps
    try:
        model.learn(max(left, 0), callback=[*callbacks, *bar], reset_num_timesteps=not goes_on)
    finally:
        for callback in callbacks:
            if isinstance(callback, CheckpointCallback):
                callback.close()
        for one in bar:
            if hasattr(one, "pbar"):
                one.pbar.close()


def _write_config(folder: Path, config: RunConfig, plan: RunPlan, reference: float | None) -> None:
    record = {
        **dataclasses.asdict(config),
        "preset": config.preset_name,
        "policy": plan.policy,
        "n_timesteps": plan.n_timesteps,
        "n_envs": plan.n_envs,
        "eval_freq": plan.eval_freq,
        "checkpoint_freq": plan.checkpoint_freq,
        "env_kwargs": plan.env_kwargs,
        "noise": None if plan.noise is None else list(plan.noise),
        "normalize": plan.normalize,
        "settings": {key: list(value) if isinstance(value, tuple) else value for key, value in plan.algorithm_kwargs.items()},
        "demonstrations": None if plan.demonstrations is None else str(plan.demonstrations),
        "demonstrators_return": reference,
        "versions": _versions(),
    }
    with atomic_write(folder / "config.yml", "w") as file:
        yaml.safe_dump(record, file, sort_keys=False)


def _action_noise(noise_type: str, noise_std: float, size: int) -> ActionNoise:
    mean, sigma = np.zeros(size), noise_std * np.ones(size)
    if noise_type == "normal":
        return NormalActionNoise(mean, sigma)
    return OrnsteinUhlenbeckActionNoise(mean, sigma)


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in _RECORDED_PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:  # a source checkout that is not installed
            versions[name] = "unknown"
    return versions
