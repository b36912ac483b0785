"""Which features tell what is done, and which tell only what episode it is.

With ten demonstrations whatever changes little throughout each of them, as how a can was turned when it was put there, names
the episode, and whoever imitates them may go by that name. Features that vary less within episodes than between them (by the
intraclass correlation) are taken smaller, where the nearest steps of other episodes then tell better what is done at each
step. That is asked of all of them together, and of each that would hardly be left. A goal stays the same, and such a test does
not see that it is needed: velocities tell what is done as well, until one has to act without the demonstrator. So what never
changes within an episode keeps its size whatever it is.
"""

import numpy as np
import torch as th

from sb3_actpc.actpc.room import N_NEIGHBOURS, evenly, nearest_steps

# of the squared error: of taking features smaller, where it is less they stay as they are; and of one that keeps its size
SMALLEST_GAIN, SMALLEST_NEED = 0.05, 0.1
SMALL_SHARE = 0.5  # of a feature that is asked for on its own
CONTEXT = 1e-4  # a share below which there is rounding alone: the feature never changes within an episode, and may be a goal
MOST_ASKED, MOST_ANSWERING = 1000, 4000  # steps
MOST_ALONE = 100  # features that are asked for on their own, those that would be left least first: each takes long


def feature_weights(features: th.Tensor, actions: th.Tensor, episodes: np.ndarray) -> th.Tensor:
    """
    How much each feature counts for where a step is.

    :param features: (N, n_features) of demonstrated steps, normalised
    :param actions: (N, A) shown there
    :param episodes: (N,) numbers of their episodes
    :return: (n_features,), in [0, 1]; 1 for all where that tells as well what is done, for each that is needed, and for what
        may be a goal
    """
    weights = share_within(features, episodes)
    as_it_is = th.ones_like(weights)
    weights = th.where(weights < CONTEXT, as_it_is, weights)
    if len(np.unique(episodes)) < 2:
        return as_it_is

    def error(of_weights: th.Tensor) -> float:
        return error_of_neighbours(features * of_weights, actions, episodes)

    smallest = error(weights)
    if smallest >= (1.0 - SMALLEST_GAIN) * error(as_it_is):
        return as_it_is
    for feature in weights.argsort().tolist()[:MOST_ALONE]:
        if weights[feature] < SMALL_SHARE:
            needed = weights.index_fill(0, th.tensor(feature, device=weights.device), 1.0)
            if (with_it := error(needed)) < (1.0 - SMALLEST_NEED) * smallest:
                weights, smallest = needed, with_it
    return weights


def error_of_neighbours(features: th.Tensor, actions: th.Tensor, episodes: np.ndarray) -> float:
    """
    Mean squared error of what is done at the nearest steps of other episodes, on average of these, as a guess of what is done.

    :param features: (N, n_features)
    :param actions: (N, A)
    :param episodes: (N,) numbers of their episodes, two at least
    """
    asked, answering = (evenly(len(features), most) for most in (MOST_ASKED, MOST_ANSWERING))
    nearest = nearest_steps(features[asked], episodes[asked], features[answering], episodes[answering], N_NEIGHBOURS)
    known = th.as_tensor(nearest >= 0, device=actions.device)[:, :, None]
    told = (actions[answering][nearest] * known).sum(1) / known.sum(1).clamp_min(1)
    return float((told - actions[asked]).square().mean())


def share_within(features: th.Tensor, episodes: np.ndarray) -> th.Tensor:
    """
    Of each feature's standard deviation, what it has within episodes: the root of 1 less the intraclass correlation.

    :param features: (N, n_features)
    :param episodes: (N,) numbers of their episodes
    :return: (n_features,), in [0, 1]; 1 for a feature that never changes
    """
    numbers = th.as_tensor(np.unique(episodes, return_inverse=True)[1], device=features.device)
    lengths, exact = th.bincount(numbers)[:, None], features.double()  # sums of long episodes would lose their digits
    means = exact.new_zeros(len(lengths), features.shape[1]).index_add_(0, numbers, exact) / lengths
    within, total = (exact - means[numbers]).square().mean(0), exact.var(0, correction=0)
    return (within / total).sqrt().clamp_max(1.0).where(total > 1e-8, th.ones_like(total)).to(features.dtype)
