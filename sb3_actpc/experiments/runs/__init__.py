"""Training runs: settings, evaluation, records and replay. The commands are thin wrappers around this package."""

from sb3_actpc.experiments.runs.config import ALGORITHMS, RunConfig, load_preset
from sb3_actpc.experiments.runs.evaluation import EpisodeStatistics, EvaluationCallback, play_episodes
from sb3_actpc.experiments.runs.run import evaluate_run, resume_run, train_run

__all__ = [
    "ALGORITHMS",
    "EpisodeStatistics",
    "EvaluationCallback",
    "RunConfig",
    "evaluate_run",
    "load_preset",
    "play_episodes",
    "resume_run",
    "train_run",
]
