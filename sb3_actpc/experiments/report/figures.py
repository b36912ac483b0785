"""The figures of a report: at most six learning curves for each task, and a summary over all tasks."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_actpc.experiments.report import statistics
from sb3_actpc.experiments.report.results import Results
from sb3_actpc.experiments.report.statistics import Scores, mean_interval
from sb3_actpc.utils.files import atomic_write

MAX_CURVES = 6
# Okabe and Ito's color-blind safe palette; markers tell curves apart without color
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
MARKERS = ("o", "s", "^", "D", "v", "P")
ALWAYS = "actpc"
N_POINTS = 200  # of a curve over time

Curve = tuple[np.ndarray, np.ndarray]  # x (n,), and y of every seed (n_seeds, n)


def step_curve(results: Results, runs: pd.Index, measure: str) -> Curve:
    """A measure over environment steps, at the steps that all seeds have."""
    rows = results.curves[results.curves["run"].isin(runs)]
    table = rows.pivot(index="timesteps", columns="run", values=measure).dropna()
    return table.index.to_numpy(), table.to_numpy().T


def time_curve(results: Results, runs: pd.Index, measure: str) -> Curve:
    """A measure over seconds of training, evaluations left out, where all seeds have values."""
    rows = results.curves[results.curves["run"].isin(runs)].dropna(subset=[measure])
    rows = rows.assign(trained=rows["seconds"] - rows["evaluation_seconds"])
    seeds = [one[["trained", measure]].to_numpy().T for _, one in rows.groupby("run")]
    start, end = max(seconds[0] for seconds, _ in seeds), min(seconds[-1] for seconds, _ in seeds)
    grid = np.linspace(start, max(start, end), N_POINTS)
    return grid, np.stack([np.interp(grid, *seed) for seed in seeds])


def drawn_labels(groups: Mapping[str, pd.DataFrame], measure: str, chosen: Sequence[str] = ()) -> list[str]:
    """The variants to draw, at most six: the chosen ones, or ActPC and the best of the others by the last evaluation."""
    if chosen:
        return [label for label in chosen if label in groups][:MAX_CURVES]
    best = sorted(groups, key=lambda label: -float(groups[label][measure].mean()))
    first = [label for label in best if label == ALWAYS]
    return [*first, *(label for label in best if label not in first)][:MAX_CURVES]


def draw_curves(results: Results, task: str, path: Path, chosen: Sequence[str] = ()) -> list[str]:
    """Draw means and 95 % intervals over steps and over seconds, and return the variants that are not drawn.

    Equal curves stay visible: each is drawn wider than the equal ones above it, and the markers are staggered.
    """
    groups, measure = results.groups(task), results.measure(task)
    labels = drawn_labels(groups, measure, chosen)
    figure = _figure(11.0, 4.2)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, curve, x_label in zip(
        panels, (step_curve, time_curve), ("environment steps", "seconds of training"), strict=True
    ):
        curves = {label: curve(results, groups[label].index, measure) for label in labels}
        for index, (label, (x, values)) in enumerate(curves.items()):
            if len(x):
                above = list(curves.values())[index + 1 :]
                _band(axes, x, values, label, index, sum(_is_same(values, other) for _, other in above))
        axes.set(xlabel=x_label)
        axes.locator_params(axis="x", nbins=6)
    panels[0].set(ylabel=measure.replace("_", " "))
    figure.suptitle(task)
    figure.legend(*panels[0].get_legend_handles_labels(), fontsize="small", loc="outside right upper")
    _save(figure, path)
    return [label for label in groups if label not in labels]


def draw_summary(scores: Mapping[str, Scores], path: Path) -> None:
    """Interquartile means with 95 % intervals, and performance profiles, of normalized scores."""
    shown = dict(list(scores.items())[:MAX_CURVES])
    figure = _figure(11.0, 4.2)
    bars, profiles = figure.subplots(1, 2)
    everything = np.concatenate([part for parts in shown.values() for part in parts])
    thresholds = np.linspace(min(0.0, everything.min()) - 0.05, max(1.0, everything.max()) + 0.05, 60)
    for index, (name, parts) in enumerate(shown.items()):
        value, low, high = statistics.interquartile_mean(parts)
        bars.barh(index, value, height=0.6, color=COLORS[index], alpha=0.7)
        bars.plot([low, high], [index, index], color="black", linewidth=2)
        share, lower, upper = statistics.performance_profile(parts, thresholds)
        _line(profiles, thresholds, share, name, index, 0)
        profiles.fill_between(thresholds, lower, upper, color=COLORS[index], alpha=0.15, linewidth=0)
    bars.set_yticks(range(len(shown)), list(shown))
    bars.invert_yaxis()
    bars.set(xlabel="interquartile mean of the normalized score")
    profiles.set(xlabel="normalized score", ylabel="fraction of runs above it", ylim=(-0.02, 1.02))
    _save(figure, path)


def _band(axes: Any, x: np.ndarray, values: np.ndarray, label: str, index: int, n_above: int) -> None:
    mean, low, high = mean_interval(values)
    _line(axes, x, mean, label, index, n_above)
    if len(values) > 1:
        axes.fill_between(x, low, high, color=COLORS[index], alpha=0.15, linewidth=0)


def _line(axes: Any, x: np.ndarray, y: np.ndarray, label: str, index: int, n_above: int) -> None:
    stride = max(MAX_CURVES, len(x) // 8)
    style = {"color": COLORS[index], "marker": MARKERS[index], "markevery": (index, stride)}
    axes.plot(x, y, label=label, linewidth=1.5 + 2.5 * n_above, markersize=6, **style)


def _is_same(values: np.ndarray, other: np.ndarray) -> bool:
    return values.shape == other.shape and bool(np.allclose(values.mean(axis=0), other.mean(axis=0)))


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _save(figure: Any, path: Path) -> None:
    with atomic_write(path) as image:
        figure.savefig(image, format="png", dpi=110)
