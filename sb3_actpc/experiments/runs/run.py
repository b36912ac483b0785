"""One training run and its folder, and the replay of a finished one."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
from filelock import FileLock, Timeout
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.logger import CSVOutputFormat, KVWriter, Logger, TensorBoardOutputFormat
from stable_baselines3.common.vec_env import VecEnv

from sb3_actpc.checkpoints import CheckpointCallback, DamagedCheckpoint, list_bundles, restore, why_no_checkpoints
from sb3_actpc.demonstrations import resolve as resolve_demonstrations
from sb3_actpc.demonstrations.recording import Report, silent
from sb3_actpc.experiments.runs.algorithms import load_algorithm
from sb3_actpc.experiments.runs.environments import check_env_id, make_eval_envs, make_train_env
from sb3_actpc.experiments.runs.episode_log import EpisodeLog
from sb3_actpc.experiments.runs.evaluation import PROGRESS, EvaluationCallback, NormalizedPredictor, Predictor, play_episodes
from sb3_actpc.experiments.runs.presets import (
    agent_keywords,
    demonstrations_hash,
    find_demonstrations,
    fitting_policy,
    missing_demonstrations,
    resolve,
)
from sb3_actpc.experiments.runs.provenance import git_state, package_versions
from sb3_actpc.experiments.runs.record import (
    CONFIG,
    RESULT,
    has_evaluations,
    read_result,
    read_run,
    write_config,
    write_result,
)
from sb3_actpc.experiments.runs.schema import Run, content_id
from sb3_actpc.experiments.runs.summary import plot_learning_curve
from sb3_actpc.utils.extras import import_extra
from sb3_actpc.utils.files import LOCK, folder_lock, folder_name

# the evaluation's episodes start from other states than the training's
EVALUATION_SEED_OFFSET = 1_000_000
CHECKPOINTS = "checkpoints"  # folder in the run's folder
DIAGNOSTICS = "diagnostics.csv"  # what the agent logs about itself
MAY_CHANGE = ("threads", "device", "checkpoint_freq")  # of a run that is gone on with


def train_run(
    run: Run, report: Report = silent, callbacks: Sequence[BaseCallback] = (), is_held: bool = False
) -> dict[str, Any]:
    """Train one agent; its folder then holds ``config.json``, ``progress.csv`` (the evaluations), ``episodes.csv`` (every
    training episode), ``diagnostics.csv`` (what the agent logs), ``model.zip``, the plot and, last, ``result.json``.

    Works with any algorithm of ``ALGORITHMS``; :func:`~sb3_actpc.checkpoints.why_no_checkpoints` says which
    cannot be gone on with. Sets the number of torch threads of the process.

    :param run: what to train
    :param report: given a line of text when the run starts and after each evaluation
    :param callbacks: further ones to watch the training with
    :param is_held: the caller holds the run's folder (:func:`~sb3_actpc.utils.files.folder_lock`); else it is held here
    :return: the content of ``result.json`` (see :func:`~sb3_actpc.experiments.runs.record.write_result`), and the folder
    :raises FileNotFoundError: when the preset or the demonstrations do not exist
    :raises ValueError: when a setting is unknown or has a wrong value, or another process trains in the folder
    :raises gymnasium.error.Error: when the environment is unknown
    """
    check_env_id(run.env, run.gym_packages)
    return _run(resolve(run), report, callbacks, resumes=False, is_held=is_held)


def resume_run(
    folder: Path,
    report: Report = silent,
    progress: bool = True,
    callbacks: Sequence[BaseCallback] = (),
    more_steps: int = 0,
    is_held: bool = False,
    changes: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Go on with a run from its newest whole checkpoint, with the settings in its ``config.json``, for the steps that it was
    to have and ``more_steps``, of which a finished run needs some. ``report`` is given a line of text when the run goes on,
    after each evaluation and for each damaged checkpoint; ``changes`` are of fields in ``MAY_CHANGE``;
    see :func:`train_run`. FileNotFoundError when the folder is not that of a run, ValueError when the run is finished and gets
    no more steps, or has no checkpoint but evaluations, or its checkpoints do not fit or are all damaged."""
    run = read_run(folder).model_copy(update={"progress": progress})
    without = why_no_checkpoints(load_algorithm(run.algo))
    if without:
        raise ValueError(f"{run.algo} {without}: start the run again, in another folder")
    if more_steps < 0:
        raise ValueError(f"more_steps={more_steps} must be at least 0")
    is_finished = (folder / RESULT).exists()
    if is_finished and not more_steps:
        raise ValueError(f"the run in {folder} is finished: say with --steps how many more it shall have")
    if is_finished and not list_bundles(folder / CHECKPOINTS):
        raise ValueError(
            f"the run in {folder} is finished and kept no checkpoint to go on from: train another with more --steps"
        )
    if not list_bundles(folder / CHECKPOINTS) and has_evaluations(folder):
        raise ValueError(
            f"the run in {folder} has evaluations but no checkpoint to go on from, and would begin anew: train in another "
            "folder, or remove this one"
        )
    check_env_id(run.env, run.gym_packages)
    if demonstrations_hash(run) != run.demonstrations_sha256:
        raise ValueError(
            f"{folder}: the demonstrations ({run.demonstrations}) are not those that the run began with: put them back, "
            "or start the run again in another folder"
        )
    if more_steps:
        run = run.model_copy(update={"n_timesteps": (run.n_timesteps or 0) + more_steps})
    run = run.model_copy(update=dict(changes or {}))
    return _run(run, report, callbacks, resumes=True, is_held=is_held)


