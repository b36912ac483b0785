"""Demonstrations: recorded from any policy, or read from files of this package, Minari, robomimic and robosuite.

Every source gives a :class:`Demonstrations`.
"""

from sb3_actpc.demonstrations.dataset import Demonstrations, shipped_demonstrations
from sb3_actpc.demonstrations.fitting import fit_demonstrations, is_minari_id, resolve, scaled_actions
from sb3_actpc.demonstrations.robomimic import read_hdf5
from sb3_actpc.demonstrations.scripted import MIXED_PROFICIENCIES, ScriptedDemonstrator, collect_scripted

__all__ = [
    "MIXED_PROFICIENCIES",
    "Demonstrations",
    "ScriptedDemonstrator",
    "collect_scripted",
    "fit_demonstrations",
    "is_minari_id",
    "read_hdf5",
    "resolve",
    "scaled_actions",
    "shipped_demonstrations",
]
