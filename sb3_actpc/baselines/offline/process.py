"""A program of :mod:`sb3_actpc.baselines.offline.servers`, in its own virtual environment, asked through its pipes."""

from __future__ import annotations

import os
import select
import subprocess
import tempfile
import time
from collections.abc import Sequence
from typing import Any

from sb3_actpc.baselines.offline.servers.frames import Arrays, Values, pack, unpack


class ServerFailed(OSError):
    """The other process has ended, said what is no answer, or nothing in time."""


class ServerProcess:
    """
    A child process that answers questions; it ends with its parent, whose death closes its standard input.

    :param command: its program and arguments
    :param name: for messages
    :param timeout: seconds that an answer may take
    :param threads: of numerical libraries in it
    :raises ServerFailed: when it cannot be started
    """

    def __init__(self, command: Sequence[str], name: str, timeout: float, threads: int = 1) -> None:
        self.name, self.timeout = name, timeout
        self._is_closed = False
        environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
        environment |= {"OMP_NUM_THREADS": str(threads), "PYTHONDONTWRITEBYTECODE": "1"}
        self._log = tempfile.TemporaryFile()
        try:
            # a session of its own: what is typed at the terminal (Ctrl-C) is for the parent, who then closes the pipes
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._log,
                env=environment,
                start_new_session=True,
                bufsize=0,
            )
        except OSError as error:
            self._log.close()
            raise ServerFailed(f"{name} cannot be started: {error}") from error
        assert self._process.stdin is not None and self._process.stdout is not None
        self._questions, self._answers = self._process.stdin.fileno(), self._process.stdout.fileno()
        os.set_blocking(self._questions, False)

    def ask(self, what: str, arrays: Arrays | None = None, **values: Any) -> tuple[Values, Arrays]:
        """
        :param what: the question's name
        :param arrays: its arrays
        :param values: its plain values
        :return: values and arrays of the answer
        :raises ServerFailed: when there is none; the process is then ended
        :raises ValueError: when the answer is that the question was wrong; likewise
        """
        if self._is_closed:
            raise ServerFailed(f"{self.name} has ended before: close() the agent, which starts it again as it was last saved")
        deadline = time.monotonic() + self.timeout
        try:
            self._write(pack({"ask": what, **values}, arrays or {}), deadline)
            answer, answered = unpack(lambda n: self._read(n, deadline))
        except ServerFailed:
            self.close()
            raise
        except ValueError as error:
            self.close()
            raise ServerFailed(f"{self.name} said what is no answer to {what!r}: {error}") from None
        except BaseException:  # interrupted between question and answer: they would no longer fit together
            self.close()
            raise
        if "error" in answer:
            self.close()
            raise ValueError(f"{self.name}: {answer['error']}")
        return answer, answered

    def _write(self, data: bytes, deadline: float) -> None:
        view = memoryview(data)
        while view:
            _, ready, _ = select.select([], [self._questions], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                raise ServerFailed(f"{self.name} took nothing in for {self.timeout:.0f} seconds")
            try:
                view = view[os.write(self._questions, view) :]
            except BrokenPipeError:
                raise ServerFailed(self._ending()) from None

    def _read(self, n: int, deadline: float) -> bytes:
        parts, missing = [], n
        while missing:
            ready, _, _ = select.select([self._answers], [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                raise ServerFailed(f"{self.name} gave no answer within {self.timeout:.0f} seconds")
            part = os.read(self._answers, missing)
            if not part:
                raise ServerFailed(self._ending())
            parts.append(part)
            missing -= len(part)
        return b"".join(parts)

    def _ending(self) -> str:
        try:
            code: int | str = self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            code = "none yet"
        self._log.seek(0)
        said = [line.strip() for line in self._log.read().decode(errors="replace").splitlines() if line.strip()]
        return f"{self.name} has ended (exit code {code}): {said[-1] if said else 'it said nothing'}"

    def close(self) -> None:
        """End the process, at once."""
        self._is_closed = True
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._log):
            if stream is not None:
                stream.close()

    def __del__(self) -> None:
        if hasattr(self, "_process"):
            self.close()