def finish_run(run: Run, report: Report = silent, callbacks: Sequence[BaseCallback] = ()) -> dict[str, Any]:
    """Bring a run with its folder (``output``) to its end, whatever has become of it: begun now, gone on with from its newest
    whole checkpoint, given more steps when it was to have fewer, or left alone when it is done. The caller holds the folder.
    See :func:`train_run`; ValueError also when the folder holds another run."""
    check_env_id(run.env, run.gym_packages)
    run, folder = resolve(run), run.folder
    stored = None
    try:
        stored = read_run(folder)
    except FileNotFoundError:
        pass
    except ValueError as error:
        report(f"{error}: the run starts again")
        (folder / CONFIG).unlink()
    more, changes = 0, {name: getattr(run, name) for name in MAY_CHANGE}
    if stored is not None:
        _check_same(stored, run)
        more = max((run.n_timesteps or 0) - (stored.n_timesteps or 0), 0)
    if stored is not None and (folder / RESULT).is_file():
        result = read_result(folder)
        if not more or (run.target_return is not None and result["dense_return"] >= run.target_return):
            return {**result, "folder": str(folder)}
        return resume_run(folder, report, run.progress, callbacks, more, is_held=True, changes=changes)
    if stored is not None and list_bundles(folder / CHECKPOINTS):
        try:
            return resume_run(folder, report, run.progress, callbacks, more, is_held=True, changes=changes)
        except DamagedCheckpoint as error:
            report(f"{error}: the run starts again")
    shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)
    return train_run(run, report, callbacks, is_held=True)


def _check_same(stored: Run, run: Run) -> None:
    """:raises ValueError: where the folder holds another run than this one"""
    if _content(stored) != _content(run):
        raise ValueError(f"{run.folder} holds another run, of other settings: choose another folder")
    for name in ("target_return", "keep"):
        old, new = getattr(stored, name), getattr(run, name)
        if old != new:
            raise ValueError(
                f"{run.folder} holds another run, with {name}={old} and not {new}: remove it, choose another folder "
                f"(--output; of `demos collect` --work-dir), or give the old {name}"
            )


def _content(run: Run) -> str:
    """An id of what must not change; the policy may have been fitted to the observations, and ``eval_freq`` to the steps;
    ``target_return`` and ``keep`` are compared by name."""
    free = ("n_timesteps", "policy", "eval_freq", "target_return", "keep")
    return content_id({**run.model_dump(), **dict.fromkeys(free)}, run.seed)


def _run(run: Run, report: Report, callbacks: Sequence[BaseCallback], resumes: bool, is_held: bool) -> dict[str, Any]:
    for module in ("pandas", "matplotlib", *(("tqdm", "rich") if run.progress else ())):  # which the end of the run needs
        import_extra(module, "experiments")
    th.set_num_threads(run.threads)
    with ExitStack() as stack:
        eval_envs = [stack.enter_context(env) for env in make_eval_envs(run.env, run.env_kwargs, run.eval_episodes)]
        train_env = make_train_env(run.env, run.env_kwargs, run.n_envs or 1, run.seed, run.normalize)
        stack.callback(train_env.close)
        model = build_model(run, train_env)
        stack.callback(close_model, model)
        if run.output is None:
            run = run.model_copy(update={"output": str(stack.enter_context(default_folder(run)))})
        elif not is_held:
            stack.enter_context(folder_lock(run.folder))
        if not resumes and (taken := _taken(run.folder)):
            raise ValueError(taken)
        result = _train(run, model, eval_envs, report, callbacks, resumes)
    return {**result, "folder": str(run.folder)}


