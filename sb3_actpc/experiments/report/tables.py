"""``report.md``: tables from ``results.csv``, and figures: learning curves of each task, and a summary over all of them."""

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from sb3_actpc.experiments.report import statistics
from sb3_actpc.experiments.report.results import MEASURES, Results, load_results, reference_score, write_results
from sb3_actpc.experiments.report.statistics import Scores
from sb3_actpc.experiments.runs.evaluation import OF_ACTOR
from sb3_actpc.utils.files import atomic_write, folder_name

CHOSEN_STEPS = (10_000, 25_000, 50_000)
# column of the deployed policy and of the actor's moving average -> what is added to the variant's name
RETURNS = {"return": "", OF_ACTOR["return"]: ", moving average"}
SUCCESSES = {"success": "", OF_ACTOR["success"]: ", moving average"}
UNDEFINED = "n/a"
# Okabe and Ito's color-blind safe palette; markers tell curves apart without color
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def write_report(folder: Path, target: Path | None = None, steps: Sequence[int] = CHOSEN_STEPS) -> list[Path]:
    """Write ``results.csv``, ``curves.csv.gz``, ``report.md`` and the figures of a comparison's folder, or of one that holds
    its two CSV files, into the target, by default the same. The tables show the evaluations at the environment steps given.
    FileNotFoundError when there are no runs."""
    target = folder if target is None else target
    results = load_results(folder)
    files = write_results(results, target)
    text = [f"# Comparison {folder.name}\n\n{_overview(results.runs)}"]
    for task in results.finished["task"].unique():
        picture = target / f"curves_{folder_name(task)}.png"
        draw_curves(results, task, picture)
        files.append(picture)
        text.append(f"## {task}\n\n![{task}]({picture.name})")
        for measure, table in task_tables(results, task, steps).items():
            text.append(f"### {measure.replace('_', ' ').capitalize()}\n\n{markdown(table)}")
    scores = _on_every_task(results.finished, "normalized")
    if scores:
        draw_summary(scores, target / "summary.png")
        files.append(target / "summary.png")
        text.append(f"## Across tasks\n\n{markdown(_aggregate_table(scores))}\n\n![Across tasks](summary.png)")
    if partial := sorted(set(results.finished.dropna(subset="normalized")["label"]) - scores.keys()):
        text.append(f"Not compared across tasks, since they did not run on all: {', '.join(partial)}.")
    improvement = improvement_table(results, steps)
    if not improvement.empty:
        text.append(f"## Probability of improvement\n\nOf the return on a task drawn at random.\n\n{markdown(improvement)}")
    missing = results.runs.loc[results.runs["status"] != "finished", ["task", "variant", "seed", "status", "steps", "error"]]
    if not missing.empty:
        text.append(f"## Runs that are not in the tables\n\n{markdown(missing)}")
    with atomic_write(target / "report.md", "w") as file:
        file.write("\n\n".join(text) + "\n")
    return [*files, target / "report.md"]


def task_tables(results: Results, task: str, steps: Sequence[int]) -> dict[str, pd.DataFrame]:
    """Measure -> a row for each variant, mean ± standard deviation over seeds; then the runs and their seconds."""
    groups = results.groups(task)
    tables = {}
    for measure in MEASURES:
        columns = {"last": measure, "area": f"{measure}_area", "worst after 5,000": f"{measure}_worst"}
        form = ".2f" if measure.endswith("success") else ".1f"
        rows = []
        for label, runs in groups.items():
            values = {f"at {step:,}": results.at_step(runs, measure, step) for step in steps}
            values |= {title: runs[column] for title, column in columns.items()}
            cells = {title: mean_and_deviation(own.to_numpy(), form) for title, own in values.items()}
            if any(cell != UNDEFINED for cell in cells.values()):
                rows.append({"variant": label, **cells})
        if rows:
            table = pd.DataFrame(rows)
            tables[measure] = table.loc[:, (table != UNDEFINED).any()]
    tables["runs"] = pd.DataFrame(
        {
            "variant": f"{label} †" if runs["dirty"].any() else label,
            "seeds": str(len(runs)),
            "evaluation episodes": ", ".join(str(n) for n in sorted(runs["eval_episodes"].unique())),
            "seconds": mean_and_deviation(runs["seconds"].to_numpy(), ".0f"),
        }
        for label, runs in groups.items()
    )
    return tables


def _on_every_task(runs: pd.DataFrame, column: str) -> dict[str, list[np.ndarray]]:
    """Variant -> its scores, (n_runs,) for each task; only variants that have runs on every scored task."""
    scored = runs.dropna(subset=[column])
    tasks = sorted(scored["task"].unique())
    own = {str(label): rows for label, rows in scored.groupby("label") if rows["task"].nunique() == len(tasks)}
    return {label: [rows.loc[rows["task"] == task, column].to_numpy() for task in tasks] for label, rows in own.items()}


