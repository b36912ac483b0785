"""The report of a comparison: tables, figures and a CSV file made from the folders of its runs, without any training."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_actpc.experiments.comparison.execution import FINISHED
from sb3_actpc.experiments.report import figures, statistics
from sb3_actpc.experiments.report.ablations import ablation_sections
from sb3_actpc.experiments.report.figures import MEASURE_NAMES
from sb3_actpc.experiments.report.page import UNDEFINED, Section, interval, mean_and_deviation, number, write_pages
from sb3_actpc.experiments.report.r_stability import N_EPISODES, WINDOW
from sb3_actpc.experiments.report.references import measure_of, paper_results, reference_score
from sb3_actpc.experiments.report.results import Results, load_results, write_runs
from sb3_actpc.utils.files import folder_name

REFRESH_ALONE = "refresh_alone"
LAST, TRAINING, STABILITY, PAPER = "last evaluation", f"last {WINDOW} training episodes", "R-stability", "paper"
# columns of the table per task: heading and name -> column of the results, format
_COLUMNS = {
    (LAST, "return"): ("dense_return", ".1f"),
    (LAST, "sparse return"): ("sparse_return", ".1f"),
    (LAST, "success"): ("success_rate", ".2f"),
    (TRAINING, "return"): ("dense_return_training", ".1f"),
    (TRAINING, "sparse return"): ("sparse_return_training", ".1f"),
    (TRAINING, "success"): ("success_rate_training", ".2f"),
    (STABILITY, "return"): ("dense_return_r_stability", ".3f"),
    (STABILITY, "sparse return"): ("sparse_return_r_stability", ".3f"),
    (STABILITY, "success (S-Dist)"): ("success_rate_r_stability", ".3f"),
}
_NOTE = (
    "The last evaluation is of the deterministic policy on episodes of its own. The training episodes are played with "
    f"exploration noise; their means need {WINDOW} episodes. R-stability (lower is steadier, 0 is perfect) needs "
    f"{N_EPISODES}, and divides by the best of the last {WINDOW}: where there are fewer, or that is 0, {UNDEFINED} stands; a "
    "column in which nothing else would stand is left out. Offline methods have no training episodes. Returns are those of "
    "the dense task, which the agents of a sparse one are not trained on. Mean ± standard deviation over seeds, (n of N) "
    "where not all are defined. "
    "† marks runs from a source tree with uncommitted changes. The paper's figures (arXiv 2209.09174) are means of five runs "
    "of its own: tasks, demonstrations and steps differ from these."
)


def write_report(folder: Path) -> list[Path]:
    """Write ``report.md``, ``report.html`` (one file, which opens without a network), ``results.csv`` and figures into the
    folder of a comparison, or of an export; FileNotFoundError when there are no runs."""
    results = load_results(folder)
    tasks = list(results.finished["task"].unique())
    sections = [Section(f"Comparison {folder.name}", _overview(results.runs), level=1)]
    sections += [_task_section(results, task, folder) for task in tasks]
    if tasks:
        sections.append(Section(text=_NOTE))
    sections += _aggregate_sections(results, folder)
    for task in tasks:
        sections += ablation_sections(results, task, folder)
    for task in tasks:
        sections += _diagnostic_section(results, task, folder)
    missing = results.runs.loc[results.runs["status"] != FINISHED, ["task", "variant", "seed", "status", "steps", "error"]]
    if len(missing):
        sections.append(Section("Runs that are not in the tables", table=missing.astype(str)))
    files = [*write_pages(sections, folder), write_runs(results, folder)]
    return [*files, *(folder / section.picture for section in sections if section.picture)]


def _overview(runs: pd.DataFrame) -> str:
    counts = runs["status"].value_counts().sort_index()
    begun = runs[runs["version"] != ""]
    commits = begun["commit"].replace("", "an installed package")
    return (
        f"{len(runs)} runs: {', '.join(f'{count} {status}' for status, count in counts.items())}. Environment steps: "
        f"{', '.join(f'{count:,}' for count in sorted(begun['planned_steps'].unique())) or 'none'}. sb3_actpc "
        f"{', '.join(sorted(begun['version'].unique())) or 'unknown'}, commit "
        f"{', '.join(sorted(commits.unique())) or 'unknown'}; "
        f"{begun['dirty'].sum()} runs from a source tree with uncommitted changes."
    )


def _task_section(results: Results, task: str, folder: Path) -> Section:
    picture = f"curves_{folder_name(task)}.png"
    figures.draw_curves(results, task, folder / picture)
    text, groups = "", results.groups(task).values()
    variants = {name for runs in groups for name in runs["variant"]}
    if any((runs["algorithm"] == "actpc").any() for runs in groups) and REFRESH_ALONE not in variants:
        text = f"Refresh alone was not run on this task: --algos {REFRESH_ALONE} does it."
    name = MEASURE_NAMES[measure_of(task)]
    caption = f"{task}: {name} over episodes, steps and time, mean and 95 % interval over seeds"
    return Section(task, text, task_table(results, task), picture, caption)


def task_table(results: Results, task: str) -> pd.DataFrame:
    """A row of texts for each group of runs on a task, then the demonstrators, random actions and those of the paper's
    algorithms that were not run; without the columns, of two levels, that no group has a value in."""
    paper = paper_results(task)
    score, stability = ("success in %", "S-Dist") if paper["is_success"].any() else ("average return", "R-stability")
    own = pd.concat(results.groups(task).values())
    own_columns = [key for key, (column, _) in _COLUMNS.items() if own[column].notna().any()]
    columns = [("", "variant"), ("", "seeds"), ("", "steps"), *own_columns, (PAPER, score), (PAPER, stability)]

    def papers(row: pd.Series) -> dict[tuple[str, str], str]:
        known = "" if np.isnan(row.r_stability) else f"{row.r_stability:.3f} ± {row.r_stability_std:.3f}"
        return {(PAPER, score): f"{row.score:.1f} ± {row.score_std:.1f}", (PAPER, stability): known}

    by_algo = {row.algo: row for _, row in paper.iterrows()}
    rows, shown = [], set()
    for label, runs in results.groups(task).items():
        first = runs.iloc[0]
        name = f"{label} †" if runs["dirty"].any() else label
        row = {("", "variant"): name, ("", "seeds"): str(len(runs)), ("", "steps"): f"{first['planned_steps']:,}"}
        for key in own_columns:
            column, form = _COLUMNS[key]
            row[key] = mean_and_deviation(runs[column].to_numpy(), form)
        if first["variant"] in (first["algorithm"], "actpc_paper"):  # not a variant with other settings
            shown.add(first["algorithm"])
            row |= papers(by_algo[first["algorithm"]]) if first["algorithm"] in by_algo else {}
        rows.append(row)
    rows += _reference_rows(results, task)
    only = [row for algo, row in by_algo.items() if algo not in shown]
    rows += [{("", "variant"): f"{row.algorithm} (paper only)", **papers(row)} for row in only]
    table = pd.DataFrame(rows, columns=pd.MultiIndex.from_tuples(columns)).fillna("")
    return table.loc[:, (table != "").any()]


def _reference_rows(results: Results, task: str) -> list[dict[tuple[str, str], str]]:
    """The demonstrators' and the random actions' scores, in the columns of the evaluation's."""
    given, reference = figures.demonstrators_returns(results, task), reference_score(task)
    name, score = ("", "variant"), (LAST, "return")
    rows = [{name: "demonstrators", score: " or ".join(f"{value:.1f}" for value in given)}] if given else []
    if reference is not None and reference.measure == "dense_return":
        rows.append({name: "random actions", score: f"{reference.random:.1f}"})
    elif reference is not None:
        rows.append({name: "shipped demonstrators", (LAST, "success"): f"{reference.demonstrators:.2f}"})
        rows.append({name: "random actions", (LAST, "success"): f"{reference.random:.2f}"})
    return rows