def _train(
    run: Run,
    model: BaseAlgorithm,
    eval_envs: list[gym.Env[Any, Any]],
    report: Report,
    more: Sequence[BaseCallback],
    resumes: bool,
) -> dict[str, Any]:
    folder, checkpoints = run.folder, run.folder / CHECKPOINTS
    goes_on = resumes and bool(list_bundles(checkpoints))
    restored = restore(model, checkpoints, report) if goes_on else None  # before any file of the run is touched
    folder.mkdir(parents=True, exist_ok=True)
    if not resumes:
        commit, dirty = git_state()
        policy = fitting_policy(run.policy or "MlpPolicy", model.observation_space)
        if missing := missing_demonstrations(run):
            report(missing)
        reference = demonstrators_return(find_demonstrations(run.env, run.demonstrations))
        filled = {"policy": policy, "demonstrators_return": reference, "versions": package_versions()}
        run = run.model_copy(update={**filled, "git_commit": commit, "dirty": dirty})
    (folder / RESULT).unlink(missing_ok=True)  # of a finished run that gets more steps, as the settings then say
    write_config(run)
    model.set_logger(_logger(model, folder))
    model.verbose = max(model.verbose, int(report is not silent))  # it says what it is about, too
    seed = run.seed + EVALUATION_SEED_OFFSET
    evaluation = EvaluationCallback(
        eval_envs, folder, run.eval_freq or 1, run.eval_episodes, seed, report, run.keep == "best", run.target_return
    )
    episodes = EpisodeLog(folder, lambda: evaluation.wall_seconds)
    since = f" from step {model.num_timesteps}" if goes_on else ""
    report(f"{run.env}: {run.algo}, {run.n_timesteps} steps{since}, into {folder}")
    if not goes_on:
        (folder / NormalizedPredictor.FILE).unlink(missing_ok=True)  # of another run, which began here and was not finished
        episodes.begin_file()
        evaluation.begin(model)
    saver = None
    if run.checkpoint_freq:
        saver = CheckpointCallback(checkpoints, run.checkpoint_freq, at_end=False, report=report, restored=restored)
    callbacks = [*([] if saver is None else [saver]), evaluation, episodes, *more]
    _learn(model, run.n_timesteps or 0, callbacks, run.progress, goes_on)
    plot_learning_curve(folder / PROGRESS, folder / "learning_curve.png", f"{run.env}, {run.algo}", run.demonstrators_return)
    _keep_last_checkpoint(saver, run.continuable, report)
    return write_result(folder)


def _logger(model: BaseAlgorithm, folder: Path) -> Logger:
    """Into the run's folder, and for TensorBoard where the settings say so."""
    formats: list[KVWriter] = [CSVOutputFormat(str(folder / DIAGNOSTICS))]
    if model.tensorboard_log is not None:
        try:
            formats.append(TensorBoardOutputFormat(str(Path(model.tensorboard_log) / folder.name)))
        except AssertionError as error:
            message = f"tensorboard_log={model.tensorboard_log!r} needs TensorBoard: pip install tensorboard, or leave it out"
            raise ImportError(message) from error
    return Logger(str(folder), formats)


def _keep_last_checkpoint(saver: CheckpointCallback | None, continuable: bool, report: Report) -> None:
    """One, of the finished run, so that it can be given more steps; or none."""
    if saver is None:
        return
    if not continuable:
        shutil.rmtree(saver.folder, ignore_errors=True)
        return
    try:
        saver.save()
    except OSError as error:
        report(f"no checkpoint of the end: {error.strerror or error}; the run is finished, and cannot be given more steps")
    for bundle in list_bundles(saver.folder)[:-1]:
        shutil.rmtree(bundle, ignore_errors=True)


