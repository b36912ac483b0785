"""The two JSON files of a run folder: ``config.json``, the run itself, and ``result.json``, written last."""

import json
import math
from pathlib import Path
from typing import Any

from sb3_actpc.experiments.runs.evaluation import OF_ACTOR, PROGRESS
from sb3_actpc.experiments.runs.schema import VERSION, Run
from sb3_actpc.utils.files import atomic_write

CONFIG, RESULT = "config.json", "result.json"
_NOT_KEPT = {"output", "progress"}  # where it stands and how it is watched is not part of a run


def write_config(run: Run) -> None:
    """Write ``config.json``: the run with everything filled in."""
    with atomic_write(run.folder / CONFIG, "w") as file:
        json.dump({"schema": VERSION, **run.model_dump(mode="json", exclude=_NOT_KEPT)}, file, indent=2)


def read_config(folder: Path) -> dict[str, Any]:
    """The content of ``config.json``, of whatever version; FileNotFoundError when there is none, ValueError when it is not
    JSON or lacks what identifies a run."""
    if not (folder / CONFIG).is_file():
        raise FileNotFoundError(f"no run in {folder}: {CONFIG} is missing; {_where_runs_are(folder)}")
    record, needed = _read_json(folder / CONFIG), {"env", "env_kwargs", "algo", "seed"}
    if not isinstance(record, dict) or not needed <= record.keys():
        raise ValueError(f"{folder / CONFIG}: expected the settings of a run ({', '.join(sorted(needed))})")
    return record


def read_run(folder: Path) -> Run:
    """The run in a folder; FileNotFoundError when there is no ``config.json``, ValueError when it is damaged, or of another
    version."""
    record = read_config(folder)
    version = record.pop("schema", 1)
    if version != VERSION:
        raise ValueError(
            f"{folder / CONFIG} has the schema {version}, this version of sb3-actpc reads {VERSION}: train the run again, or "
            "use the version that wrote it"
        )
    try:
        return Run(**record, output=str(folder))
    except ValueError as error:
        raise ValueError(f"{folder / CONFIG}: {error}") from error


def write_result(folder: Path) -> dict[str, Any]:
    """Write ``result.json`` of a run that has come to its end, from its ``config.json`` and ``progress.csv``.

    :return: its content: the means and standard deviations of the last evaluation (of the best one, where that agent was to be
        kept), the steps trained, training steps per second (evaluations left out), seconds, and where it comes from
    :raises FileNotFoundError: when one of the two files is missing
    :raises ValueError: when one is damaged, or the run has not come to its end
    """
    run = read_run(folder)
    evaluations = _read_evaluations(folder / PROGRESS)
    last = evaluations[-1]
    best = max(evaluations, key=lambda row: row["dense_return"])
    has_reached = run.target_return is not None and best["dense_return"] >= run.target_return
    if last["timesteps"] < (run.n_timesteps or 0) and not has_reached:
        raise ValueError(f"{folder}: the run stands at step {last['timesteps']} of {run.n_timesteps}: go on with it first")
    kept = best if run.keep == "best" else last
    seconds, evaluation_seconds = last["seconds"], last["evaluation_seconds"]
    names = ("env", "algo", "seed", "eval_episodes", "demonstrators_return", "versions", "git_commit", "dirty")
    result = {
        **{name: value for name, value in kept.items() if name not in ("seconds", "evaluation_seconds")},
        "timesteps": last["timesteps"],
        "updates": last["updates"],
        **{name: getattr(run, name) for name in names},
        "preset": run.preset_name,
        "steps_per_second": last["timesteps"] / max(seconds - evaluation_seconds, 0.01),  # the clock's resolution
        "wall_seconds": seconds,
        "evaluation_seconds": evaluation_seconds,
    }
    with atomic_write(folder / RESULT, "w") as file:
        json.dump(result, file, indent=2)
    return result


def is_finished(folder: Path) -> bool:
    """Whether the run of a folder has a result."""
    return (folder / RESULT).is_file()


def has_evaluations(folder: Path) -> bool:
    """Whether a run has been evaluated after its first step, or has a damaged row that may be of such an evaluation."""
    path = folder / PROGRESS
    rows = path.read_text(encoding="utf-8", errors="replace").splitlines()[1:] if path.is_file() else []
    return any(row.partition(",")[0] != "0" for row in rows)


def read_result(folder: Path) -> dict[str, Any]:
    """The content of ``result.json``; FileNotFoundError when the run is not finished, ValueError when the file is damaged."""
    if not is_finished(folder):
        raise FileNotFoundError(f"no result in {folder}: the run is not finished")
    result = _read_json(folder / RESULT)
    if not isinstance(result, dict) or not {"env", "algo", "seed", "timesteps", "dense_return"} <= result.keys():
        raise ValueError(f"{folder / RESULT}: expected the result of a run")
    return result


def _where_runs_are(folder: Path) -> str:
    """In the folders below, or beside a file."""
    runs = [str(path.parent) for depth in (1, 2, 3) for path in sorted(folder.glob("*/" * depth + CONFIG))]
    if runs:
        return f"runs in it: {', '.join(runs[:8])}" + (f" and {len(runs) - 8} more" if len(runs) > 8 else "")
    beside = f": {folder.parent}" if folder.is_file() and (folder.parent / CONFIG).is_file() else ""
    return f"a run is a folder, as sb3-actpc train writes it{beside}"


def _read_evaluations(path: Path) -> Any:
    """A dictionary for each row of a ``progress.csv``; the success rate is None where it is not reported."""
    import pandas as pd  # takes as long to import as the rest

    try:
        rows = pd.read_csv(path, dtype=float, float_precision="round_trip").astype({"timesteps": int, "updates": int})
        if rows.empty or rows.drop(columns=["success", *OF_ACTOR.values()], errors="ignore").isna().any(axis=None):
            raise ValueError("values are missing")
    except (ValueError, KeyError) as error:  # a row that was not written to its end
        raise ValueError(f"{path}: holds no evaluation, or a row is damaged") from error
    return rows.astype(object).replace({math.nan: None}).to_dict("records")


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # JSON's and UTF-8's own errors are such
        raise ValueError(f"{path}: not a JSON file") from error
