"""Runs as tasks of a Ray cluster (extra ``ray``); their folders end up on this machine, shared or not."""

import io
import os
import socket
import tempfile
import time
import uuid
import zipfile
from pathlib import Path
from typing import Any

from sb3_actpc.experiments.comparison.engines import Engine, Event
from sb3_actpc.experiments.comparison.execution import LOG, LOST, STOPPED, Outcome, execute_run
from sb3_actpc.experiments.runs import Run
from sb3_actpc.utils.extras import import_extra
from sb3_actpc.utils.files import LOCK

CONNECTION_TIME = 10.0  # seconds
_PROBE = ".shared-"  # a file by which a node sees whether it shares the folders


class RayEngine(Engine):
    """A Ray task for each run, at most ``n_workers`` at a time, by default as many as the cluster has cores for their
    ``threads``. A run whose node dies ends as lost, and is begun again, or gone on with, elsewhere. A node that sees this
    machine's folders (a network file system, or the same machine) works in them, checkpoints and all. To another the run's
    folder is sent, and what it made of it comes back when the run has ended. The cluster is that at the ``address``, such as
    ``"auto"`` or ``"10.0.0.1:6379"``; by default one is started on this machine, or the one that this process has joined
    already is used. ImportError when Ray is not installed, ConnectionError when there is no cluster at the address."""

    def __init__(self, n_workers: int | None = None, threads: int = 1, address: str | None = None) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported to anybody unless the user asks for it
        self.ray = import_extra("ray", "ray")
        self.n_workers, self.threads = n_workers, threads
        self._is_mine = not self.ray.is_initialized()
        if self._is_mine:
            _check_address(address)
            # None might find the file of a cluster that has died, and wait for it
            options = {"address": "local", "include_dashboard": False} if address is None else {"address": address}
            self.ray.init(log_to_driver=False, **options)
        self._task = self.ray.remote(num_cpus=threads, max_retries=0)(_execute)
        # the actor to which runs tell their steps; on this node, so that no other's death takes it along
        context = self.ray.get_runtime_context()
        node, self._head = context.get_node_id(), context.gcs_address
        here = import_extra("ray.util.scheduling_strategies", "ray").NodeAffinitySchedulingStrategy(node, soft=True)
        self._board = self.ray.remote(num_cpus=0, scheduling_strategy=here)(StepBoard).remote()
        self._tasks: dict[Any, Run] = {}  # by Ray's reference to the answer
        self._steps: dict[str, int] = {}
        self._is_stopping = False

    def capacity(self) -> int:
        """As many as the nodes that live now have cores for."""
        fitting = int(self.ray.cluster_resources().get("CPU", 0)) // self.threads
        return max(1, fitting if self.n_workers is None else min(fitting, self.n_workers))

    def start(self, run: Run) -> None:
        run.folder.mkdir(parents=True, exist_ok=True)
        folder = run.folder.absolute()
        run = run.model_copy(update={"output": str(folder)})
        probe = folder / f"{_PROBE}{uuid.uuid4().hex}"
        probe.touch()
        packed = self.ray.put(pack_folder(folder))
        self._tasks[self._task.remote(run.model_dump_json(), str(probe), packed, self._board)] = run

    def poll(self, timeout: float) -> list[Event]:
        if not self._tasks:
            time.sleep(timeout)
            return []
        ended, _ = self.ray.wait(list(self._tasks), num_returns=1, timeout=timeout)
        try:
            _check_address(self._head)
        except ConnectionError as error:  # Ray would wait for a minute and end this process
            self._tasks, self._is_mine = {}, False
            died = f"the head of the Ray cluster at {self._head} has died"
            raise ConnectionError(f"{died}: start a cluster again, with whose address the same command goes on") from error
        return [*self._progress(), *(self._end(reference) for reference in ended)]

    def stop(self) -> None:
        """Interrupt the tasks, upon which they save and end."""
        self._is_stopping = True
        for reference in self._tasks:
            self.ray.cancel(reference)

    def close(self) -> None:
        """Leave the cluster, and end it if this engine started it."""
        for reference in self._tasks:
            self.ray.cancel(reference, force=True)
        if self._is_mine:
            self.ray.shutdown()

    def _progress(self) -> list[Event]:
        try:
            steps = self.ray.get(self._board.read.remote(), timeout=5.0)
        except self.ray.exceptions.RayError:  # the steps are for display only
            return []
        news = [Event(run_id, steps=count) for run_id, count in steps.items() if self._steps.get(run_id) != count]
        self._steps = steps
        return news

    def _end(self, reference: Any) -> Event:
        run = self._tasks.pop(reference)
        for probe in run.folder.glob(f"{_PROBE}*"):
            probe.unlink(missing_ok=True)
        try:
            status, message, packed = self.ray.get(reference)
        except self.ray.exceptions.RayError as error:  # the node, or the process on it, died
            first_line = (str(error).strip() or type(error).__name__).splitlines()[0]
            return Event(run.id, outcome=Outcome(STOPPED if self._is_stopping else LOST, first_line))
        if packed is not None:
            unpack_folder(packed, run.folder)
        return Event(run.id, outcome=Outcome(status, message))


