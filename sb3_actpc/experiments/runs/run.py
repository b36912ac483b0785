"""One training run and its folder, what it shows at its end, and the replay of a finished one."""

import importlib
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.logger import CSVOutputFormat, KVWriter, Logger, TensorBoardOutputFormat
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

from sb3_actpc.checkpoints import CheckpointCallback, list_bundles, restore, why_no_checkpoints
from sb3_actpc.demonstrations import resolve as resolve_demonstrations
from sb3_actpc.demonstrations.recording import Report, silent
from sb3_actpc.envs import UNSEEN_SEED
from sb3_actpc.experiments.runs import evaluation, presets, record
from sb3_actpc.experiments.runs.algorithms import load_algorithm
from sb3_actpc.experiments.runs.environments import check_env_id, make_eval_envs, make_train_env
from sb3_actpc.experiments.runs.evaluation import EpisodeLog, EvaluationCallback, NormalizedPredictor
from sb3_actpc.experiments.runs.record import is_finished, read_result, read_run
from sb3_actpc.experiments.runs.schema import CONTENT, Run
from sb3_actpc.utils.extras import import_extra
from sb3_actpc.utils.files import atomic_write, folder_lock

UNSET = "unset"  # a setting that is left to its default, which null is not
CHECKPOINTS = "checkpoints"  # folder in the run's folder
DIAGNOSTICS = "diagnostics.csv"  # what the agent logs about itself
# of a run that is gone on with
MAY_CHANGE = ("threads", "device", "checkpoint_freq", "progress", "demonstrations", "gym_packages")


def train_run(run: Run, report: Report = silent, callbacks: Sequence[BaseCallback] = ()) -> dict[str, Any]:
    """Train one agent; its folder then holds ``config.json``, ``progress.csv`` (the evaluations), ``episodes.csv`` (every
    training episode), ``diagnostics.csv`` (what the agent logs), ``model.zip``, the plot and, last, ``result.json``.

    Works with any algorithm of ``ALGORITHMS``; :func:`~sb3_actpc.checkpoints.why_no_checkpoints` says which
    cannot be gone on with. Sets the number of torch threads of the process.

    :param run: what to train
    :param report: given a line of text when the run starts and after each evaluation
    :param callbacks: further ones to watch the training with
    :return: the content of ``result.json`` (see :func:`~sb3_actpc.experiments.runs.record.write_result`), and the folder
    :raises FileNotFoundError: when the preset or the demonstrations do not exist
    :raises ValueError: when a setting is unknown or has a wrong value, or another process trains in the folder
    :raises gymnasium.error.Error: when the environment is unknown
    """
    check_env_id(run.env, run.gym_packages)
    if run.demonstrations not in ("shipped", "none") and not presets.takes_demonstrations(run):
        raise ValueError(f"demonstrations={run.demonstrations!r}: {run.algo} takes none, leave them out")
    return _run(presets.resolve(run), report, callbacks)


def resume_run(
    folder: Path,
    report: Report = silent,
    progress: bool = True,
    callbacks: Sequence[BaseCallback] = (),
    more_steps: int = 0,
    demonstrations: str | None = None,
) -> dict[str, Any]:
    """Go on with a run from its newest whole checkpoint, with the settings in its ``config.json``, for the steps that it was
    to have and ``more_steps``, of which a finished run needs some. ``demonstrations`` is their file, where it has moved.
    ``report`` is given a line of text when the run goes on, after each evaluation and for each damaged checkpoint; see
    :func:`train_run`. FileNotFoundError when the folder is not that of a run, ValueError when the run is finished and gets no
    more steps, or its checkpoints do not fit, are all damaged, or are not there."""
    changes = {"progress": progress} | ({} if demonstrations is None else {"demonstrations": demonstrations})
    return _run(_continued(folder, more_steps, changes), report, callbacks, resumes=True)


