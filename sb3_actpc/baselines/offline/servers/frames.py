"""What two processes say to each other: plain values as JSON, and numpy arrays byte by byte. Nothing is unpickled.

A frame is ``MARK``, the length of its header (4 bytes, big-endian), the header (JSON: the values, and name, type and shape of
each array) and the bytes of the arrays. The standard library and numpy are enough to read one.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import traceback
from collections.abc import Callable
from typing import Any

import numpy as np

MARK = b"ACTP"
MAX_HEADER, MAX_ARRAYS = 2**20, 2**32  # bytes
DTYPES = ("<f4", "<f8", "<i8", "|u1", "|b1")

Values = dict[str, Any]
Arrays = dict[str, np.ndarray]
Handler = Callable[[Values, Arrays], tuple[Values, Arrays]]


def pack(values: Values, arrays: Arrays) -> bytes:
    """
    :param values: what JSON can hold
    :param arrays: of ``DTYPES``
    :return: the frame
    :raises ValueError: for arrays of other types
    """
    listed, parts = [], []
    for name, array in arrays.items():
        array = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False)
        if array.dtype.str not in DTYPES:
            raise ValueError(f"array {name!r} has the type {array.dtype}, which no frame holds")
        listed.append([name, array.dtype.str, list(array.shape)])
        parts.append(array.tobytes())
    header = json.dumps({"values": values, "arrays": listed}).encode()
    return b"".join([MARK, struct.pack(">I", len(header)), header, *parts])


def unpack(read: Callable[[int], bytes]) -> tuple[Values, Arrays]:
    """
    :param read: gives exactly so many bytes
    :return: values and arrays of the next frame
    :raises ValueError: when the bytes are no frame
    """
    start = read(len(MARK) + 4)
    if start[: len(MARK)] != MARK:
        raise ValueError(f"expected an answer, found {start!r}")
    n_header = struct.unpack(">I", start[len(MARK) :])[0]
    if n_header > MAX_HEADER:
        raise ValueError(f"expected a header of at most {MAX_HEADER} bytes, found {n_header}")
    try:
        header = json.loads(read(n_header))
        values = dict(header["values"])
        listed = [(str(name), str(dtype), tuple(shape)) for name, dtype, shape in header["arrays"]]
        sizes = [_n_bytes(dtype, shape) for _, dtype, shape in listed]
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"expected values and arrays, found a damaged header ({error})") from None
    if sum(sizes) > MAX_ARRAYS:
        raise ValueError(f"expected arrays of at most {MAX_ARRAYS} bytes, found {sum(sizes)}")
    arrays = {}
    for (name, dtype, shape), size in zip(listed, sizes, strict=True):
        arrays[name] = np.frombuffer(read(size), dtype=dtype).reshape(shape).copy()
    return values, arrays


def _n_bytes(dtype: str, shape: tuple[int, ...]) -> int:
    if dtype not in DTYPES or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise ValueError(f"an array of type {dtype} and shape {shape}")
    n_values = 1
    for n in shape:
        n_values *= n
    return n_values * np.dtype(dtype).itemsize


def serve(handlers: dict[str, Handler]) -> int:
    """Answer the frames on the standard input until it ends.

    What libraries print goes to the standard error: the standard output is for the answers alone. An exception is the answer
    ``{"error": ...}`` and ends the program.

    :param handlers: what to do, by the ``ask`` of a frame; given its values and arrays, returns those of the answer
    :return: exit code
    """
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while True:
        try:
            values, arrays = unpack(_read_stdin)
        except EOFError:  # the other side has ended
            return 0
        try:
            frame = pack(*handlers[values.pop("ask")](values, arrays))
        except Exception as error:
            traceback.print_exc()
            frame = pack({"error": f"{type(error).__name__}: {error}"}, {})
        try:
            answers.write(frame)
            answers.flush()
        except BrokenPipeError:
            return 0
        if b'"error"' in frame[:32]:
            return 1


def _read_stdin(n: int) -> bytes:
    data = sys.stdin.buffer.read(n)
    if len(data) < n:
        raise EOFError
    return data
