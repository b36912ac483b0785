"""The Ray engine on a cluster of two nodes on this machine, one of them killed while a run is on it."""

import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from sb3_actpc.checkpoints import list_bundles
from sb3_actpc.experiments.comparison.schedule import FINISHED, run_comparison, run_on_ray, run_status
from sb3_actpc.experiments.runs import Run
from sb3_actpc.experiments.runs.run import CHECKPOINTS
from tests.experiments.comparison.tasks import bring_to_end, measured, small_runs, straight

pytest.importorskip("ray")


def once_saved(runs: list[Run], act: Callable[[], object]) -> None:
    """In another thread, when all runs have a checkpoint."""

    def wait() -> None:
        while not all(list_bundles(run.folder / CHECKPOINTS) for run in runs):
            time.sleep(0.1)
        act()

    threading.Thread(target=wait, daemon=True).start()


@pytest.mark.slow
def test_the_runs_of_a_node_that_dies_are_done_elsewhere(tmp_path: Path) -> None:
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    runs = small_runs(tmp_path / "out", ["first", "second"], pause=0.2)
    deaths: list[object] = []
    once_saved(runs, lambda: deaths.append(cluster.remove_node(second, allow_graceful=False)))
    try:
        run_comparison(runs, tmp_path / "out", partial(run_on_ray, cluster.address, 1))
    finally:
        cluster.shutdown()
    assert deaths and [measured(run) for run in runs] == straight(["first", "second"])


def test_runs_on_a_cluster_of_its_own_save_when_told_and_go_on(tmp_path: Path) -> None:
    [run] = small_runs(tmp_path / "out", pause=0.1)
    stop = threading.Event()
    once_saved([run], stop.set)
    [(_, outcome)] = run_on_ray(None, 1, [run], stop.is_set)
    assert outcome.status == "stopped" and run_status(run.folder) == "unfinished"
    _, lines = bring_to_end([run], tmp_path / "out")
    assert "from step" in lines[0] and run_status(run.folder) == FINISHED
