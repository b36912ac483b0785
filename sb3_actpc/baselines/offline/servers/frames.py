"""What two processes say to each other through a pipe: plain values as JSON and numpy arrays, as one ``.npz``.

Nothing is unpickled. The standard library and numpy are enough to read it.
"""

import io
import json
import sys
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

VALUES = "values"  # the entry that holds them
QUESTIONS = ("build", "show", "train", "predict", "save", "load")

Values = dict[str, Any]
Arrays = dict[str, np.ndarray]


def pack(values: Values, arrays: Arrays) -> bytes:
    """What JSON can hold, and arrays of numbers, as one message; ValueError for arrays of objects."""
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise ValueError(f"array {name!r} has the type {array.dtype}, which no message holds")
    message = io.BytesIO()
    np.savez(message, **{VALUES: np.frombuffer(json.dumps(values).encode(), np.uint8)}, **arrays)
    return message.getvalue()


def unpack(message: bytes) -> tuple[Values, Arrays]:
    """Values and arrays of what :func:`pack` returned; ValueError when it is no such message."""
    try:
        with np.load(io.BytesIO(message), allow_pickle=False) as stored:
            arrays = dict(stored)
        return dict(json.loads(arrays.pop(VALUES).tobytes())), arrays
    except Exception as error:  # the readers of zip and npy have a dozen kinds
        raise ValueError(f"expected values and arrays, found {message[:16]!r} ({error})") from None


def serve(server: Any) -> int:
    """Answer the questions of the pipe whose number is the last argument of this program, until it is closed: the exit
    code. The server's method, by the ``ask`` of a question, one of ``QUESTIONS``, is given its values and arrays and returns
    those of the answer, if any. An exception is the answer ``{"error": ...}`` and ends the program."""
    methods = {name: getattr(server, name) for name in QUESTIONS}
    channel = Connection(int(sys.argv[-1]))
    with suppress(EOFError, ConnectionError):  # the other side has ended
        while True:
            values, arrays = unpack(channel.recv_bytes())
            try:
                answer = pack(*(methods[values.pop("ask")](values, arrays) or ({}, {})))
            except Exception as error:
                traceback.print_exc()
                channel.send_bytes(pack({"error": f"{type(error).__name__}: {error}"}, {}))
                return 1
            channel.send_bytes(answer)
    return 0