def finish_run(run: Run, report: Report = silent, callbacks: Sequence[BaseCallback] = ()) -> dict[str, Any]:
    """Bring a run with its folder (``output``) to its end, whatever has become of it: begun now, gone on with from its newest
    whole checkpoint, given more steps when it was to have fewer, or left alone when it is done. The caller holds the folder.
    See :func:`train_run`; ValueError also when the folder holds another run."""
    check_env_id(run.env, run.gym_packages)
    run = presets.resolve(run)
    folder = run.folder
    try:
        stored = read_run(folder)
    except FileNotFoundError:
        return _run(run, report, callbacks, is_held=True)
    _check_same(stored, run)
    more = max((run.n_timesteps or 0) - (stored.n_timesteps or 0), 0)
    if is_finished(folder):
        result = read_result(folder)
        if not more or (run.target_return is not None and result["dense_return"] >= run.target_return):
            return {**result, "folder": str(folder)}
    elif not list_bundles(folder / CHECKPOINTS):
        return _run(run, report, callbacks, is_held=True)
    run = _continued(folder, more, {name: getattr(run, name) for name in MAY_CHANGE})
    return _run(run, report, callbacks, resumes=True, is_held=True)


def _continued(folder: Path, more_steps: int, changes: Mapping[str, Any]) -> Run:
    """The run in a folder as it goes on; see :func:`resume_run` for the errors."""
    run = read_run(folder)
    if is_finished(folder) and not more_steps:
        raise ValueError(f"the run in {folder} is finished: give it more steps with --steps N")
    if not list_bundles(folder / CHECKPOINTS):
        without = why_no_checkpoints(load_algorithm(run.algo)) or "left none"
        raise ValueError(f"{folder} has no checkpoint to go on from ({run.algo} {without}): train again, in another folder")
    run = run.model_copy(update={**changes, "n_timesteps": (run.n_timesteps or 0) + more_steps})
    check_env_id(run.env, run.gym_packages)
    try:
        present = presets.demonstrations_hash(run)
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"{error}; go on in the folder in which the run began, or give the file with --demonstrations"
        ) from error
    if present != run.demonstrations_sha256:
        raise ValueError(f"{folder}: the demonstrations ({run.demonstrations}) are not those that the run began with")
    return run


def _check_same(stored: Run, run: Run) -> None:
    """:raises ValueError: where the folder holds another run than this one"""
    old = _decisive(stored)
    new = _decisive(run)
    for name in sorted(old.keys() | new.keys()):
        before = old.get(name, UNSET)
        now = new.get(name, UNSET)
        if before != now:
            raise ValueError(
                f"{run.folder} holds another run, with {name}={before} and not {now}: remove it, choose another folder "
                f"(--output; of `demos collect` --work-dir), or give the old {name}"
            )


def _decisive(run: Run) -> dict[str, Any]:
    """What must not change in a run that is gone on with, its settings one by one; the policy may have been fitted to the
    observations, and ``eval_freq`` to the steps."""
    values = run.model_dump(mode="json", include={*CONTENT, "seed"} - {"n_timesteps", "policy", "eval_freq"})
    settings = values.pop("settings")
    return {**values, **settings}


