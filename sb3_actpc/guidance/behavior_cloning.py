"""Behavior cloning (BC): the actor circuit imitates demonstrated actions by settling and Hebbian changes."""

from collections.abc import Callable

import torch as th

from sb3_actpc.guidance.base import ImitationBatch
from sb3_actpc.ngc import NGCCircuit

BATCH_SIZE = 256
LEARNING_RATES = (1e-3, 5e-5)  # first and last; the rate falls geometrically
SMALLEST_RESIDUAL_STD = 0.02  # of actions in [-1, 1]: nearly deterministic demonstrators still leave room to explore


def clone_behavior(actor: NGCCircuit, sample: Callable[[int], ImitationBatch], n_updates: int) -> None:
    """
    Train ``actor`` on imitated steps with a falling learning rate. Its optimizer's moments are dropped afterwards.

    :param actor: changed in place; has an optimizer
    :param sample: draws a batch of so many steps
    :param n_updates: updates
    """
    first, last = LEARNING_RATES
    rates = [group["lr"] for group in actor.optimizer.param_groups]
    for update in range(n_updates):
        rate = first * (last / first) ** (update / n_updates)
        for group, own in zip(actor.optimizer.param_groups, actor.parameter_groups(rate), strict=True):
            group["lr"] = own["lr"]
        features, actions, memory = sample(BATCH_SIZE)
        actor.apply_changes(actor.hebbian_update(actor.settle(features, actions, memory)))
    for group, rate in zip(actor.optimizer.param_groups, rates, strict=True):
        group["lr"] = rate
    actor.optimizer.state.clear()


def residual_std(actor: NGCCircuit, sample: Callable[[int], ImitationBatch]) -> th.Tensor:
    """Standard deviation of 4,096 imitated actions around the actor's, (A,), at least ``SMALLEST_RESIDUAL_STD``."""
    features, actions, memory = sample(4096)
    residuals = actions - actor.project(features, memory)
    return residuals.square().mean(0).sqrt().clamp_min(SMALLEST_RESIDUAL_STD)
