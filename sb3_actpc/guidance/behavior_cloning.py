"""Behavior cloning (BC): the actor circuit imitates demonstrated actions by settling and Hebbian changes."""

from collections.abc import Callable

import torch as th

from sb3_actpc.guidance.base import ImitationBatch
from sb3_actpc.ngc import NGCCircuit

BATCH_SIZE = 256
N_EVALUATED = 4096  # steps of which the error is returned
SMALLEST_VARIANCE = 1e-12
LEARNING_RATES = (1e-3, 5e-5)  # first and last; the rate falls geometrically


def add_noise(features: th.Tensor, standard_deviation: float) -> th.Tensor:
    """Imitation at points around the demonstrated ones: training with noisy inputs penalizes steep policies (Bishop, Neural
    Computation 1995).

    :param features: (B, n_features), normalized
    :param standard_deviation: of the Gaussian noise; 0 for none
    :return: (B, n_features)
    """
    return features + standard_deviation * th.randn_like(features) if standard_deviation else features


def clone_behavior(actor: NGCCircuit, sample: Callable[[int], ImitationBatch], n_updates: int, input_noise: float) -> float:
    """
    Train ``actor`` on imitated steps with a falling learning rate. Its optimizer's moments are dropped afterwards.

    :param actor: changed in place; has an optimizer
    :param sample: draws a batch of so many steps
    :param n_updates: updates
    :param input_noise: standard deviation of Gaussian noise on the features
    :return: mean squared error of the trained actor's actions, as a share of the variance of the imitated ones
    """
    first, last = LEARNING_RATES
    rates = [group["lr"] for group in actor.optimizer.param_groups]
    for update in range(n_updates):
        rate = first * (last / first) ** (update / n_updates)
        for group, own in zip(actor.optimizer.param_groups, actor.parameter_groups(rate), strict=True):
            group["lr"] = own["lr"]
        features, actions, memory = sample(BATCH_SIZE)
        state = actor.settle(add_noise(features, input_noise), actions, memory)
        actor.apply_changes(actor.hebbian_update(state))
    for group, rate in zip(actor.optimizer.param_groups, rates, strict=True):
        group["lr"] = rate
    actor.optimizer.state.clear()
    features, actions, memory = sample(N_EVALUATED)
    error = (actor.project(features, memory) - actions).square().mean()
    return float(error / actions.var(0, unbiased=False).mean().clamp_min(SMALLEST_VARIANCE))
