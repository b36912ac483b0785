"""The figures of a report: curves with 95 % intervals, profiles, bars. Every legend stands beside the axes or below them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_actpc.experiments.report import statistics
from sb3_actpc.experiments.report.r_stability import WINDOW, smooth
from sb3_actpc.experiments.report.references import measure_of, reference_score
from sb3_actpc.experiments.report.results import MEASURES, Results, side_by_side
from sb3_actpc.experiments.report.statistics import Estimate, Scores, mean_interval
from sb3_actpc.utils.files import atomic_write

_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999999", "#7f3c8d", "#a5aa99")
_STYLES = ("-", "--", ":", "-.")
# what ActPC logs about itself: panel -> columns of diagnostics.csv
DIAGNOSTIC_PANELS = {
    "signals": ("train/epistemic_signal", "train/instrumental_signal"),
    "energies": ("train/actor_energy", "train/critic_energy", "train/generator_energy", "train/prior_energy"),
    "action-value": ("train/action_value",),
    "self-imitation memory (transitions)": ("train/self_imitation_size",),
}
MEASURE_NAMES = {"dense_return": "dense return", "success_rate": "success"}
N_POINTS = 200  # of a curve over time

Curve = tuple[np.ndarray, np.ndarray]  # x (n,), and y of every seed (n_seeds, n)


def episode_curve(results: Results, runs: pd.Index, measure: str = "dense_return") -> Curve:
    """A measure in training, smoothed over 100 episodes, of as many episodes as all seeds have."""
    values = side_by_side(results.episodes, runs, "episode", MEASURES[measure])
    return values.index.to_numpy(), smooth(values.to_numpy()).T


def step_curve(results: Results, runs: pd.Index, measure: str = "dense_return") -> Curve:
    """A measure of the evaluations over environment steps, where all seeds have one."""
    values = side_by_side(results.evaluations, runs, "timesteps", measure)
    return values.index.to_numpy(), values.to_numpy().T


def time_curve(results: Results, runs: pd.Index, measure: str = "dense_return") -> Curve:
    """A measure of the evaluations over the seconds of training (evaluations left out), from the last seed's first evaluation
    until the first seed ends.
    """
    rows = results.evaluations[results.evaluations["run"].isin(runs)]
    rows = rows.assign(trained=rows["seconds"] - rows["evaluation_seconds"])
    seeds = [one[["trained", measure]].to_numpy().T for _, one in rows.groupby("run")]
    grid = np.linspace(max(seconds[0] for seconds, _ in seeds), min(seconds[-1] for seconds, _ in seeds), N_POINTS)
    return grid, np.stack([np.interp(grid, *seed) for seed in seeds])


def axis_limits(heights: Sequence[float]) -> tuple[float, float]:
    """Limits that hold every height with a margin of 5 %; with none, of 0 and 1. The intervals of two or three seeds reach
    much farther, and would flatten the curves: they may leave the picture."""
    low, high = min(heights, default=0.0), max(heights, default=1.0)
    margin = 0.05 * (high - low or 1.0)
    return low - margin, high + margin


def draw_curves(results: Results, task: str, path: Path) -> None:
    """Returns (or success, by the task's measure) over episodes where they are kept, over steps and over time."""
    groups, measure = results.groups(task), measure_of(task)
    lines = reference_lines(results, task)
    order = sorted(results.finished["label"].unique())  # a variant looks the same on every task
    panels: list[Any] = [(step_curve, "environment steps", "evaluation"), (time_curve, "seconds of training", "evaluation")]
    if len(results.episodes):
        panels.insert(0, (episode_curve, "episodes", f"training, mean of {WINDOW} episodes"))
    figure = _figure(5.0 * len(panels), 4.2)
    for axes, (curve, x_label, where) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        heights = [*lines.values()]
        for label, runs in groups.items():
            x, values = curve(results, runs.index, measure)
            if len(x):
                _band(axes, x, values, label, order.index(label))
                heights += [float(values.min()), float(values.max())]
        for style, (label, height) in zip(("--", ":"), lines.items(), strict=False):
            axes.axhline(height, color="black", linestyle=style, linewidth=1, label=label)
        limits = axis_limits([0.0, 1.0] if measure == "success_rate" else heights)
        axes.set(xlabel=x_label, ylabel=f"{MEASURE_NAMES[measure]} in {where}", ylim=limits)
        axes.locator_params(axis="x", nbins=6)
    figure.suptitle(task)
    _legend(figure)
    _save(figure, path)


def reference_lines(results: Results, task: str) -> dict[str, float]:
    """The scores of demonstrators and random actions in the task's measure; of dense returns the demonstrators' are those
    that the runs were given, which may not be the shipped ones; empty where none are known."""
    reference = reference_score(task)
    if reference is None:
        return {}
    given = demonstrators_returns(results, task)
    own = reference.measure == "dense_return" and len(given) == 1
    return {"demonstrators": given[0] if own else reference.demonstrators, "random actions": reference.random}


def demonstrators_returns(results: Results, task: str) -> list[float]:
    """Mean dense returns, rounded, of the demonstrations that a task's finished runs were given: one, unless they differ."""
    finished = results.finished
    return sorted(finished.loc[finished["task"] == task, "demonstrators_return"].dropna().round(1).unique())


def draw_aggregates(means: Mapping[str, Estimate], scores: Mapping[str, Scores], path: Path) -> None:
    """Interquartile means with their intervals, and performance profiles of the normalised scores of each task, by variant."""
    figure = _figure(12.0, max(4.0, 1.0 + 0.35 * len(scores)))
    bars, profiles = figure.subplots(1, 2)
    _bars(bars, means)
    bars.set(xlabel="interquartile mean of the normalised score")
    everything = np.concatenate([part for parts in scores.values() for part in parts])
    thresholds = np.linspace(min(0.0, everything.min()) - 0.05, max(1.0, everything.max()) + 0.05, 60)
    for index, (name, parts) in enumerate(scores.items()):
        look = _look(index)
        profile, low, high = statistics.performance_profile(parts, thresholds)
        profiles.plot(thresholds, profile, label=name, **look)
        profiles.fill_between(thresholds, low, high, color=look["color"], alpha=0.15, linewidth=0)
    profiles.set(xlabel="normalised score τ", ylabel="share of runs with a score above τ", ylim=(-0.02, 1.02))
    _legend(figure)
    _save(figure, path)


def draw_ablation(values: Mapping[str, np.ndarray], measure: str, title: str, path: Path) -> None:
    """A bar for every ablation: label -> (n_seeds,) the last evaluation of each seed, the base first."""
    figure = _figure(9.0, 1.2 + 0.4 * len(values))
    axes = figure.subplots()
    bars = {label: tuple(map(float, mean_interval(seeds))) for label, seeds in values.items()}
    _bars(axes, bars)  # type: ignore[arg-type]
    base, (height, *_) = next(iter(bars.items()))
    axes.axvline(height, color="black", linestyle="--", linewidth=1, label=f"mean of {base}")
    axes.set(title=title, xlabel=f"{MEASURE_NAMES[measure]} of the last evaluation, mean and 95 % interval over seeds")
    _legend(figure)
    _save(figure, path)


def draw_diagnostics(results: Results, groups: Mapping[str, pd.DataFrame], task: str, path: Path) -> bool:
    """What ActPC logged about itself: a panel for each kind of quantity, a colour for each variant (label -> runs of one
    task), a line for every run. Without anything to draw no file is written, and the answer is False."""
    rows = results.diagnostics[results.diagnostics["run"].isin(pd.concat(groups.values()).index)]
    logged = set(rows.columns[rows.notna().any()])
    panels = {title: [one for one in columns if one in logged] for title, columns in DIAGNOSTIC_PANELS.items()}
    panels = {title: columns for title, columns in panels.items() if columns}
    if not panels:
        return False
    figure = _figure(4.2 * len(panels) + 1.5, 4.2)
    for axes, (title, columns) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        for index, (label, runs) in enumerate(groups.items()):
            for style, column in zip(_STYLES, columns, strict=False):
                for run in runs.index:
                    one = rows.loc[rows["run"] == run, ["time/total_timesteps", column]].dropna().to_numpy()
                    axes.plot(*one.T, color=_look(index)["color"], linestyle=style, linewidth=1, label=label)
        axes.set(title=title, xlabel="environment steps", yscale="log" if title == "energies" else "linear")
        if len(columns) > 1:  # what the styles mean, under the panel; the colours are in the figure's legend
            words = [
                one.removeprefix("train/").replace("_", " ").removesuffix(" energy").removesuffix(" signal") for one in columns
            ]
            named = zip(_STYLES, words, strict=False)
            handles = [axes.plot([], [], color="gray", linestyle=style, label=label)[0] for style, label in named]
            axes.legend(handles=handles, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    figure.suptitle(task)
    _legend(figure, groups)
    _save(figure, path)
    return True


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _look(index: int) -> dict[str, str]:
    return {"color": _COLORS[index % len(_COLORS)], "linestyle": _STYLES[index // len(_COLORS) % len(_STYLES)]}


def _band(axes: Any, x: np.ndarray, values: np.ndarray, label: str, index: int) -> None:
    mean, low, high = mean_interval(values)
    axes.plot(x, mean, label=label, marker="o" if len(set(x)) == 1 else None, **_look(index))
    if len(values) > 1:
        axes.fill_between(x, low, high, color=_look(index)["color"], alpha=0.15, linewidth=0)


def _bars(axes: Any, bars: Mapping[str, Estimate]) -> None:
    """Horizontal bars, the first at the top: value, lower and upper bound (NaN for none)."""
    for index, (value, low, high) in enumerate(bars.values()):
        axes.barh(index, value, height=0.6, color=_COLORS[index % len(_COLORS)], alpha=0.7)
        if not np.isnan(low):
            axes.plot([low, high], [index, index], color="black", linewidth=2)
    axes.set_yticks(range(len(bars)), list(bars))
    axes.set_ylim(len(bars) - 0.5, -0.5)


def _legend(figure: Any, names: Mapping[str, Any] | None = None) -> None:
    """One legend to the right of all axes, each label once; only ``names`` where they are given."""
    kept: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            if names is None or label in names:
                kept.setdefault(label, handle)
    if kept:
        figure.legend(kept.values(), kept.keys(), fontsize="small", loc="outside right upper")


def _save(figure: Any, path: Path) -> None:
    with atomic_write(path) as image:
        figure.savefig(image, format="png", dpi=110)
