"""Demonstrations: recorded from whoever can do a task, or read from the files of this package, Minari, robomimic, robosuite.

All of it ends in the one form of :class:`Demonstrations`.
"""

from sb3_actpc.demonstrations.dataset import Demonstrations, shipped_demonstrations
from sb3_actpc.demonstrations.fitting import fit_demonstrations, is_minari_id, resolve, scaled_actions
from sb3_actpc.demonstrations.robomimic import read_robomimic, write_robomimic
from sb3_actpc.demonstrations.robosuite_states import read_robosuite
from sb3_actpc.demonstrations.scripted import MIXED_DEMONSTRATORS, ScriptedDemonstrator, collect_scripted

__all__ = [
    "MIXED_DEMONSTRATORS",
    "Demonstrations",
    "ScriptedDemonstrator",
    "collect_scripted",
    "fit_demonstrations",
    "is_minari_id",
    "read_robomimic",
    "read_robosuite",
    "resolve",
    "scaled_actions",
    "shipped_demonstrations",
    "write_robomimic",
]
