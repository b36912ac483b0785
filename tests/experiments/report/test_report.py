"""What a report says of runs whose numbers are known."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sb3_actpc.cli import main
from sb3_actpc.experiments.report.results import area, load_results, reference_score
from sb3_actpc.experiments.report.tables import improvement_table, mean_and_deviation, write_report
from tests.experiments.report.folders import HOPPER, REACHER, STEPS, write_run


def test_a_row_holds_what_the_run_reached(tmp_path: Path) -> None:
    write_run(tmp_path, dense=(0.0, 50.0, 100.0))
    results = load_results(tmp_path)
    [row] = results.runs.to_dict("records")
    assert [results.at_step(results.runs, "dense_return", step).item() for step in (5_000, 10_000)] == [50.0, 100.0]
    assert np.isnan(results.at_step(results.runs, "dense_return", 20_000).item())
    assert np.isnan(results.at_step(results.runs, "actor_return", 5_000).item())
    assert (row["dense_return"], row["return"], row["success"]) == (100.0, 2.0, 1.0)
    assert row["dense_return_worst"] == 50.0, "the evaluation at step 0 does not count"
    assert row["dense_return_area"] == 50.0
    assert row["seconds"] == 10.0, "evaluations are left out"
    assert row["normalized"] == pytest.approx((100.0 - 18.157) / (2618.606 - 18.157))


def test_an_evaluation_next_to_a_step_stands_for_it(tmp_path: Path) -> None:
    """Several environments step at once, and on-policy methods in rollouts."""
    write_run(tmp_path, dense=(0.0, 50.0, 100.0))
    results = load_results(tmp_path)
    near = [results.at_step(results.runs, "dense_return", step).item() for step in (4_900, 5_100, 9_600)]
    assert near == [50.0, 50.0, 100.0]
    assert np.isnan(results.at_step(results.runs, "dense_return", 7_000).item())


def test_the_area_weighs_evaluations_by_the_steps_between_them() -> None:
    assert area(np.array([0.0, 10.0, 40.0]), np.array([0.0, 2.0, 2.0])) == pytest.approx((10 * 1 + 30 * 2) / 40)
    assert np.isnan(area(np.array([0.0]), np.array([1.0])))


def test_a_run_that_failed_before_its_settings_does_not_rename_the_others(tmp_path: Path) -> None:
    folder = write_run(tmp_path, seed=0)
    failed = folder.parent / "seed1_0123456789"
    failed.mkdir()
    (failed / "error.json").write_text(json.dumps({"message": "no such task"}), encoding="utf-8")
    assert load_results(tmp_path).runs["label"].tolist() == ["actpc", "actpc"]


def test_the_two_files_make_the_same_report_again(tmp_path: Path) -> None:
    for seed in range(2):
        write_run(tmp_path / "runs", seed=seed, dense=(0.0, 50.0 + seed, 100.0))
        write_run(tmp_path / "runs", REACHER, "td3", seed=seed)
    write_run(tmp_path / "runs", REACHER, "actpc", finished=False)
    write_report(tmp_path / "runs", tmp_path / "kept")
    first = (tmp_path / "kept" / "report.md").read_text(encoding="utf-8")
    files = {name: (tmp_path / "kept" / name).read_bytes() for name in ("results.csv", "curves.csv.gz")}
    write_report(tmp_path / "kept")
    assert (tmp_path / "kept" / "report.md").read_text(encoding="utf-8").replace("kept", "runs") == first
    assert {name: (tmp_path / "kept" / name).read_bytes() for name in files} == files
    assert (
        "did not run on all: actpc, td3." in first
        and "50.5 ± 0.7" in first
        and "Runs that are not in the tables" in first
        and "| 20 |" in first
    )
    write_report(tmp_path / "kept", tmp_path / "other", (5_000,))
    assert "### Return\n\n| variant | at 5,000 |" in (tmp_path / "other" / "report.md").read_text(encoding="utf-8")
    curves = pd.read_csv(tmp_path / "kept" / "curves.csv.gz")
    assert len(curves) == 5 * 3 and curves["run"].nunique() == 5


def test_the_probability_of_improvement_is_of_returns_at_each_step(tmp_path: Path) -> None:
    for seed in range(2):
        write_run(tmp_path, variant="actpc", seed=seed, returns=(0.0, 3.0, 5.0))
        write_run(tmp_path, variant="bc", seed=seed, returns=(0.0, 4.0, 4.0))
    table = improvement_table(load_results(tmp_path), (5_000, 10_000, 50_000))
    assert table[["pair", "steps", "probability"]].to_numpy().tolist() == [
        ["actpc over bc", "5,000", "0.00"],
        ["actpc over bc", "10,000", "1.00"],
    ]


def test_moving_averages_are_compared_too(tmp_path: Path) -> None:
    for seed in range(2):
        write_run(tmp_path, variant="actpc", seed=seed, returns=(0.0, 3.0, 3.0), averages=(0.0, 2.0, 5.0))
        write_run(tmp_path, variant="bc", seed=seed, returns=(0.0, 4.0, 4.0))
    table = improvement_table(load_results(tmp_path), (10_000,)).set_index("pair")["probability"]
    assert table.to_dict() == {
        "actpc over actpc, moving average": "0.00",
        "actpc over bc": "0.00",
        "actpc, moving average over bc": "1.00",
    }


def test_settings_of_one_name_are_told_apart(tmp_path: Path) -> None:
    write_run(tmp_path, seed=0, gamma=0.9)
    write_run(tmp_path, seed=1, gamma=0.8)
    assert len(load_results(tmp_path).groups(HOPPER)) == 2


def test_runs_of_fewer_steps_have_one_name_on_all_tasks(tmp_path: Path) -> None:
    for task in (HOPPER, REACHER):
        write_run(tmp_path, task, seed=0)
        shorter = write_run(tmp_path, task, seed=1)
        config = json.loads((shorter / "config.json").read_text(encoding="utf-8"))
        (shorter / "config.json").write_text(json.dumps({**config, "n_timesteps": STEPS[1]}), encoding="utf-8")
        rows = (shorter / "progress.csv").read_text(encoding="utf-8").splitlines(keepends=True)
        (shorter / "progress.csv").write_text("".join(rows[:-1]), encoding="utf-8")
    results = load_results(tmp_path)
    assert [list(results.groups(task)) for task in (HOPPER, REACHER)] == [["actpc (10000 steps)", "actpc (5000 steps)"]] * 2


def test_the_demonstrators_score_more_than_random_actions() -> None:
    for task in ("HalfCheetah", "Hopper", "Reacher", "Swimmer", "Walker2d"):
        score = reference_score(f"sb3_actpc.envs:Sparse{task}-v5")
        assert score.demonstrators_score > score.random_score
    assert reference_score("Unknown-v0") is None


def test_undefined_values_are_counted() -> None:
    assert mean_and_deviation(np.array([1.0, 3.0, np.nan]), ".1f") == "2.0 ± 1.4 (2 of 3)"
    assert mean_and_deviation(np.array([np.nan]), ".1f") == "n/a"


def test_the_command_lists_its_files_and_refuses_an_empty_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path)]) == 2
    assert "no runs in" in capsys.readouterr().err
    write_run(tmp_path)
    assert main(["report", str(tmp_path), "--steps", "5000"]) == 0
    printed = capsys.readouterr().out.split()
    assert [Path(path).name for path in printed] == [
        "results.csv",
        "curves.csv.gz",
        "curves_SparseHopper-v5.png",
        "summary.png",
        "report.md",
    ]
    assert all(Path(path).stat().st_size for path in printed)
