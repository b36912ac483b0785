"""The report of a comparison: tables, figures and a CSV file made from the folders of its runs, without any training."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sb3_actpc.experiments.comparison.execution import FINISHED
from sb3_actpc.experiments.report import figures
from sb3_actpc.experiments.report.ablations import ablation_blocks
from sb3_actpc.experiments.report.cells import interval, mean_and_deviation, number
from sb3_actpc.experiments.report.document import Block, Heading, Paragraph, Picture, Table, to_html, to_markdown
from sb3_actpc.experiments.report.r_stability import N_EPISODES, WINDOW
from sb3_actpc.experiments.report.references import PaperResult, ReferenceScore, measure_of, paper_results_of, reference_score
from sb3_actpc.experiments.report.results import Group, RunResult, group_runs, load_runs
from sb3_actpc.experiments.report.statistics import (
    Scores,
    interquartile_mean,
    interquartile_mean_interval,
    probability_of_improvement,
    probability_of_improvement_interval,
)
from sb3_actpc.utils.files import atomic_write

REFRESH_ALONE = "refresh_alone"
# one figure of the table per task: heading, key of a run's measures, format
_COLUMNS = (
    ("average return", "average_dense", ".1f"),
    ("R-stability", "r_stability_dense", ".3f"),
    ("average sparse return", "average_sparse", ".1f"),
    ("R-stability, sparse", "r_stability_sparse", ".3f"),
    ("success", "average_success", ".2f"),
    ("S-Dist", "r_stability_success", ".3f"),
    ("evaluation: return", "evaluation_dense", ".1f"),
    ("success", "evaluation_success", ".2f"),
)
_NOTE = (
    f"Average return, sparse return and success are means of the last {WINDOW} training episodes, exploration noise and all; "
    f"R-stability (lower is steadier, 0 is perfect) needs the last {N_EPISODES}; with fewer episodes, or where the best of "
    f"the last {WINDOW} is 0, which the formula divides by, they are undefined; offline methods have no training episodes. "
    "S-Dist is the R-stability of success. The "
    "evaluation is the last one, of the deterministic policy on episodes of its own. Returns are those of the dense task, "
    "which no agent is trained on. Mean ± standard deviation over seeds. The paper's figures (arXiv 2209.09174) are means of "
    "five runs of its own: tasks, demonstrations and steps differ from these."
)


def write_report(folder: Path) -> list[Path]:
    """Write ``report.md``, ``report.html`` (one file, which opens without a network), ``results.csv`` and figures.

    :param folder: of a comparison
    :return: the files
    :raises FileNotFoundError: when there are no runs
    :raises OSError: when a file cannot be written
    """
    runs = load_runs(folder)
    groups = group_runs(runs)
    tasks = list(dict.fromkeys(group.task for group in groups))
    blocks: list[Block] = [Heading(f"Comparison {folder.name}", 1), Paragraph(_overview(runs))]
    for task in tasks:
        blocks += _task_blocks([group for group in groups if group.task == task], task, folder)
    if groups:
        blocks.append(Paragraph(_NOTE))
    blocks += _aggregate_blocks(groups, folder)
    for task in tasks:
        blocks += ablation_blocks([group for group in groups if group.task == task], task, folder)
    blocks += _diagnostic_blocks(groups, folder)
    blocks += _open_run_blocks(runs)
    _write_csv(runs, folder / "results.csv")
    for name, text in (("report.md", to_markdown(blocks)), ("report.html", to_html(blocks, folder))):
        with atomic_write(folder / name, "w") as file:
            file.write(text)
    pictures = [folder / block.file for block in blocks if isinstance(block, Picture)]
    return [folder / "report.md", folder / "report.html", folder / "results.csv", *pictures]


def _overview(runs: Sequence[RunResult]) -> str:
    counts = Counter(run.status for run in runs)
    versions = sorted({str(run.config["versions"]["sb3-actpc"]) for run in runs if "versions" in run.config})
    commits = sorted({str(run.config.get("git_commit") or "an installed package")[:10] for run in runs if run.config})
    steps = sorted({run.config["n_timesteps"] for run in runs if run.config})
    return (
        f"{len(runs)} runs: {', '.join(f'{count} {status}' for status, count in sorted(counts.items()))}. Environment steps: "
        f"{', '.join(f'{count:,}' for count in steps) or 'none'}. sb3_actpc {', '.join(versions) or 'unknown'}, commit "
        f"{', '.join(commits) or 'unknown'}."
    )


# ------------------------------------------------------------------ a task


def _task_blocks(groups: Sequence[Group], task: str, folder: Path) -> list[Block]:
    picture = f"curves_{task}.png"
    figures.draw_curves(groups, task, _drawn_reference(groups, task), folder / picture)
    blocks: list[Block] = [Heading(task), _task_table(groups, task)]
    if any(group.algo == "actpc" for group in groups) and REFRESH_ALONE not in {group.variant for group in groups}:
        blocks.append(Paragraph(f"Refresh alone was not run on this task: --algos {REFRESH_ALONE} does it."))
    name = figures.MEASURE_NAMES[measure_of(task)]
    return [*blocks, Picture(picture, f"{task}: {name} over episodes, steps and time, mean and 95 % interval over seeds")]


def _task_table(groups: Sequence[Group], task: str) -> Table:
    paper = {result.algo or result.algorithm: result for result in paper_results_of(task)}
    score, stability = _paper_header(paper.values())
    header = ["", "seeds", "steps", *(name for name, _, _ in _COLUMNS), f"paper: {score}", f"paper: {stability}"]
    rows, shown = [], set()
    for group in groups:
        values = [mean_and_deviation(group.values(key), form) for _, key, form in _COLUMNS]
        is_papers = group.variant in (group.algo, "actpc_paper")  # not that of a variant with other settings
        shown |= {group.algo} if is_papers else set()
        steps = f"{group.runs[0].config['n_timesteps']:,}"
        rows.append(
            [group.variant, str(len(group.runs)), steps, *values, *_paper_cells(paper.get(group.algo) if is_papers else None)]
        )
    rows += _reference_rows(groups, task)
    empty = [""] * (len(_COLUMNS) + 2)
    rows += [[f"{one.algorithm} (paper only)", *empty, *_paper_cells(one)] for key, one in paper.items() if key not in shown]
    return Table(header, rows)


def _paper_header(results: Iterable[PaperResult]) -> tuple[str, str]:
    is_success = any(result.is_success for result in results)
    return ("success in %", "S-Dist") if is_success else ("average return", "R-stability")


def _paper_cells(result: PaperResult | None) -> list[str]:
    if result is None:
        return ["", ""]
    stability = "" if result.r_stability is None else f"{result.r_stability} ± {result.r_stability_std}"
    return [f"{result.score} ± {result.score_std}", stability]


def _demonstrators_returns(groups: Sequence[Group]) -> list[float]:
    """Mean dense returns, rounded, of the demonstrations that the runs were given: one, unless they differ."""
    returns = np.concatenate([group.values("demonstrators_return") for group in groups])
    return sorted(set(returns[~np.isnan(returns)].round(1)))


def _drawn_reference(groups: Sequence[Group], task: str) -> ReferenceScore | None:
    """The scores that are drawn as lines: the demonstrators' are those of the runs, which may not be the shipped ones."""
    reference, known = reference_score(task), _demonstrators_returns(groups)
    if reference is None or reference.measure != "dense_return" or len(known) != 1:
        return reference
    return replace(reference, demonstrators=known[0])


