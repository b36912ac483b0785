"""Head-to-head comparisons: a table of runs, brought to their end on one machine or many, and a report about them."""

from sb3_actpc.utils.extras import import_extra

for _module in ("pandas", "rich"):
    import_extra(_module, "experiments")

from sb3_actpc.experiments.comparison.engines import Engine, make_engine  # noqa: E402
from sb3_actpc.experiments.comparison.plan import Comparison, plan_runs, read_comparison  # noqa: E402
from sb3_actpc.experiments.comparison.variants import find_variant, variant_names  # noqa: E402

__all__ = ["Comparison", "Engine", "find_variant", "make_engine", "plan_runs", "read_comparison", "variant_names"]