def _run(
    run: Run, report: Report, callbacks: Sequence[BaseCallback], resumes: bool = False, is_held: bool = False
) -> dict[str, Any]:
    """A filled run; ``is_held`` where the caller holds its folder."""
    needed = ["pandas", "matplotlib"]  # at the end of the run
    if run.progress:
        needed += ["tqdm", "rich"]
    for module in needed:
        import_extra(module, "experiments")
    th.set_num_threads(run.threads)
    with ExitStack() as stack:
        eval_envs = [stack.enter_context(env) for env in make_eval_envs(run.env, run.env_kwargs, run.eval_episodes)]
        train_env = make_train_env(run.env, run.env_kwargs, run.n_envs or 1, run.seed, run.normalize)
        stack.callback(train_env.close)
        model = build_model(run, train_env)
        if not is_held:
            stack.enter_context(folder_lock(run.folder))
        if not resumes:
            _check_free(run.folder)
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
    folder = run.folder
    checkpoints = folder / CHECKPOINTS
    restored = restore(model, checkpoints, report) if resumes else None  # before any file of the run is touched
    folder.mkdir(parents=True, exist_ok=True)
    if not resumes:
        run = _begun(run, model, report)
    (folder / record.RESULT).unlink(missing_ok=True)  # of a finished run that gets more steps, as the settings then say
    record.write_config(run)
    model.set_logger(_logger(model, folder))
    model.verbose = max(model.verbose, int(report is not silent))  # it says what it is about, too
    evaluations = EvaluationCallback(eval_envs, run, report)
    episodes = EpisodeLog(folder, lambda: evaluations.wall_seconds)
    since = f" from step {model.num_timesteps}" if resumes else ""
    report(f"{run.env}: {run.algo}, {run.n_timesteps} steps{since}, into {folder}")
    if not resumes:
        (folder / NormalizedPredictor.FILE).unlink(missing_ok=True)  # of another run, which began here and was not finished
        episodes.begin_file()
        evaluations.begin(model)
    callbacks: list[BaseCallback] = [evaluations, episodes, *more]
    saver = None
    if run.checkpoint_freq:
        saver = CheckpointCallback(checkpoints, run.checkpoint_freq, at_end=False, report=report)
        saver.restored = restored
        callbacks.insert(0, saver)
    # what progress_bar=True does, but closed when training stops early
    bar = ProgressBarCallback() if run.progress else None
    try:
        left = max((run.n_timesteps or 0) - model.num_timesteps, 0)
        model.learn(left, callback=[*callbacks, *([bar] if bar else [])], reset_num_timesteps=not resumes)
    finally:
        if saver is not None:
            saver.close()
        if bar is not None and hasattr(bar, "pbar"):
            bar.pbar.close()
    plot_learning_curve(run)
    if saver is not None and run.continuable:
        saver.save()
    model.logger.close()
    result = record.write_result(run)  # before checkpoints go: a run that is killed now need not begin anew
    # one of the finished run, so that it can be given more steps; or none
    for bundle in list_bundles(checkpoints)[: -1 if run.continuable else None]:
        shutil.rmtree(bundle)
    return result


def _begun(run: Run, model: BaseAlgorithm, report: Report) -> Run:
    """The run with what is known when it begins."""
    missing = presets.missing_demonstrations(run)
    if missing:
        report(missing)
    source = presets.find_demonstrations(run.env, run.demonstrations) if run.demonstrations_sha256 else None
    returns = None if source is None else resolve_demonstrations(source).dense_returns
    commit, dirty = record.git_state()
    known: dict[str, Any] = {"versions": record.package_versions(), "git_commit": commit, "dirty": dirty}
    known["demonstrators_return"] = None if returns is None else float(returns.mean())
    known["policy"] = presets.fitting_policy(run.policy or "MlpPolicy", model.observation_space)
    return run.model_copy(update=known)


def _logger(model: BaseAlgorithm, folder: Path) -> Logger:
    """Into the run's folder, and for TensorBoard where the settings say so."""
    formats: list[KVWriter] = [CSVOutputFormat(str(folder / DIAGNOSTICS))]
    if model.tensorboard_log is not None:
        importlib.import_module("tensorboard")  # SB3 would assert
        formats.append(TensorBoardOutputFormat(str(Path(model.tensorboard_log) / folder.name)))
    return Logger(str(folder), formats)


def evaluate_run(folder: Path, n_episodes: int = 10, seed: int = UNSEEN_SEED) -> dict[str, Any]:
    """Play episodes with the policy of a run, the first from ``seed``: means and standard deviations over the episodes, where
    those without success ended, and what identifies the run. Its ``model.zip`` is unpickled: open only runs that you trust.
    FileNotFoundError when the folder is not that of a run, ValueError when its files are damaged, gymnasium.error.Error when
    the environment is unknown."""
    run, model = load_run(folder)
    with ExitStack() as stack:
        envs = [stack.enter_context(env) for env in make_eval_envs(run.env, run.env_kwargs, n_episodes)]
        statistics = evaluation.play_episodes(model, envs, n_episodes, seed)
    return {
        **statistics.summary(),
        "failed_after": statistics.failed_after(),
        **{name: getattr(run, name) for name in ("env", "algo", "seed", "demonstrators_return")},
        "eval_episodes": n_episodes,
    }