def _reference_rows(groups: Sequence[Group], task: str) -> list[list[str]]:
    """The demonstrators' and the random actions' scores, in the columns of the evaluation's."""
    known = _demonstrators_returns(groups)
    rows = {"demonstrators": {"evaluation_dense": " or ".join(f"{value:.1f}" for value in known)}} if known else {}
    reference = reference_score(task)
    if reference is not None and reference.measure == "dense_return":
        rows["random actions"] = {"evaluation_dense": f"{reference.random:.1f}"}
    elif reference is not None:
        rows["shipped demonstrators"] = {"evaluation_success": f"{reference.demonstrators:.2f}"}
        rows["random actions"] = {"evaluation_success": f"{reference.random:.2f}"}
    return [[name, "", "", *(cells.get(key, "") for _, key, _ in _COLUMNS), "", ""] for name, cells in rows.items()]


# ------------------------------------------------------------------ across tasks


def _aggregate_blocks(groups: Sequence[Group], folder: Path) -> list[Block]:
    """Statistics over all tasks with reference scores, of the variants that were run on each of them."""
    scored = [group for group in groups if reference_score(group.task) is not None]
    tasks = list(dict.fromkeys(group.task for group in scored))
    by_variant: dict[str, dict[str, np.ndarray]] = {}
    for group in scored:
        by_variant.setdefault(group.variant, {})[group.task] = group.values("normalized")
    whole = {name: [parts[task] for task in tasks] for name, parts in by_variant.items() if len(parts) == len(tasks)}
    if not whole:
        return []
    means = {name: (interquartile_mean(scores), interquartile_mean_interval(scores)) for name, scores in whole.items()}
    figures.draw_aggregates(means, whole, folder / "aggregates.png")
    left_out = sorted(set(by_variant) - set(whole))
    missing = f" Left out, because not run on every one: {', '.join(left_out)}." if left_out else ""
    rows = [
        [name, str(sum(map(len, whole[name]))), number(value, ".3f"), interval(bounds, ".3f")]
        for name, (value, bounds) in means.items()
    ]
    blocks: list[Block] = [
        Heading("Across tasks"),
        Paragraph(
            f"The dense return (of robosuite's tasks, the success) of the last evaluation, normalised so that random actions "
            f"are 0 and the shipped demonstrators 1, over "
            f"{', '.join(tasks)}. Intervals: 95 %, stratified bootstrap, left open for single runs.{missing}"
        ),
        Table(["", "runs", "interquartile mean", "95 % interval"], rows),
        Picture("aggregates.png", "interquartile means and performance profiles"),
    ]
    return [*blocks, *_improvement_blocks(whole)]


