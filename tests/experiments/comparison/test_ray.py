"""The Ray engine on a cluster of two nodes on this machine, one of them killed while a run is on it."""

import threading
import time
from pathlib import Path

import pytest

from sb3_actpc.checkpoints import list_bundles
from sb3_actpc.cli import main
from sb3_actpc.experiments.comparison import make_engine
from sb3_actpc.experiments.comparison.execution import run_status
from sb3_actpc.experiments.comparison.schedule import run_comparison
from sb3_actpc.experiments.runs.run import CHECKPOINTS
from tests.checkpoints.runs import log_rows
from tests.experiments.comparison.tasks import ROOT, Lines, bring_to_end, small_runs, write_preset

pytest.importorskip("ray")
OUT = Path("out")


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    write_preset(tmp_path / "small.yml")


@pytest.mark.slow
def test_the_runs_of_a_node_that_dies_are_done_elsewhere(tmp_path: Path) -> None:
    import ray
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    runs = small_runs(tmp_path / "out", ["first", "second", "third"], pause=0.2)
    deaths = []

    def kill_once_both_work() -> None:
        while sum(bool(list_bundles(run.folder / CHECKPOINTS)) for run in runs) < 2:
            time.sleep(0.1)
        cluster.remove_node(second, allow_graceful=False)
        deaths.append(second)

    display = Lines()
    threading.Thread(target=kill_once_both_work, daemon=True).start()
    try:
        summary = run_comparison(runs, tmp_path / "out", lambda: make_engine("ray", None, 1, address=cluster.address), display)
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert deaths and any(line.startswith("lost") for line in display.lines), display.lines
    assert summary.finished == runs, display.lines
    straight = small_runs(Path("straight"), ["first", "second", "third"])
    bring_to_end(straight, Path("straight"))
    for run, other in zip(runs, straight, strict=True):
        for name in ("progress.csv", "episodes.csv"):
            assert log_rows(run.folder / name) == log_rows(other.folder / name) != []


def test_a_cluster_of_its_own_is_started_and_stops_when_told(tmp_path: Path) -> None:
    """A run that is stopped has saved where it was, and goes on there."""
    [run] = small_runs(tmp_path / "out", pause=0.1)
    engine, stop = make_engine("ray", 1, 1), threading.Event()

    def stop_after_a_checkpoint() -> None:
        while not list_bundles(run.folder / CHECKPOINTS):
            time.sleep(0.1)
        stop.set()

    threading.Thread(target=stop_after_a_checkpoint, daemon=True).start()
    try:
        assert engine.capacity() == 1
        outcome = engine.execute(run, stop, lambda steps: None)
    finally:
        engine.close()
    assert outcome.status == "stopped"
    assert run_status(run.folder) == "unfinished"
    _, inline, _ = bring_to_end([run], tmp_path / "out")
    assert "from step" in inline.lines[0]


def test_no_cluster_at_the_address_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["compare", "--envs", "SparseReacher-v5", "--algos", "actpc", "--seeds", "1", "--steps", "10"]
    assert main([*arguments, "--engine", "ray", "--address", "127.0.0.1:1"]) == 2
    errors = capsys.readouterr().err
    assert "no Ray cluster answers at address='127.0.0.1:1'" in errors and errors.count("\n") == 1
