"""Writing files so that a reader never meets half of one, telling whether one is what was written, and holding folders."""

import errno
import hashlib
import os
import re
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal

from filelock import FileLock, Timeout

LOCK = ".lock"  # in a folder that one process has to itself
PIECE = 2**18  # bytes read at a time


def file_hash(*paths: Path) -> str:
    """SHA-256 of the content of files, one after the other, in hex digits."""
    digest = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as file:
            while piece := file.read(PIECE):
                digest.update(piece)
    return digest.hexdigest()


def folder_name(env_id: str) -> str:
    """An environment's id as a part of a path: one level, also with a module or a namespace."""
    return re.sub("[:/]", "_", env_id)


@contextmanager
def named_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """An OSError without a file name, such as that of a full disk, is raised again with this one."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error


@contextmanager
def atomic_write(path: str | os.PathLike[str], mode: Literal["wb", "w"] = "wb") -> Iterator[IO[Any]]:
    """Open ``path`` for writing, as bytes (``"wb"``) or UTF-8 text with ``\\n`` line ends (``"w"``); the file appears, or
    replaces the old one, only when the block ends without an error. The data goes to a temporary name in the same folder, is
    flushed to the disk and then renamed; when the block raises, an old file stays as it was. Missing folders are created, a
    link is followed, an old file's permissions are kept. OSError when the folder cannot be
    written, or ``path`` is a folder."""
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise IsADirectoryError(f"cannot write a file over the folder {target}")
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.parent / f".{target.name[:32]}.{uuid.uuid4().hex[:12]}.tmp"
    text_options = {} if mode == "wb" else {"encoding": "utf-8", "newline": "\n"}
    try:
        with named_errors(target), open(temporary, mode.replace("w", "x"), **text_options) as file:  # type: ignore[call-overload]
            yield file
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, temporary)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)  # nothing is left to remove once it has been renamed


class FolderBusy(ValueError):
    """Another process works in the folder."""


@contextmanager
def folder_lock(folder: Path, wait: float = 0.0, report: Callable[[str], None] = lambda line: None) -> Iterator[None]:
    """Hold a folder, made when it does not exist; another process that holds it is waited for some seconds, then FolderBusy is
    raised. The lock is the operating system's: it is gone with the process that held it, however that ended."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        report(f"{folder} is in use by another process: waiting {wait:.0f} seconds for it")
        try:
            lock.acquire(timeout=wait)
        except Timeout:
            message = f"{folder} is in use by another process: wait until it has ended, or choose another folder"
            raise FolderBusy(message) from None
    try:
        yield
    finally:
        lock.release()
