"""What the runs of a comparison have measured, as tables: read from their folders, or from the small files of an export."""

import io
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_actpc.experiments.comparison.execution import ERROR, FINISHED, read_error, run_status
from sb3_actpc.experiments.report.r_stability import final_mean, r_stability
from sb3_actpc.experiments.report.references import reference_score
from sb3_actpc.experiments.runs.episode_log import EPISODES
from sb3_actpc.experiments.runs.evaluation import PROGRESS
from sb3_actpc.experiments.runs.record import CONFIG, read_config
from sb3_actpc.experiments.runs.run import DIAGNOSTICS
from sb3_actpc.experiments.runs.schema import content_id
from sb3_actpc.utils.files import atomic_write

RUNS, CURVES, SETTINGS = "results.csv", "curves.csv.gz", "settings.json"  # of an export
RUN_FOLDER = re.compile(r"seed\d+_[0-9a-f]+")
SETTLED = 5000  # the worst evaluation is looked for from this step on
# columns of progress.csv -> of episodes.csv
MEASURES = {"dense_return": "dense_return", "sparse_return": "sparse_return", "success_rate": "success"}
_TEXTS = ["task", "variant", "algorithm", "settings", "demonstrations", "status", "version", "versions", "commit", "error"]
# columns that may tell the settings of a variant apart, and how a label says so
_TELLING = (("planned_steps", "{:,} steps"), ("demonstrations", "demonstrations: {}"), ("settings", "{:.4}"))
_NO_ROWS = pd.DataFrame(columns=["run"])


@dataclass(frozen=True)
class Results:
    """Tables of a comparison.

    :param runs: a row for each run, indexed by its folder's name: ``task``, ``variant``, ``algorithm``, ``settings`` (an id
        that runs share which differ in their seeds alone), ``demonstrations``, ``seed``, ``status``, ``steps``, what it
        reached (see :func:`run_measures`), ``seconds``, ``versions``, ``commit``, ``dirty`` (from a source tree with changes)
        and ``label``: the variant's name, and where several settings go by that name what tells them apart
    :param evaluations: the rows of ``progress.csv``, with the column ``run``
    :param episodes: the rows of ``episodes.csv`` likewise: every training episode; empty for an export
    :param diagnostics: what the agents logged about themselves, likewise
    """

    runs: pd.DataFrame
    evaluations: pd.DataFrame
    episodes: pd.DataFrame
    diagnostics: pd.DataFrame

    @property
    def finished(self) -> pd.DataFrame:
        """The rows of the finished runs."""
        return self.runs[self.runs["status"] == FINISHED]

    def groups(self, task: str) -> dict[str, pd.DataFrame]:
        """Label -> rows of its finished runs on a task, which differ in their seeds alone."""
        runs = self.finished[self.finished["task"] == task].sort_values("seed", kind="stable")
        return {str(label): rows for label, rows in runs.groupby("label")}


def side_by_side(rows: pd.DataFrame, runs: pd.Index, index: str, column: str) -> pd.DataFrame:
    """A column of the rows laid side by side over steps or episodes: one for each of the runs, where all of them have a
    value."""
    if column not in rows:
        return pd.DataFrame()
    return rows[rows["run"].isin(runs)].pivot(index=index, columns="run", values=column).dropna()


