"""The two JSON files of a run folder: ``config.json``, from which it can be resumed, and ``result.json``, written last."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

from sb3_actpc.utils.files import atomic_write
from sb3_actpc.experiments.runs.config import RunConfig, RunPlan, find_demonstrations, load_algorithm
from sb3_actpc.experiments.runs.evaluation import PROGRESS
from sb3_actpc.experiments.runs.provenance import file_hash, git_commit, package_versions

CONFIG, RESULT = "config.json", "result.json"
_TEXT_COLUMNS = {"success_rate"}  # empty where the environment does not report it


def write_config(folder: Path, config: RunConfig, plan: RunPlan, demonstrators_return: float | None) -> None:
    """Write ``config.json``: every choice and setting, the versions and the commit.

    :param folder: run folder
    :param config: the user's choices
    :param plan: what they resolve to
    :param demonstrators_return: mean dense return of the demonstrations, or None
    :raises OSError: when it cannot be written
    """
    record = {
        **dataclasses.asdict(config),
        "preset": config.preset_name,
        **describe_plan(plan),
        "eval_freq": plan.eval_freq,
        "checkpoint_freq": plan.checkpoint_freq,
        "demonstrators_return": demonstrators_return,
        "versions": package_versions(),
        "git_commit": git_commit(),
    }
    del record["output"], record["progress"]  # where it stands and how it is watched is not part of a run
    with atomic_write(folder / CONFIG, "w") as file:
        json.dump(record, file, indent=2)


def describe_plan(plan: RunPlan) -> dict[str, Any]:
    """
    :param plan: a resolved run
    :return: what decides its outcome apart from algorithm, task and seed, as plain values; the demonstrations by their SHA-256
    """
    return {
        "policy": plan.policy,
        "n_timesteps": plan.n_timesteps,
        "n_envs": plan.n_envs,
        "env_kwargs": plan.env_kwargs,
        "noise": None if plan.noise is None else list(plan.noise),
        "normalize": plan.normalize,
        "settings": {key: list(value) if isinstance(value, tuple) else value for key, value in plan.algorithm_kwargs.items()},
        "demonstrations_sha256": file_hash(plan.demonstrations),
    }


def read_config(folder: Path, needed: set[str] | None = None) -> dict[str, Any]:
    """
    :param folder: run folder
    :param needed: keys that it must have, by default those that identify a run
    :return: the content of ``config.json``
    :raises FileNotFoundError: when there is none
    :raises ValueError: when it is not JSON or lacks a key
    """
    if not (folder / CONFIG).is_file():
        raise FileNotFoundError(f"no run in {folder}: {CONFIG} is missing")
    needed = {"env", "env_kwargs", "algo", "seed"} if needed is None else needed
    record = _read_json(folder / CONFIG)
    if not isinstance(record, dict) or not needed <= record.keys():
        raise ValueError(f"{folder / CONFIG}: expected the settings of a run ({', '.join(sorted(needed))})")
    return record


def read_plan(folder: Path, progress: bool) -> tuple[RunConfig, RunPlan]:
    """The choices and the plan of a run from what :func:`write_config` wrote.

    :param folder: run folder
    :param progress: show a progress bar
    :return: both
    :raises FileNotFoundError: when there is no ``config.json``, or the demonstrations are gone
    :raises ValueError: when it is damaged, or the demonstrations are not those that the run began with
    """
    choices = {field.name for field in dataclasses.fields(RunConfig)} - {"output", "progress"}
    record = read_config(folder, {*choices, "policy", "noise", "normalize", "settings", "demonstrations_sha256"})
    config = RunConfig(**{name: record[name] for name in choices}, output=str(folder), progress=progress)
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
        demonstrations=find_demonstrations(config.env, config.demonstrations),
        checkpoint_freq=record["checkpoint_freq"],
        normalize=record["normalize"],
    )
    if file_hash(plan.demonstrations) != record["demonstrations_sha256"]:
        raise ValueError(
            f"{folder}: the demonstrations ({plan.demonstrations}) are not those that the run began with: put them back, or "
            "start the run again in another folder"
        )
    return config, plan


def write_result(folder: Path) -> dict[str, Any]:
    """Write ``result.json`` of a run that has reached its last step, from its ``config.json`` and ``progress.csv``.

    :param folder: run folder
    :return: its content: the last evaluation's means and standard deviations, the demonstrators' mean dense return (or None),
        training steps per second (evaluations left out), seconds, versions
    :raises FileNotFoundError: when one of the two files is missing
    :raises ValueError: when one is damaged, or the run has not reached its last step
    """
    config = read_config(folder, {"env", "algo", "preset", "seed", "n_timesteps", "eval_episodes", "versions"})
    last = _last_evaluation(folder / PROGRESS)
    if last["timesteps"] < config["n_timesteps"]:
        raise ValueError(
            f"{folder}: the run stands at step {last['timesteps']} of {config['n_timesteps']}: go on with it first"
        )
    seconds, evaluation_seconds = last.pop("seconds"), last.pop("evaluation_seconds")
    result = {
        **last,
        **{name: config[name] for name in ("env", "algo", "preset", "seed", "eval_episodes")},
        "demonstrators_return": config.get("demonstrators_return"),
        "steps_per_second": last["timesteps"] / max(seconds - evaluation_seconds, 0.01),  # the clock's resolution
        "wall_seconds": seconds,
        "evaluation_seconds": evaluation_seconds,
        "versions": config["versions"],
        "git_commit": config.get("git_commit"),
    }
    with atomic_write(folder / RESULT, "w") as file:
        json.dump(result, file, indent=2)
    return result


def read_result(folder: Path) -> dict[str, Any]:
    """
    :param folder: run folder
    :return: the content of ``result.json``
    :raises FileNotFoundError: when there is none: the run is not finished
    :raises ValueError: when it is damaged
    """
    if not (folder / RESULT).is_file():
        raise FileNotFoundError(f"no result in {folder}: the run is not finished")
    result = _read_json(folder / RESULT)
    if not isinstance(result, dict) or not {"env", "algo", "seed", "timesteps", "dense_return"} <= result.keys():
        raise ValueError(f"{folder / RESULT}: expected the result of a run")
    return result


def _last_evaluation(path: Path) -> dict[str, Any]:
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise ValueError(f"{path}: holds no evaluation")
    try:
        values = {name: None if not text and name in _TEXT_COLUMNS else float(text) for name, text in rows[-1].items()}
    except (TypeError, ValueError) as error:  # a row that was not written to its end
        raise ValueError(f"{path}: the last row is damaged") from error
    return {
        name: int(value) if name in ("timesteps", "updates") and value is not None else value for name, value in values.items()
    }


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # JSON's and UTF-8's own errors are such
        raise ValueError(f"{path}: not a JSON file") from error