class StepBoard:
    """The steps that each run has done."""

    def __init__(self) -> None:
        self.steps: dict[str, int] = {}

    def write(self, run_id: str, steps: int) -> None:
        """Note the steps of a run."""
        self.steps[run_id] = steps

    def read(self) -> dict[str, int]:
        """Steps by the run's id."""
        return self.steps


def _execute(job: str, probe: str, packed: bytes, board: Any) -> tuple[str, str, bytes | None]:
    """On a node: bring a run to its end, in its folder where that is seen; else in a copy, which is sent back."""
    run, is_shared = Run.model_validate_json(job), Path(probe).is_file()

    def on_steps(steps: int) -> None:
        if board is not None:
            board.write.remote(run.id, steps)

    with tempfile.TemporaryDirectory() as temporary:
        if not is_shared:
            unpack_folder(packed, Path(temporary))
            run = run.model_copy(update={"output": temporary})
        with open(run.folder / LOG, "a", encoding="utf-8") as log:  # as the local engine has it
            outcome = execute_run(run, lambda line: print(line, file=log, flush=True), on_steps)
        return outcome.status, outcome.message, None if is_shared else pack_folder(run.folder)


def pack_folder(folder: Path) -> bytes:
    """The files of a folder as a ZIP archive, locks and probes left out."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as target:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path.name != LOCK and not path.name.startswith(_PROBE):
                target.write(path, path.relative_to(folder))
    return archive.getvalue()


def unpack_folder(archive: bytes, folder: Path) -> None:
    """Make a folder what another was, packed by :func:`pack_folder`; files that the archive does not hold are removed,
    ``result.json`` comes last."""
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(io.BytesIO(archive)) as source:
        names = source.namelist()
        for name in sorted(names, key=lambda name: name == "result.json"):
            source.extract(name, folder)  # which keeps within the folder
    kept = {(folder / name).resolve() for name in names}
    for path in folder.rglob("*"):
        if path.is_file() and path.resolve() not in kept and path.name != LOCK:
            path.unlink()


def _check_address(address: str | None) -> None:
    """Ray itself would try for minutes, where nobody answers at ``host:port``."""
    host, separator, port = (address or "").rpartition(":")
    if not separator or "/" in host or not port.isdigit():  # "auto", or a URL of Ray's
        return
    try:
        socket.create_connection((host, int(port)), timeout=CONNECTION_TIME).close()
    except OSError as error:
        raise ConnectionError(
            f"no Ray cluster answers at address={address!r} ({error.strerror or error}): give that of `ray start --head`, or "
            "leave it out to start one on this machine"
        ) from error
