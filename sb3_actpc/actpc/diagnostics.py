"""What is logged about the circuits, measured every so many updates so that it costs next to nothing."""

from typing import Any

import torch as th

from sb3_actpc.actpc.policies import ActPCPolicy
from sb3_actpc.ngc import CoupledState, HebbianChanges, SettledState, policy_gradient

INTERVAL = 100  # updates between two measurements, or the next multiple of the actor's delay


class Diagnostics:
    """Collects energies, settling residuals, action-values and signals; checks the synapses for NaN and infinity.

    :param policy: whose circuits are watched
    """

    def __init__(self, policy: ActPCPolicy) -> None:
        self.circuits = policy.circuits()
        self.active = False
        self.values: dict[str, float] = {}  # everything measured last

    def is_due(self, n_updates: int, delay: int = 1) -> bool:
        """Whether the update with this number, from 1 on, is measured."""
        interval = delay * -(-INTERVAL // delay)
        return n_updates % interval == delay % interval

    def begin_update(self, n_updates: int, step: int, delay: int = 1) -> None:
        """Decide whether this update, by its number from 1 on, is measured, and if so check all synapses. The actor, which
        has one update in ``delay``, takes part in every one that is measured.

        :raises ValueError: naming the circuit and the environment step when a synapse is not finite
        """
        self.active = self.is_due(n_updates, delay)
        if not self.active:
            return
        for name, circuit in self.circuits.items():
            if not all(bool(th.isfinite(parameter).all()) for parameter in circuit.parameters()):
                raise ValueError(
                    f"{name}: synapses are not finite at step {step}; lower its learning rate, bound them with "
                    "policy_kwargs=dict(circuit_kwargs=dict(synaptic_scaling='column_norm', weight_bound=...)), or normalise "
                    "the observations"
                )

    def follow(self, **values: Any) -> None:
        """Log the latest of these values; a callable is evaluated only when this update is measured."""
        for key, value in values.items():
            if not callable(value):
                self.values[key] = float(value)
            elif self.active:
                self.values[key] = float(value())

    def rewards(self, n_updates: int, n_batches: int, delay: int, internal: th.Tensor, task: th.Tensor) -> None:
        """
        Means of the internal and of the task's reward, where one of the next ``n_batches`` updates is measured.

        :param n_updates: updates so far
        :param n_batches: updates that the rewards are for
        :param delay: updates for each of the actor
        :param internal: (B, 1), what the critic learns from beside the task's reward
        :param task: (B, 1), the task's reward
        """
        numbers = range(n_updates + 1, n_updates + 1 + n_batches)
        if len(task) and any(self.is_due(number, delay) for number in numbers):
            self.follow(internal_reward=float(internal.mean()), task_reward=float(task.mean()))

    def settled(self, name: str, state: SettledState) -> None:
        """Energy (batch mean) and settling residual of a circuit."""
        if self.active:
            self.values[f"{name}_energy"] = float(state.total_discrepancy().mean())
            self.values[f"{name}_settling_steps"] = state.n_steps
            self.values[f"{name}_residual"] = float(self.circuits[name].residual(state))

    def coupled(self, state: CoupledState, changes: HebbianChanges, features: th.Tensor, memory: th.Tensor | None) -> None:
        """
        Action-values, and per layer how the actor's change compares with the deterministic policy gradient: cosine and ratio
        of the norms. (The gradient is for the log alone; it goes through W^T, which learned error synapses never see.)
        """
        if not self.active:
            return
        self.values["action_value"] = float(state.action_values.mean())
        self.values["action_saturation"] = float((state.actions.abs() > 0.97).float().mean())
        gradient = policy_gradient(self.circuits["actor"], self.circuits["critic"], features, memory)
        for layer, (mine, exact) in enumerate(zip(changes.weights, gradient.weights, strict=True)):
            cosine = th.nn.functional.cosine_similarity(mine.flatten(), exact.flatten(), dim=0)
            self.values[f"actor_cosine_{layer}"] = float(cosine)
            self.values[f"actor_ratio_{layer}"] = float(mine.norm() / exact.norm().clamp_min(1e-30))

    def change_norms(self, name: str, changes: HebbianChanges) -> None:
        """Per layer, the norm of one of the two changes that are added up for the actor."""
        if self.active:
            for layer, change in enumerate(changes.weights):
                self.values[f"actor_{name}_norm_{layer}"] = float(change.norm())
