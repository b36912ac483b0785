"""Training runs: settings, evaluation, records and replay. The commands are thin wrappers around this package."""

from sb3_actpc.experiments.runs.algorithms import ALGORITHMS
from sb3_actpc.experiments.runs.evaluation import play_episodes
from sb3_actpc.experiments.runs.presets import load_preset, preset, resolve
from sb3_actpc.experiments.runs.run import evaluate_run, finish_run, load_run, resume_run, train_run
from sb3_actpc.experiments.runs.schema import Run

__all__ = [
    "ALGORITHMS",
    "Run",
    "evaluate_run",
    "finish_run",
    "load_preset",
    "load_run",
    "play_episodes",
    "preset",
    "resolve",
    "resume_run",
    "train_run",
]
