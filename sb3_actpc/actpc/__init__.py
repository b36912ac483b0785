"""The ActPC agent."""

from sb3_actpc.actpc.actpc import ActPC
from sb3_actpc.actpc.policies import ActPCPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["ActPC", "ActPCPolicy", "MlpPolicy", "MultiInputPolicy"]
