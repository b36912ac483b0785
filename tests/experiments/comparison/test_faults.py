"""SIGKILL and SIGTERM, to the command and to its workers: real processes on a comparison of a few steps."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from sb3_actpc.checkpoints import EXIT_STOPPED, list_bundles
from sb3_actpc.experiments.comparison.schedule import FINISHED, run_status
from sb3_actpc.experiments.runs.run import CHECKPOINTS
from tests.experiments.comparison.tasks import ROOT, measured, small_comparison, small_runs, straight

OUT = Path("out")
PATIENCE = 300.0  # seconds


def start_command(*options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "sb3_actpc", "compare", "c.yml", *options]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "stdin": subprocess.DEVNULL}
    return subprocess.Popen(command, text=True, env=environment, start_new_session=True, **pipes)


def write_comparison(algos: list[str], **env_kwargs: object) -> None:
    """What :func:`small_runs` plans, as a file for the command."""
    Path("c.yml").write_text(yaml.safe_dump({**small_comparison(algos, **env_kwargs), "output": str(OUT)}), encoding="utf-8")


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.02)


@pytest.mark.parametrize(("n_deaths", "code"), [(1, 0), (3, 1)])
def test_a_worker_that_is_killed_takes_nothing_along_and_its_run_goes_on(n_deaths: int, code: int) -> None:
    """SIGKILL at step 30 of the first of two runs; both end as those that were never killed. Not for ever, though."""
    fault = str(Path("fault").absolute())
    runs = small_runs(OUT, ["first", "second"], fault=fault)
    write_comparison(["first", "second"], fault=fault)
    Path("fault").touch()
    command = start_command("--workers", "1")
    if n_deaths > 1:
        for _ in range(n_deaths - 1):  # it is removed at each death
            wait_until(lambda: not Path("fault").exists() or command.poll() is not None)
            Path("fault").touch()
    printed, errors = command.communicate(timeout=PATIENCE)
    assert command.returncode == code, errors
    assert printed.count("ended with signal 9") == n_deaths
    assert f"{2 - code} of 2 runs are finished" in printed
    assert ("given up after 3 times" in errors) == bool(code)
    expected = straight(["first", "second"])
    assert [measured(run) for run in runs][code:] == expected[code:]
    if not code:
        assert "from step 20" in (runs[0].folder / "log.txt").read_text(encoding="utf-8")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_command_that_is_killed_or_stopped_goes_on_where_it_was(number: int) -> None:
    """Its worker notices, saves a checkpoint and ends; the same command then repeats nothing."""
    write_comparison(["first"], pause=0.03)
    [run] = small_runs(OUT, pause=0.03)
    command = start_command("--workers", "1")
    wait_until(lambda: bool(list_bundles(run.folder / CHECKPOINTS)))
    if number == signal.SIGINT:  # Ctrl-C, to all of the terminal
        os.killpg(command.pid, number)
    else:
        command.send_signal(number)
    _, errors = command.communicate(timeout=PATIENCE)
    if number == signal.SIGKILL:
        assert command.returncode == -signal.SIGKILL
    else:
        assert command.returncode == EXIT_STOPPED
        assert errors == "sb3-actpc: stopped by SIGINT; 1 runs are left, the same command goes on with them\n"
    assert run_status(run.folder) != FINISHED
    again = start_command("--workers", "1")  # it waits for the worker of the other
    _, errors = again.communicate(timeout=PATIENCE)
    assert again.returncode == 0, errors
    steps = [int(part.split(",")[0]) for part in (run.folder / "log.txt").read_text("utf-8").split("from step ")[1:]]
    assert len(steps) == 1 and 0 < steps[0] < 60
    assert [measured(run)] == straight()
