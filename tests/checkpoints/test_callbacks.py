"""What callbacks keep in attributes, those named as arguments of their constructors among them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from tests.actpc.envs import CountingEnv
from tests.checkpoints.runs import learn_in_two, learn_straight, make_actpc


class Raising(BaseCallback):
    """Raises its own threshold by one a step, and more."""

    def __init__(self, threshold: int, steps: list[int], weights: Any, label: str = "") -> None:
        super().__init__()
        self.threshold, self.steps, self.weights, self.label, self.n_seen = threshold, steps, weights, label, 0

    def _on_step(self) -> bool:
        self.threshold += 1
        self.n_seen += 1
        self.steps.append(self.n_seen)
        self.weights = self.weights + 1.0
        return True


def make() -> Any:
    return make_actpc(CountingEnv)


def test_arguments_that_a_callback_changed_go_on(tmp_path: Path) -> None:
    callbacks: list[Raising] = []

    def more() -> list[BaseCallback]:
        callbacks.append(Raising(5, [], np.zeros(2), label=["first", "second"][len(callbacks)]))
        return [callbacks[-1]]

    straight = Raising(5, [], np.zeros(2))
    learn_straight(make, tmp_path / "straight", 60, straight)
    learn_in_two(make, tmp_path / "resumed", 60, 33, more)
    assert (callbacks[1].threshold, callbacks[1].n_seen) == (straight.threshold, straight.n_seen) == (65, 60)
    assert callbacks[1].steps == straight.steps and callbacks[1].weights.tolist() == straight.weights.tolist()
    assert callbacks[1].label == "second"


def test_another_argument_counts(tmp_path: Path) -> None:
    callbacks: list[Raising] = []

    def more() -> list[BaseCallback]:
        first = not callbacks
        callbacks.append(Raising(5 if first else 1000, [] if first else [7], np.zeros(2 if first else 3)))
        return [callbacks[-1]]

    learn_in_two(make, tmp_path, 60, 33, more)
    assert callbacks[1].threshold == 1000 + 60 - 33
    assert callbacks[1].steps[:2] == [7, 34] and callbacks[1].weights == pytest.approx([27.0] * 3)
    assert callbacks[1].n_seen == 60
