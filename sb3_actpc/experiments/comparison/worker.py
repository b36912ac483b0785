"""A process that brings one run to its end (``python -m sb3_actpc.experiments.comparison.worker``), for the local engine.

It reads the run as a line of JSON from its standard input and answers with lines of JSON on its standard output. When its
standard input closes (the command wants it to stop, or was killed) it saves a checkpoint and ends.
"""

import json
import os
import signal
import sys
import threading
from contextlib import suppress
from typing import Any


def main() -> int:
    """Run it; the exit code is 0: what came of the run has been said."""
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever libraries print goes to the log
    text = sys.stdin.readline()
    threading.Thread(target=_stop_when_input_closes, daemon=True).start()

    from sb3_actpc.experiments.comparison.execution import execute_run
    from sb3_actpc.experiments.runs import Run

    def send(**message: Any) -> None:
        with suppress(BrokenPipeError):  # the command was killed: nobody listens
            print(json.dumps(message), file=channel, flush=True)

    outcome = execute_run(Run.model_validate_json(text), lambda line: print(line, flush=True), lambda steps: send(steps=steps))
    send(status=outcome.status, message=outcome.message)
    return 0


def _stop_when_input_closes() -> None:
    while os.read(0, 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
