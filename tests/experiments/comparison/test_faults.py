"""SIGKILL and SIGTERM, to the command and to its workers: real processes on a comparison of a few steps."""

import os
import random
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
from sb3_actpc.experiments.comparison.execution import FINISHED, run_status
from sb3_actpc.experiments.runs.run import CHECKPOINTS
from tests.checkpoints.runs import log_rows
from tests.experiments.comparison.tasks import ROOT, TASK, bring_to_end, small_runs, write_demonstrations, write_preset

OUT = Path("out")
PATIENCE = 300.0  # seconds
FILES = ("progress.csv", "episodes.csv")


@pytest.fixture(autouse=True)
def comparison_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_preset()


def write_comparison(algos: list[Any], **env_kwargs: object) -> None:
    """What :func:`small_runs` plans, as a file for the command."""
    discounts = {"first": 0.9, "second": 0.8}
    entries = [
        {"name": one, "algo": "actpc", "preset": "small.yml", "settings": {"gamma": discounts[one]}}
        if isinstance(one, str)
        else one
        for one in algos
    ]
    given = {
        "envs": [{"env": TASK, "env_kwargs": env_kwargs, "demonstrations": "none"}],
        "algos": entries,
        "seeds": 1,
        "eval_freq": 20,
        "eval_episodes": 1,
        "checkpoint_freq": 10,
        "output": str(OUT),
    }
    Path("c.yml").write_text(yaml.safe_dump(given), encoding="utf-8")


def start_command(*options: str) -> subprocess.Popen[str]:
    code = "import sys; from sb3_actpc.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "compare", "c.yml", *options]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "stdin": subprocess.DEVNULL}
    return subprocess.Popen(command, text=True, env=environment, start_new_session=True, **pipes)


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.02)


def worker_of(command: subprocess.Popen[str]) -> int:
    """The worker that one of the command's threads has started."""

    def workers() -> list[int]:
        lists = [path.read_text().split() for path in Path(f"/proc/{command.pid}/task").glob("*/children")]
        children = [int(pid) for pids in lists for pid in pids]
        return [pid for pid in children if b"comparison.worker" in Path(f"/proc/{pid}/cmdline").read_bytes()]

    wait_until(lambda: bool(workers()))
    return workers()[0]


needs_proc = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="processes are found in /proc")


def test_a_worker_that_is_killed_takes_nothing_along_and_its_run_goes_on() -> None:
    """SIGKILL at step 30 of the first of two runs; both end as those that were never killed."""
    fault = str(Path("fault").absolute())
    runs = small_runs(OUT, ["first", "second"], fault=fault)
    write_comparison(["first", "second"], fault=fault)
    Path("fault").touch()
    command = start_command("--workers", "1")
    printed, errors = command.communicate(timeout=PATIENCE)
    assert command.returncode == 0, errors
    assert "ended with signal 9" in printed and "lost, will go on" in printed
    assert "2 of 2 runs are finished" in printed
    log = (runs[0].folder / "log.txt").read_text(encoding="utf-8")
    assert "from step 20" in log
    straight = small_runs(Path("straight"), ["first", "second"])
    bring_to_end(straight, Path("straight"))
    for run, other in zip(runs, straight, strict=True):
        for name in FILES:
            assert log_rows(run.folder / name) == log_rows(other.folder / name) != []


@needs_proc
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_command_that_is_killed_or_stopped_goes_on_where_it_was(number: int) -> None:
    """Its worker notices, saves a checkpoint and ends; the same command then repeats nothing."""
    write_comparison(["first"], pause=0.03)
    [run] = small_runs(OUT, pause=0.03)
    command = start_command("--workers", "1")
    worker = worker_of(command)
    wait_until(lambda: bool(list_bundles(run.folder / CHECKPOINTS)))
    command.send_signal(number)
    _, errors = command.communicate(timeout=PATIENCE)
    assert command.returncode == (EXIT_STOPPED if number == signal.SIGTERM else -signal.SIGKILL)
    if number == signal.SIGTERM:
        assert errors.count("\n") == 1 and "stopped by SIGTERM; 1 runs are left, the same command goes on" in errors
    wait_until(lambda: not Path(f"/proc/{worker}").exists())
    assert run_status(run.folder) != FINISHED
    newest = list_bundles(run.folder / CHECKPOINTS)[-1].name
    step = int(newest.rpartition("_")[2])
    assert step < run.n_timesteps
    again = start_command("--workers", "1")
    _, errors = again.communicate(timeout=PATIENCE)
    assert again.returncode == 0, errors
    assert f"from step {step}" in (run.folder / "log.txt").read_text(encoding="utf-8")
    [straight] = small_runs(Path("straight"))
    bring_to_end([straight], Path("straight"))
    for name in FILES:
        assert log_rows(run.folder / name) == log_rows(straight.folder / name) != []


@pytest.mark.slow
def test_a_command_that_is_killed_ten_times_ends_as_if_it_never_was() -> None:
    """SIGKILL at random moments, to the command alone or to its workers too; one run has BC and a deployment gate."""
    write_demonstrations()
    shown = {"name": "shown", "algo": "actpc", "preset": "small.yml", "demonstrations": "demonstrations.npz"}
    shown["settings"] = {"guidance_kwargs": {"bc_updates": 40, "critic_warmup": 10}}
    write_comparison(["first", shown], pause=0.1)
    moments, n_kills, finished = random.Random(0), 0, False
    while not finished:
        command = start_command("--workers", "2")
        try:
            _, errors = command.communicate(timeout=moments.uniform(4.0, 20.0) if n_kills < 10 else PATIENCE)
            assert command.returncode == 0, errors
            finished = True
        except subprocess.TimeoutExpired:
            n_kills += 1
            (os.killpg if n_kills % 2 else os.kill)(command.pid, signal.SIGKILL)
            command.communicate()
    assert n_kills >= 3
    straight = small_runs(Path("straight"), ["first", shown])
    bring_to_end(straight, Path("straight"))
    for run, other in zip(small_runs(OUT, ["first", shown], pause=0.1), straight, strict=True):
        for name in FILES:
            assert log_rows(run.folder / name) == log_rows(other.folder / name) != []
