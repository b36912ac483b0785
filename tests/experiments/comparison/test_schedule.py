"""Which runs are begun, gone on with, tried again or left alone; in this process, with faults planted."""

import errno
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from sb3_actpc.checkpoints import list_bundles
from sb3_actpc.cli import main
from sb3_actpc.experiments.comparison.display import Display, describe_runs
from sb3_actpc.experiments.comparison.execution import (
    FAILED,
    FINISHED,
    LOST,
    NEW,
    UNFINISHED,
    Outcome,
    execute_run,
    run_status,
)
from sb3_actpc.experiments.comparison.schedule import MAX_LOSSES
from sb3_actpc.experiments.runs import Run
from sb3_actpc.experiments.runs.record import read_result, read_run
from sb3_actpc.experiments.runs.run import CHECKPOINTS
from sb3_actpc.utils.files import FolderBusy, folder_lock
from tests.checkpoints.runs import log_rows
from tests.experiments.comparison import tasks
from tests.experiments.comparison.tasks import bring_to_end, interrupt_after, small_runs, write_preset

OUT = Path("out")
FILES = ("progress.csv", "episodes.csv")


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_preset()


def measured(run: Run) -> list[Any]:
    """What a run wrote, without times of the clock."""
    return [log_rows(run.folder / name) for name in FILES]


def test_all_runs_are_brought_to_their_end_once() -> None:
    runs = small_runs(OUT, ["first", "second"])
    summary, engine, _ = bring_to_end(runs, OUT)
    assert (len(summary.finished), summary.failed, summary.unfinished) == (2, [], [])
    assert engine.begun == runs
    before = [(run.folder / "result.json").read_bytes() for run in runs]
    summary, engine, display = bring_to_end(runs, OUT)
    assert len(summary.finished) == 2 and engine.begun == []
    assert display.lines == ["0 to do, 2 finished"]
    assert [(run.folder / "result.json").read_bytes() for run in runs] == before


def test_a_table_that_grows_is_only_added_to() -> None:
    bring_to_end(small_runs(OUT, ["first"]), OUT)
    _, engine, _ = bring_to_end(small_runs(OUT, ["first", "second"], seeds=2), OUT)
    assert [(run.name, run.seed) for run in engine.begun] == [("second", 0), ("first", 1), ("second", 1)]


def test_an_unfinished_run_goes_on_from_its_checkpoint_and_ends_as_the_one_never_stopped() -> None:
    [straight] = small_runs(Path("straight"))
    bring_to_end([straight], Path("straight"))
    [run] = small_runs(OUT)
    interrupt_after(run, 33)
    assert run_status(run.folder) == UNFINISHED
    summary, engine, _ = bring_to_end([run], OUT)
    assert summary.finished == [run]
    assert "60 steps from step 33" in engine.lines[0]
    assert measured(run) == measured(straight)
    assert [row["timesteps"] for row in measured(run)[1]] == ["8", "16", "24", "32", "40", "48", "56"]


def test_a_run_that_goes_on_takes_what_does_not_decide_its_outcome_from_the_command() -> None:
    [run] = small_runs(OUT)
    interrupt_after(run, 33)
    bring_to_end([run.model_copy(update={"threads": 2, "checkpoint_freq": 7})], OUT)
    stored = read_run(run.folder)
    assert (stored.threads, stored.checkpoint_freq) == (2, 7)


def test_a_truncated_checkpoint_is_passed_over_for_the_one_before() -> None:
    [straight] = small_runs(Path("straight"))
    bring_to_end([straight], Path("straight"))
    [run] = small_runs(OUT)
    interrupt_after(run, 33)
    newest = list_bundles(run.folder / CHECKPOINTS)[-1] / "state.json"
    newest.write_bytes(newest.read_bytes()[:100])
    _, engine, _ = bring_to_end([run], OUT)
    assert "damaged checkpoint skipped" in engine.lines[0] and "state.json" in engine.lines[0]
    assert "from step 30" in engine.lines[1]
    assert measured(run) == measured(straight)


def test_a_run_whose_checkpoints_are_all_damaged_starts_again() -> None:
    [run] = small_runs(OUT)
    interrupt_after(run, 33)
    for bundle in list_bundles(run.folder / CHECKPOINTS):
        (bundle / "manifest.json").write_bytes(b"{")
    summary, engine, _ = bring_to_end([run], OUT)
    assert summary.finished == [run]
    assert any("checkpoints are damaged" in line and "the run starts again" in line for line in engine.lines)


