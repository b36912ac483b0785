"""The report, made from folders written by hand: what stands in its tables, and that it needs nothing but the folder."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from sb3_actpc.cli import main
from sb3_actpc.experiments.comparison import ablation_variants
from sb3_actpc.experiments.report.build import task_table, write_report
from sb3_actpc.experiments.report.page import UNDEFINED, Section, write_pages
from sb3_actpc.experiments.report.references import reference_score
from sb3_actpc.experiments.report.results import load_results, read_rows
from tests.experiments.report.folders import HOPPER, REACHER, write_run


def table_row(markdown: str, name: str, heading: str) -> dict[str, str]:
    """The row of a table below a heading, by its columns."""
    section = markdown.split(f"{heading}\n", 1)[1]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    header = [cell.strip() for cell in lines[0].strip("|").split("|")]
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
    training = "last 100 training episodes: "
    assert row[training + "return"] == "10.0 ± 7.1" and row["R-stability: return"] == "0.500 ± 0.000"
    assert row[training + "sparse return"] == "1.0 ± 0.0" and row["R-stability: sparse return"] == "0.000 ± 0.000"
    # successes 1 and 0 in turn: half succeed, and each mean of a hundred is half of the best
    assert row[training + "success"] == "0.50 ± 0.00" and row["R-stability: success (S-Dist)"] == "0.500 ± 0.000"
    assert row["last evaluation: return"] == "200.0 ± 141.4" and row["last evaluation: success"] == "1.00 ± 0.00"
    assert row["paper: average return"] == "2170.7 ± 918.8" and row["paper: R-stability"] == "0.349 ± 0.227"


def test_short_runs_are_undefined_and_never_computed_on_a_shorter_window(tmp_path: Path) -> None:
    write_run(tmp_path, seed=0, returns=[0.0, 10.0] * 60)  # 120 episodes: an average, no stability
    write_run(tmp_path, seed=1, returns=[0.0, 10.0] * 120)
    write_run(tmp_path, variant="refresh_alone", returns=[5.0] * 99)
    write_report(tmp_path)
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    row = table_row(markdown, "actpc", f"## {HOPPER}")
    assert row["last 100 training episodes: return"] == "5.0 ± 0.0" and row["R-stability: return"] == "0.500 (1 of 2)"
    row = table_row(markdown, "refresh_alone", f"## {HOPPER}")
    assert row["last 100 training episodes: return"] == row["R-stability: return"] == UNDEFINED
    assert row["paper: average return"] == ""  # the paper did not run it


def test_a_column_that_nobody_has_a_value_in_is_left_out(tmp_path: Path) -> None:
    write_run(tmp_path, returns=[5.0] * 99)
    assert {name for name, _ in task_table(load_results(tmp_path), HOPPER).columns} == {"", "last evaluation", "paper"}
    write_run(tmp_path, variant="refresh_alone", returns=[5.0] * 100)
    columns = task_table(load_results(tmp_path), HOPPER).columns
    assert ("last 100 training episodes", "return") in columns and "R-stability" not in columns.get_level_values(0)


def test_runs_from_a_changed_source_tree_are_marked(tmp_path: Path) -> None:
    write_run(tmp_path, variant="actpc", commit="a" * 40)
    write_run(tmp_path, variant="td3", algo="td3", commit="a" * 40, dirty=True)
    names = task_table(load_results(tmp_path), HOPPER)["", "variant"]
    assert {"actpc", "td3 †"} < set(names)
    write_report(tmp_path)
    assert "commit aaaaaaaaaa; 1 runs from" in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_demonstrators_random_actions_and_the_papers_other_algorithms_stand_below(tmp_path: Path) -> None:
    write_run(tmp_path, returns=[1.0] * 10)
    write_report(tmp_path)
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert table_row(markdown, "demonstrators", f"## {HOPPER}")["last evaluation: return"] == "2000.0"
    score = reference_score(HOPPER)
    assert score is not None
    assert table_row(markdown, "random actions", f"## {HOPPER}")["last evaluation: return"] == f"{score.random:.1f}"
    assert table_row(markdown, "LOGO (paper only)", f"## {HOPPER}")["paper: average return"] == "975.4 ± 24.3"
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
    assert "Left out, because not every task has runs of that name: sac_rlpd." in markdown
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
    assert table_row(markdown, "actpc", f"## {HOPPER}")["last evaluation: return"] == "100.0"
    for text in ("ValueError: it broke", "it never began", "unfinished"):
        assert text in markdown.split("## Runs that are not in the tables")[1]
    rows = pd.read_csv(tmp_path / "results.csv")
    assert list(zip(rows["seed"], rows["status"], strict=True)) == [
        (0, "finished"),
        (1, "unfinished"),
        (2, "failed"),
        (3, "failed"),
    ]
    assert rows["dense_return"][0] == 100.0 and pd.isna(rows["dense_return_r_stability"][0])
    assert rows["steps_per_second"][0] == 1000 / 10


def test_settings_that_go_by_one_name_are_kept_apart(tmp_path: Path) -> None:
    write_run(tmp_path, seed=0, final=100.0, gamma=0.9)
    write_run(tmp_path, seed=1, final=100.0, gamma=0.9)
    write_run(tmp_path, seed=0, final=500.0, gamma=0.5)
    groups = load_results(tmp_path).groups(HOPPER)
    assert sorted(map(len, groups.values())) == [1, 2]
    assert all(re.fullmatch(r"actpc \[[0-9a-f]{4}\]", label) for label in groups)


def test_a_second_number_of_steps_in_a_folder_leaves_the_first_comparison_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    base, part, other = (variant.name for variant in ablation_variants()[:3])
    for task in (HOPPER, REACHER):
        for variant in (base, part, other):
            write_run(tmp_path, task, variant, returns=[1.0] * 3)
    for variant in (base, part):
        write_run(tmp_path, HOPPER, variant, returns=[1.0] * 3, steps=2000, checksum=1 + (variant == part))
    assert main(["report", str(tmp_path)]) == 1
    errors = capsys.readouterr().err
    assert f"{HOPPER}: not one action changed in {part} [1,000 steps], {other}: the part" in errors
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    for name in (f"{base} [1,000 steps]", f"{part} [1,000 steps]", other):
        assert table_row(markdown, name, "## Across tasks")["runs"] == "2"
    assert f"Left out, because not every task has runs of that name: {base} [2,000 steps], {part} [2,000 steps]." in markdown
    longer = f"## What each part is worth: {HOPPER}, {base} [2,000 steps]"
    assert table_row(markdown, f"{part} [2,000 steps]", longer)["actions changed"] == "yes"
    assert other not in markdown.split(longer)[1].split("## ")[0]  # has no such run
    assert {f"ablations_{HOPPER}.png", f"ablations_{HOPPER}_2.png"} < {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize("of_reacher", [{"steps": 1000}, {"steps": 50_000}])  # as one of the Hopper's, or as none
@pytest.mark.parametrize("other", [{"steps": 2000}, {"gamma": 0.5}])
def test_a_task_with_one_kind_of_settings_counts_with_each_of_another_tasks(
    other: dict[str, Any], of_reacher: dict[str, Any], tmp_path: Path
) -> None:
    for task, settings in ((HOPPER, {}), (HOPPER, other), (REACHER, of_reacher)):
        write_run(tmp_path, task, **settings)
    write_report(tmp_path)
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    for name in load_results(tmp_path).groups(HOPPER):
        if name == "actpc [2,000 steps]" and of_reacher["steps"] == 1000:
            assert f"runs of that name: {name}." in markdown
        else:
            assert table_row(markdown, name, "## Across tasks")["runs"] == "2"
    is_other = set(load_results(tmp_path).groups(REACHER)) == {"actpc"}
    assert ("its runs on tasks with one kind of them count with each." in markdown) is is_other


def test_sections_that_are_left_out_are_named(tmp_path: Path) -> None:
    """Nothing was run on both tasks; and no ablation has as many steps as the base."""
    base, part = (variant.name for variant in ablation_variants()[:2])
    write_run(tmp_path, HOPPER, base, steps=2000)
    write_run(tmp_path, HOPPER, part)
    write_run(tmp_path, REACHER, "td3", algo="td3")
    write_report(tmp_path)
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert (
        f"Left out: none of {base}, {part}, td3 has runs on all of {HOPPER}, {REACHER}"
        in markdown.split("## Across tasks\n")[1]
    )
    assert f"Left out: no ablation has as many steps as {base}, " in markdown.split(f"each part is worth: {HOPPER}\n")[1]


def test_the_page_needs_no_other_file_and_no_network(tmp_path: Path) -> None:
    write_run(tmp_path, returns=[1.0] * 5)
    files = write_report(tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    sources = re.findall(r'src="([^"]*)"', page)
    assert len(sources) == sum(path.suffix == ".png" for path in files) >= 3
    assert all(source.startswith("data:image/png;base64,iVBOR") for source in sources)
    assert not re.search(r"https?://|<script|<link", page)
    assert all(path.stat().st_size > 0 for path in files)


def test_text_cannot_become_markup(tmp_path: Path) -> None:
    long = "x" * 300
    table = pd.DataFrame([["<b>|", long]], columns=["x|y", "z"])
    write_pages([Section("a < b", "<script>", table)], tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<script>" not in page and "<b>" not in page and "&lt;script&gt;" in page and long in page
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert text.split() == [*"## a < b <script> | x\\|y | z | | --- | --- |".split(), "|", "<b>\\|", "|", long, "|"]


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
    (tmp_path / "a.csv").write_text("x,y\n1,2\n3,\n4,5", encoding="utf-8")  # 5 may be the beginning of 56
    rows = read_rows(tmp_path / "a.csv")
    assert rows["x"].tolist() == [1.0, 3.0] and pd.isna(rows["y"][1])
    assert read_rows(tmp_path / "none.csv").empty
    (tmp_path / "empty.csv").touch()
    assert read_rows(tmp_path / "empty.csv").empty
    (tmp_path / "line.csv").write_text("\n", encoding="utf-8")
    assert read_rows(tmp_path / "line.csv").empty


def test_a_damaged_row_and_a_copy_of_a_run_are_left_out(tmp_path: Path) -> None:
    for seed in range(2):
        write_run(tmp_path, seed=seed, final=100.0 * seed)
    [first] = (tmp_path / HOPPER / "actpc").glob("seed0_*")
    shutil.copytree(first, first.with_name(f"{first.name}_backup"))
    shutil.copytree(first, first.with_name("seed0-old_1"))
    with open(first / "progress.csv", "a", encoding="utf-8") as file:
        file.write("garbage\n")
    write_report(tmp_path)
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    row = table_row(markdown, "actpc", f"## {HOPPER}")
    assert (row["seeds"], row["last evaluation: return"]) == ("2", "50.0 ± 70.7")


def test_a_task_with_a_namespace_is_reported_by_its_own_name(tmp_path: Path) -> None:
    for seed in range(2):
        write_run(tmp_path / "runs", "mylab/Pend-v0", seed=seed, final=7.0)
        write_run(tmp_path / "runs", "mylab/Pend-v0", "no_refresh", seed=seed, final=5.0)
    folder = tmp_path / "runs"
    assert main(["report", str(folder), "--export", str(tmp_path / "kept")]) == 0
    assert load_results(folder).runs["task"].unique() == load_results(tmp_path / "kept").runs["task"].unique()
    assert main(["report", str(folder)]) == 0
    assert "## mylab/Pend-v0\n" in (folder / "report.md").read_text(encoding="utf-8")
    assert (tmp_path / "kept" / "curves_mylab_Pend-v0.png").is_file()
    assert {"curves_mylab_Pend-v0.png", "diagnostics_mylab_Pend-v0.png"} < {path.name for path in folder.iterdir()}


def test_a_folder_without_runs_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path)]) == 2
    errors = capsys.readouterr().err
    assert "no runs in" in errors and "sb3-actpc compare --output" in errors and errors.count("\n") == 1


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
