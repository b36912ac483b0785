"""What clones of some demonstrated episodes make of the others: which of two ways to imitate suits these demonstrations."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th

from sb3_actpc.actpc.cloning import Cloning, Imitated
from sb3_actpc.actpc.self_imitation import Episodes

HELD_OUT = 4  # every so manieth episode
N_UPDATES, N_ASKED = 2000, 1000  # of a clone that is tried, and steps that it is asked about


def split(shown: Episodes) -> tuple[Episodes, Episodes] | None:
    """
    :param shown: the demonstrations
    :return: those that are imitated, and those that are held out; None where there are too few
    """
    numbers = np.unique(shown.starts, return_inverse=True)[1]
    is_held = numbers % HELD_OUT == HELD_OUT - 1
    return (shown.select(~is_held), shown.select(is_held)) if is_held.any() else None


def typical_error(cloning: Cloning, held_out: Imitated) -> float:
    """
    The median squared error of a clone, which is made here, on steps that it has not seen.

    Not the mean, which a few steps make where what is done leaps (to a standstill, say), and which is hardly changed by
    whether all others are precise. But these bring an episode home.

    :param cloning: the clone in the making
    :param held_out: features (B, n_features), actions (B, A) and working memory of steps that are held out
    """
    for update in range(len(cloning)):
        cloning.update(update)
    features, actions, memory = held_out
    return float((cloning.clone.project(features, memory) - actions).square().mean(1).median())


@contextmanager
def random_numbers_of_its_own(device: th.device, seed: int = 0) -> Iterator[None]:
    """The same ones whenever it is entered; after it NumPy's and torch's go on as if nothing had been drawn."""
    before = np.random.get_state()
    with th.random.fork_rng([device] if device.type == "cuda" else []):
        np.random.seed(seed)
        th.manual_seed(seed)
        try:
            yield
        finally:
            np.random.set_state(before)
