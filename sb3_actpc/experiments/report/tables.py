"""``report.md``: tables from ``results.csv``, with figures from ``curves.csv.gz``."""

import math
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_actpc.experiments.report import figures, statistics
from sb3_actpc.experiments.report.results import CHOSEN_STEPS, MEASURES, Results, load_results, write_results
from sb3_actpc.utils.files import atomic_write, folder_name

UNDEFINED = "n/a"


def write_report(
    folder: Path, target: Path | None = None, steps: Sequence[int] = CHOSEN_STEPS, curves: Sequence[str] = ()
) -> list[Path]:
    """Write ``results.csv``, ``curves.csv.gz``, ``report.md`` and the figures of a comparison.

    :param folder: of the comparison, or one that holds its two CSV files
    :param target: where the files go, by default the same folder
    :param steps: the environment steps whose evaluations the tables show
    :param curves: the variants to draw, at most six; by default the best ones, ActPC among them
    :raises FileNotFoundError: when there are no runs
    """
    target = folder if target is None else target
    results = load_results(folder, steps)
    files = write_results(results, target)
    text = [f"# Comparison {folder.name}\n\n{_overview(results.runs)}"]
    for task in results.finished["task"].unique():
        picture = target / f"curves_{folder_name(task)}.png"
        left_out = figures.draw_curves(results, task, picture, curves)
        note = f"\n\nNot drawn: {', '.join(left_out)}." if left_out else ""
        text.append(f"## {task}\n\n![{task}]({picture.name}){note}")
        for measure, table in task_tables(results, task, steps).items():
            text.append(f"### {measure.replace('_', ' ').capitalize()}\n\n{markdown(table)}")
        files.append(picture)
    scores = normalized_scores(results)
    if scores:
        figures.draw_summary(scores, target / "summary.png")
        files.append(target / "summary.png")
        text.append(f"## Across tasks\n\n{markdown(aggregate_table(scores))}\n\n![Across tasks](summary.png)")
    improvement = improvement_table(results, steps)
    if len(improvement):
        text.append(f"## Probability of improvement\n\nOf the return on a task drawn at random.\n\n{markdown(improvement)}")
    missing = results.runs.loc[results.runs["status"] != "finished", ["task", "variant", "seed", "status", "steps", "error"]]
    if len(missing):
        text.append(f"## Runs that are not in the tables\n\n{markdown(missing)}")
    with atomic_write(target / "report.md", "w") as file:
        file.write("\n\n".join(text) + "\n")
    return [*files, target / "report.md"]


def task_tables(results: Results, task: str, steps: Sequence[int]) -> dict[str, pd.DataFrame]:
    """Measure -> a row for each variant, mean ± standard deviation over seeds; then the runs and their seconds."""
    groups = results.groups(task)
    tables = {}
    for measure in MEASURES:
        columns = {f"at {step:,}": f"{measure}_at_{step}" for step in steps}
        columns |= {"last": measure, "area": f"{measure}_area", "worst after 5,000": f"{measure}_worst"}
        form = ".2f" if measure.endswith("success") else ".1f"
        rows = []
        for label, runs in groups.items():
            cells = {title: mean_and_deviation(runs[column].to_numpy(), form) for title, column in columns.items()}
            if any(cell != UNDEFINED for cell in cells.values()):
                rows.append({"variant": label, **cells})
        table = pd.DataFrame(rows)
        tables[measure] = table.loc[:, (table != UNDEFINED).any()]
    rows = []
    for label, runs in groups.items():
        rows.append(
            {
                "variant": f"{label} †" if runs["dirty"].any() else label,
                "seeds": str(len(runs)),
                "evaluation episodes": ", ".join(str(n) for n in sorted(runs["eval_episodes"].unique())),
                "seconds": mean_and_deviation(runs["seconds"].to_numpy(), ".0f"),
            }
        )
    return {**{name: table for name, table in tables.items() if len(table)}, "runs": pd.DataFrame(rows)}


def normalized_scores(results: Results) -> dict[str, list[np.ndarray]]:
    """Variant -> its normalized scores, (n_runs,) for each task; only variants that have runs on every scored task."""
    return _on_every_task(results.finished, "normalized")


def returns_at(results: Results, step: int) -> dict[str, list[np.ndarray]]:
    """Variant -> its returns at a step, (n_runs,) for each task; a run that ended before counts with its last evaluation."""
    runs = results.finished
    ended = runs["return"].where(runs["steps"] < step)
    return _on_every_task(runs.assign(at_step=runs[f"return_at_{step}"].fillna(ended)), "at_step")


def _on_every_task(runs: pd.DataFrame, column: str) -> dict[str, list[np.ndarray]]:
    scored = runs.dropna(subset=[column])
    tasks = sorted(scored["task"].unique())
    whole = {}
    for label, own in scored.groupby("label"):
        parts = [own.loc[own["task"] == task, column].to_numpy() for task in tasks]
        if all(len(part) for part in parts):
            whole[str(label)] = parts
    return whole


def aggregate_table(scores: dict[str, list[np.ndarray]]) -> pd.DataFrame:
    """Interquartile means with 95 % stratified bootstrap intervals."""
    rows = []
    for name, parts in scores.items():
        value, low, high = statistics.interquartile_mean(parts)
        rows.append([name, str(sum(map(len, parts))), f"{value:.3f}", interval(low, high, ".3f")])
    return pd.DataFrame(rows, columns=["variant", "runs", "interquartile mean", "95 % interval"])


def improvement_table(results: Results, steps: Sequence[int]) -> pd.DataFrame:
    """Probability that a run of the first variant has a higher return than one of the second, for every pair and step."""
    rows = []
    longest = results.finished["steps"].max()
    for step in sorted({step for step in steps if step <= longest}):
        scores = returns_at(results, step)
        for name, other in combinations(scores, 2):
            value, low, high = statistics.probability_of_improvement(scores[name], scores[other])
            rows.append([f"{name} over {other}", f"{step:,}", f"{value:.2f}", interval(low, high, ".2f")])
    return pd.DataFrame(rows, columns=["pair", "steps", "probability", "95 % interval"])


def _overview(runs: pd.DataFrame) -> str:
    counts = runs["status"].value_counts().sort_index()
    states = ", ".join(f"{count} {status}" for status, count in counts.items())
    versions = ", ".join(sorted(set(runs["version"]) - {""})) or "unknown"
    note = "Mean ± standard deviation over seeds. † marks runs from a source tree with uncommitted changes."
    return f"{len(runs)} runs: {states}. sb3_actpc {versions}. {note}"


def mean_and_deviation(values: np.ndarray, form: str) -> str:
    """Mean ± sample standard deviation over (n_seeds,); says of how many where not all are defined."""
    known = values[~np.isnan(values)]
    if not len(known):
        return UNDEFINED
    spread = f" ± {known.std(ddof=1):{form}}" if len(known) > 1 else ""
    share = f" ({len(known)} of {len(values)})" if len(known) < len(values) else ""
    return f"{known.mean():{form}}{spread}{share}"


def interval(low: float, high: float, form: str) -> str:
    """A cell with both bounds; empty where they are NaN."""
    return "" if math.isnan(low) else f"{low:{form}} to {high:{form}}"


def markdown(table: pd.DataFrame) -> str:
    """A table in GitHub's Markdown."""
    names = [str(name) for name in table.columns]
    lines = [names, ["---"] * len(names), *table.astype(str).to_numpy().tolist()]
    return "\n".join("| " + " | ".join(text.replace("|", "\\|") for text in line) + " |" for line in lines)
