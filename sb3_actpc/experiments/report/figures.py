"""The figures of a report: curves with 95 % intervals, profiles, bars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np

from sb3_actpc.experiments.report.r_stability import WINDOW, smooth
from sb3_actpc.experiments.report.references import ReferenceScore, measure_of
from sb3_actpc.experiments.report.results import Group
from sb3_actpc.experiments.report.statistics import (
    Interval,
    Scores,
    mean_interval,
    performance_profile,
    performance_profile_interval,
)
from sb3_actpc.utils.files import atomic_write

_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999999", "#7f3c8d", "#a5aa99")
# what ActPC logs about itself: panel -> columns of diagnostics.csv
DIAGNOSTIC_PANELS = {
    "signals": ("train/epistemic_signal", "train/instrumental_signal"),
    "energies": ("train/actor_energy", "train/critic_energy", "train/generator_energy", "train/prior_energy"),
    "action-value": ("train/action_value",),
    "self-imitation memory (transitions)": ("train/self_imitation_size",),
}
_STYLES = ("-", "--", ":", "-.")
MEASURE_NAMES = {"dense_return": "dense return", "success_rate": "success"}
_IN_EPISODES = {"dense_return": "dense_return", "success_rate": "success"}  # column of progress.csv -> of episodes.csv
N_POINTS = 200  # of a curve over time

Curve = tuple[np.ndarray, np.ndarray]  # x (n,), and y of every seed (n_seeds, n)


def episode_curve(group: Group, measure: str = "dense_return") -> Curve:
    """Dense returns (or successes) in training, smoothed over 100 episodes, of as many episodes as all seeds have."""
    column = _IN_EPISODES[measure]
    values = group.column(lambda run: smooth(run.episode_values(column)))
    return np.arange(1, values.shape[1] + 1), values


def step_curve(group: Group, measure: str = "dense_return") -> Curve:
    """A measure of the evaluations over environment steps, where all seeds have one."""
    steps = reduce(np.intersect1d, [run.progress["timesteps"] for run in group.runs])
    return steps, np.stack([run.progress[measure][np.isin(run.progress["timesteps"], steps)] for run in group.runs])


def time_curve(group: Group, measure: str = "dense_return") -> Curve:
    """
    A measure of the evaluations over the seconds of training (evaluations left out), from the last seed's first evaluation
    until the first seed ends.
    """
    seconds = [run.progress["seconds"] - run.progress["evaluation_seconds"] for run in group.runs]
    grid = np.linspace(max(one[0] for one in seconds), min(one[-1] for one in seconds), N_POINTS)
    values = [np.interp(grid, one, run.progress[measure]) for one, run in zip(seconds, group.runs, strict=True)]
    return grid, np.stack(values)


def axis_limits(heights: Sequence[float]) -> tuple[float, float]:
    """Limits that hold every height with a margin of 5 %.

    The intervals of two or three seeds reach much farther, and would flatten the curves: they may leave the picture.

    :param heights: (n,) what must be seen; with none, 0 and 1
    :return: lower and upper limit
    """
    low, high = min(heights, default=0.0), max(heights, default=1.0)
    margin = 0.05 * (high - low or 1.0)
    return low - margin, high + margin


def draw_curves(groups: Sequence[Group], task: str, reference: ReferenceScore | None, path: Path) -> None:
    """Returns (or success, by the task's measure) over episodes, over steps and over time.

    :param groups: of one task
    :param task: its name
    :param reference: its measure is drawn, and its scores as lines; None for dense returns without lines
    :param path: PNG file to write
    """
    figure = _figure(15.0, 4.5)
    measure = measure_of(task)
    name = MEASURE_NAMES[measure]
    panels = (
        (episode_curve, "episodes", f"{name} in training, mean of {WINDOW} episodes"),
        (step_curve, "environment steps", f"{name} in evaluation"),
        (time_curve, "seconds of training", f"{name} in evaluation"),
    )
    for axes, (curve, x_label, y_label) in zip(figure.subplots(1, 3), panels, strict=True):
        heights = [] if reference is None else [reference.demonstrators, reference.random]
        for index, group in enumerate(groups):
            x, values = curve(group, measure)
            if len(x):
                _band(axes, x, values, group.variant, index)
                heights += [float(values.min()), float(values.max())]
        if reference is not None:
            axes.axhline(reference.demonstrators, color="black", linestyle="--", linewidth=1, label="demonstrators")
            axes.axhline(reference.random, color="black", linestyle=":", linewidth=1, label="random")
        axes.set(xlabel=x_label, ylabel=y_label, ylim=axis_limits([0.0, 1.0] if measure == "success_rate" else heights))
    axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.suptitle(task)
    _save(figure, path)


def draw_aggregates(intervals: Mapping[str, tuple[float, Interval]], scores: Mapping[str, Scores], path: Path) -> None:
    """Interquartile means with their intervals, and performance profiles.

    :param intervals: variant -> interquartile mean and its interval
    :param scores: variant -> normalised scores of each task
    :param path: PNG file to write
    """
    figure = _figure(12.0, 4.5)
    bars, profiles = figure.subplots(1, 2)
    _bars(bars, {name: (value, *interval) for name, (value, interval) in intervals.items()})
    bars.set(xlabel="interquartile mean of the normalised score")
    everything = np.concatenate([part for parts in scores.values() for part in parts])
    thresholds = np.linspace(min(0.0, everything.min()) - 0.05, max(1.0, everything.max()) + 0.05, 60)
    for index, (name, parts) in enumerate(scores.items()):
        color = _COLORS[index % len(_COLORS)]
        profiles.plot(thresholds, performance_profile(parts, thresholds), color=color, label=name)
        low, high = performance_profile_interval(parts, thresholds)
        profiles.fill_between(thresholds, low, high, color=color, alpha=0.15, linewidth=0)
    profiles.set(xlabel="normalised score τ", ylabel="share of runs with a score above τ", ylim=(-0.02, 1.02))
    profiles.legend(fontsize="small")
    _save(figure, path)


def draw_ablation(groups: Sequence[Group], labels: Sequence[str], measure: str, title: str, path: Path) -> None:
    """A bar for every ablation.

    :param groups: of one task, the base first
    :param labels: of each
    :param measure: column of ``progress.csv``
    :param title: of the figure
    :param path: PNG file to write
    """
    figure = _figure(8.0, 1.2 + 0.4 * len(groups))
    axes = figure.subplots()
    bars = {}
    for group, label in zip(groups, labels, strict=True):
        mean, low, high = (float(one) for one in mean_interval(group.last(measure)))
        bars[label] = (mean, low, high)
    _bars(axes, bars)
    axes.axvline(next(iter(bars.values()))[0], color="black", linestyle="--", linewidth=1)
    axes.set(title=title, xlabel=f"{MEASURE_NAMES[measure]} of the last evaluation, mean and 95 % interval over seeds")
    _save(figure, path)


def draw_diagnostics(groups: Sequence[Group], task: str, path: Path) -> None:
    """What ActPC logged about itself, a line for every run.

    :param groups: of one task, with diagnostics
    :param task: its name
    :param path: PNG file to write
    """
    figure = _figure(16.0, 4.0)
    for axes, (title, columns) in zip(figure.subplots(1, len(DIAGNOSTIC_PANELS)), DIAGNOSTIC_PANELS.items(), strict=True):
        for index, group in enumerate(groups):
            for style, column in zip(_STYLES, columns, strict=False):
                _draw_logged(axes, group, column, _COLORS[index % len(_COLORS)], style)
        axes.set(title=title, xlabel="environment steps", yscale="log" if title == "energies" else "linear")
        if axes.has_data():
            axes.legend(fontsize="x-small")
    figure.suptitle(task)
    _save(figure, path)


def _draw_logged(axes: Any, group: Group, column: str, color: str, style: str) -> None:
    label = f"{group.variant}: {column.removeprefix('train/')}"
    for run in group.runs:
        steps, values = run.diagnostics.get("time/total_timesteps"), run.diagnostics.get(column)
        if steps is None or values is None:
            continue
        known = ~np.isnan(values)
        axes.plot(steps[known], values[known], color=color, linestyle=style, linewidth=1, label=label)
        label = "_"  # the other seeds have no entry of their own


def _figure(width: float, height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _band(axes: Any, x: np.ndarray, values: np.ndarray, label: str, index: int) -> None:
    mean, low, high = mean_interval(values)
    color = _COLORS[index % len(_COLORS)]
    style = _STYLES[index // len(_COLORS) % len(_STYLES)]
    axes.plot(x, mean, color=color, linestyle=style, label=label, marker="o" if len(set(x)) == 1 else None)
    if len(values) > 1:
        axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)


def _bars(axes: Any, bars: Mapping[str, tuple[float, float, float]]) -> None:
    """Horizontal bars, the first at the top: value, lower and upper bound (NaN for none)."""
    for index, (value, low, high) in enumerate(bars.values()):
        axes.barh(index, value, height=0.6, color=_COLORS[index % len(_COLORS)], alpha=0.7)
        if not np.isnan(low):
            axes.plot([low, high], [index, index], color="black", linewidth=2)
    axes.set_yticks(range(len(bars)), list(bars))
    axes.set_ylim(len(bars) - 0.5, -0.5)


def _save(figure: Any, path: Path) -> None:
    with atomic_write(path) as image:
        figure.savefig(image, format="png", dpi=110)
