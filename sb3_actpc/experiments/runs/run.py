"""One training run and its folder, and the replay of a finished one."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.logger import CSVOutputFormat, Logger
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_actpc.checkpoints import CheckpointCallback, Restored, list_bundles, restore
from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.experiments.runs.config import RunConfig, RunPlan, load_algorithm, parse_schedule, resolve_run
from sb3_actpc.experiments.runs.environments import check_env_id, make_eval_envs, make_train_env
from sb3_actpc.experiments.runs.episode_log import EpisodeLog
from sb3_actpc.experiments.runs.evaluation import PROGRESS, EvaluationCallback, NormalizedPredictor, Predictor, play_episodes
from sb3_actpc.experiments.runs.record import read_config, read_plan, write_config, write_result
from sb3_actpc.experiments.runs.summary import plot_learning_curve

# the evaluation's episodes start from other states than the training's
EVALUATION_SEED_OFFSET = 1_000_000
CHECKPOINTS = "checkpoints"  # folder in the run's folder
DIAGNOSTICS = "diagnostics.csv"  # what the agent logs about itself


def train_run(
    config: RunConfig, report: Callable[[str], None] = lambda line: None, callbacks: Sequence[BaseCallback] = ()
) -> dict[str, Any]:
    """Train one agent; its folder then holds ``config.json``, ``progress.csv`` (the evaluations), ``episodes.csv`` (every
    training episode), ``diagnostics.csv`` (what the agent logs), ``model.zip``, the plot and, last, ``result.json``.

    Works with any algorithm of ``ALGORITHMS``; those that learn on policy keep no checkpoints. Sets the number of torch
    threads of the process.

    :param config: what to train
    :param report: given a line of text when the run starts and after each evaluation
    :param callbacks: further ones to watch the training with
    :return: the content of ``result.json`` (see :func:`~sb3_actpc.experiments.runs.record.write_result`), and the folder
    :raises FileNotFoundError: when the preset or the demonstrations do not exist
    :raises ValueError: when a setting is unknown or has a wrong value
    :raises gymnasium.error.Error: when the environment is unknown
    """
    check_env_id(config.env)
    return _run(config, resolve_run(config), report, None, callbacks)


def resume_run(
    folder: Path,
    report: Callable[[str], None] = lambda line: None,
    progress: bool = True,
    callbacks: Sequence[BaseCallback] = (),
) -> dict[str, Any]:
    """Go on with a run that was stopped, from its newest whole checkpoint, with the settings in its ``config.json``.

    :param folder: run folder
    :param report: given a line of text when the run goes on, after each evaluation and for each damaged checkpoint
    :param progress: show a progress bar
    :param callbacks: further ones to watch the training with
    :return: as :func:`train_run`
    :raises FileNotFoundError: when the folder is not that of a run
    :raises ValueError: when the run is finished, or its checkpoints do not fit or are all damaged
    """
    if (folder / "result.json").exists():
        raise ValueError(f"the run in {folder} is finished: start another with more --steps")
    config, plan = read_plan(folder, progress)
    if not plan.learns_off_policy:
        raise ValueError(f"{config.algo} {plan.without_checkpoints}: start the run again, in another folder")
    check_env_id(config.env)
    return _run(config, plan, report, folder, callbacks)


def _run(
    config: RunConfig, plan: RunPlan, report: Callable[[str], None], resumed: Path | None, more: Sequence[BaseCallback]
) -> dict[str, Any]:
    th.set_num_threads(config.threads)
    eval_envs = make_eval_envs(config.env, plan.env_kwargs, config.eval_episodes)
    train_env = make_train_env(config.env, plan.env_kwargs, plan.n_envs, config.seed, plan.normalize)
    try:
        return _train(config, plan, train_env, eval_envs, report, resumed, more)
    finally:
        train_env.close()
        for env in eval_envs:
            env.close()


def evaluate_run(folder: Path, n_episodes: int = 10, seed: int = 0) -> dict[str, Any]:
    """Play episodes with the policy of a run. Its ``model.zip`` is unpickled: open only runs that you trust.

    :param folder: run folder
    :param n_episodes: how many episodes
    :param seed: seed of the first episode
    :return: means and standard deviations over the episodes, where those without success ended, and what identifies the run
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
        close_model(model)
        for env in envs:
            env.close()
    return {
        **statistics.summary(),
        "failed_after": statistics.failed_after(),
        "env": record["env"],
        "algo": record["algo"],
        "seed": record["seed"],
        "eval_episodes": n_episodes,
        "demonstrators_return": record.get("demonstrators_return"),
    }


