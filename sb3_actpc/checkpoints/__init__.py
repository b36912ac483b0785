"""Checkpoints that lose nothing, for algorithms of Stable-Baselines3.

Nothing here uses pickle: arrays are safetensors and ``.npy``, everything else is JSON.
"""

from sb3_actpc.checkpoints.bundle import DamagedCheckpoint, find_bundle, list_bundles
from sb3_actpc.checkpoints.callback import CheckpointCallback, continue_learning, load_checkpoint, why_no_checkpoints
from sb3_actpc.checkpoints.interrupts import EXIT_STOPPED, StopSignals, TrainingStopped
from sb3_actpc.checkpoints.state import Restored, restore

__all__ = [
    "EXIT_STOPPED",
    "CheckpointCallback",
    "DamagedCheckpoint",
    "Restored",
    "StopSignals",
    "TrainingStopped",
    "continue_learning",
    "find_bundle",
    "list_bundles",
    "load_checkpoint",
    "restore",
    "why_no_checkpoints",
]
