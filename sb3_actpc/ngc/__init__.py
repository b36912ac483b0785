"""Neural generative coding circuits in plain torch tensors: no reinforcement learning, no autograd."""

from sb3_actpc.ngc.activations import ACTIVATIONS
from sb3_actpc.ngc.circuit import NGCCircuit
from sb3_actpc.ngc.coupled import CoupledState, check_agreement, policy_gradient, settle_coupled
from sb3_actpc.ngc.dynamics import SettledState
from sb3_actpc.ngc.memory import WorkingMemory
from sb3_actpc.ngc.plasticity import HebbianChanges

__all__ = [
    "ACTIVATIONS",
    "CoupledState",
    "HebbianChanges",
    "NGCCircuit",
    "SettledState",
    "WorkingMemory",
    "check_agreement",
    "policy_gradient",
    "settle_coupled",
]
