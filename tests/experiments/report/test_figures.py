"""What the figures are drawn from, and that nothing in them is hidden or unnamed."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes

from sb3_actpc.experiments.report import figures
from sb3_actpc.experiments.report.figures import (
    Curve,
    axis_limits,
    draw_ablation,
    draw_aggregates,
    draw_curves,
    draw_diagnostics,
    episode_curve,
    step_curve,
    time_curve,
)
from sb3_actpc.experiments.report.references import reference_score
from sb3_actpc.experiments.report.results import Results, load_results
from tests.experiments.report.folders import HOPPER, REACHER, write_run


def curve_of(function: Any, folder: Path, *measure: str, task: str = HOPPER) -> Curve:
    """Of the only group in a folder."""
    results = load_results(folder)
    [runs] = results.groups(task).values()
    curve: Curve = function(results, runs.index, *measure)
    return curve


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The figures that would be saved."""
    kept: list[Any] = []
    monkeypatch.setattr(figures, "_save", lambda figure, path: kept.append(figure))
    return kept


def test_curves_are_those_of_the_files(tmp_path: Path) -> None:
    write_run(tmp_path, seed=0, returns=[1.0, 3.0, 5.0], final=100.0)
    write_run(tmp_path, seed=1, returns=[2.0, 2.0], final=300.0)
    x, values = curve_of(episode_curve, tmp_path)
    assert x.tolist() == [1, 2] and values.tolist() == [[1.0, 2.0], [2.0, 2.0]]  # as many episodes as both have
    x, values = curve_of(step_curve, tmp_path)
    assert x.tolist() == [0, 500, 1000] and values.tolist() == [[0, 50, 100], [0, 150, 300]]
    x, values = curve_of(time_curve, tmp_path)
    assert (x[0], x[-1]) == (0.0, 10.0) and np.allclose(values[:, -1], [100.0, 300.0])  # 12 seconds, 2 of evaluation


def test_curves_of_success(tmp_path: Path) -> None:
    write_run(tmp_path, "SparseLift-v0", returns=[5.0] * 120)
    assert curve_of(step_curve, tmp_path, "success_rate", task="SparseLift-v0")[1].tolist() == [[0.0, 0.5, 1.0]]
    assert curve_of(episode_curve, tmp_path, "success_rate", task="SparseLift-v0")[1][0, -1] == 0.5


def test_curves_of_runs_without_an_evaluation_at_the_start(tmp_path: Path) -> None:
    """An offline method's: nothing is drawn before the first evaluation, and only steps that all seeds have."""
    for seed in range(2):
        path = write_run(tmp_path, seed=seed, final=100.0) / "progress.csv"
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        path.write_text("".join([lines[0], *lines[2 + seed :]]), encoding="utf-8")
    x, values = curve_of(step_curve, tmp_path)
    assert x.tolist() == [1000] and values.tolist() == [[100.0], [100.0]]
    x, values = curve_of(time_curve, tmp_path)
    assert x[0] == x[-1] == 10.0 and (values == 100.0).all()


def test_the_line_of_the_demonstrators_is_that_of_the_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They need not be the shipped ones."""
    heights: list[float] = []
    monkeypatch.setattr(Axes, "axhline", lambda axes, y, **keywords: heights.append(y))
    write_run(tmp_path, returns=[1.0])
    draw_curves(load_results(tmp_path), HOPPER, tmp_path / "curves.png")
    score = reference_score(HOPPER)
    assert score is not None and score.demonstrators != 2000.0
    assert heights == [2000.0, score.random] * 3


def test_axes_hold_every_seed_with_a_margin_of_five_percent() -> None:
    assert axis_limits([-100.0, 40.0, 300.0]) == pytest.approx((-120.0, 320.0))
    assert axis_limits([7.0]) == pytest.approx((6.95, 7.05))  # one value is still a picture
    assert axis_limits([]) == pytest.approx((-0.05, 1.05))


@pytest.mark.parametrize(("task", "height"), [("Other-v0", 3000.0), ("SparseLift-v0", 1.0)])
def test_an_axis_is_not_stretched_by_the_interval_of_two_seeds(
    tmp_path: Path, drawn: list[Any], task: str, height: float
) -> None:
    """The 95 % interval of two seeds at 0 and 3000 reaches from -17,559 to 20,559; of success, nothing is beyond 0 and 1."""
    write_run(tmp_path, task, seed=0, final=0.0)
    write_run(tmp_path, task, seed=1, final=3000.0)
    draw_curves(load_results(tmp_path), task, tmp_path / "curves.png")
    assert [axes.get_ylim() for axes in drawn[0].axes] == [pytest.approx((-0.05 * height, 1.05 * height))] * 2


def every_figure(results: Results, path: Path) -> None:
    """Draw one of each kind, with a line or bar for two variants."""
    draw_curves(results, HOPPER, path)
    scores = {"actpc": [np.array([1.0, 0.9])], "td3": [np.array([0.1, 0.3])]}
    draw_aggregates({"actpc": (0.9, 0.8, 1.0), "td3": (0.2, 0.1, 0.3)}, scores, path)
    draw_ablation({name: np.concatenate(parts) for name, parts in scores.items()}, "dense_return", HOPPER, path)
    assert draw_diagnostics(results, results.groups(HOPPER), HOPPER, path)


def test_every_line_is_named_and_no_legend_lies_on_an_axis(tmp_path: Path, drawn: list[Any]) -> None:
    for variant in ("actpc", "refresh_alone"):
        for seed in range(2):
            write_run(tmp_path, variant=variant, seed=seed, returns=[1.0, 2.0], final=5.0)
    every_figure(load_results(tmp_path), tmp_path / "none.png")
    assert len(drawn) == 4
    for figure in drawn:
        figure.draw_without_rendering()
        legends = [*figure.legends, *(one for axes in figure.axes if (one := axes.get_legend()))]
        boxes = [axes.get_window_extent() for axes in figure.axes]
        assert legends and not any(one.get_window_extent().overlaps(box) for one in legends for box in boxes)
        named = {text.get_text() for one in legends for text in one.get_texts()}
        labels = {line.get_label() for axes in figure.axes for line in axes.lines}
        # those that matplotlib names itself: the intervals of bars, which the axis' description explains
        assert {label for label in labels if not label.startswith("_")} <= named and named


def test_what_was_not_logged_has_no_panel(tmp_path: Path, drawn: list[Any]) -> None:
    """The folders log the epistemic signal alone, of what has a panel."""
    write_run(tmp_path)
    results = load_results(tmp_path)
    assert draw_diagnostics(results, results.groups(HOPPER), HOPPER, tmp_path / "none.png")
    assert [axes.get_title() for axes in drawn[0].axes] == ["signals"]
    silent = Results(results.runs, results.evaluations, results.episodes, pd.DataFrame(columns=["run"]))
    assert not draw_diagnostics(silent, silent.groups(HOPPER), HOPPER, tmp_path / "none.png") and len(drawn) == 1


def test_a_variant_looks_the_same_on_every_task(tmp_path: Path, drawn: list[Any]) -> None:
    for task, variants in ((HOPPER, ("actpc", "td3")), (REACHER, ("td3",))):
        for variant in variants:
            write_run(tmp_path, task, variant, algo=variant, returns=[1.0])
    for task in (HOPPER, REACHER):
        draw_curves(load_results(tmp_path), task, tmp_path / "none.png")
    lines = [line for figure in drawn for axes in figure.axes for line in axes.lines if line.get_label() == "td3"]
    assert len(lines) == 6 and len({line.get_color() for line in lines}) == 1
