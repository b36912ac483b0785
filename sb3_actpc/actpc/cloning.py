"""Clones: actors that have learned from imitation alone.

Clones of the same demonstrations agree where these have steps and differ beside them, by their first synapses; and a gait
stands or falls by what an actor does beside them. The mean action of several clones is steadier than theirs. So a
clone has an *ensemble* of teachers: they imitate what is shown, and then it imitates what is shown and, around it, their mean
(distillation: Hinton, Vinyals and Dean 2015). Every circuit settles and changes by Hebbian updates, as always.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch as th

from sb3_actpc.ngc import NGCCircuit

RATES, BATCH_SIZE = (1e-3, 5e-5), 256  # a precise clone: what follows can only be as good as its habit

TEACHING_NOISE = 0.1  # standard deviation of the noise where teachers are asked, on features as the circuits see them

# features (n, n_features), actions (n, A) and working memory of n imitated steps
Imitated = tuple[th.Tensor, th.Tensor, th.Tensor | None]
Sample = Callable[[int], Imitated]


class Cloning:
    """
    A clone in the making.

    :param clone: the circuit that becomes one
    :param make_circuit: gives circuits like it that have learned nothing
    :param sample: draws imitated steps
    :param n_updates: of every circuit
    :param ensemble_size: how many teach the clone, 2 or more; with 1 it learns alone
    :param weight_decay: λ of all these circuits meanwhile; None for their own
    """

    def __init__(
        self,
        clone: NGCCircuit,
        make_circuit: Callable[[], NGCCircuit],
        sample: Sample,
        n_updates: int,
        ensemble_size: int = 1,
        weight_decay: float | None = None,
    ) -> None:
        self.clone, self.make_circuit, self.sample = clone, make_circuit, sample
        self.n_updates, self.ensemble_size, self.weight_decay = n_updates, ensemble_size, weight_decay
        self.teachers: list[NGCCircuit] = []

    def __len__(self) -> int:
        """Updates in all."""
        return self.n_updates * (1 if self.ensemble_size == 1 else self.ensemble_size + 1)

    def update(self, index: int) -> None:
        """One update of the circuit whose turn it is.

        :param index: how many were before this one
        """
        stage, done = divmod(index, self.n_updates)
        features, actions, memory = self.sample(BATCH_SIZE)
        circuit = self.clone
        if stage < self.ensemble_size > 1:
            if stage == len(self.teachers):
                self.teachers.append(self.make_circuit())
            circuit = self.teachers[stage]
        elif self.ensemble_size > 1:
            features, actions = taught(self.teachers, features, actions, memory)
        first, last = RATES
        rate = first * (last / first) ** (done / self.n_updates)
        for group, own in zip(circuit.optimizer.param_groups, circuit.parameter_groups(rate), strict=True):
            group["lr"] = own["lr"]
        circuit.apply_changes(circuit.hebbian_update(circuit.settle(features, actions, memory)), self.weight_decay)

    def checkpoint_state(self) -> dict[str, Any]:
        """The sizes, the teachers and their optimizers' moments, as plain values and tensors."""
        teachers = [(dict(teacher.state_dict()), teacher.optimizer.state_dict()["state"]) for teacher in self.teachers]
        sizes = {"n_updates": self.n_updates, "ensemble_size": self.ensemble_size, "weight_decay": self.weight_decay}
        return {**sizes, "teachers": teachers}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """:param state: what :meth:`checkpoint_state` returned"""
        self.n_updates, self.ensemble_size = state["n_updates"], state["ensemble_size"]
        self.weight_decay = state["weight_decay"]
        self.teachers = [self.make_circuit() for _ in state["teachers"]]
        for teacher, (synapses, moments) in zip(self.teachers, state["teachers"], strict=True):
            teacher.load_state_dict(synapses)
            teacher.optimizer.load_state_dict({**teacher.optimizer.state_dict(), "state": moments})


def taught(
    teachers: Sequence[NGCCircuit], features: th.Tensor, actions: th.Tensor, memory: th.Tensor | None
) -> tuple[th.Tensor, th.Tensor]:
    """
    Imitated steps, every other of them moved by noise, where the teachers say what is done there.

    :param teachers: circuits whose mean action is imitated
    :param features: (B, n_features) of the steps
    :param actions: (B, A) shown there
    :param memory: (B, n_memory), the working memory, or None
    :return: features and actions, shaped as they were
    """
    features, actions = features.clone(), actions.clone()
    features[::2] += TEACHING_NOISE * th.randn_like(features[::2])
    remembered = None if memory is None else memory[::2]
    actions[::2] = th.stack([teacher.project(features[::2], remembered) for teacher in teachers]).mean(0)
    return features, actions
