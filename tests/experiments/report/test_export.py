"""What is kept of a comparison: everything that tables and curves need, and nothing read wrongly when it is read again."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sb3_actpc.cli import main
from sb3_actpc.experiments.report.export import export
from sb3_actpc.experiments.report.figures import step_curve
from sb3_actpc.experiments.report.results import load_results, run_measures
from tests.experiments.report.folders import HOPPER, REACHER, write_run


def test_an_export_is_read_as_the_folders_are(tmp_path: Path) -> None:
    write_run(tmp_path / "runs", seed=0, returns=[1.0] * 120, final=1 / 3, commit="1" * 40)
    write_run(tmp_path / "runs", seed=1, final=3000.123, commit="12e4567890" * 4, gamma=0.5)
    write_run(tmp_path / "runs", REACHER, "td3", algo="td3", final=-4.0, commit="a" * 40, dirty=True)
    write_run(tmp_path / "runs", REACHER, "td3", seed=1, algo="td3", finished=False)
    files = export(tmp_path / "runs", tmp_path / "kept")
    names = ["results.csv", "curves.csv.gz", "settings.json", f"curves_{HOPPER}.png", f"curves_{REACHER}.png"]
    assert [path.name for path in files] == names == [*dict.fromkeys(names)] and all(path.stat().st_size for path in files)
    before, after = load_results(tmp_path / "runs"), load_results(tmp_path / "kept")
    pd.testing.assert_frame_equal(before.runs, after.runs, check_dtype=False, rtol=1e-7)
    assert after.runs.loc[after.runs["dirty"], "variant"].tolist() == ["td3"]
    assert sorted(after.runs["commit"]) == ["", "1" * 10, "12e4567890", "a" * 10]  # texts, not numbers
    for label, runs in before.groups(HOPPER).items():
        kept = after.groups(HOPPER)[label]
        for one, two in zip(step_curve(before, runs.index), step_curve(after, kept.index), strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-5)


def test_the_same_runs_give_the_same_files_and_a_report_of_an_export_leaves_them(tmp_path: Path) -> None:
    write_run(tmp_path / "runs", final=1 / 3)
    for name in ("one", "two"):
        assert main(["report", str(tmp_path / "runs"), "--export", str(tmp_path / name)]) == 0
    assert main(["report", str(tmp_path / "two")]) == 0
    for path in (tmp_path / "one").iterdir():
        if path.suffix != ".png":
            assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes(), path.name
    assert (tmp_path / "two" / "report.html").is_file()


def test_the_settings_that_an_id_stands_for_are_kept(tmp_path: Path) -> None:
    write_run(tmp_path / "runs", gamma=0.75)
    export(tmp_path / "runs", tmp_path / "kept")
    [settings] = load_results(tmp_path / "kept").runs["settings"]
    kept = pd.read_json(tmp_path / "kept" / "settings.json", typ="series")[settings]
    assert kept["settings"] == {"gamma": 0.75} and kept["env"] == HOPPER and "seed" not in kept


def test_an_export_of_an_export_keeps_all_and_none_goes_into_its_own_folder(tmp_path: Path) -> None:
    write_run(tmp_path / "runs", gamma=0.75)
    with pytest.raises(ValueError, match="is the folder of the runs themselves: give another"):
        export(tmp_path / "runs", tmp_path / "kept" / ".." / "runs")  # its runs would not be read again
    export(tmp_path / "runs", tmp_path / "kept")
    for path in export(tmp_path / "kept", tmp_path / "again"):
        assert path.suffix == ".png" or path.read_bytes() == (tmp_path / "kept" / path.name).read_bytes(), path.name


def test_measures_of_a_run() -> None:
    """Evaluations at 0, 4000, ..., 20,000: the worst counts from 5,000 steps on, the last half begins at 10,000."""
    evaluations = pd.DataFrame(
        {
            "timesteps": [0, 4000, 8000, 12000, 16000, 20000],
            "updates": [0, 4, 8, 12, 16, 20],
            "seconds": [1.0, 20.0, 40.0, 60.0, 80.0, 101.0],
            "evaluation_seconds": [1.0, 1.0, 1.0, 1.0, 1.0, 1.0],
            "dense_return": [-9.0, -5.0, 2.0, 6.0, 3.0, 9.0],
            "sparse_return": [0.0, 0.0, 1.0, 2.0, 3.0, 4.0],
            "success_rate": [np.nan] * 6,
        }
    )
    values = run_measures("Unknown-v0", evaluations, pd.DataFrame({"dense_return": [2.0] * 250}))
    assert values["dense_return"] == 9.0 and values["sparse_return"] == 4.0
    assert values["dense_return_worst"] == 2.0 and values["dense_return_last_half"] == 6.0
    assert values["dense_return_training"] == 2.0 and values["dense_return_r_stability"] == 0.0
    assert values["steps_per_second"] == 200.0 and values["updates"] == 20
    assert np.isnan(values["success_rate_worst"]) and np.isnan(values["normalized"])
    assert np.isnan(run_measures(HOPPER, evaluations[:2], pd.DataFrame())["dense_return_worst"])  # ends before 5,000
    assert np.isnan(run_measures(HOPPER, pd.DataFrame(), pd.DataFrame())["seconds"])  # has not begun


def test_nothing_to_do_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report"]) == 2 and "--tables FILE.md" in capsys.readouterr().err
    assert main(["report", "--export", str(tmp_path)]) == 2 and "folder of a comparison" in capsys.readouterr().err
