"""The two JSON files of a run folder, ``config.json`` (the run itself) and ``result.json`` (written last), and where the
numbers come from."""

import json
import math
import platform
import subprocess
from pathlib import Path
from typing import Any

from sb3_actpc.experiments.runs.evaluation import PROGRESS
from sb3_actpc.experiments.runs.schema import VERSION, Run
from sb3_actpc.utils.extras import installed_version
from sb3_actpc.utils.files import atomic_write

CONFIG, RESULT = "config.json", "result.json"
_NOT_KEPT = {"output", "progress"}  # where it stands and how it is watched is not part of a run
_PACKAGES = ("sb3-actpc", "stable-baselines3", "torch", "gymnasium", "mujoco", "robosuite", "numpy")
CHECKOUT = Path(__file__).resolve().parents[3]


def package_versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result depends on; ``"unknown"`` for one that is not installed."""
    return {"python": platform.python_version(), **{name: installed_version(name) for name in _PACKAGES}}


def git_state(checkout: Path = CHECKOUT) -> tuple[str | None, bool | None]:
    """The commit of a source checkout, 40 hex digits, and whether files that git knows differ from it; None and None for an
    installed package or where git cannot be asked."""
    if not (checkout / ".git").exists():
        return None, None
    answers = []
    try:
        for arguments in (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"]):
            command = ["git", "-C", str(checkout), *arguments]
            answers.append(subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip())
    except (OSError, subprocess.SubprocessError):
        return None, None
    return answers[0], bool(answers[1])


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file that people can read."""
    with atomic_write(path, "w") as file:
        json.dump(content, file, indent=2)
        file.write("\n")


def write_config(run: Run) -> None:
    """Write ``config.json``: the run with everything filled in."""
    write_json(run.folder / CONFIG, {"schema": VERSION, **run.model_dump(mode="json", exclude=_NOT_KEPT)})


def read_config(folder: Path) -> dict[str, Any]:
    """The content of ``config.json``, of whatever version; FileNotFoundError when there is none, ValueError when it is not
    JSON or lacks what identifies a run."""
    if not (folder / CONFIG).is_file():
        raise FileNotFoundError(f"no run in {folder}: {CONFIG} is missing (a run is a folder that sb3-actpc train wrote)")
    record = _read_json(folder / CONFIG)
    needed = {"env", "env_kwargs", "algo", "seed"}
    if not isinstance(record, dict) or not needed <= record.keys():
        raise ValueError(f"{folder / CONFIG}: expected the settings of a run ({', '.join(sorted(needed))})")
    return record


def read_run(folder: Path) -> Run:
    """The run in a folder; FileNotFoundError when there is no ``config.json``, ValueError when it is damaged, or of another
    version."""
    record = read_config(folder)
    version = record.pop("schema", 1)
    if version != VERSION:
        raise ValueError(f"{folder / CONFIG} has the schema {version}, this version reads {VERSION}: train the run again")
    try:
        return Run(**record, output=str(folder))
    except ValueError as error:
        raise ValueError(f"{folder / CONFIG}: {error}") from error


def write_result(run: Run) -> dict[str, Any]:
    """Write ``result.json`` of a run that has come to its end, from its ``progress.csv``.

    :return: its content: the means and standard deviations of the last evaluation (of the best one, where that agent was to be
        kept), the steps trained, those of the kept agent, training steps per second (evaluations left out), seconds, and where
        it comes from
    """
    import pandas as pd  # takes as long to import as the rest

    rows = pd.read_csv(run.folder / PROGRESS, dtype=float, float_precision="round_trip")
    rows = rows.astype({"timesteps": int, "updates": int}).astype(object).replace({math.nan: None})
    evaluations: Any = rows.to_dict("records")
    last = evaluations[-1]
    kept = last if run.keep == "last" else max(reversed(evaluations), key=lambda row: row["dense_return"])
    seconds = last["seconds"]
    evaluation_seconds = last["evaluation_seconds"]
    names = ("env", "algo", "seed", "eval_episodes", "demonstrators_return", "versions", "git_commit", "dirty")
    result = {
        **{name: value for name, value in kept.items() if name not in ("seconds", "evaluation_seconds")},
        "timesteps": last["timesteps"],
        "kept_timesteps": kept["timesteps"],
        "updates": last["updates"],
        **{name: getattr(run, name) for name in names},
        "preset": run.preset_name,
        "steps_per_second": last["timesteps"] / max(seconds - evaluation_seconds, 0.01),  # the clock's resolution
        "wall_seconds": seconds,
        "evaluation_seconds": evaluation_seconds,
    }
    write_json(run.folder / RESULT, result)
    return result


def is_finished(folder: Path) -> bool:
    """Whether the run of a folder has a result."""
    return (folder / RESULT).is_file()


def read_result(folder: Path) -> dict[str, Any]:
    """The content of ``result.json``; FileNotFoundError when the run is not finished, ValueError when the file is damaged."""
    if not is_finished(folder):
        raise FileNotFoundError(f"no result in {folder}: there is no run, or the run is not finished")
    return _read_json(folder / RESULT)


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # JSON's and UTF-8's own errors are such
        raise ValueError(f"{path}: not a JSON file") from error
