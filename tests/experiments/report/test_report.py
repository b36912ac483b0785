"""The report, made from folders written by hand: what stands in its tables, and that it needs nothing but the folder."""

import csv
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes

from sb3_actpc.cli import main
from sb3_actpc.experiments.comparison import ablation_variants
from sb3_actpc.experiments.report.build import write_report
from sb3_actpc.experiments.report.document import Heading, Paragraph, Picture, Table, to_html, to_markdown
from sb3_actpc.experiments.report.figures import axis_limits, draw_curves, episode_curve, step_curve, time_curve
from sb3_actpc.experiments.report.references import reference_score
from sb3_actpc.experiments.report.results import group_runs, load_runs, read_columns

HOPPER, REACHER = "SparseHopper-v5", "SparseReacher-v5"


def write_csv(path: Path, columns: dict[str, Sequence[Any]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def write_run(
    out: Path,
    task: str = HOPPER,
    variant: str = "actpc",
    seed: int = 0,
    returns: Sequence[float] = (),
    final: float = 0.0,
    algo: str = "actpc",
    checksum: int = 1,
    finished: bool = True,
    **settings: Any,
) -> Path:
    """A run of 1000 steps, with the given dense returns of its training episodes and of its last evaluation."""
    folder = out / task / variant / f"seed{seed}_{abs(hash((variant, seed, str(settings)))):010x}"
    folder.mkdir(parents=True)
    config = {
        "algo": algo,
        "env": task,
        "env_kwargs": {},
        "seed": seed,
        "n_timesteps": 1000,
        "settings": settings,
        "demonstrators_return": 2000.0,
        "versions": {"sb3-actpc": "0.1.0"},
    }
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    n = len(returns)
    progress = {
        "timesteps": [0, 500, 1000],
        "updates": [0, 400, 900],
        "seconds": [0.0, 6.0, 12.0],
        "evaluation_seconds": [0.0, 1.0, 2.0],
        "dense_return": [0.0, final / 2, final],
        "dense_return_std": [0.0] * 3,
        "sparse_return": [0.0, 1.0, 2.0],
        "sparse_return_std": [0.0] * 3,
        "success_rate": [0.0, 0.5, 1.0],
        "episode_length": [5.0] * 3,
    }
    write_csv(folder / "progress.csv", progress)
    episodes = {
        "episode": range(1, n + 1),
        "timesteps": range(5, 5 * n + 5, 5),
        "seconds": range(n),
        "length": [5] * n,
        "sparse_return": [1.0] * n,
        "dense_return": returns,
        "success": [1.0, 0.0] * (n // 2) + [1.0] * (n % 2),
        "actions_crc32": [checksum] * n,
    }
    write_csv(folder / "episodes.csv", episodes)
    diagnostics = {
        "time/total_timesteps": [500, 1000],
        "train/actor_cosine_0": ["", 0.5],
        "train/actor_ratio_0": ["", 0.25],
        "train/actor_cosine_1": [0.75, 1.0],
        "train/actor_ratio_1": [0.9, 0.8],
        "train/epistemic_signal": [0.3, 0.2],
    }
    write_csv(folder / "diagnostics.csv", diagnostics)
    if finished:
        result = {"env": task, "algo": algo, "seed": seed, "timesteps": 1000, "dense_return": final}
        (folder / "result.json").write_text(json.dumps(result), encoding="utf-8")
    return folder


def table_row(markdown: str, name: str, heading: str) -> dict[str, str]:
    """The row of a table below a heading, by its columns; a second column of the same name gets a 2."""
    section = markdown.split(f"{heading}\n", 1)[1]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    header = [cell.strip() for cell in lines[0].strip("|").split("|")]
    header = [name + "2" * (name in header[:index]) for index, name in enumerate(header)]
    for line in lines[2:]:
        cells = [cell.strip() for cell in line[1:-1].split("|")]
        if cells[0] == name:
            return dict(zip(header, cells, strict=True))
    raise AssertionError(f"no row {name!r} in {lines}")


def test_the_table_of_a_task_has_the_figures_that_follow_from_the_episodes(tmp_path: Path) -> None:
    """Returns of 0 and 10 in turn: R-stability 0.5, average 5; of 0 and 30: 0.5 and 15. Mean 10, deviation sqrt(50) = 7.1."""
    write_run(tmp_path, seed=0, returns=[0.0, 10.0] * 100, final=100.0)
    write_run(tmp_path, seed=1, returns=[0.0, 30.0] * 120, final=300.0)
    write_report(tmp_path)
    row = table_row((tmp_path / "report.md").read_text(encoding="utf-8"), "actpc", f"## {HOPPER}")
    assert row["seeds"] == "2" and row["steps"] == "1,000"
    assert row["average return"] == "10.0 ± 7.1"
    assert row["R-stability"] == "0.500 ± 0.000"
    assert row["average sparse return"] == "1.0 ± 0.0" and row["R-stability, sparse"] == "0.000 ± 0.000"
    # successes 1 and 0 in turn: half succeed, and each mean of a hundred is half of the best
    assert row["success"] == "0.50 ± 0.00" and row["S-Dist"] == "0.500 ± 0.000"
    assert row["evaluation: return"] == "200.0 ± 141.4" and row["success2"] == "1.00 ± 0.00"
    assert row["paper: average return"] == "2170.714 ± 918.793" and row["paper: R-stability"] == "0.349 ± 0.227"


def test_short_runs_are_undefined_and_never_computed_on_a_shorter_window(tmp_path: Path) -> None:
    write_run(tmp_path, seed=0, returns=[0.0, 10.0] * 60)  # 120 episodes: an average, no stability
    write_run(tmp_path, seed=1, returns=[0.0, 10.0] * 120)
    write_run(tmp_path, variant="refresh_alone", returns=[5.0] * 99)
    write_report(tmp_path)
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    row = table_row(markdown, "actpc", f"## {HOPPER}")
    assert row["average return"] == "5.0 ± 0.0" and row["R-stability"] == "0.500 (1 of 2 seeds)"
    row = table_row(markdown, "refresh_alone", f"## {HOPPER}")
    assert row["average return"] == row["R-stability"] == row["success"] == "undefined"
    assert row["paper: average return"] == ""  # the paper did not run it


def test_demonstrators_random_actions_and_the_papers_other_algorithms_stand_below(tmp_path: Path) -> None:
    write_run(tmp_path, returns=[1.0] * 10)
    write_report(tmp_path)
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert table_row(markdown, "demonstrators", f"## {HOPPER}")["evaluation: return"] == "2000.0"
    score = reference_score(HOPPER)
    assert score is not None
    assert table_row(markdown, "random actions", f"## {HOPPER}")["evaluation: return"] == f"{score.random:.1f}"
    assert table_row(markdown, "LOGO (paper only)", f"## {HOPPER}")["paper: average return"] == "975.368 ± 24.273"
    assert "Refresh alone was not run" in markdown


def test_normalised_scores_across_tasks(tmp_path: Path) -> None:
    """One variant as good as the demonstrators everywhere, one as good as random actions, one that lacks a task."""
    for task in (HOPPER, REACHER):
        score = reference_score(task)
        assert score is not None
        for seed in range(2):
            write_run(tmp_path, task, "actpc", seed, final=score.demonstrators)
            write_run(tmp_path, task, "td3", seed, final=score.random, algo="td3")
    write_run(tmp_path, HOPPER, "sac_rlpd", final=5.0, algo="sac_rlpd")
    write_report(tmp_path)
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert table_row(markdown, "actpc", "## Across tasks")["interquartile mean"] == "1.000"
    row = table_row(markdown, "td3", "## Across tasks")
    assert (row["interquartile mean"], row["95 % interval"], row["runs"]) == ("0.000", "0.000 to 0.000", "4")
    assert "Left out, because not run on every one: sac_rlpd." in markdown
    assert table_row(markdown, "actpc over td3", "### Probability of improvement")["probability"] == "1.00"


def test_unfinished_and_failed_runs_are_listed_and_left_out(tmp_path: Path) -> None:
    write_run(tmp_path, seed=0, final=100.0)
    write_run(tmp_path, seed=1, final=900.0, finished=False)
    failed = write_run(tmp_path, seed=2, final=900.0, finished=False)
    (failed / "error.json").write_text(json.dumps({"message": "ValueError: it broke"}), encoding="utf-8")
    before = tmp_path / HOPPER / "actpc" / "seed3_0123456789"
    before.mkdir()
    (before / "error.json").write_text(json.dumps({"message": "it never began"}), encoding="utf-8")
    write_report(tmp_path)
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "4 runs: 2 failed, 1 finished, 1 unfinished" in markdown
    assert table_row(markdown, "actpc", f"## {HOPPER}")["evaluation: return"] == "100.0"
    for text in ("ValueError: it broke", "it never began", "unfinished"):
        assert text in markdown.split("## Runs that are not in the tables")[1]
    with open(tmp_path / "results.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(row["seed"], row["status"]) for row in rows] == [
        ("0", "finished"),
        ("1", "unfinished"),
        ("2", "failed"),
        ("3", "failed"),
    ]
    assert float(rows[0]["evaluation_dense"]) == 100.0 and rows[0]["r_stability_dense"] == ""
    assert float(rows[0]["steps_per_second"]) == 1000 / 10


def test_settings_that_go_by_one_name_are_kept_apart(tmp_path: Path) -> None:
    write_run(tmp_path, seed=0, final=100.0, gamma=0.9)
    write_run(tmp_path, seed=1, final=100.0, gamma=0.9)
    write_run(tmp_path, seed=0, final=500.0, gamma=0.5)
    groups = group_runs(load_runs(tmp_path))
    assert sorted(len(group.runs) for group in groups) == [1, 2]
    assert all(re.fullmatch(r"actpc \[[0-9a-f]{4}\]", group.variant) for group in groups)


def test_curves_are_those_of_the_files(tmp_path: Path) -> None:
    write_run(tmp_path, seed=0, returns=[1.0, 3.0, 5.0], final=100.0)
    write_run(tmp_path, seed=1, returns=[2.0, 2.0], final=300.0)
    [group] = group_runs(load_runs(tmp_path))
    x, values = episode_curve(group)
    assert x.tolist() == [1, 2] and values.tolist() == [[1.0, 2.0], [2.0, 2.0]]  # as many episodes as both have
    x, values = step_curve(group)
    assert x.tolist() == [0, 500, 1000] and values.tolist() == [[0, 50, 100], [0, 150, 300]]
    x, values = time_curve(group)
    assert (x[0], x[-1]) == (0.0, 10.0) and np.allclose(values[:, -1], [100.0, 300.0])  # 12 seconds, 2 of evaluation


def test_the_line_of_the_demonstrators_is_that_of_the_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They need not be the shipped ones."""
    drawn: list[float] = []
    monkeypatch.setattr(Axes, "axhline", lambda axes, y, **keywords: drawn.append(y))
    write_run(tmp_path)
    write_report(tmp_path)
    score = reference_score(HOPPER)
    assert score is not None and score.demonstrators != 2000.0
    assert drawn == [2000.0, score.random] * 3


def test_axes_hold_every_seed_with_a_margin_of_five_percent() -> None:
    assert axis_limits([-100.0, 40.0, 300.0]) == pytest.approx((-120.0, 320.0))
    assert axis_limits([7.0]) == pytest.approx((6.95, 7.05))  # one value is still a picture
    assert axis_limits([]) == pytest.approx((-0.05, 1.05))


@pytest.mark.parametrize(("task", "height"), [(HOPPER, 3000.0), ("SparseLift-v0", 1.0)])
def test_an_axis_is_not_stretched_by_the_interval_of_two_seeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, task: str, height: float
) -> None:
    """The 95 % interval of two seeds at 0 and 3000 reaches from -17,559 to 20,559; of success, nothing is beyond 0 and 1."""
    limits: list[tuple[float, float]] = []
    monkeypatch.setattr(Axes, "set", lambda axes, **keywords: limits.append(keywords["ylim"]))
    write_run(tmp_path, task, seed=0, final=0.0)
    write_run(tmp_path, task, seed=1, final=3000.0)
    draw_curves(group_runs(load_runs(tmp_path)), task, None, tmp_path / "curves.png")
    assert limits[1:] == [pytest.approx((-0.05 * height, 1.05 * height))] * 2


def test_curves_of_runs_without_an_evaluation_at_the_start(tmp_path: Path) -> None:
    """An offline method's: nothing is drawn before the first evaluation, and only steps that all seeds have."""
    for seed in range(2):
        path = write_run(tmp_path, seed=seed, final=100.0) / "progress.csv"
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        path.write_text("".join([lines[0], *lines[2 + seed :]]), encoding="utf-8")
    [group] = group_runs(load_runs(tmp_path))
    x, values = step_curve(group)
    assert x.tolist() == [1000] and values.tolist() == [[100.0], [100.0]]
    x, values = time_curve(group)
    assert x[0] == x[-1] == 10.0 and (values == 100.0).all()


def test_the_page_needs_no_other_file_and_no_network(tmp_path: Path) -> None:
    write_run(tmp_path, returns=[1.0] * 5)
    files = write_report(tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    sources = re.findall(r'src="([^"]*)"', page)
    assert len(sources) == sum(path.suffix == ".png" for path in files) >= 3
    assert all(source.startswith("data:image/png;base64,iVBOR") for source in sources)
    assert not re.search(r"https?://|<script|<link", page)
    assert all(path.stat().st_size > 0 for path in files)


def test_text_cannot_become_markup() -> None:
    blocks = [Heading("a < b", 1), Paragraph("<script>"), Table(["x|y"], [["<b>|"]])]
    page = to_html(blocks, Path("."))
    assert "<script>" not in page and "<b>" not in page and "&lt;script&gt;" in page
    assert "x\\|y" in to_markdown(blocks)
    assert to_markdown([Picture("a.png", "what")]) == "![what](a.png)\n"


def test_ablations_are_beside_the_base_and_one_without_effect_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    base = ablation_variants()[0].name
    for seed in range(2):
        write_run(tmp_path, variant=base, seed=seed, returns=[1.0] * 3, final=100.0, checksum=1)
        write_run(tmp_path, variant="no_epistemic", seed=seed, returns=[1.0] * 3, final=60.0, checksum=2)
    assert main(["report", str(tmp_path)]) == 0
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    row = table_row(markdown, "no_epistemic", f"## What each part is worth: {HOPPER}")
    assert (row["evaluation: dense return"], row["actions changed"]) == ("60.0 ± 0.0", "yes")
    assert row["gradient that arrives, by layer"] == "0.50, 0.25; 1.00, 0.8"
    assert (tmp_path / f"ablations_{HOPPER}.png").read_bytes().startswith(b"\x89PNG")
    for seed in range(2):
        write_run(tmp_path, variant="no_targets", seed=seed, returns=[1.0] * 3, final=100.0, checksum=1)
    capsys.readouterr()
    assert main(["report", str(tmp_path)]) == 1
    assert "not one action changed in no_targets" in capsys.readouterr().err
    assert "NO: the part did nothing" in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_a_row_that_was_not_written_to_its_end_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y\n1,2\n3,\n4", encoding="utf-8")
    columns = read_columns(tmp_path / "a.csv")
    assert columns["x"].tolist() == [1.0, 3.0] and np.isnan(columns["y"][1])
    assert read_columns(tmp_path / "none.csv") == {}
    (tmp_path / "empty.csv").touch()
    assert read_columns(tmp_path / "empty.csv") == {}


def test_a_folder_without_runs_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path)]) == 2
    errors = capsys.readouterr().err
    assert "no runs in" in errors and "sb3-actpc compare --out" in errors and errors.count("\n") == 1


def test_robosuites_tasks_are_scored_by_success(tmp_path: Path) -> None:
    """The runs end with success 1, like the demonstrators, whatever their dense return is."""
    for variant, final in (("actpc", 3.0), ("refresh_alone", 200.0)):
        write_run(tmp_path, "SparseLift-v0", variant, final=final, returns=[5.0] * 120)
    write_report(tmp_path)
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    for variant in ("actpc", "refresh_alone"):
        assert table_row(markdown, variant, "## Across tasks")["interquartile mean"] == "1.000"
    write_run(tmp_path, "SparseLift-v0", "bc_rnn", algo="bc_rnn")
    write_report(tmp_path)
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert table_row(markdown, "bc_rnn", "## SparseLift-v0")["paper: success in %"] == "100.0 ± 0.0"
    assert "BC-RNN (paper only)" not in markdown and "BCQ (paper only)" in markdown
    group = group_runs(load_runs(tmp_path))[0]
    assert step_curve(group, "success_rate")[1].tolist() == [[0.0, 0.5, 1.0]]
    assert episode_curve(group, "success_rate")[1][0, -1] == 0.5
