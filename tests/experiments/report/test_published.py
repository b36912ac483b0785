"""The tables of Markdown files: made from exports worked by hand, and in this repository equal to its data."""

import re
from pathlib import Path

import pytest

from sb3_actpc.cli import main
from sb3_actpc.experiments.report.export import export
from sb3_actpc.experiments.report.published import fill_tables, write_tables
from tests.experiments.report.folders import REACHER, write_run

ROOT = Path(__file__).resolve().parents[3]
PAGE = """Before.

<!-- table: tables.yml one -->
old
<!-- /table -->
After."""
TABLE = """one:
  from: kept
  rows: {{{rows}}}
  columns: {{Hopper: SparseHopper-v5, Reacher: {{task: SparseReacher-v5, score: "{{success_rate:.2f}}"}}}}
  score: "{{dense_return:.0f}} ({{sparse_return:.0f}})"
  cell: "{cell}"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Dense returns of 100 and 300 on the Hopper with ActPC, whose sparse one is 2 and success 1; and others."""
    write_run(tmp_path / "runs", seed=0, final=100.0)
    write_run(tmp_path / "runs", seed=1, final=300.0)
    write_run(tmp_path / "runs", REACHER, final=-4.0)
    write_run(tmp_path / "runs", variant="td3", algo="td3", final=7.0, dirty=True)
    write_run(tmp_path / "runs", seed=2, final=900.0, finished=False)
    export(tmp_path / "runs", tmp_path / "kept")
    return tmp_path


def lines(folder: Path, rows: str, cell: str = "{score}") -> list[str]:
    """Of the table."""
    (folder / "tables.yml").write_text(TABLE.format(rows=rows, cell=cell), encoding="utf-8")
    text = fill_tables(PAGE, folder)
    assert text.startswith("Before.\n\n<!-- table: tables.yml one -->\n|") and text.endswith("\n<!-- /table -->\nAfter.")
    assert fill_tables(text, folder) == text
    return text.split("-->\n")[1].splitlines()[:-1]


def test_a_cell_is_the_mean_over_the_seeds_of_finished_runs(folder: Path) -> None:
    rows = "ActPC: actpc, demonstrators: demonstrators, its paper: 'paper:actpc'"
    assert lines(folder, rows) == [
        "|  | Hopper | Reacher |",
        "| --- | --- | --- |",
        "| ActPC | 200 (2) | 1.00 |",
        "| demonstrators | 2000 |  |",  # of the runs; their sparse return is not known, nor their success
        "| its paper | 2171 |  |",
    ]


def test_other_figures_than_the_mean(folder: Path) -> None:
    cell = "{dense_return:each .0f}; {dense_return:min .0f} to {dense_return:max .1f} ± {dense_return:std .1f} of {n:.0f}"
    assert (
        lines(folder, "ActPC: actpc", cell)[2] == "| ActPC | 100, 300; 100 to 300.0 ± 141.4 of 2 | -4; -4 to -4.0 ± n/a of 1 |"
    )


def test_a_curve_is_every_evaluation_seed_by_seed(folder: Path) -> None:
    assert lines(folder, "ActPC: actpc", "{dense_return:curve .0f}")[2] == "| ActPC | 0, 50, 100; 0, 150, 300 | 0, -2, -4 |"


def test_an_interval_of_the_mean_is_students(folder: Path) -> None:
    """Two seeds, 200 ± 100 (standard error) times t's 12.706; a single one has none."""
    row = lines(folder, "ActPC: actpc", "{dense_return:.0f} {dense_return:interval .0f}")[2]
    assert row == "| ActPC | 200 [-1071, 1471] | -4 |"


def test_a_row_says_more_than_a_column_and_runs_of_a_changed_source_tree_are_marked(folder: Path) -> None:
    table = lines(folder, "TD3: {variant: td3, cell: '{score}, {steps:,.0f}'}, ActPC: actpc")
    assert lines(folder, "ActPC: actpc, d: demonstrators", "{dense_return:.0f} x {n:.0f}")[2:] == [
        "| ActPC | 200 x 2 | -4 x 1 |",
        "| d | 2000 | 2000 |",
    ]
    assert lines(folder, "ActPC: actpc", "{paper:.1f}")[2] == "| ActPC | 2170.7 | -9.3 |"
    assert table[2:] == ["| TD3 | 7 (2), 1,000 † |  |", "| ActPC | 200 (2) | 1.00 |"]