def evaluate_run(folder: Path, n_episodes: int = 10, seed: int = 0) -> dict[str, Any]:
    """Play episodes with the policy of a run, the first from ``seed``. Its ``model.zip`` is unpickled: open only runs that you
    trust.

    :return: means and standard deviations over the episodes, where those without success ended, and what identifies the run
    :raises FileNotFoundError: when the folder is not that of a run
    :raises ValueError: when its files are damaged
    :raises gymnasium.error.Error: when the environment is unknown
    """
    if n_episodes < 1:
        raise ValueError(f"episodes must be at least 1, found {n_episodes}")
    run, model = load_run(folder)
    with ExitStack() as stack:
        stack.callback(close_model, model)
        envs = [stack.enter_context(env) for env in make_eval_envs(run.env, run.env_kwargs, n_episodes)]
        statistics = play_episodes(model, envs, n_episodes, seed)
    return {
        **statistics.summary(),
        "failed_after": statistics.failed_after(),
        **{name: getattr(run, name) for name in ("env", "algo", "seed", "demonstrators_return")},
        "eval_episodes": n_episodes,
    }


def load_run(folder: Path) -> tuple[Run, Predictor]:
    """A run and its model, on the CPU, with its normalisation of observations where it has one. The model is unpickled: open
    only runs that you trust. FileNotFoundError when the folder, ``config.json`` or ``model.zip`` does not exist, ValueError
    when one of the two cannot be read, gymnasium.error.Error when its environment is unknown."""
    run = read_run(folder)
    if not (folder / "model.zip").is_file():
        raise FileNotFoundError(f"no run in {folder}: model.zip is missing")
    check_env_id(run.env, run.gym_packages)
    model = load_algorithm(run.algo).load(folder / "model.zip", device="cpu")
    return run, NormalizedPredictor.wrap_saved(model, folder)


def _taken(folder: Path) -> str:
    """What a folder holds that another run must not touch; empty where that is nothing."""
    if (folder / RESULT).exists():
        return f"{folder} already holds a finished run: choose another folder"
    if list_bundles(folder / CHECKPOINTS):
        return f"{folder} holds a stopped run: go on with --resume {folder}, or choose another folder"
    return ""


@contextmanager
def default_folder(run: Run) -> Iterator[Path]:
    """``runs/<env>/<algo>_<preset>_seed<seed>``, made when it does not exist, or with ``_2``, ``_3``, … where that holds a
    result or checkpoints, or another process trains in it. Until the block ends no other process is given it."""
    base = Path("runs") / folder_name(run.env) / f"{run.algo.rpartition(':')[2]}_{run.preset_name}_seed{run.seed}"
    for number in count(1):
        folder = base if number == 1 else base.with_name(f"{base.name}_{number}")
        if _taken(folder):
            continue
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / LOCK, timeout=0)
        try:
            lock.acquire()
        except Timeout:
            continue
        try:
            if not _taken(folder):  # by a process that has just ended
                yield folder
                return
        finally:
            with suppress(OSError):  # Windows removes no file that is open
                (folder / LOCK).unlink()
            lock.release()


def demonstrators_return(source: Path | str | None) -> float | None:
    """Mean dense return of demonstrated episodes, of a file or a Minari dataset; None when there are none, or without dense
    rewards."""
    returns = None if source is None else resolve_demonstrations(source).dense_returns
    return None if returns is None else float(returns.mean())


def build_model(run: Run, env: VecEnv) -> BaseAlgorithm:
    """The agent of a filled run, not trained."""
    algorithm, keywords = load_algorithm(run.algo), agent_keywords(run, env.observation_space, env.action_space)
    try:
        return algorithm(env=env, seed=run.seed, device=run.device, **keywords)
    except (TypeError, AssertionError, RuntimeError) as error:
        # SB3 checks some settings by assertion, torch says so of a network that is too large for the memory
        raise ValueError(f"{algorithm.__name__}: {error}") from error


def close_model(model: Any) -> None:
    """End the agent's other process, where it has one."""
    getattr(model, "close", lambda: None)()


def _learn(model: BaseAlgorithm, n_timesteps: int, callbacks: list[BaseCallback], progress: bool, goes_on: bool) -> None:
    # what progress_bar=True does, but closed when training stops early
    everything = [*callbacks, *([ProgressBarCallback()] if progress else [])]
    try:
        model.learn(max(n_timesteps - model.num_timesteps, 0), callback=everything, reset_num_timesteps=not goes_on)
    finally:
        for callback in everything:
            if isinstance(callback, CheckpointCallback):
                callback.close()
            elif isinstance(callback, ProgressBarCallback) and hasattr(callback, "pbar"):
                callback.pbar.close()
