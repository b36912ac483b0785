"""
What ActPC adds to the paper: a behavior-regularized actor-critic with gated deployment, self-imitation and BC pre-training.

The actor circuit maximizes, by local changes alone,

    J(θ) = w_c E[Q(s, π_θ(s))]  -  w_i E[f(s, a) ||a - π_θ(s)||²] / 2

over replayed states s (value term) and over demonstrated and self-imitated steps (s, a) (imitation term). Learning starts
from a behavior-cloned (BC) policy. w_c is TD3+BC's by default, divided by mean|Q|. During a warm-up it is 0, so that the
critic first sees what the BC policy's own actions lead to. f is the Q-filter, 1 or less, by the precision of the imitated
actions. The deployed policy, which ``predict`` uses, changes only after a test on returns.
"""

from sb3_actpc.guidance.base import ActorGuidance, GuidanceContext
from sb3_actpc.guidance.guidance import BehaviorGuidance, GuidanceConfig
from sb3_actpc.guidance.policy_selection import PolicySelection

__all__ = ["ActorGuidance", "BehaviorGuidance", "GuidanceConfig", "GuidanceContext", "PolicySelection"]