def _aggregate_sections(results: Results, folder: Path) -> list[Section]:
    """Statistics over all tasks with reference scores, of the variants that were run on each of them; a task where nothing
    tells a variant's settings apart counts with each that another task has."""
    scored = results.finished.dropna(subset="normalized")
    tasks = list(scored["task"].unique())
    by_label = {str(label): dict(tuple(runs.groupby("task")["normalized"])) for label, runs in scored.groupby("label")}
    variants = dict(zip(scored["label"], scored["variant"], strict=True))
    joined = {label: {**by_label.get(variants[label], {}), **parts} for label, parts in by_label.items()}
    whole = {label: [parts[task].to_numpy() for task in tasks] for label, parts in joined.items() if len(parts) == len(tasks)}
    if not whole:
        text = f"Left out: none of {', '.join(sorted(by_label))} has runs on all of {', '.join(tasks)}."
        return [Section("Across tasks", text)] if tasks else []
    means = {name: statistics.interquartile_mean(scores) for name, scores in whole.items()}
    figures.draw_aggregates(means, whole, folder / "aggregates.png")
    left_out = sorted(set(by_label) - set(whole) - {variants[label] for label in whole})
    missing = f" Left out, because not every task has runs of that name: {', '.join(left_out)}." if left_out else ""
    if any(label != variants[label] in by_label for label in whole):
        missing += " Where brackets tell a variant's settings apart, its runs on tasks with one kind of them count with each."
    text = (
        "The dense return (of robosuite's tasks, the success) of the last evaluation, normalised so that random actions are 0 "
        f"and the shipped demonstrators 1, over {', '.join(tasks)}. Intervals: 95 %, stratified bootstrap, left open for "
        f"single runs.{missing}"
    )
    rows = [
        (name, str(sum(map(len, whole[name]))), number(value, ".3f"), interval(bounds, ".3f"))
        for name, (value, *bounds) in means.items()
    ]
    table = pd.DataFrame(rows, columns=["variant", "runs", "interquartile mean", "95 % interval"])
    caption = "interquartile means and performance profiles"
    pairs = []
    for name, other in combinations(whole, 2):
        value, *bounds = statistics.probability_of_improvement(whole[name], whole[other])
        pairs.append((f"{name} over {other}", number(value, ".2f"), interval(bounds, ".2f")))
    improvement = pd.DataFrame(pairs, columns=["pair", "probability", "95 % interval"])
    sections = [Section("Across tasks", text, table, "aggregates.png", caption)]
    return sections + ([Section("Probability of improvement", table=improvement, level=3)] if pairs else [])


def _diagnostic_section(results: Results, task: str, folder: Path) -> list[Section]:
    own = {label: runs for label, runs in results.groups(task).items() if (runs["algorithm"] == "actpc").all()}
    picture = f"diagnostics_{folder_name(task)}.png"
    if not own or not figures.draw_diagnostics(results, own, task, folder / picture):
        return []
    caption = f"{task}: signals, energies, action-values, self-imitation memory"
    return [Section(f"Inside ActPC: {task}", picture=picture, caption=caption)]
