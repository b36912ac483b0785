"""Two tidy tables of a comparison: a row for each run, and a row for each evaluation."""

import gzip
import io
import math
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_actpc.experiments.comparison.schedule import ERROR, FINISHED, read_error, run_status
from sb3_actpc.experiments.runs.evaluation import OF_ACTOR, PROGRESS
from sb3_actpc.experiments.runs.record import CONFIG, read_config
from sb3_actpc.experiments.runs.schema import content_id
from sb3_actpc.utils.files import atomic_write

RESULTS, CURVES = "results.csv", "curves.csv.gz"
RUN_FOLDER = re.compile(r"seed\d+_[0-9a-f]+")
MEASURES = ("return", "dense_return", "success", *OF_ACTOR.values())  # columns of progress.csv
NEAR = 0.05  # share of a step, within which an evaluation stands for it
SETTLED = 5000  # the worst evaluation is taken from this step on
# of random actions and of the shipped demonstrations; ``python benchmarks/reference_scores.py`` measures them again
SCORES_FILE = Path(__file__).with_name("reference_scores.csv")
_TEXTS = ["task", "env", "variant", "algorithm", "settings", "demonstrations", "status", "version", "commit", "error"]


@cache
def reference_score(env_id: str) -> Any:
    """A row of ``SCORES_FILE``, of a task with or without a module in its id: ``random_score`` and ``demonstrators_score`` in
    units of ``measure``, a column of ``progress.csv``; None where none were measured."""
    return pd.read_csv(SCORES_FILE, index_col="env").dropna().T.get(env_id.rpartition(":")[2])


@dataclass(frozen=True)
class Results:
    """Tables of a comparison.

    :param runs: a row for each run, indexed by its folder: identity, status, and what :func:`run_measures` returns
    :param curves: the rows of every ``progress.csv``, with the column ``run``
    """

    runs: pd.DataFrame
    curves: pd.DataFrame

    @property
    def finished(self) -> pd.DataFrame:
        """The rows of the finished runs."""
        return self.runs[self.runs["status"] == FINISHED]

    def groups(self, task: str) -> dict[str, pd.DataFrame]:
        """Variant -> its finished runs on a task, one for each seed."""
        runs = self.finished[self.finished["task"] == task].sort_values("seed", kind="stable")
        return {str(name): rows for name, rows in runs.groupby("label")}

    def at_step(self, runs: pd.DataFrame, measure: str, step: int) -> pd.Series:
        """What some of the runs reached in the evaluation at a step, or the one nearest to it within ``NEAR`` of it (several
        environments step at once); NaN where they have none."""
        distance = (self.curves["timesteps"] - step).abs()
        near = self.curves[distance <= NEAR * step].assign(distance=distance)[::-1].sort_values("distance", kind="stable")
        rows = near.drop_duplicates("run").set_index("run")
        return rows.reindex(index=runs.index, columns=[measure])[measure]


def load_results(folder: Path) -> Results:
    """Read a comparison's run folders, or the two files that :func:`write_results` left where there are no run folders.
    FileNotFoundError when the folder holds neither."""
    found = {path.parent for name in (CONFIG, ERROR) for path in folder.glob(f"*/*/seed*/{name}")}
    folders = sorted(path for path in found if RUN_FOLDER.fullmatch(path.name))
    if not folders and (folder / CURVES).is_file():
        runs = pd.read_csv(folder / RESULTS, index_col="run", dtype=dict.fromkeys(_TEXTS, str))
        runs[_TEXTS] = runs[_TEXTS].fillna("")
        return Results(_labelled(runs), pd.read_csv(folder / CURVES))
    if not folders:
        raise FileNotFoundError(f"no runs in {folder}: make some with sb3-actpc compare --output {folder}")
    names = [path.relative_to(folder).as_posix() for path in folders]
    curves = [_read_rows(path / PROGRESS) for path in folders]
    rows = [_run_row(path, own) for path, own in zip(folders, curves, strict=True)]
    named = [own.assign(run=name) for name, own in zip(names, curves, strict=True) if len(own)]
    joined = pd.concat(named, ignore_index=True) if named else pd.DataFrame(columns=["run", "timesteps", *MEASURES])
    return Results(_labelled(pd.DataFrame(rows, index=pd.Index(names, name="run"))), joined)


