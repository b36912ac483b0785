"""One process at a time in a folder."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

LOCK = ".lock"
_POLL = 0.2  # seconds


class FolderBusy(ValueError):
    """Another process holds the folder."""


@contextmanager
def folder_lock(folder: Path, wait: float, report: Callable[[str], None] = lambda line: None) -> Iterator[None]:
    """Hold a folder. The lock is the operating system's: it is gone with the process that held it, however that ended.

    :param folder: made when it does not exist
    :param wait: seconds to wait for another process that holds it
    :param report: given a line when there is one to wait for
    :return: context manager
    :raises FolderBusy: when the other still holds it then, naming its process
    :raises OSError: when the folder cannot be written
    """
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / LOCK, "a+", encoding="utf-8") as file:
        deadline = time.monotonic() + wait
        is_reported = False
        while not _try_lock(file):
            holder = _holder(folder)
            if time.monotonic() >= deadline:
                raise FolderBusy(
                    f"{folder} is in use by another process{holder}: wait until it has ended, or choose another folder"
                )
            if not is_reported:
                report(f"{folder} is in use by another process{holder}: waiting {wait:.0f} seconds for it")
                is_reported = True
            time.sleep(_POLL)
        file.seek(0)
        file.truncate()
        try:
            file.write(str(os.getpid()))
            file.flush()
        except OSError:  # a full disk: the number only says who it is
            pass
        yield


def _holder(folder: Path) -> str:
    try:
        number = (folder / LOCK).read_text(encoding="utf-8").strip()
    except OSError:
        number = ""
    return f" ({number})" if number else ""


if sys.platform == "win32":
    import msvcrt

    def _try_lock(file: IO[str]) -> bool:
        file.seek(0)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

else:
    import fcntl

    def _try_lock(file: IO[str]) -> bool:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True