def test_a_damaged_config_starts_the_run_again() -> None:
    [run] = small_runs(OUT)
    interrupt_after(run, 33)
    (run.folder / "config.json").write_bytes(b"{")
    summary, engine, _ = bring_to_end([run], OUT)
    assert summary.finished == [run]
    assert "config.json: not a JSON file: the run starts again" in engine.lines[0]


def test_a_corrupt_result_is_written_again_without_training() -> None:
    [run] = small_runs(OUT)
    bring_to_end([run], OUT)
    before = (run.folder / "result.json").read_bytes()
    for content in (b"", b"{", b"[]", b'{"env": 1}', b"\xff", before[:-40]):
        (run.folder / "result.json").write_bytes(content)
        assert run_status(run.folder) == UNFINISHED
        summary, engine, display = bring_to_end([run], OUT)
        assert summary.finished == [run] and engine.begun == []
        assert "written again from the run's other files" in display.lines[0]
        assert (run.folder / "result.json").read_bytes() == before


def test_a_result_of_a_run_that_has_not_ended_is_removed_and_the_run_goes_on() -> None:
    [run] = small_runs(OUT)
    interrupt_after(run, 33)
    (run.folder / "result.json").write_bytes(b"{")
    summary, engine, display = bring_to_end([run], OUT)
    assert "the run goes on from its last checkpoint" in display.lines[0]
    assert "from step 33" in engine.lines[0] and summary.finished == [run]


def test_a_failed_run_stops_no_other_and_is_tried_again_on_request_only() -> None:
    Path("fault").touch()
    runs = small_runs(OUT, ["first", "second"], fault=str(Path("fault").absolute()), at_fault="error")
    summary, _, _ = bring_to_end(runs, OUT)
    [(failed, message)] = summary.failed
    assert failed == runs[0] and message == "RuntimeError: the planted fault"
    assert summary.finished == runs[1:]
    assert "tasks.py" in json.loads((failed.folder / "error.json").read_text(encoding="utf-8"))["details"]
    summary, engine, _ = bring_to_end(runs, OUT)
    assert engine.begun == [] and [run for run, _ in summary.failed] == [failed]
    summary, engine, _ = bring_to_end(runs, OUT, retry_failed=True)
    assert engine.begun == [failed]
    assert "from step 20" in engine.lines[0]
    assert summary.finished == runs and not (failed.folder / "error.json").exists()


class FaultyEngine(tasks.InlineEngine):
    """The process of a run dies so many times."""

    n_losses = 0

    def outcome_of(self, run: Run) -> Outcome:
        if self.n_losses:
            self.n_losses -= 1
            return Outcome(LOST, "the process of the run ended with signal 9")
        return super().outcome_of(run)


@pytest.mark.parametrize("n_losses", [MAX_LOSSES - 1, MAX_LOSSES])
def test_a_run_whose_process_dies_is_tried_again_but_not_for_ever(n_losses: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "InlineEngine", FaultyEngine)
    monkeypatch.setattr(FaultyEngine, "n_losses", n_losses)
    [run] = small_runs(OUT)
    summary, engine, _ = bring_to_end([run], OUT)
    assert len(engine.begun) == min(n_losses + 1, MAX_LOSSES)
    if n_losses < MAX_LOSSES:
        assert summary.finished == [run]
    else:
        assert summary.failed == [(run, "given up after 3 times: the process of the run ended with signal 9")]


def test_a_full_disk_stops_the_command_and_loses_nothing() -> None:
    Path("fault").touch()
    runs = small_runs(OUT, ["first", "second"], fault=str(Path("fault").absolute()), at_fault="full")
    summary, engine, _ = bring_to_end(runs, OUT)
    assert summary.stopped_by == "disk full" and "No space left" in summary.message
    assert engine.begun == runs[:1] and summary.unfinished == runs  # nothing further is begun
    assert not (runs[0].folder / "error.json").exists()  # the run is not to blame
    summary, engine, _ = bring_to_end(runs, OUT)
    assert summary.finished == runs
    assert "from step 20" in engine.lines[0]


