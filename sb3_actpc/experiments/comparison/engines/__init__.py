"""Where runs are executed: processes of this machine, or a Ray cluster."""

from sb3_actpc.experiments.comparison.engines.base import Engine, Event
from sb3_actpc.experiments.comparison.engines.cluster import RayEngine
from sb3_actpc.experiments.comparison.engines.local import LocalEngine

ENGINES = ("local", "ray")

__all__ = ["ENGINES", "Engine", "Event", "make_engine"]


def make_engine(name: str, n_workers: int | None, threads: int, address: str | None = None) -> Engine:
    """:param name: one of ``ENGINES``
    :param n_workers: runs at a time; by default one for each core (of the cluster) and ``threads``
    :param threads: of each run
    :param address: of a Ray cluster; by default one is started on this machine
    :raises ValueError: for another name, a number below 1, or an address that the engine has no use for
    :raises ImportError: when Ray is not installed
    """
    if name not in ENGINES:
        raise ValueError(f"engine={name!r} is unknown: choose one of {', '.join(ENGINES)}")
    if n_workers is not None and n_workers < 1:
        raise ValueError(f"workers={n_workers} must be at least 1: give the number of runs at a time")
    if name == "ray":
        return RayEngine(n_workers, threads, address)
    if address is not None:
        raise ValueError(f"address={address!r} is of no use to the local engine: add --engine ray, or leave it out")
    return LocalEngine(n_workers, threads)