def load_run(folder: Path) -> tuple[dict[str, Any], Predictor]:
    """The recorded settings and the model of a run. The model is unpickled: open only runs that you trust.

    :param folder: run folder
    :return: the content of ``config.json``, and the model on the CPU, with its normalisation of observations where it has one
    :raises FileNotFoundError: when the folder, ``config.json`` or ``model.zip`` does not exist
    :raises ValueError: when one of the two cannot be read
    """
    record = read_config(folder)
    if not (folder / "model.zip").is_file():
        raise FileNotFoundError(f"no run in {folder}: model.zip is missing")
    model = load_algorithm(record["algo"]).load(folder / "model.zip", device="cpu")
    return record, NormalizedPredictor.wrap_saved(model, folder)


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
    more: Sequence[BaseCallback],
) -> dict[str, Any]:
    reference = demonstrators_return(plan.demonstrations)
    model = build_model(plan, config, train_env)
    folder = run_folder(config) if resumed is None else resumed
    has_checkpoint = resumed is not None and bool(list_bundles(folder / CHECKPOINTS))
    restored = None
    if has_checkpoint:  # before any file of the run is touched
        assert isinstance(model, OffPolicyAlgorithm)
        restored = restore(model, folder / CHECKPOINTS, report)
    folder.mkdir(parents=True, exist_ok=True)
    if resumed is None:
        write_config(folder, config, plan, reference)
    model.set_logger(Logger(str(folder), [CSVOutputFormat(str(folder / DIAGNOSTICS))]))
    evaluation = EvaluationCallback(
        eval_envs, folder, plan.eval_freq, config.eval_episodes, config.seed + EVALUATION_SEED_OFFSET, report
    )
    episodes = EpisodeLog(folder, lambda: evaluation.wall_seconds)
    since = f" from step {model.num_timesteps}" if has_checkpoint else ""
    report(f"{config.env}: {config.algo}, {plan.n_timesteps} steps{since}, into {folder}")
    if not has_checkpoint:
        episodes.begin()
        evaluation.begin(model)
    callbacks = [*_checkpoints(folder, plan, report, restored), evaluation, episodes, *more]
    try:
        _learn(model, plan.n_timesteps, callbacks, config.progress, goes_on=has_checkpoint)
    finally:
        close_model(model)
    plot_learning_curve(folder / PROGRESS, folder / "learning_curve.png", f"{config.env}, {config.algo}", reference)
    result = write_result(folder)
    shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)  # there is nothing left to resume
    return {**result, "folder": str(folder)}


def close_model(model: Any) -> None:
    """
    :param model: ends its other process, where it has one
    """
    getattr(model, "close", lambda: None)()


def _checkpoints(
    folder: Path, plan: RunPlan, report: Callable[[str], None], restored: Restored | None
) -> list[BaseCallback]:
    """The one that saves checkpoints, where they are wanted."""
    if not plan.checkpoint_freq:
        return []
    options: dict[str, Any] = {"at_end": False, "report": report, "restored": restored}
    return [CheckpointCallback(folder / CHECKPOINTS, plan.checkpoint_freq, **options)]


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


def _action_noise(noise_type: str, noise_std: float, size: int) -> ActionNoise:
    mean, sigma = np.zeros(size), noise_std * np.ones(size)
    if noise_type == "normal":
        return NormalActionNoise(mean, sigma)
    return OrnsteinUhlenbeckActionNoise(mean, sigma)