def test_a_row_can_come_from_several_exports(folder: Path) -> None:
    write_run(folder / "more", seed=3, final=800.0)
    export(folder / "more", folder / "later")
    row = "both: {from: [kept, later], variant: actpc, cell: '{dense_return:each .0f} x {n:.0f}'}"
    assert lines(folder, row)[2] == "| both | 100, 300, 800 x 3 | -4 x 1 |"
    references = "d: {from: [kept, later], variant: demonstrators}, p: {from: [kept, later], variant: 'paper:actpc'}"
    assert lines(folder, references)[2:] == ["| d | 2000 |  |", "| p | 2171 |  |"]


def test_each_task_can_come_from_an_export_of_its_own(folder: Path) -> None:
    """Runs of a task that was measured again; a task that is nowhere has an empty cell."""
    write_run(folder / "more", seed=3, final=800.0)
    export(folder / "more", folder / "later")
    cell = "variant: actpc, cell: '{dense_return:each .0f} x {n:.0f}'"
    for others, reacher in ((", others: kept", "-4 x 1"), ("", "")):
        row = f"new: {{from: {{SparseHopper-v5: later{others}}}, {cell}}}"
        assert lines(folder, row)[2] == f"| new | 800 x 1 | {reacher} |"


def test_the_command_writes_what_has_changed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "page.md"
    path.write_text(PAGE, encoding="utf-8")
    (folder / "tables.yml").write_text(TABLE.format(rows="ActPC: actpc", cell="{score}"), encoding="utf-8")
    assert main(["report", "--tables", str(path)]) == 0 and str(path) in capsys.readouterr().out
    assert "| ActPC | 200 (2) | 1.00 |" in path.read_text(encoding="utf-8")
    assert not write_tables(path)


@pytest.mark.parametrize(
    ("rows", "cell", "message"),
    [
        ("A: actcp", "{score}", "table one: no variant 'actcp' in kept: there are actpc, "),
        ("A: {task: Hopper}", "{score}", "no task 'Hopper' in kept: there are SparseHopper-v5"),
        ("A: {variant: actpc, cel: x}", "{score}", "unknown cel; known are cell, columns, from"),
        ("A: actpc", "{dense}", "table one: 'dense'"),
        ("A: actpc", "{dense_return:median .0f}", "unknown 'median' in a format"),
        ("A: [", "{score}", "table one: tables.yml: not YAML of plain values (while parsing"),
    ],
)
def test_mistakes_are_named(folder: Path, rows: str, cell: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        lines(folder, rows, cell)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "tables must be a mapping, found None"),
        ("one: [1]", "a table must be a mapping, found [1]"),
        ("one: {rows: [fast], columns: {}}", "rows must be a mapping, found ['fast']"),
        ("one: {from: kept, rows: {A: actpc}, columns: {B: SparseHopper-v5}, cell: 3}", "cell=3 must be a text"),
    ],
)
def test_what_is_no_table_is_named(folder: Path, text: str, message: str) -> None:
    (folder / "tables.yml").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=re.escape(f"table one: {message}")):
        fill_tables(PAGE, folder)


def test_runs_with_several_settings_are_not_mixed(folder: Path) -> None:
    write_run(folder / "runs", seed=0, final=500.0, gamma=0.5)
    export(folder / "runs", folder / "more")
    with pytest.raises(ValueError, match="several runs with one seed"):
        lines(folder, "A: {variant: actpc, from: more}")


def test_a_name_that_is_not_in_the_file_is_an_error(folder: Path) -> None:
    lines(folder, "A: actpc")
    with pytest.raises(ValueError, match=r"table two: not in tables\.yml: there are one"):
        fill_tables(PAGE.replace(" one ", " two "), folder)


def test_a_marker_that_is_not_closed_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="1 begin, 0 end, 0 are whole"):
        fill_tables(PAGE.replace("<!-- /table -->", ""), tmp_path)


@pytest.mark.parametrize("name", ["README.md", "RESULTS.md", "docs/recipe.md"])
def test_the_repositorys_tables_are_those_of_its_data(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    assert fill_tables(text, (ROOT / name).parent) == text, f"{name} and its data differ: sb3-actpc report --tables {name}"