def _aggregate_table(scores: dict[str, list[np.ndarray]]) -> pd.DataFrame:
    """Interquartile means with 95 % stratified bootstrap intervals."""
    rows = []
    for name, parts in scores.items():
        value, low, high = statistics.interquartile_mean(parts)
        rows.append([name, str(sum(map(len, parts))), f"{value:.3f}", interval(low, high, ".3f")])
    return pd.DataFrame(rows, columns=["variant", "runs", "interquartile mean", "95 % interval"])


def improvement_table(results: Results, steps: Sequence[int]) -> pd.DataFrame:
    """Probability that a run of the first variant has a higher return than one of the second on a task drawn at random, for
    every pair and step; a run that ended before counts with its last evaluation."""
    runs = results.finished
    rows = []
    for step in sorted({step for step in steps if step <= runs["steps"].max()}):
        parts = []
        for measure, policy in RETURNS.items():
            ended = runs[measure].where(runs["steps"] < step)
            at_step = results.at_step(runs, measure, step).fillna(ended)
            parts.append(runs.assign(at_step=at_step, label=runs["label"] + policy))
        scores = _on_every_task(pd.concat(parts), "at_step")
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


# ---------------------------------------------------------------------- figures


def draw_curves(results: Results, task: str, path: Path) -> None:
    """Draw mean returns (on robosuite tasks successes) and 95 % intervals over environment steps, at the steps that all seeds
    of a variant have: deployed policies solid, moving averages dashed, variants with a single evaluation dotted."""
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    axes = figure.subplots()
    reference = reference_score(results.runs.loc[results.runs["task"] == task, "env"].iloc[0])
    is_success = reference is not None and reference.measure == "success"
    shown = SUCCESSES if is_success else RETURNS
    values: list[float] = []
    for index, (label, runs) in enumerate(results.groups(task).items()):
        rows = results.curves[results.curves["run"].isin(runs.index)]
        for measure, policy in shown.items():
            curves = rows.reindex(columns=["run", "timesteps", measure])
            table = curves.pivot(index="timesteps", columns="run", values=measure).dropna()
            values.extend(table.to_numpy().ravel())
            if len(table) == 1:
                axes.axhline(table.to_numpy().mean(), label=label + policy, color=COLORS[index % len(COLORS)], linestyle=":")
            elif len(table):
                band = statistics.mean_interval(table.to_numpy().T)
                _band(axes, table.index.to_numpy(), band, label + policy, index, "--" if policy else "-")
    if values:  # intervals of few seeds reach far beyond all runs
        margin = 0.05 * (max(values) - min(values)) or 1.0
        axes.set_ylim(min(values) - margin, max(values) + margin)
    axes.set(title=task, xlabel="environment steps", ylabel="success" if is_success else "return")
    figure.legend(fontsize="small", loc="outside right upper")
    _save(figure, path)


def draw_summary(scores: Mapping[str, Scores], path: Path) -> None:
    """Interquartile means with 95 % intervals, and performance profiles, of normalized scores."""
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    bars, profiles = figure.subplots(1, 2)
    everything = np.concatenate([part for parts in scores.values() for part in parts])
    thresholds = np.linspace(min(0.0, everything.min()) - 0.05, max(1.0, everything.max()) + 0.05, 60)
    for index, (name, parts) in enumerate(scores.items()):
        value, low, high = statistics.interquartile_mean(parts)
        bars.barh(index, value, height=0.6, color=COLORS[index % len(COLORS)], alpha=0.7)
        bars.plot([low, high], [index, index], color="black", linewidth=2)
        _band(profiles, thresholds, statistics.performance_profile(parts, thresholds), name, index)
    bars.set_yticks(range(len(scores)), list(scores))
    bars.invert_yaxis()
    bars.set(xlabel="interquartile mean of the normalized score")
    profiles.set(xlabel="normalized score", ylabel="fraction of runs above it", ylim=(-0.02, 1.02))
    _save(figure, path)


def _band(axes: Any, x: np.ndarray, values: Any, label: str, index: int, line: str = "-") -> None:
    """A line, and the band between two others around it: (3, n)."""
    color = COLORS[index % len(COLORS)]
    marker = MARKERS[index % len(MARKERS)]
    axes.plot(x, values[0], label=label, color=color, marker=marker, markevery=max(1, len(x) // 8), linestyle=line)
    axes.fill_between(x, values[1], values[2], color=color, alpha=0.15, linewidth=0)


def _save(figure: Figure, path: Path) -> None:
    with atomic_write(path) as image:
        figure.savefig(image, format="png", dpi=110)
