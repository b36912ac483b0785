"""What every engine does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from sb3_actpc.experiments.comparison.execution import Outcome
from sb3_actpc.experiments.comparison.run_table import PlannedRun

ENGINES = ("local", "ray")


@dataclass(frozen=True)
class Event:
    """News of a run: how far it is, or, where there is an outcome, that it has ended.

    :param run_id: which
    :param steps: environment steps done so far
    :param outcome: what came of it
    """

    run_id: str
    steps: int | None = None
    outcome: Outcome | None = None


class Engine(Protocol):
    """Executes runs, each in a process of its own with :func:`~sb3_actpc.experiments.comparison.execution.execute_run`."""

    def capacity(self) -> int:
        """How many runs can be executed at a time, now."""

    def start(self, run: PlannedRun) -> None:
        """Begin, or go on with, a run.

        :param run: one that is not under way
        """

    def poll(self, timeout: float) -> list[Event]:
        """
        :param timeout: seconds to wait for news
        :return: what has happened since the last call; each run that was started ends in exactly one event with an outcome
        """

    def stop(self) -> None:
        """Ask every run under way to save a checkpoint and end; their ends still come as events."""

    def close(self) -> None:
        """Leave nothing running."""


def make_engine(name: str, n_workers: int | None, threads: int, address: str | None = None) -> Engine:
    """
    :param name: one of ``ENGINES``
    :param n_workers: runs at a time; by default one for each core (of the cluster) and ``threads``
    :param threads: of each run
    :param address: of a Ray cluster; by default one is started on this machine
    :return: the engine
    :raises ValueError: for another name, a number below 1, or an address that the engine has no use for
    :raises ImportError: when Ray is not installed
    """
    if name not in ENGINES:
        raise ValueError(f"engine={name!r} is unknown: choose one of {', '.join(ENGINES)}")
    if n_workers is not None and n_workers < 1:
        raise ValueError(f"workers={n_workers} must be at least 1: give the number of runs at a time")
    if name == "ray":
        from sb3_actpc.experiments.comparison.engines.cluster import RayEngine

        return RayEngine(n_workers, threads, address)
    if address is not None:
        raise ValueError(f"address={address!r} is of no use to the local engine: add --engine ray, or leave it out")
    from sb3_actpc.experiments.comparison.engines.local import LocalEngine

    return LocalEngine(n_workers, threads)
