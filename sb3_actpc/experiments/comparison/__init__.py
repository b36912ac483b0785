"""Head-to-head comparisons: a table of runs, brought to their end on one machine or many, and a report about them."""

from sb3_actpc.experiments.comparison.plan import Comparison, plan_runs, read_comparison
from sb3_actpc.experiments.comparison.variants import ablation_variants, find_variant, variant_names

__all__ = ["Comparison", "ablation_variants", "find_variant", "plan_runs", "read_comparison", "variant_names"]
