"""A program of :mod:`sb3_actpc.baselines.offline.servers`, in its own virtual environment, asked through a pipe."""

import os
import subprocess
import tempfile
from collections.abc import Sequence
from multiprocessing import Pipe
from threading import Timer
from typing import Any

from sb3_actpc.baselines.offline.servers.frames import Arrays, Values, pack, unpack

MAX_ANSWER = 2**30  # bytes


class ServerFailed(OSError):
    """The other process has ended, said what is no answer, or nothing in time."""


class ServerProcess:
    """A child process, by the ``command`` that starts it, which answers questions, each within ``timeout`` seconds; it ends
    with its parent, whose death closes the pipe. ``name`` is for messages, ``threads`` are those of numerical libraries in it.
    ServerFailed when it cannot be started."""

    def __init__(self, command: Sequence[str], name: str, timeout: float, threads: int = 1) -> None:
        self.name, self.timeout = name, timeout
        environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
        environment |= {"OMP_NUM_THREADS": str(threads), "PYTHONDONTWRITEBYTECODE": "1"}
        self._log = tempfile.TemporaryFile()
        self._channel, theirs = Pipe()
        try:
            self._process = subprocess.Popen(
                [*command, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                env=environment,
                start_new_session=True,  # Ctrl-C is for the parent, who then closes the pipe
            )
        except OSError as error:
            self._channel.close()
            self._log.close()
            raise ServerFailed(f"{name} cannot be started: {error}") from error
        finally:
            theirs.close()

    def ask(self, what: str, arrays: Arrays | None = None, **values: Any) -> tuple[Values, Arrays]:
        """Values and arrays of the answer to a question of this name, with these arrays and plain values; ServerFailed when
        there is none, ValueError when it is that the question was wrong, and the process is then ended."""
        if self._channel.closed:
            raise ServerFailed(f"{self.name} has ended before: close() the agent, which starts it again as it was last saved")
        is_answered = False
        deadline = Timer(self.timeout, self._process.kill)  # sending blocks while the other takes nothing in
        try:
            deadline.start()
            self._channel.send_bytes(pack({"ask": what, **values}, arrays or {}))
            deadline.cancel()
            if not self._channel.poll(self.timeout):
                raise TimeoutError
            answer, answered = unpack(self._channel.recv_bytes(MAX_ANSWER))
            is_answered = "error" not in answer
        except TimeoutError:
            raise ServerFailed(f"{self.name} gave no answer within {self.timeout:.0f} seconds") from None
        except (EOFError, ConnectionError):
            raise ServerFailed(self._ending()) from None
        except (OSError, ValueError) as error:
            raise ServerFailed(f"{self.name} said what is no answer to {what!r}: {error}") from None
        finally:
            deadline.cancel()
            if not is_answered:  # also when interrupted: the next answer would not fit its question
                self.close()
        if "error" in answer:
            raise ValueError(f"{self.name}: {answer['error']}")
        return answer, answered

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
        self._process.kill()
        self._process.wait()
        self._channel.close()
        self._log.close()

    def __del__(self) -> None:
        if hasattr(self, "_process"):
            self.close()
