"""Head-to-head comparisons: a table of runs, brought to their end on one machine or many, and a report about them."""

from sb3_actpc.experiments.comparison.engines import Engine, LocalEngine
from sb3_actpc.experiments.comparison.plan import Comparison, plan_runs, read_comparison
from sb3_actpc.experiments.comparison.variants import find_variant, variant_names

ENGINES = ("local", "ray")

__all__ = ["Comparison", "find_variant", "make_engine", "plan_runs", "read_comparison", "variant_names"]


def make_engine(name: str, n_workers: int | None, threads: int, address: str | None = None) -> Engine:
    """One of ``ENGINES``, for ``n_workers`` runs at a time (by default one for each core, of the cluster, and ``threads``) of
    so many threads; ``address`` is a Ray cluster's, by default one is started on this machine. ValueError for another name, a
    number below 1, or an address that the engine has no use for, ImportError when Ray is not installed."""
    if name not in ENGINES:
        raise ValueError(f"engine={name!r} is unknown: choose one of {', '.join(ENGINES)}")
    if n_workers is not None and n_workers < 1:
        raise ValueError(f"workers={n_workers} must be at least 1: give the number of runs at a time")
    if name == "ray":
        from sb3_actpc.experiments.comparison.cluster import RayEngine

        return RayEngine(n_workers, threads, address)
    if address is not None:
        raise ValueError(f"address={address!r} is of no use to the local engine: add --engine ray, or leave it out")
    return LocalEngine(n_workers, threads)
