"""Where runs are executed: processes of this machine, or a Ray cluster."""

from sb3_actpc.experiments.comparison.engines.base import ENGINES, Engine, Event, make_engine

__all__ = ["ENGINES", "Engine", "Event", "make_engine"]
