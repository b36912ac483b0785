"""Stopping a run by SIGTERM or SIGINT: a note is made at once, and acted upon at the next step."""

import signal
import threading
from types import FrameType
from typing import Any

EXIT_STOPPED = 75  # EX_TEMPFAIL of sysexits.h: not finished, try again


class TrainingStopped(SystemExit):
    """A signal stopped the training and everything is saved. Where nobody catches it, the process ends with
    ``EXIT_STOPPED``."""

    def __init__(self, signal_name: str, num_timesteps: int, checkpoint: str) -> None:
        super().__init__(EXIT_STOPPED)
        self.signal_name = signal_name
        self.num_timesteps = num_timesteps
        self.checkpoint = checkpoint

    def __str__(self) -> str:
        return f"stopped by {self.signal_name} at step {self.num_timesteps}, saved in {self.checkpoint}"


class StopSignals:
    """Handlers that note the first signal; a second one goes to the handlers that were there before.

    Only the main thread can have handlers: elsewhere nothing is installed.
    """

    def __init__(self) -> None:
        self.received: str | None = None
        self._old: dict[int, Any] = {}

    def install(self) -> None:
        """Put the handlers in place; again does nothing."""
        if self._old or threading.current_thread() is not threading.main_thread():
            return
        self.received = None
        for number in (signal.SIGTERM, signal.SIGINT):
            self._old[number] = signal.signal(number, self._handle)

    def restore(self) -> None:
        """Put the old handlers back; again does nothing."""
        while self._old:
            number, old = self._old.popitem()
            signal.signal(number, signal.SIG_DFL if old is None else old)

    def __enter__(self) -> "StopSignals":
        self.install()
        return self

    def __exit__(self, *error: object) -> None:
        self.restore()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.received is None:
            self.received = signal.Signals(number).name
            return
        self.restore()
        signal.raise_signal(number)
