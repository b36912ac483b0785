"""The hooks through which guidance takes part in learning. All of them do nothing, as the paper has no guidance."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch as th

from sb3_actpc.ngc import NGCCircuit

# features (B, n_features), actions (B, A) in [-1, 1] and working memory (B, n_memory) or None of imitated steps
ImitationBatch = tuple[th.Tensor, th.Tensor, th.Tensor | None]


@dataclass
class GuidanceContext:
    """
    What guidance may use of an agent.

    :param actor: the circuit that learns
    :param targets: circuits that start as copies of the actor (its target circuit)
    :param n_envs: environments
    :param episode_starts: (n_envs,), in ``on_step`` whether the step was the first of its episode
    :param sample: draws a batch of so many imitated steps; None where there is nothing to imitate
    :param selection_circuits: "deployed", "average", "challenger" and "previous"; None without a deployment gate
    """

    actor: NGCCircuit
    targets: list[NGCCircuit]
    n_envs: int
    episode_starts: np.ndarray
    sample: Callable[[int], ImitationBatch] | None
    selection_circuits: dict[str, NGCCircuit] | None


class ActorGuidance:
    """Hooks without effect: ``ActPC(guidance="none")``, Algorithm 1 as the paper has it."""

    weighting: Literal["returns", "uniform"] = "uniform"  # how imitated steps are drawn
    stores: Literal["positive", "best"] = "best"  # which episodes enter the self-imitation memory
    input_noise = 0.0  # standard deviation of noise on the features of imitated steps
    has_gate = False
    bc_residual: float | None = None  # error of BC, as a share of the actions' variance; an agent saves it

    def on_training_start(self, context: GuidanceContext, is_pretrained: bool) -> None:
        """Before the first environment step of a ``learn``; ``is_pretrained`` where the actor has imitated already."""

    def acting_circuits(self, context: GuidanceContext) -> list[NGCCircuit]:
        """The circuit that acts in each environment, n_envs of them."""
        return [context.actor] * context.n_envs

    def candidate(self, context: GuidanceContext) -> NGCCircuit:
        """What may be deployed next; ``actor_policy`` and the evaluations beside the deployed policy use it."""
        return context.actor

    def explores(self, env: int) -> bool:
        """Whether the running episode of environment ``env`` has exploration noise."""
        return True

    def on_step(self, context: GuidanceContext, rewards: np.ndarray, dones: np.ndarray, n_updates: int) -> None:
        """After an environment step with the task's ``rewards`` and ``dones``, (n_envs,) each."""

    def on_reset(self) -> None:
        """The environments were reset in mid-episode."""

    def forget_returns(self) -> None:
        """Another environment, or other parameters: returns so far say nothing of them."""

    def critic_weight(self, n_updates: int) -> float:
        """Factor of the critic term in the actor's update."""
        return 1.0

    def filtered_weight(self, n_updates: int) -> float:
        """Weight, from 0 to 1, that imitation keeps where the critics value the actor's own action more; 1 for no filter."""
        return 1.0

    def imitation_weight(self, n_updates: int) -> float:
        """Factor of the imitation term (refresh) in the actor's update."""
        return 1.0

    def after_update(self, context: GuidanceContext) -> None:
        """After an update of the actor."""

    def logs(self) -> dict[str, float]:
        """Values to log under ``train/``."""
        return {}

    def describe(self) -> str:
        """One line for ``ActPC.describe``."""
        return "guidance: none"

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps beside circuits: plain values."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """:param state: what :meth:`state_dict` returned"""
