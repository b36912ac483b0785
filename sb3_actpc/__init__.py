"""ActPC (active predictive coding) for Stable-Baselines3: a backprop-free agent for sparse-reward robot control."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sb3_actpc.envs import register_envs
from sb3_actpc.utils.extras import installed_version

if TYPE_CHECKING:
    from sb3_actpc.actpc import ActPC, CnnPolicy, MlpPolicy, MultiInputPolicy
    from sb3_actpc.demonstrations import Demonstrations, shipped_demonstrations
    from sb3_actpc.experiments.runs import preset
    from sb3_actpc.ngc import NGCCircuit

__version__ = installed_version("sb3-actpc")

__all__ = [
    "ActPC",
    "CnnPolicy",
    "Demonstrations",
    "MlpPolicy",
    "MultiInputPolicy",
    "NGCCircuit",
    "__version__",
    "preset",
    "shipped_demonstrations",
]

# imported when first used, so that registering the tasks and `sb3-actpc --help` do not wait for torch
_MODULE_OF = {
    **dict.fromkeys(("ActPC", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"), "sb3_actpc.actpc"),
    **dict.fromkeys(("Demonstrations", "shipped_demonstrations"), "sb3_actpc.demonstrations"),
    "NGCCircuit": "sb3_actpc.ngc",
    "preset": "sb3_actpc.experiments.runs",
}

register_envs()


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'sb3_actpc' has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)
