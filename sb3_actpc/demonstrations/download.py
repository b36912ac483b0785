"""Fetching robomimic's human demonstrations."""

from __future__ import annotations

import http.client
import os
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.hdf5 import import_h5py
from sb3_actpc.demonstrations.robomimic import read_robomimic
from sb3_actpc.envs.robosuite_layouts import robosuite_task
from sb3_actpc.utils.files import atomic_write

REPOSITORY = "https://huggingface.co/datasets/robomimic/robomimic_datasets/resolve/main"
KINDS = {"mh": "300 by six humans of three levels", "ph": "200 by one proficient human"}
CHUNK = 1 << 20
TIMEOUT_SECONDS = 30.0


def robomimic_url(env_id: str, kind: str = "mh") -> str:
    """
    :param env_id: ``SparseLift-v0`` or ``SparsePickPlaceCan-v0``
    :param kind: key of ``KINDS``
    :return: address of the file of low-dimensional observations (MIT licence; 30 to 130 MB)
    :raises ValueError: when an argument is not allowed
    """
    folder = {"Lift": "lift", "PickPlaceCan": "can"}[robosuite_task(env_id).name]
    if kind not in KINDS:
        raise ValueError(f"kind={kind!r} is not one of {', '.join(KINDS)}: choose one of these")
    return f"{REPOSITORY}/v1.5/{folder}/{kind}/low_dim_v15.hdf5"


def download_robomimic(
    env_id: str, path: str | os.PathLike[str], url: str, report: Callable[[str], None] = lambda line: None
) -> Demonstrations:
    """Download a robomimic file, unless it is there already, and check what it holds.

    The file appears under its name only when it is whole.

    :param env_id: the task it must be of
    :param path: where to put the file
    :param url: its address (http or https)
    :param report: takes lines of progress
    :return: its demonstrations, with ``obs="robomimic"``
    :raises OSError: when it cannot be fetched
    :raises ValueError: when what arrived is not such a file
    :raises ImportError: when h5py is not installed
    """
    import_h5py()  # before the long part
    path = Path(path)
    if not url.startswith(("http://", "https://")):
        raise ValueError(f"url={url!r} must begin with http:// or https://")
    if path.is_file():
        report(f"{path} is there already")
    else:
        _fetch(url, path, report)
    return read_robomimic(path, env_id, obs="robomimic")


def _fetch(url: str, path: Path, report: Callable[[str], None]) -> None:
    report(f"fetching {url}")
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT_SECONDS) as response, atomic_write(path) as file:
            expected = response.headers.get("Content-Length")
            n_bytes = 0
            while chunk := response.read(CHUNK):
                file.write(chunk)
                n_bytes += len(chunk)
            if expected is not None and n_bytes != int(expected):
                raise OSError(f"only {n_bytes} of {expected} bytes arrived")
    except (OSError, http.client.HTTPException) as error:  # URLError is an OSError
        reason = error.reason if isinstance(error, urllib.error.URLError) else error
        raise OSError(
            f"could not fetch {url} ({reason}): where there is a network, download it, then "
            f"`sb3-actpc demos convert FILE --env ...` makes demonstrations of it"
        ) from None
    report(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")
