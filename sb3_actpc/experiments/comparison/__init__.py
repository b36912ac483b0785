"""Head-to-head comparisons: a table of runs, brought to their end on one machine or many, and a report about them."""

from sb3_actpc.experiments.comparison.plan import Comparison, find_variant, plan_runs, read_comparison, variant_names

__all__ = ["Comparison", "find_variant", "plan_runs", "read_comparison", "variant_names"]
