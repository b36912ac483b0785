"""Fetching robomimic's human demonstrations."""

import os
from pathlib import Path

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.recording import Report, silent
from sb3_actpc.demonstrations.robomimic import read_robomimic
from sb3_actpc.envs.robosuite_layouts import robosuite_task
from sb3_actpc.utils.extras import import_extra

REPOSITORY = "https://huggingface.co/datasets/robomimic/robomimic_datasets/resolve/main"
KINDS = ("mh", "ph")  # 300 by six humans of three levels, 200 by one proficient human
TIMEOUT_SECONDS = 30.0


def robomimic_url(env_id: str, kind: str = "mh") -> str:
    """Address of a file of low-dimensional observations of a robosuite task and a key of ``KINDS`` (MIT licence; 30 to 130
    MB)."""
    folder = {"Lift": "lift", "PickPlaceCan": "can"}[robosuite_task(env_id).name]
    if kind not in KINDS:
        raise ValueError(f"kind={kind!r} is not one of {', '.join(KINDS)}: choose one of these")
    return f"{REPOSITORY}/v1.5/{folder}/{kind}/low_dim_v15.hdf5"


def download_robomimic(
    env_id: str, path: str | os.PathLike[str], url: str, obs: str = "paper", report: Report = silent
) -> Demonstrations:
    """Download a robomimic file (http or https) to a path, unless it is there already, and read it, see
    :func:`~sb3_actpc.demonstrations.read_robomimic`. The file appears under its name only when it is whole. OSError when it
    cannot be fetched, ValueError when what arrived is not such a file, ImportError when h5py is not installed."""
    import pooch

    import_extra("h5py", "robosuite")  # before the long part
    path = Path(path)
    if not url.startswith(("http://", "https://")):
        raise ValueError(f"url={url!r} must begin with http:// or https://")
    if path.is_file():
        report(f"{path} is there already")
        return read_robomimic(path, env_id, obs)
    report(f"fetching {url}")
    pooch.get_logger().setLevel("WARNING")
    try:
        downloader = pooch.HTTPDownloader(timeout=TIMEOUT_SECONDS)
        pooch.retrieve(url, known_hash=None, fname=path.name, path=path.parent, downloader=downloader)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise OSError(
            f"could not fetch {url}: where there is a network, download that address, then make demonstrations of the file "
            f"here with `sb3-actpc demos convert FILE --env {env_id}` ({reason})"
        ) from None
    report(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")
    return read_robomimic(path, env_id, obs)
