"""The ActPC agent."""

from sb3_actpc.actpc.actpc import ActPC
from sb3_actpc.actpc.policies import ActPCPolicy, CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["ActPC", "ActPCPolicy", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
