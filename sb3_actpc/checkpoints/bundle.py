"""The folder of a checkpoint: written under a temporary name, hashed, renamed when whole, checked when read."""

import hashlib
import json
import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sb3_actpc.utils.files import file_hash, named_errors

VERSION = 14
MANIFEST = "manifest.json"
_NAME = re.compile(r"\d{6}_step_\d+")
_TEMPORARY = ".writing-"
_USE_ANOTHER = "use another checkpoint of the run"
Report = Callable[[str], None]
Write = Callable[[str, bytes | np.ndarray], None]


class DamagedCheckpoint(ValueError):
    """A checkpoint whose files are not what was written."""


def _seal(path: Path) -> str:
    """Flush a file to the disk, and return its SHA-256."""
    with named_errors(path), open(path, "rb+") as file:
        os.fsync(file.fileno())
    return file_hash(path)


class Bundle:
    """A whole checkpoint on the disk, by its folder. DamagedCheckpoint names the first file that is missing or not what was
    written; ValueError when another version of the format wrote it."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        try:
            self.manifest = json.loads((self.path / MANIFEST).read_bytes())
        except (OSError, ValueError) as error:
            raise DamagedCheckpoint(f"{path}: {MANIFEST} cannot be read ({error}); {_USE_ANOTHER}") from error
        if self.manifest.pop("sha256", None) != manifest_hash(self.manifest):
            raise DamagedCheckpoint(f"{path}: {MANIFEST} is not what was written; {_USE_ANOTHER}")
        if self.manifest["version"] != VERSION:
            raise ValueError(
                f"{path} has format version {self.manifest['version']}, this sb3_actpc reads {VERSION}: begin the run again, "
                "or go on with the version that wrote it"
            )
        for name, digest in self.manifest["files"].items():
            if not (self.path / name).is_file() or file_hash(self.path / name) != digest:
                raise DamagedCheckpoint(f"{self.path}: {name} is missing, or is not what was written; {_USE_ANOTHER}")


@contextmanager
def write_bundle(folder: Path, num_timesteps: int, keep: int, manifest: Mapping[str, Any]) -> Iterator[Write]:
    """Write a checkpoint: the block is given a function of a file's name and content. It appears among the checkpoints of the
    run, in ``folder``, when everything has worked, and ``keep`` of them stay. OSError when the disk is full or the folder
    cannot be written; nothing is left behind then."""
    folder.mkdir(parents=True, exist_ok=True)
    for left in folder.glob(f"{_TEMPORARY}*"):  # of a killed process
        shutil.rmtree(left, ignore_errors=True)
    with TemporaryDirectory(prefix=_TEMPORARY, dir=folder, ignore_cleanup_errors=True) as temporary:
        bundle = Path(temporary) / "new"
        bundle.mkdir()

        def write(name: str, content: bytes | np.ndarray) -> None:
            with named_errors(bundle / name):
                if isinstance(content, bytes):
                    (bundle / name).write_bytes(content)
                else:
                    np.save(bundle / name, content, allow_pickle=False)

        yield write
        paths = sorted(bundle.iterdir())
        with ThreadPoolExecutor(max_workers=4) as workers:
            files = dict(zip([path.name for path in paths], workers.map(_seal, paths), strict=True))
        record = {"version": VERSION, "num_timesteps": num_timesteps, **manifest, "files": files}
        write(MANIFEST, json.dumps({**record, "sha256": manifest_hash(record)}).encode())
        _seal(bundle / MANIFEST)
        number = 1 + max((int(path.name.partition("_")[0]) for path in list_bundles(folder)), default=0)
        os.replace(bundle, folder / f"{number:06d}_step_{num_timesteps}")
        for old in list_bundles(folder)[:-keep]:  # renamed first: a bundle never has its name while half of it is gone
            os.replace(old, Path(temporary) / old.name)


def list_bundles(folder: str | os.PathLike[str]) -> list[Path]:
    """Folders of all checkpoints of a run, oldest first; empty when there are none."""
    return sorted(path for path in Path(folder).glob("*_step_*") if _NAME.fullmatch(path.name) and path.is_dir())


def find_bundle(path: str | os.PathLike[str], report: Report = warnings.warn) -> Bundle:
    """The checkpoint at ``path``, or the newest whole one of those in it, verified; damaged ones are skipped, and ``report``
    is given a line for each. FileNotFoundError when there is none, DamagedCheckpoint when all are damaged, or ``path`` is one
    that is, ValueError when the newest was written in another version of the format."""
    path = Path(path)
    bundles = list_bundles(path)
    if not bundles:
        if (path / MANIFEST).exists() or (_NAME.fullmatch(path.name) and path.is_dir()):
            return Bundle(path)
        raise FileNotFoundError(f"no checkpoint in {path}")
    for candidate in reversed(bundles):
        try:
            return Bundle(candidate)
        except DamagedCheckpoint as error:
            report(f"damaged checkpoint skipped: {error}")
    raise DamagedCheckpoint(f"{path}: all of its {len(bundles)} checkpoints are damaged; begin the run again")


def manifest_hash(manifest: Mapping[str, Any]) -> str:
    """SHA-256 of a manifest's other entries."""
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
