"""ActPC (active predictive coding) for Stable-Baselines3: a backprop-free agent for sparse-reward robot control."""

from importlib.metadata import version

from sb3_actpc.actpc import ActPC, MlpPolicy, MultiInputPolicy
from sb3_actpc.common.demonstrations import Demonstrations
from sb3_actpc.envs import register_envs
from sb3_actpc.ngc import NGCCircuit

__version__ = version("sb3-actpc")
__all__ = ["ActPC", "Demonstrations", "MlpPolicy", "MultiInputPolicy", "NGCCircuit", "__version__"]

register_envs()
