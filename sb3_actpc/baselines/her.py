"""Hindsight experience replay with demonstrations and priorities, as the paper's baseline has it."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from sb3_actpc.baselines.demonstrated import DemonstrationHerReplayBuffer, join_batches
from sb3_actpc.baselines.td3 import DDPGDemo
from sb3_actpc.utils.arguments import Share, Weight, checked


class PrioritizedHerReplayBuffer(DemonstrationHerReplayBuffer):
    """Prioritized replay (Schaul et al., arXiv 1511.05952) of hindsight: every transition is there twice, with its own goal
    and with one of its episode's, and each of the two has a priority. ``n_sampled_goal`` has no meaning here.

    The agent's transitions are drawn with probability P ∝ (absolute TD error + ε)^α, and their loss is weighed by (n P)^-β,
    divided by the batch's largest weight. New ones get the largest priority so far. Demonstrations are drawn uniformly, with
    weight 1.

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
        self._drawn = np.zeros(0, dtype=np.int64)

    def _compute_episode_length(self, env_idx: int) -> None:
        start = int(self._current_ep_start[env_idx])
        super()._compute_episode_length(env_idx)
        rows = (start + np.arange(int(self.ep_length[start, env_idx]))) % self.buffer_size
        self.priorities[rows, env_idx] = self.largest_priority

    def _sample_own(self, batch_size: int, env: VecNormalize | None) -> Any:
        """Those with their own goals come first; ``importance_weights`` then holds the weights, (B, 1)."""
        n_rows = self.size()
        is_whole = self.ep_length[:n_rows, :, None] > 0  # not of an episode that runs or is partly overwritten
        if not is_whole.any():
            raise RuntimeError("no episode has ended yet: raise learning_starts above the length of an episode")
        priorities = (self.priorities[:n_rows] * is_whole).ravel()
        sums = priorities.cumsum()
        # one from each B-th part of the total
        masses = (np.arange(batch_size) + np.random.random(batch_size)) / batch_size * sums[-1]
        drawn = np.searchsorted(sums, np.minimum(masses, np.nextafter(sums[-1], 0.0)), side="right")
        drawn = drawn[np.argsort(drawn % 2, kind="stable")]
        n_own = int((drawn % 2 == 0).sum())
        rows, envs = np.divmod(drawn // 2, self.n_envs)
        weights = priorities[drawn] ** -self.beta  # the number stored and the total cancel below
        self.importance_weights = self.to_torch((weights / weights.max()).astype(np.float32)[:, None])
        self.beta = min(1.0, self.beta + self.beta_increment)
        self._drawn = drawn
        real = self._get_real_samples(rows[:n_own], envs[:n_own], env)
        return join_batches(real, self._get_virtual_samples(rows[n_own:], envs[n_own:], env))

    def update_priorities(self, errors: np.ndarray) -> None:
        """:param errors: (B,) TD errors of the agent's transitions sampled last, in their order"""
        priorities = (np.abs(errors) + self.epsilon) ** self.alpha
        self.largest_priority = max(self.largest_priority, float(priorities.max(initial=0.0)))
        self.priorities.reshape(-1)[self._drawn] = priorities

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint keeps beside the arrays with a row per step."""
        return {"beta": self.beta, "largest_priority": self.largest_priority}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """:param state: what :meth:`checkpoint_state` returned"""
        self.beta, self.largest_priority = state["beta"], state["largest_priority"]


class HER(DDPGDemo):
    """DDPG with hindsight experience replay (Andrychowicz et al., arXiv 1707.01495) and demonstrations, on goal tasks.

    Relabelling is SB3's ``HerReplayBuffer``. The defaults are the paper's baseline (arXiv 2209.09174): a random action with
    probability ε, ε = max(0.32, 0.9999^steps); every transition twice, with its own goal and with the last one achieved in
    its episode; prioritised replay. ``prioritized=False`` and ``replay_buffer_kwargs=dict(n_sampled_goal=4,
    goal_selection_strategy="future")`` is the usual HER.

    Differences from the paper's text:

    1. The second copy of a transition is not stored but relabelled when it is drawn; it has a priority of its own.
    2. Demonstrations are a fixed share of the batch (relabelled likewise) and have no priorities: the paper does not say how
       its HER used them.
    3. ε decays once per environment step; the paper does not say what its 0.9999 is applied to.

    :param args: policy, "MultiInputPolicy", and env, a goal task: Dict observations with ``observation``, ``achieved_goal``
        and ``desired_goal``
    :param prioritized: draw the agent's transitions by priority; ``replay_buffer_kwargs`` then takes ``alpha``, ``beta``,
        ``beta_increment`` and ``epsilon`` (see :class:`PrioritizedHerReplayBuffer`)
    :param random_action_start: ε at the start
    :param random_action_decay: factor of ε per environment step
    :param random_action_end: smallest ε
    :param replay_buffer_kwargs: further keywords of the buffer
    :param options: keywords of :class:`DDPGDemo`; ``cloning_weight`` is 0 (the paper names no cloning for HER) and
        ``demonstration_fraction`` 0.5 unless given
    :raises ValueError: for an environment without goals, or a value that is not allowed
    """

    @checked
    def __init__(
        self,
        *args: Any,
        prioritized: bool = True,
        random_action_start: Share = 1.0,
        random_action_decay: Share = 0.9999,
        random_action_end: Share = 0.32,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        **options: Any,
    ) -> None:
        self.prioritized = prioritized
        self.random_action_start, self.random_action_decay = random_action_start, random_action_decay
        self.random_action_end = random_action_end
        buffer = {"n_sampled_goal": 1, "goal_selection_strategy": "final", **(replay_buffer_kwargs or {})}
        options = {"cloning_weight": 0.0, "demonstration_fraction": 0.5, **options, "replay_buffer_kwargs": buffer}
        super().__init__(*args, **options)

    def _replay_class(self) -> type[DemonstrationHerReplayBuffer]:
        return PrioritizedHerReplayBuffer if self.prioritized else DemonstrationHerReplayBuffer

    @property
    def random_action_probability(self) -> float:
        """ε at the present step."""
        return max(self.random_action_end, self.random_action_start * self.random_action_decay**self.num_timesteps)

    def _sample_action(self, *args: Any, **options: Any) -> tuple[np.ndarray, np.ndarray]:
        actions, scaled = super()._sample_action(*args, **options)
        random = np.random.random(self.n_envs) < self.random_action_probability
        if random.any():
            drawn = np.array([self.action_space.sample() for _ in range(self.n_envs)])
            random = random.reshape(-1, *[1] * (scaled.ndim - 1))
            scaled = np.where(random, self.policy.scale_action(drawn), scaled)
            actions = self.policy.unscale_action(scaled)
        return actions, scaled

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """DDPG's updates, once the buffer can be sampled from."""
        if self.replay_buffer.can_sample(batch_size):
            self.logger.record("rollout/random_action_probability", self.random_action_probability)
            super().train(gradient_steps, batch_size)

    def _critic_loss(self, values: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """The squared errors by importance weight; the priorities follow the errors of the first critic."""
        buffer = self.replay_buffer
        if not isinstance(buffer, PrioritizedHerReplayBuffer) or buffer.importance_weights is None:
            return super()._critic_loss(values, targets)
        n_own = len(buffer.importance_weights)
        weights = th.ones_like(targets)
        weights[:n_own] = buffer.importance_weights
        buffer.update_priorities((values[0] - targets).detach()[:n_own, 0].cpu().numpy())
        return (weights * (values - targets).square()).mean(dim=(1, 2)).sum()