def can_mount() -> bool:
    return hasattr(os, "geteuid") and os.geteuid() == 0 and shutil.which("mount") is not None


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if not can_mount():
        pytest.skip("only root can mount a small file system")
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no file system can be mounted here")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_on_a_disk_that_is_really_full_nothing_is_lost(small_disk: Path) -> None:
    """The first run is finished and leaves 20 kB, the second does not fit; once there is room it goes on."""
    [first] = small_runs(small_disk, ["first"])
    bring_to_end([first], small_disk)
    kept = measured(first)
    free = shutil.disk_usage(small_disk).free
    (small_disk / "ballast").write_bytes(b"x" * max(free - 20_000, 0))
    runs = [first, *small_runs(small_disk, ["second"])]
    summary, _, _ = bring_to_end(runs, small_disk)
    assert summary.stopped_by == "disk full"
    assert summary.finished == [first] and measured(first) == kept
    (small_disk / "ballast").unlink()
    summary, engine, _ = bring_to_end(runs, small_disk)
    assert summary.finished == runs and engine.begun == runs[1:]
    [straight] = small_runs(Path("straight"), ["second"])
    bring_to_end([straight], Path("straight"))
    assert measured(runs[1]) == measured(straight)


def test_a_second_command_in_the_folder_is_refused_with_a_message(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_actpc.experiments.comparison.schedule.LOCK_WAIT", 0.3)
    with folder_lock(OUT, 0.0):
        assert main(["compare", "--envs", "SparseReacher-v5", "--algos", "actpc", "--output", str(OUT)]) == 2
    captured = capsys.readouterr()
    assert "out is in use by another process: waiting" in captured.out
    assert "out is in use by another process: wait until it has ended" in captured.err
    assert not list(OUT.rglob("seed*"))


def test_a_run_that_another_process_works_on_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_actpc.experiments.comparison.execution.LOCK_WAIT", 0.3)
    [run] = small_runs(OUT)
    with folder_lock(run.folder, 0.0):
        lines: list[str] = []
        outcome = execute_run(run, lines.append, lambda steps: None)
        assert outcome.status == LOST and "is in use by another process" in outcome.message
        assert "waiting" in lines[0] and run_status(run.folder) == NEW
    with folder_lock(run.folder, 0.0):  # free again
        pass
    with folder_lock(run.folder, 0.0), pytest.raises(FolderBusy), folder_lock(run.folder, 0.0):
        raise AssertionError("two held one folder")


def test_every_state_of_a_run_has_its_name() -> None:
    [run] = small_runs(OUT)
    assert run_status(run.folder) == NEW
    bring_to_end([run], OUT)
    assert run_status(run.folder) == FINISHED
    assert read_result(run.folder)["timesteps"] == 60


def test_the_table_gives_the_seconds_of_finished_runs_to_those_of_their_kind_and_guesses_none() -> None:
    finished, alike, other = [*small_runs(OUT, seeds=2), *small_runs(OUT, ["second"])]
    bring_to_end([finished], OUT)
    result = json.loads((finished.folder / "result.json").read_text(encoding="utf-8"))
    (finished.folder / "result.json").write_text(json.dumps({**result, "wall_seconds": 600.0}), encoding="utf-8")
    rows = {line.split()[0]: line.split()[1:] for line in describe_runs([finished, alike, other]).splitlines()[1:4]}
    assert rows[finished.id][-2:] == ["finished", "600"]
    assert rows[alike.id][-2:] == ["new", "600"]
    assert rows[other.id][-1] == "new"


def test_without_a_terminal_there_are_lines() -> None:
    text = StringIO()
    [run] = small_runs(OUT)
    with Display(console=Console(file=text, width=40)) as display:
        display.begin([run], 0)
        display.started(run)
        display.ended(run, Outcome(FAILED, "a reason [red]"))
    first, second, last = text.getvalue().splitlines()
    assert "1 to do" in first and "started" in second
    assert "failed" in last and "a reason [red]" in last and "0 of 1 runs done" in last


def test_in_a_terminal_there_are_bars() -> None:
    text = StringIO()
    [run] = small_runs(OUT)
    with Display(console=Console(file=text, force_terminal=True, width=160)) as display:
        display.begin([run], 1)
        display.started(run)
        display.stepped(run, 30)
        display.progress.refresh()
        display.ended(run, Outcome(FINISHED))
    shown = text.getvalue()
    assert "30/60" in shown and "60/60" in shown and "2 of 2 runs done" in shown


def test_disk_full_is_told_from_other_errors() -> None:
    from sb3_actpc.experiments.comparison.execution import is_disk_full

    assert is_disk_full(OSError(errno.ENOSPC, "")) and is_disk_full(OSError(errno.EDQUOT, ""))
    assert not is_disk_full(OSError(errno.EACCES, "")) and not is_disk_full(ValueError())
