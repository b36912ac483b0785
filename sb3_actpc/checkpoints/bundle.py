"""The folder of a checkpoint: written under a temporary name, hashed while written, renamed when whole, checked when read."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import uuid
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

FORMAT = "sb3_actpc checkpoint"
VERSION = 1
MANIFEST = "manifest.json"
CHUNK = 8 * 1024 * 1024  # bytes
_NAME = re.compile(r"(\d{6,})_step_(\d+)")
_TEMPORARY = ".writing-"
Report = Callable[[str], None]


class DamagedCheckpoint(ValueError):
    """A checkpoint whose files are not what was written."""


def _warn(line: str) -> None:
    warnings.warn(line, stacklevel=3)


class BundleWriter:
    """
    Files of one checkpoint; made by :func:`write_bundle`.

    :param folder: where they go
    :param hasher: one worker that hashes what is being written
    """

    def __init__(self, folder: Path, hasher: ThreadPoolExecutor) -> None:
        self.folder, self.hasher = folder, hasher
        self.files: dict[str, dict[str, Any]] = {}

    @contextmanager
    def _open(self, name: str) -> Iterator[Callable[[Any], None]]:
        """Hashes what it is given while it writes it, and flushes the file to the disk at the end."""
        digest, size = hashlib.sha256(), 0
        hashed: Future[None] | None = None
        with open(self.folder / name, "xb") as file:

            def write(data: Any) -> None:
                nonlocal size, hashed
                view = memoryview(data).cast("B")
                for start in range(0, len(view), CHUNK):
                    part = view[start : start + CHUNK]
                    hashed = self.hasher.submit(digest.update, part)
                    file.write(part)
                size += len(view)

            yield write
            file.flush()
            os.fsync(file.fileno())
        if hashed is not None:
            hashed.result()  # the worker takes the parts in order: this was the last
        self.files[name] = {"sha256": digest.hexdigest(), "bytes": size}

    def add_bytes(self, name: str, data: bytes) -> None:
        """:param name: file name
        :param data: its content"""
        with self._open(name) as write:
            if data:
                write(data)

    def add_json(self, name: str, value: Any) -> None:
        """:param name: file name
        :param value: plain values"""
        self.add_bytes(name, json.dumps(value).encode())

    def add_array(self, name: str, array: np.ndarray) -> None:
        """
        Write ``.npy`` straight from the array's memory.

        :param name: file name
        :param array: of numbers; one that is not C-contiguous is copied
        :raises ValueError: for an array of Python objects
        """
        if array.dtype.hasobject:
            raise ValueError(f"{name}: an array of Python objects cannot be stored")
        array = np.ascontiguousarray(array)
        with self._open(name) as write:
            header = _HeaderSink()
            npy.write_array_header_1_0(header, npy.header_data_from_array_1_0(array))
            write(header.content)
            if array.size:
                write(array)


class _HeaderSink:
    """Collects what NumPy writes as the header."""

    content = b""

    def write(self, data: bytes) -> None:
        self.content += data


class Bundle:
    """
    A checkpoint on the disk.

    :param path: its folder
    :raises DamagedCheckpoint: when the manifest is missing or not whole
    :raises ValueError: when a newer version wrote it
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
                raise DamagedCheckpoint(
                    f"{self.path}: {name} has {file.stat().st_size} bytes instead of {expected['bytes']}"
                )
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

    def read_array_into(self, name: str, target: np.ndarray) -> None:
        """
        :param name: file name
        :param target: C-contiguous, of the stored shape and type; overwritten
        :raises ValueError: when shape or type differ
        """
        with open(self.path / name, "rb") as file:
            shape, dtype = _read_header(file)
            if (shape, dtype) != (target.shape, target.dtype):
                raise ValueError(f"{name} holds {dtype}{list(shape)}, expected {target.dtype}{list(target.shape)}")
            if target.size:
                file.readinto(target.data.cast("B"))


@contextmanager
def write_bundle(
    folder: Path, num_timesteps: int, keep: int, manifest: Mapping[str, Any], check: Callable[[], None] = lambda: None
) -> Iterator[BundleWriter]:
    """
    Write a checkpoint; it appears in ``folder`` only when the block and everything after it has worked.

    :param folder: of all checkpoints of a run
    :param num_timesteps: environment steps so far
    :param keep: how many checkpoints stay
    :param manifest: what else to record, plain values
    :param check: called last before the checkpoint gets its name
    :return: takes the files
    :raises OSError: when the disk is full or the folder cannot be written; nothing is left behind then
    """
    folder.mkdir(parents=True, exist_ok=True)
    _remove_unfinished(folder)
    temporary = folder / f"{_TEMPORARY}{uuid.uuid4().hex[:12]}"
    temporary.mkdir()
    try:
        with ThreadPoolExecutor(max_workers=1) as hasher:
            writer = BundleWriter(temporary, hasher)
            yield writer
            record = {"format": FORMAT, "version": VERSION, "num_timesteps": num_timesteps, **manifest, "files": writer.files}
            writer.add_json(MANIFEST, {**record, "sha256": _manifest_hash(record)})
        _sync_folder(temporary)
        check()
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
    :raises ValueError: when the newest was written by a newer version
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
    if manifest["version"] > VERSION:
        raise ValueError(
            f"{path} has format version {manifest['version']}, this sb3_actpc reads up to {VERSION}: install the newer "
            f"version that wrote it ({manifest.get('versions', {}).get('sb3-actpc', 'unknown')})"
        )
    return manifest


def _manifest_hash(manifest: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def _hash_file(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while part := file.read(CHUNK):
            digest.update(part)
    return digest.hexdigest()


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