def _improvement_blocks(scores: Mapping[str, Scores]) -> list[Block]:
    names = list(scores)
    rows = []
    for index, name in enumerate(names):
        for other in names[index + 1 :]:
            value = probability_of_improvement(scores[name], scores[other])
            bounds = probability_of_improvement_interval(scores[name], scores[other])
            rows.append([f"{name} over {other}", number(value, ".2f"), interval(bounds, ".2f")])
    if not rows:
        return []
    return [Heading("Probability of improvement", 3), Table(["", "probability", "95 % interval"], rows)]


# ------------------------------------------------------------------ inside the agent, and what is missing


def _diagnostic_blocks(groups: Sequence[Group], folder: Path) -> list[Block]:
    own = [group for group in groups if group.algo == "actpc"]
    blocks: list[Block] = [Heading("Inside ActPC")] if own else []
    for task in dict.fromkeys(group.task for group in own):
        picture = f"diagnostics_{task}.png"
        figures.draw_diagnostics([group for group in own if group.task == task], task, folder / picture)
        blocks.append(Picture(picture, f"{task}: signals, energies, action-values, self-imitation memory"))
    return blocks


def _open_run_blocks(runs: Sequence[RunResult]) -> list[Block]:
    rows = []
    for run in runs:
        if run.status != FINISHED:
            rows.append([run.task, run.variant, str(run.seed), run.status, f"{run.timesteps:,}", run.error])
    if not rows:
        return []
    return [Heading("Runs that are not in the tables"), Table(["task", "variant", "seed", "state", "step", "error"], rows)]


def _write_csv(runs: Sequence[RunResult], path: Path) -> None:
    measures = list(runs[0].measures)
    with atomic_write(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["task", "variant", "algo", "seed", "status", "timesteps", "episodes", "settings", *measures])
        for run in runs:
            own = [run.task, run.variant, run.config.get("algo", ""), run.seed, run.status, run.timesteps]
            values = ["" if math.isnan(run.measures[name]) else run.measures[name] for name in measures]
            writer.writerow([*own, len(run.episode_values("episode")), run.content if run.config else "", *values])
