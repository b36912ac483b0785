"""Where demonstrations come from: recordings of experts and scripted operators, and the files of robomimic and robosuite.

All of it ends in the one form of :class:`sb3_actpc.demonstrations.dataset.Demonstrations`.
"""

from sb3_actpc.demonstrations.operators import MIXED_OPERATORS, ScriptedOperator, collect_scripted
from sb3_actpc.demonstrations.robomimic import read_robomimic, write_robomimic
from sb3_actpc.demonstrations.robosuite_states import read_robosuite

__all__ = [
    "MIXED_OPERATORS",
    "ScriptedOperator",
    "collect_scripted",
    "read_robomimic",
    "read_robosuite",
    "write_robomimic",
]