def write_results(results: Results, folder: Path) -> list[Path]:
    """Write ``results.csv`` and ``curves.csv.gz``."""
    columns = ["run", *results.curves.columns.drop("run")]
    with atomic_write(folder / RESULTS, "w") as file:
        results.runs.drop(columns="label").to_csv(file, float_format="%.8g")
    with atomic_write(folder / CURVES) as binary, gzip.GzipFile("", "wb", fileobj=binary, mtime=0) as packed:
        packed.write(results.curves[columns].to_csv(index=False, float_format="%.8g").encode())
    return [folder / RESULTS, folder / CURVES]


def _read_rows(path: Path) -> pd.DataFrame:
    """The rows of a CSV file of numbers, NaN where empty; one that is not yet written to its end is left out."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    whole = text[: text.rfind("\n") + 1]
    return pd.read_csv(io.StringIO(whole)).apply(pd.to_numeric, errors="coerce") if whole else pd.DataFrame()


def run_measures(env_id: str, curve: pd.DataFrame) -> dict[str, float]:
    """What one run reached; NaN where it is undefined. For each of ``MEASURES``: the last evaluation, the worst from 5,000
    steps on, and the area under the curve divided by its length (the mean over steps)."""
    values: dict[str, float] = {}
    steps = curve["timesteps"] if len(curve) else pd.Series(dtype=float)
    for name in MEASURES:
        column = curve[name] if name in curve else pd.Series(math.nan, index=curve.index)
        values[name] = float(column.iloc[-1]) if len(column) else math.nan
        values[f"{name}_worst"] = column[steps >= SETTLED].min()
        values[f"{name}_area"] = area(steps.to_numpy(), column.to_numpy())
    reference = reference_score(env_id)
    values["normalized"] = values["success"]
    if reference is not None:  # random actions have 0, the demonstrators 1
        span = reference.demonstrators_score - reference.random_score
        values["normalized"] = float((values[reference.measure] - reference.random_score) / span)
    last: Any = curve.iloc[-1] if len(curve) else {}
    values["updates"] = last.get("updates", math.nan)
    values["seconds"] = last.get("seconds", math.nan) - last.get("evaluation_seconds", math.nan)
    return values


def area(steps: np.ndarray, values: np.ndarray) -> float:
    """Area under a curve of (n,) evaluations by the trapezoidal rule, divided by the steps that it spans."""
    if len(steps) < 2:
        return math.nan
    widths = np.diff(steps)
    return float(np.sum(widths * (values[1:] + values[:-1]) / 2.0) / np.sum(widths))


def _run_row(folder: Path, curve: pd.DataFrame) -> dict[str, Any]:
    """A row of :class:`Results`' runs. A run that failed before it wrote its settings has little more than a name."""
    config = read_config(folder) if (folder / CONFIG).is_file() else {}
    task = config.get("task") or folder.parent.parent.name
    env_id = config.get("env") or task
    return {
        "task": task,
        "env": env_id,
        "variant": folder.parent.name,
        "algorithm": config.get("algo", ""),
        "settings": content_id(config) if config else "",
        "demonstrations": Path(config.get("demonstrations") or "none").name,
        "seed": int(folder.name.partition("_")[0].removeprefix("seed")),
        "status": run_status(folder),
        "steps": int(curve["timesteps"].iloc[-1]) if len(curve) else 0,
        "eval_episodes": config.get("eval_episodes", 0),
        **run_measures(env_id if reference_score(task) is None else task, curve),
        "version": dict(config.get("versions", {})).get("sb3-actpc", ""),
        "commit": (config.get("git_commit") or "")[:10],
        "dirty": bool(config.get("dirty")),
        "error": read_error(folder),
    }


def _labelled(runs: pd.DataFrame) -> pd.DataFrame:
    """Add ``label``: the variant. Where a task has several settings of that name, it has their steps, if these tell them
    apart, or else a part of the settings' id, which other tasks do not share."""
    labels = runs["variant"].copy()
    known = runs[runs["settings"] != ""]  # a run can fail before it wrote them
    for _, rows in known.groupby(["task", "variant"]):
        n_settings = rows["settings"].nunique()
        if n_settings > 1:
            ends = rows.loc[rows["status"] == FINISHED, ["settings", "steps"]].drop_duplicates()
            by_steps, by_id = " (" + rows["steps"].astype(str) + " steps)", " [" + rows["settings"].str[:4] + "]"
            labels[rows.index] += by_steps if len(ends) == ends["steps"].nunique() == n_settings else by_id
    return runs.assign(label=labels)
