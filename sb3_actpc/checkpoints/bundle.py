"""The folder of a checkpoint: written under a temporary name, hashed while written, renamed when whole, checked when read.

Every checkpoint is whole by itself. What has not changed since the one before is not written again: it is a second name (a
hard link) of the same file, found by comparing that file with the memory, whatever the algorithm did with its buffer.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import shutil
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

FORMAT = "sb3_actpc checkpoint"
VERSION = 2
MANIFEST = "manifest.json"
SEGMENT = 8 * 2**20  # bytes of an array in one file
PIECE = 64 * 2**10  # bytes read at a time: fresh memory for more would cost more than what is done with them
SHARED_FROM = 2**20  # bytes; smaller files are written again, so that damage to one concerns one checkpoint
_NAME = re.compile(r"(\d{6,})_step_(\d+)")
_TEMPORARY = ".writing-"
Report = Callable[[str], None]


class DamagedCheckpoint(ValueError):
    """A checkpoint whose files are not what was written."""


def _warn(line: str) -> None:
    warnings.warn(line, stacklevel=3)


class BundleWriter:
    """
    Files of one checkpoint; made by :func:`write_bundle`. Workers hash and flush a file while the next one is written.

    :param folder: where they go
    :param previous: the checkpoint before: large files that have not changed since are shared with it
    :param workers: hash and flush
    """

    def __init__(self, folder: Path, previous: Bundle | None, workers: ThreadPoolExecutor) -> None:
        self.folder, self.previous, self.workers = folder, previous, workers
        self._shared: dict[str, dict[str, Any]] = {}
        self._written: dict[str, tuple[int, Future[str], Future[None]]] = {}

    def files(self) -> dict[str, dict[str, Any]]:
        """Wait until everything is on the disk.

        :return: name -> SHA-256 and size
        :raises OSError: when a file could not be flushed
        """
        files = dict(self._shared)
        for name, (size, digest, flushed) in self._written.items():
            flushed.result()
            files[name] = {"sha256": digest.result(), "bytes": size}
        return files

    def add_bytes(self, name: str, data: bytes) -> None:
        """:param name: file name
        :param data: its content"""
        self._write(name, [memoryview(data)])

    def add_json(self, name: str, value: Any) -> None:
        """:param name: file name
        :param value: plain values"""
        self.add_bytes(name, json.dumps(value).encode())

    def add_array(self, stem: str, array: np.ndarray) -> list[str]:
        """
        Write ``.npy`` files straight from the array's memory, one for each range of rows; the ranges depend on the rows'
        size alone, so that a range that has not changed since the previous checkpoint need not be written again.

        :param stem: what the file names begin with
        :param array: (n, ...) of numbers; one that is not C-contiguous is copied
        :return: the file names, in the order of the rows
        :raises ValueError: for an array of Python objects
        """
        if array.dtype.hasobject:
            raise ValueError(f"{stem}: an array of Python objects cannot be stored")
        array = np.ascontiguousarray(array)
        n_rows = max(1, SEGMENT // max(1, array[:1].nbytes))
        names = []
        for start in range(0, max(1, len(array)), n_rows):
            rows = array[start : start + n_rows]
            names.append(f"{stem}_{start}.npy")
            parts = [memoryview(_npy_header(rows)), rows.reshape(-1).view(np.uint8).data]
            if not self._share(names[-1], parts):
                self._write(names[-1], parts)
        return names

    def _write(self, name: str, parts: list[memoryview]) -> None:
        path = self.folder / name
        digest = self.workers.submit(_hash, parts)
        with open(path, "xb", buffering=0) as file:
            for part in parts:
                _write_all(file, part)
        self._written[name] = sum(map(len, parts)), digest, self.workers.submit(_flush, path)

    def _share(self, name: str, parts: list[memoryview]) -> bool:
        """Give the previous checkpoint's file a second name here, if it has this content.

        :return: whether it was done; not for small files, of which every checkpoint has its own
        """
        record = None if self.previous is None else self.previous.manifest["files"].get(name)
        if self.previous is None or record is None or sum(map(len, parts)) < SHARED_FROM:
            return False
        try:
            if not _holds(self.previous.path / name, parts):
                return False
            os.link(self.previous.path / name, self.folder / name)
        except OSError:  # it is gone, or the file system has no links
            return False
        self._shared[name] = record
        return True


def _npy_header(array: np.ndarray) -> bytes:
    header = io.BytesIO()
    npy.write_array_header_1_0(header, npy.header_data_from_array_1_0(array))
    return header.getvalue()


def _write_all(file: IO[bytes], part: memoryview) -> None:
    while part:
        part = part[file.write(part) :]


def _flush(path: Path) -> None:
    with open(path, "rb+") as file:
        os.fsync(file.fileno())


def _hash(parts: Iterable[bytes | memoryview]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()


def _holds(path: Path, parts: list[memoryview]) -> bool:
    """Whether a file has exactly this content."""
    if path.stat().st_size != sum(map(len, parts)):
        return False
    pieces = (part[start : start + PIECE] for part in parts for start in range(0, len(part), PIECE))
    with open(path, "rb") as file:
        return all(file.read(len(piece)) == bytes(piece) for piece in pieces)


class Bundle:
    """
    A checkpoint on the disk.

    :param path: its folder
    :raises DamagedCheckpoint: when the manifest is missing or not whole
    :raises ValueError: when another version of the format wrote it
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.manifest = _read_manifest(self.path)

    @property
    def num_timesteps(self) -> int:
        """Environment steps of the run until then."""
        return int(self.manifest["num_timesteps"])

    def verify(self) -> None:
        """:raises DamagedCheckpoint: naming the first file that is missing or not what was written"""
        for name, expected in self.manifest["files"].items():
            file = self.path / name
            if not file.is_file():
                raise DamagedCheckpoint(f"{self.path}: {name} is missing")
            if file.stat().st_size != expected["bytes"]:
                raise DamagedCheckpoint(f"{self.path}: {name} has {file.stat().st_size} bytes instead of {expected['bytes']}")
            if _hash_file(file) != expected["sha256"]:
                raise DamagedCheckpoint(f"{self.path}: {name} does not have the recorded SHA-256")

    def read_bytes(self, name: str) -> bytes:
        """:param name: file name
        :return: its content"""
        return (self.path / name).read_bytes()

    def read_json(self, name: str) -> Any:
        """:param name: file name
        :return: plain values"""
        return json.loads(self.read_bytes(name))

    def array_header(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """:param name: file name
        :return: shape and type of the array in it"""
        with open(self.path / name, "rb") as file:
            return _read_header(file)

    def read_array_into(self, names: Sequence[str], target: np.ndarray) -> None:
        """
        :param names: files of consecutive rows
        :param target: C-contiguous, of the stored shape and type; overwritten
        :raises ValueError: when shape or type differ
        """
        n_read = 0
        for name in names:
            with open(self.path / name, "rb") as file:
                shape, dtype = _read_header(file)
                rows = target[n_read : n_read + shape[0]]
                if (shape, dtype) != (rows.shape, rows.dtype):
                    raise ValueError(f"{name} holds {dtype}{list(shape)}, expected {rows.dtype}{list(rows.shape)}")
                file.readinto(rows.reshape(-1).view(np.uint8).data)
            n_read += shape[0]
        if n_read != len(target):
            raise ValueError(f"{', '.join(names)} hold {n_read} rows, expected {len(target)}")


@contextmanager
def write_bundle(folder: Path, num_timesteps: int, keep: int, manifest: Mapping[str, Any]) -> Iterator[BundleWriter]:
    """
    Write a checkpoint; it appears in ``folder`` only when the block and everything after it has worked.

    :param folder: of all checkpoints of a run
    :param num_timesteps: environment steps so far
    :param keep: how many checkpoints stay
    :param manifest: what else to record, plain values
    :return: takes the files
    :raises OSError: when the disk is full or the folder cannot be written; nothing is left behind then
    """
    folder.mkdir(parents=True, exist_ok=True)
    _remove_unfinished(folder)
    temporary = folder / f"{_TEMPORARY}{uuid.uuid4().hex[:12]}"
    temporary.mkdir()
    try:
        with ThreadPoolExecutor(max_workers=4) as workers:
            writer = BundleWriter(temporary, _newest_readable(folder), workers)
            yield writer
            files = writer.files()
            record = {"format": FORMAT, "version": VERSION, "num_timesteps": num_timesteps, **manifest, "files": files}
            writer.add_json(MANIFEST, {**record, "sha256": _manifest_hash(record)})
            writer.files()
        _sync_folder(temporary)
        numbers = [number for number, _ in _list(folder)]
        os.replace(temporary, folder / f"{max(numbers, default=0) + 1:06d}_step_{num_timesteps}")
        _sync_folder(folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    for _, old in _list(folder)[:-keep]:
        _remove(old)


def list_bundles(folder: str | os.PathLike[str]) -> list[Path]:
    """
    :param folder: of all checkpoints of a run
    :return: their folders, oldest first; empty when there are none
    """
    return [path for _, path in _list(Path(folder))]


def find_bundle(path: str | os.PathLike[str], report: Report = _warn) -> Bundle:
    """
    The checkpoint at ``path``, or the newest whole one of those in it; damaged ones are named and skipped.

    :param path: one checkpoint, or the folder of a run's checkpoints
    :param report: given a line for every damaged one
    :return: the checkpoint, verified
    :raises FileNotFoundError: when there is none
    :raises DamagedCheckpoint: when all are damaged, or ``path`` is one that is
    :raises ValueError: when the newest was written in another version of the format
    """
    path = Path(path)
    bundles = list_bundles(path)
    if not bundles and (path / MANIFEST).exists():
        return _verified(path)
    if not bundles:
        if _NAME.fullmatch(path.name) and path.is_dir():
            raise DamagedCheckpoint(f"{path}: {MANIFEST} is missing")
        raise FileNotFoundError(f"no checkpoint in {path}")
    for candidate in reversed(bundles):
        try:
            return _verified(candidate)
        except DamagedCheckpoint as error:
            report(f"damaged checkpoint skipped: {error}")
    raise DamagedCheckpoint(f"{path}: all of its {len(bundles)} checkpoints are damaged")


def _newest_readable(folder: Path) -> Bundle | None:
    """The newest checkpoint whose manifest is whole; its files are not looked at."""
    for path in reversed(list_bundles(folder)):
        try:
            return Bundle(path)
        except ValueError:
            continue
    return None


def _verified(path: Path) -> Bundle:
    bundle = Bundle(path)
    bundle.verify()
    return bundle


def _list(folder: Path) -> list[tuple[int, Path]]:
    if not folder.is_dir():
        return []
    matches = [(_NAME.fullmatch(entry.name), entry) for entry in folder.iterdir()]
    return sorted((int(match.group(1)), entry) for match, entry in matches if match and entry.is_dir())


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads((path / MANIFEST).read_bytes())
    except OSError as error:
        raise DamagedCheckpoint(f"{path}: {MANIFEST} cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise DamagedCheckpoint(f"{path}: {MANIFEST} is not JSON") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise DamagedCheckpoint(f"{path}: {MANIFEST} is not that of a checkpoint")
    recorded = manifest.pop("sha256", None)
    if _manifest_hash(manifest) != recorded:
        raise DamagedCheckpoint(f"{path}: {MANIFEST} is not what was written")
    if manifest["version"] != VERSION:
        raise ValueError(
            f"{path} has format version {manifest['version']}, this sb3_actpc reads {VERSION}: go on with the version that "
            f"wrote it ({manifest.get('versions', {}).get('sb3-actpc', 'unknown')})"
        )
    return manifest


def _manifest_hash(manifest: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def _hash_file(path: Path) -> str:
    with open(path, "rb") as file:
        return _hash(iter(lambda: file.read(PIECE), b""))


def _read_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    if npy.read_magic(file) != (1, 0):
        raise ValueError("expected version 1.0 of the .npy format")
    shape, fortran, dtype = npy.read_array_header_1_0(file)
    if fortran or dtype.hasobject:
        raise ValueError("expected a C-contiguous array of numbers")
    return shape, dtype


def _sync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk, where the system can."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # folders cannot be opened on Windows
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove(bundle: Path) -> None:
    """Rename first: a bundle never has its name while half of it is gone."""
    doomed = bundle.with_name(f"{_TEMPORARY}{uuid.uuid4().hex[:12]}")
    os.replace(bundle, doomed)
    shutil.rmtree(doomed, ignore_errors=True)


def _remove_unfinished(folder: Path) -> None:
    """What a killed process left behind."""
    for entry in folder.glob(f"{_TEMPORARY}*"):
        shutil.rmtree(entry, ignore_errors=True)