def load_run(folder: Path) -> tuple[Run, PolicyPredictor]:
    """A run and its model, on the CPU, with its normalisation of observations where it has one. Both are unpickled: open
    only runs that you trust. FileNotFoundError when the folder, ``config.json`` or ``model.zip`` does not exist, ValueError
    when one of the two cannot be read, gymnasium.error.Error when its environment is unknown."""
    run = read_run(folder)
    if not (folder / "model.zip").is_file():
        raise FileNotFoundError(f"no run in {folder}: model.zip is missing")
    check_env_id(run.env, run.gym_packages)
    model = load_algorithm(run.algo).load(folder / "model.zip", device="cpu")
    return run, NormalizedPredictor.wrap_saved(model, folder)


def _check_free(folder: Path) -> None:
    """:raises ValueError: where a new run would overwrite a finished or a stopped one"""
    if is_finished(folder):
        raise ValueError(f"{folder} already holds a finished run: choose another folder (--output) or --seed")
    if list_bundles(folder / CHECKPOINTS):
        raise ValueError(f"{folder} holds a stopped run: go on with --resume {folder}, or choose another folder (--output)")


def build_model(run: Run, env: VecEnv) -> BaseAlgorithm:
    """The agent of a filled run, not trained."""
    algorithm = load_algorithm(run.algo)
    keywords = presets.agent_keywords(run, env.observation_space, env.action_space)
    try:
        return algorithm(env=env, seed=run.seed, device=run.device, **keywords)
    except (TypeError, AssertionError, RuntimeError) as error:
        # SB3 checks some settings by assertion, torch says so of a network that is too large for the memory
        raise ValueError(f"{algorithm.__name__}: {error}") from error


def result_table(result: Mapping[str, Any]) -> str:
    """The result of ``train_run`` or ``evaluate_run`` as aligned text, a line per quantity."""
    names = {"dense return": "dense_return", "return": "return"}
    if evaluation.says_one_return(result):
        del names["dense return"]
    rows = {name: f"{result[key]:.1f} ± {result[f'{key}_std']:.1f}" for name, key in names.items()}
    if "dense return" in rows and result.get("demonstrators_return") is not None:
        rows["demonstrators' dense return"] = f"{result['demonstrators_return']:.1f}"
    rows["success rate"] = "n/a" if result["success"] is None else f"{result['success']:.2f}"
    rows["episode length"] = f"{result['episode_length']:.1f}"
    if result.get("failed_after"):
        rows["failed, farthest stage"] = ", ".join(f"{stage} {n}" for stage, n in result["failed_after"].items())
    if "steps_per_second" in result:
        rows["steps per second, warm start included"] = f"{result['steps_per_second']:.0f}"
    title = f"{result['env']}, {result['algo']}, seed {result['seed']}: mean ± std of {result['eval_episodes']} episodes"
    width = max(map(len, rows))
    return "\n".join([title, "-" * len(title), *(f"{name:<{width}}  {value}" for name, value in rows.items())])


def plot_learning_curve(run: Run) -> None:
    """Draw the dense and the sparse return of a run's ``progress.csv`` against the environment steps, and the demonstrators'
    as a dashed line, into ``learning_curve.png``."""
    import pandas as pd
    from matplotlib.figure import Figure

    rows = pd.read_csv(run.folder / evaluation.PROGRESS)
    steps, dense, spread = (rows[name].to_numpy() for name in ("timesteps", "dense_return", "dense_return_std"))
    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    dense_axes, return_axes = figure.subplots(2, 1, sharex=True)
    dense_axes.plot(steps, dense, marker="o", label="policy")
    dense_axes.fill_between(steps, dense - spread, dense + spread, alpha=0.2)
    if run.demonstrators_return is not None:
        dense_axes.axhline(run.demonstrators_return, color="black", linestyle="--", label="demonstrators")
    dense_axes.legend()
    dense_axes.set(title=f"{run.env}, {run.algo}", ylabel="dense return (mean ± std)")
    return_axes.plot(steps, rows["return"], marker="o", color="tab:orange")
    return_axes.set(xlabel="environment steps", ylabel="return (mean)")
    with atomic_write(run.folder / "learning_curve.png") as image:
        figure.savefig(image, format="png", dpi=120)
