"""Hindsight replay with priorities (Schaul et al., arXiv 1511.05952; Andrychowicz et al., arXiv 1707.01495)."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.baselines.demonstration_buffers import DemonstrationHerReplayBuffer, join_batches
from sb3_actpc.utils.arguments import Share, Weight, checked


class SumTree:
    """Numbers, at first 0, of which any can be changed, and drawn in proportion, in logarithmic time."""

    def __init__(self, size: int) -> None:
        self.n_leaves = 1 << max(size - 1, 1).bit_length()
        self.nodes = np.zeros(2 * self.n_leaves)  # node i has children 2i and 2i + 1; 1 is the root

    @property
    def total(self) -> float:
        """Sum of all numbers."""
        return float(self.nodes[1])

    def __getitem__(self, indices: np.ndarray) -> np.ndarray:
        return self.nodes[self.n_leaves + indices]

    def __setitem__(self, indices: np.ndarray, values: np.ndarray | float) -> None:
        nodes = self.n_leaves + np.asarray(indices)
        self.nodes[nodes] = values
        while nodes.size and nodes[0] > 1:
            nodes = np.unique(nodes >> 1)
            self.nodes[nodes] = self.nodes[2 * nodes] + self.nodes[2 * nodes + 1]

    def draw(self, n: int) -> np.ndarray:
        """(n,) indices, each drawn in proportion to its number: one from each n-th part of the total."""
        masses = (np.arange(n) + np.random.random(n)) / n * self.total
        nodes = np.ones(n, dtype=np.int64)
        while nodes[0] < self.n_leaves:
            nodes *= 2
            left = self.nodes[nodes]
            # rounding may leave a mass just beyond the last number: never step into an empty half
            goes_right = (masses >= left) & (self.nodes[nodes + 1] > 0)
            masses -= np.where(goes_right, left, 0.0)
            nodes += goes_right
        return nodes - self.n_leaves


class PrioritizedHerReplayBuffer(HerReplayBuffer):
    """
    Every transition is there twice, with its own goal and with one of its episode's, and each of the two has a priority: the
    paper's HER stores each episode "twice", "once for the original goal pursued" and once for "the final state achieved".

    A transition is drawn with probability P ∝ (absolute TD error + ε)^α, and its loss is weighed by (n P)^-β, divided by the
    batch's largest weight. New ones get the largest priority so far. ``n_sampled_goal`` has no meaning here.

    :param alpha: α
    :param beta: β at the start
    :param beta_increment: added to β at each sampling, up to 1
    :param epsilon: ε
    :raises ValueError: for a value out of range
    """

    @checked
    def __init__(
        self,
        *args: Any,
        alpha: Share = 0.6,
        beta: Share = 0.4,
        beta_increment: Weight = 0.001,
        epsilon: Weight = 0.01,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.alpha, self.beta, self.beta_increment, self.epsilon = alpha, beta, beta_increment, epsilon
        self.priorities = np.zeros((self.buffer_size, self.n_envs, 2))
        self.largest_priority = 1.0
        self.importance_weights: th.Tensor | None = None
        self._tree = SumTree(self.priorities.size)
        self._drawn = np.zeros(0, dtype=np.int64)

    def add(self, *args: Any, **kwargs: Any) -> None:
        for env in range(self.n_envs):  # SB3 drops the whole episode of which a transition is overwritten
            length = int(self.ep_length[self.pos, env])
            if length:
                end = int(self.ep_start[self.pos, env]) + length
                self._set_priorities(np.arange(self.pos, end) % self.buffer_size, env, 0.0)
        super().add(*args, **kwargs)

    def _compute_episode_length(self, env_idx: int) -> None:
        start = int(self._current_ep_start[env_idx])
        super()._compute_episode_length(env_idx)
        rows = (start + np.arange(int(self.ep_length[start, env_idx]))) % self.buffer_size
        self._set_priorities(rows, env_idx, self.largest_priority)

    def _set_priorities(self, rows: np.ndarray, env: int, priority: float) -> None:
        self.priorities[rows, env] = priority
        first = (rows * self.n_envs + env) * 2
        self._tree[np.concatenate([first, first + 1])] = priority

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> DictReplayBufferSamples:  # type: ignore[override]
        """B transitions, those with their own goals first; ``importance_weights`` then holds their weights, (B, 1).
        RuntimeError before the end of the first episode."""
        if not self._tree.total:
            raise RuntimeError("no whole episode is stored yet: choose a learning_starts greater than an episode's steps")
        drawn = self._tree.draw(batch_size)
        drawn = drawn[np.argsort(drawn % 2, kind="stable")]
        n_own = int((drawn % 2 == 0).sum())
        rows, envs = np.divmod(drawn // 2, self.n_envs)
        parts = [
            get(rows[part], envs[part], env)
            for get, part in ((self._get_real_samples, slice(n_own)), (self._get_virtual_samples, slice(n_own, None)))
            if len(rows[part])
        ]
        weights = self._tree[drawn] ** -self.beta  # the number stored and the total cancel below
        self.importance_weights = self.to_torch((weights / weights.max()).astype(np.float32)[:, None])
        self.beta = min(1.0, self.beta + self.beta_increment)
        self._drawn = drawn
        return parts[0] if len(parts) == 1 else join_batches(*parts)

    def update_priorities(self, errors: np.ndarray) -> None:
        """:param errors: (B,) TD errors of the transitions sampled last, in their order"""
        priorities = (np.abs(errors) + self.epsilon) ** self.alpha
        self.largest_priority = max(self.largest_priority, float(priorities.max(initial=0.0)))
        self.priorities.reshape(-1)[self._drawn] = priorities
        # of an index drawn twice the last one counts, in the tree as in the array
        self._tree[self._drawn] = self.priorities.reshape(-1)[self._drawn]

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint keeps beside the arrays with a row per step."""
        return {"beta": self.beta, "largest_priority": self.largest_priority}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """:param state: what :meth:`checkpoint_state` returned"""
        self.beta, self.largest_priority = state["beta"], state["largest_priority"]
        self._tree = SumTree(self.priorities.size)
        self._tree[np.arange(self.priorities.size)] = self.priorities.reshape(-1)


class DemonstrationPrioritizedHerReplayBuffer(DemonstrationHerReplayBuffer, PrioritizedHerReplayBuffer):
    """The same with demonstrations, which are drawn uniformly and have weight 1."""

    _own_keywords: ClassVar[tuple[str, ...]] = ("alpha", "beta", "beta_increment", "epsilon")
