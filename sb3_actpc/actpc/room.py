"""The room between demonstrations, and what clones imitate there.

Where each episode begins and ends elsewhere, as an arm's and those with goals do, a clone has to guess what is done between
them. So it imitates steps *between* one that is shown and one of the nearest of other episodes, with the actions between
theirs (mixup, Zhang et al. 2018, among neighbours), and noise of about a step's length around them. Noise alone, as wide as
the room, fills it too, but blurs what the dimensions say of each other: where the gripper is, where the can is, and the way
from one to the other.
"""

from collections.abc import Callable

import numpy as np
import torch as th

from sb3_actpc.actpc.self_imitation import Episodes

N_NEIGHBOURS = 3  # other episodes whose nearest steps are known of each step
MOST_NEIGHBOURS = 20_000  # demonstrated steps among which the nearest is looked for
MOST_SEARCHES = 100_000  # imitated steps of which that is done; those between them take the neighbours of the one before
MOST_MEASURED = 1000  # steps by which it is judged whether there is room

# (episodes, (B,) rows) -> (B, n_features)
FeaturesOf = Callable[[Episodes, np.ndarray], th.Tensor]


class Room:
    """
    :param shown: the demonstrations
    :param features_of: gives the features of some of their rows
    :param by_return: whether steps are drawn by returns: then those that are never drawn are nobody's neighbours
    """

    def __init__(self, shown: Episodes, features_of: FeaturesOf, by_return: bool) -> None:
        self.shown, self.features_of = shown, features_of
        drawn = np.flatnonzero(shown.weights > 0.0) if by_return else np.arange(len(shown))
        self.rows = drawn[evenly(len(drawn), MOST_NEIGHBOURS)]
        rows = drawn[evenly(len(drawn), MOST_MEASURED)]
        rows = rows[(rows + 1 < len(shown)) & (shown.starts[rows] == shown.starts[np.minimum(rows + 1, len(shown) - 1)])]
        self.step, self.is_wide = 0.0, False
        if len(rows):
            here = features_of(shown, rows)
            nearest = self._nearest(here, shown.starts[rows], 1)[:, 0]
            self.step = float((features_of(shown, rows + 1) - here).norm(dim=1).median())
            ways = (features_of(shown, nearest) - here).norm(dim=1)[th.as_tensor(nearest >= 0)]
            self.is_wide = len(ways) > 0 and float(ways.median()) > self.step

    def measure(self, part: Episodes) -> None:
        """Sets the neighbours of imitated steps where they are not known: (N, ``N_NEIGHBOURS``) rows, -1 for none."""
        if part.neighbours is None:
            every = -(-len(part) // MOST_SEARCHES)
            rows = np.arange(0, len(part), every)
            # own episodes are none of those that are shown
            numbers = part.starts[rows] if part is self.shown else np.full(len(rows), -1)
            nearest = self._nearest(self.features_of(part, rows), numbers, N_NEIGHBOURS)
            part.neighbours = np.repeat(nearest, every, axis=0)[: len(part)]
            if part is self.shown and every > 1:  # beyond an episode's end they may be of the step's own
                own = self.shown.starts[part.neighbours] == self.shown.starts[:, None]
                left = np.where(own, -1, part.neighbours)
                part.neighbours = np.take_along_axis(left, np.argsort(left < 0, axis=1, kind="stable"), axis=1)

    def between(
        self, features: th.Tensor, actions: th.Tensor, neighbours: np.ndarray, noise: float
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Each step moved towards one of its neighbours, by a share between 0 and 1, and then by noise.

        :param features: (B, n_features) of imitated steps
        :param actions: (B, A), scaled to [-1, 1]
        :param neighbours: (B, k) rows of the demonstrations; -1 where there are no more
        :param noise: standard deviation in steps; in the proportions of the way to the neighbour, and no longer than it
        :return: features and actions, shaped as they were
        """
        known = (neighbours >= 0).sum(1)
        rows = neighbours[np.arange(len(neighbours)), (np.random.random(len(neighbours)) * known).astype(np.int64)]
        has_one = th.as_tensor(known > 0, device=features.device)[:, None]
        way = (self.features_of(self.shown, rows) - features) * has_one
        turn = (th.as_tensor(self.shown.actions[rows], dtype=actions.dtype, device=actions.device) - actions) * has_one
        share = th.rand(len(features), 1, device=features.device)
        size = (noise * self.step / way.norm(dim=1, keepdim=True)).nan_to_num(0.0).clamp_max(1.0)
        return features + share * way + size * way.abs() * th.randn_like(features), actions + share * turn

    def _nearest(self, features: th.Tensor, episodes: np.ndarray, n: int) -> np.ndarray:
        demonstrated = self.features_of(self.shown, self.rows)
        nearest = nearest_steps(features, episodes, demonstrated, self.shown.starts[self.rows], n)
        return np.where(nearest < 0, -1, self.rows[nearest])


def evenly(n: int, most: int) -> np.ndarray:
    """
    Rows that are spread over all of ``n``: not every so manieth, which of episodes of one length may always be the same step.

    :return: (min(n, most),), increasing
    """
    return np.linspace(0, n - 1, min(n, most)).astype(np.int64)


def nearest_steps(
    features: th.Tensor, episodes: np.ndarray, demonstrated: th.Tensor, demonstrated_episodes: np.ndarray, n: int
) -> np.ndarray:
    """
    The demonstrated steps that are nearest to some steps, each of another episode than these and than one another.

    :param features: (N, n_features) of the steps
    :param episodes: (N,) numbers of their episodes
    :param demonstrated: (M, n_features) of demonstrations
    :param demonstrated_episodes: (M,) numbers of their episodes
    :param n: how many of each step
    :return: (N, n) their rows, the nearest first; -1 where there are no more
    """
    of_features, of_demonstrated = (th.as_tensor(one, device=features.device) for one in (episodes, demonstrated_episodes))
    found = th.full((len(features), n), -1, device=features.device)
    mean = demonstrated.mean(0)  # far from 0 the lengths would lose their digits
    for rows in th.arange(len(features), device=features.device).split(1024):
        lengths = th.cdist(features[rows] - mean, demonstrated - mean)
        known = of_features[rows]
        for place in range(n):
            lengths.masked_fill_(known[:, None] == of_demonstrated, th.inf)
            shortest, nearest = lengths.min(dim=1)
            found[rows, place] = nearest.where(shortest.isfinite(), th.tensor(-1))
            known = of_demonstrated[nearest]
    return found.cpu().numpy()
