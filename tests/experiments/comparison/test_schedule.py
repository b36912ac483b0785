"""Which runs are begun, gone on with, tried again or left alone; in this process, with faults planted."""

import json
from pathlib import Path

import pytest

from sb3_actpc.cli import main
from sb3_actpc.experiments.comparison.schedule import FAILED, FINISHED, NEW, UNFINISHED, read_error, run_status
from sb3_actpc.experiments.runs.record import read_run
from sb3_actpc.utils.files import FolderBusy, folder_lock
from tests.experiments.comparison.tasks import bring_to_end, interrupt_after, measured, small_runs, straight

OUT = Path("out")


def test_all_runs_are_brought_to_their_end_once(capsys: pytest.CaptureFixture[str]) -> None:
    runs = small_runs(OUT, ["first", "second"])
    assert {run_status(run.folder) for run in runs} == {NEW}
    assert bring_to_end(runs, OUT)[0] == runs
    assert "finished  tests.experiments.comparison.tasks:SparsePoint-v0 second seed 0" in capsys.readouterr().out
    assert {run_status(run.folder) for run in runs} == {FINISHED}
    before = [(run.folder / "result.json").read_bytes() for run in runs]
    assert bring_to_end(runs, OUT)[0] == []
    assert capsys.readouterr().out == "2 runs are done, 0 to do\n"
    assert [(run.folder / "result.json").read_bytes() for run in runs] == before
    begun, _ = bring_to_end(small_runs(OUT, ["first", "second"], seeds=2), OUT)  # the table grows
    assert [(run.name, run.seed) for run in begun] == [("first", 1), ("second", 1)]


def test_an_unfinished_run_goes_on_from_its_checkpoint_and_ends_as_the_one_never_stopped() -> None:
    """With what does not decide its outcome as the command says it now."""
    [run] = small_runs(OUT)
    interrupt_after(run, 33)
    assert run_status(run.folder) == UNFINISHED
    _, lines = bring_to_end([run.model_copy(update={"threads": 2, "checkpoint_freq": 7})], OUT)
    assert run_status(run.folder) == FINISHED
    assert "60 steps from step 33" in lines[0]
    assert [measured(run)] == straight()
    assert [row["timesteps"] for row in measured(run)[1]] == ["8", "16", "24", "32", "40", "48", "56"]
    stored = read_run(run.folder)
    assert (stored.threads, stored.checkpoint_freq) == (2, 7)


def test_a_failed_run_stops_no_other_and_is_tried_again_on_request_only() -> None:
    Path("fault").touch()
    runs = small_runs(OUT, ["first", "second"], fault=str(Path("fault").absolute()), at_fault="error")
    bring_to_end(runs, OUT)
    assert [run_status(run.folder) for run in runs] == [FAILED, FINISHED]
    assert read_error(runs[0].folder) == "RuntimeError: the planted fault"
    assert "tasks.py" in json.loads((runs[0].folder / "error.json").read_text(encoding="utf-8"))["details"]
    assert bring_to_end(runs, OUT)[0] == []
    begun, lines = bring_to_end(runs, OUT, retry_failed=True)
    assert begun == runs[:1]
    assert "from step 20" in lines[0]
    assert run_status(runs[0].folder) == FINISHED and not (runs[0].folder / "error.json").exists()


def test_a_second_command_in_the_folder_is_refused_with_a_message(capsys: pytest.CaptureFixture[str]) -> None:
    with folder_lock(OUT, 0.0):
        assert main(["compare", "--envs", "SparseReacher-v5", "--algos", "actpc", "--output", str(OUT)]) == 2
        with pytest.raises(FolderBusy), folder_lock(OUT, 0.0):
            raise AssertionError("two held one folder")
    captured = capsys.readouterr()
    assert "out is in use by another process: waiting" in captured.out
    assert "out is in use by another process: wait until it has ended" in captured.err
    assert not list(OUT.rglob("seed*"))
