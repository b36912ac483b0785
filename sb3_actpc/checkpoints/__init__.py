"""Checkpoints that lose nothing, for algorithms of Stable-Baselines3, and files of weights that hold no code.

Nothing here uses pickle: weights are safetensors, buffers ``.npy``, everything else is JSON.
"""

from sb3_actpc.checkpoints.bundle import Bundle, DamagedCheckpoint, find_bundle, list_bundles
from sb3_actpc.checkpoints.callback import CheckpointCallback, between_updates, continue_learning, restore, why_no_checkpoints
from sb3_actpc.checkpoints.interrupts import EXIT_STOPPED, StopSignals, TrainingStopped
from sb3_actpc.checkpoints.state import Restored
from sb3_actpc.checkpoints.weights import load_checkpoint, load_weights, save_weights

__all__ = [
    "EXIT_STOPPED",
    "Bundle",
    "CheckpointCallback",
    "DamagedCheckpoint",
    "Restored",
    "StopSignals",
    "TrainingStopped",
    "between_updates",
    "continue_learning",
    "find_bundle",
    "list_bundles",
    "load_checkpoint",
    "load_weights",
    "restore",
    "save_weights",
    "why_no_checkpoints",
]