def read_rows(path: Path) -> pd.DataFrame:
    """The rows of a CSV file of numbers, NaN where empty; none without a file; a last row that was not written to its end
    and others without steps are left out."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    whole = text[: text.rfind("\n") + 1]
    if not whole.strip():
        return pd.DataFrame()
    rows = pd.read_csv(io.StringIO(whole), on_bad_lines="skip").apply(pd.to_numeric, errors="coerce")
    return rows[rows["timesteps"].notna()] if "timesteps" in rows else rows  # damaged ones


def load_results(folder: Path) -> Results:
    """The runs, begun and finished, in the folder of a comparison or of an export; FileNotFoundError when there is none."""
    if (folder / CURVES).is_file():
        runs = pd.read_csv(folder / RUNS, index_col="run", dtype=dict.fromkeys(_TEXTS, str))  # else 12e4567890 is a number
        runs[_TEXTS] = runs[_TEXTS].fillna("")
        return Results(_labelled(runs), pd.read_csv(folder / CURVES), _NO_ROWS, _NO_ROWS)
    found = run_folders(folder)
    if not found:
        raise FileNotFoundError(f"no runs in {folder}: make some with sb3-actpc compare --output {folder}")
    names = [path.relative_to(folder).as_posix() for path in found]
    files = [[read_rows(path / file) for path in found] for file in (PROGRESS, EPISODES, DIAGNOSTICS)]
    runs = pd.DataFrame([_run_row(*row) for row in zip(found, *files[:2], strict=True)], index=pd.Index(names, name="run"))
    named = [[table.assign(run=name) for name, table in zip(names, tables, strict=True)] for tables in files]
    evaluations, episodes, diagnostics = (
        pd.concat([part for part in parts if len(part)] or [_NO_ROWS], ignore_index=True) for parts in named
    )
    return Results(_labelled(runs), evaluations, episodes, diagnostics)


def run_folders(folder: Path) -> list[Path]:
    """Those of the runs of a comparison, begun and finished; copies that somebody has made under other names are left out."""
    found = {path.parent for name in (CONFIG, ERROR) for path in folder.glob(f"*/*/seed*/{name}")}
    return sorted(path for path in found if RUN_FOLDER.fullmatch(path.name))


def run_measures(task: str, evaluations: pd.DataFrame, episodes: pd.DataFrame) -> dict[str, float]:
    """What one run on a task has reached, from the rows of its ``progress.csv`` and ``episodes.csv``; NaN where it is
    undefined. Of dense return, sparse return and success rate: the last evaluation's, the worst from 5,000 steps on, the mean
    of the evaluations in the last half of the steps, the mean of the last 100 training episodes and their R-stability; the
    measure by which the task is compared, 0 for random actions and 1 for the demonstrators; and what it took."""
    values: dict[str, float] = {}
    steps = evaluations.get("timesteps", pd.Series(dtype=float))
    end = float(steps.max()) if len(steps) else 0.0
    for name, in_episodes in MEASURES.items():
        column = evaluations.get(name, pd.Series(dtype=float))
        training = episodes.get(in_episodes, pd.Series(dtype=float)).to_numpy()
        values[name] = column.iloc[-1] if len(column) else math.nan
        values[f"{name}_worst"] = column[steps >= SETTLED].min()
        values[f"{name}_last_half"] = column[(steps >= end / 2) & (steps > 0)].mean()
        values[f"{name}_training"] = final_mean(training)
        values[f"{name}_r_stability"] = r_stability(training)
    reference = reference_score(task)
    values["normalized"] = math.nan if reference is None else reference.normalize(values[reference.measure])
    seconds, evaluation, values["updates"] = (
        evaluations[name].iloc[-1] if len(steps) else math.nan for name in ("seconds", "evaluation_seconds", "updates")
    )
    # the clock's resolution is a hundredth of a second
    return {**values, "seconds": seconds, "steps_per_second": end / max(seconds - evaluation, 0.01)}


def _run_row(folder: Path, evaluations: pd.DataFrame, episodes: pd.DataFrame) -> dict[str, Any]:
    """A row of :class:`Results`' runs. A run that failed before it wrote its settings has hardly more than a name."""
    try:
        config, error = read_config(folder), read_error(folder)
    except (FileNotFoundError, ValueError) as problem:
        config, error = {}, read_error(folder) or str(problem)
    task, variant = config.get("task") or folder.parent.parent.name, folder.parent.name
    steps = evaluations["timesteps"].iloc[-1] if len(evaluations) else 0
    versions = dict(config.get("versions", {}))
    return {
        "task": task,
        "variant": variant,
        "algorithm": config.get("algo", ""),
        "settings": content_id(config) if config else "",
        "demonstrations": Path(config.get("demonstrations") or "none").name if config else "",
        "seed": int(folder.name.partition("_")[0].removeprefix("seed")),
        "status": run_status(folder),
        "steps": int(steps),
        "planned_steps": config.get("n_timesteps", 0),
        "episodes": len(episodes),
        **run_measures(task, evaluations, episodes),
        "demonstrators_return": np.nan if config.get("demonstrators_return") is None else config["demonstrators_return"],
        "version": versions.pop("sb3-actpc", ""),
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
        "commit": (config.get("git_commit") or "")[:10],
        "dirty": bool(config.get("dirty")),
        "error": error,
    }


def _labelled(runs: pd.DataFrame) -> pd.DataFrame:
    return runs.assign(label=pd.concat([_labels(own) for _, own in runs.groupby("variant")]))


def _labels(runs: pd.DataFrame) -> pd.Series:
    """Of one variant's runs: its name, and of settings like those of tasks with several of that name what tells these apart:
    the steps, the demonstrations, or else a part of their ids."""
    finished = runs[runs["status"] == FINISHED]
    counts = finished.groupby("task")["settings"].nunique()
    several = counts.index[counts > 1]
    if several.empty:
        return runs["variant"]
    unclear = finished[finished["task"].isin(several)]
    column, form = next(one for one in _TELLING if unclear.groupby(["task", one[0]])["settings"].nunique().max() == 1)
    return runs["variant"] + runs[column].map(f" [{form}]".format).where(runs[column].isin(unclear[column]), "")


def write_runs(results: Results, folder: Path) -> Path:
    """Write ``results.csv`` into a folder."""
    with atomic_write(folder / RUNS, "w") as file:
        results.runs.drop(columns="label").to_csv(file, float_format="%.8g")
    return folder / RUNS
