"""What every engine does."""

from dataclasses import dataclass
from typing import Protocol

from sb3_actpc.experiments.comparison.execution import Outcome
from sb3_actpc.experiments.runs import Run


@dataclass(frozen=True)
class Event:
    """News of a run: how many steps it has done, or, where there is an outcome, that it has ended."""

    run_id: str
    steps: int | None = None
    outcome: Outcome | None = None


class Engine(Protocol):
    """Executes runs, each in a process of its own with :func:`~sb3_actpc.experiments.comparison.execution.execute_run`."""

    def capacity(self) -> int:
        """How many runs can be executed at a time, now."""

    def start(self, run: Run) -> None:
        """Begin, or go on with, a run that is not under way."""

    def poll(self, timeout: float) -> list[Event]:
        """What has happened since the last call, waiting for it some seconds; each run that was started ends in exactly one
        event with an outcome."""

    def stop(self) -> None:
        """Ask every run under way to save a checkpoint and end; their ends still come as events."""

    def close(self) -> None:
        """Leave nothing running."""
