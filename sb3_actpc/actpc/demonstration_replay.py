"""The demonstrations, as the agent uses them: imitated by the actor, predicted by the prior, mixed into the critic's batch."""

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_actpc.actpc.batches import Batch, Observations, SignalReplaySamples, normalized, to_device
from sb3_actpc.actpc.policies import ActPCActor
from sb3_actpc.actpc.reward_signals import STORED, Normalize, RewardWeights
from sb3_actpc.actpc.self_imitation import Episodes, failure_reward
from sb3_actpc.demonstrations import Demonstrations, scaled_actions
from sb3_actpc.demonstrations.rows import split_observations
from sb3_actpc.utils.nested import map_observations

PART = 1024  # rows at a time, where all are passed through: there can be many images
# so many rewards are enough to compare, and so many times the demonstrated ones are another scale
ENOUGH_REWARDS, OTHER_SCALE = 500, 30.0


class DemonstrationReplay:
    """
    Minibatches of demonstrated transitions, with signals and n-step returns as the agent's own have.

    :param demonstrations: N transitions that fit the environment
    :param observation_space: the environment's
    :param action_space: the environment's
    :param history: H observations in the working memory; 0 for none
    """

    def __init__(
        self, demonstrations: Demonstrations, observation_space: spaces.Space, action_space: spaces.Box, history: int
    ) -> None:
        self.demonstrations = demonstrations
        self.history = history
        bounds = demonstrations.episode_bounds
        lengths = bounds[:, 1] - bounds[:, 0]
        self.ends = np.repeat(bounds[:, 1], lengths)
        self.failure_reward = failure_reward(demonstrations.rewards, bounds[:, 0])
        returns = np.add.reduceat(demonstrations.rewards.astype(np.float64) - self.failure_reward, bounds[:, 0])
        self.episodes = Episodes(
            observations=split_observations(observation_space, demonstrations.observations),
            actions=scaled_actions(demonstrations, action_space),
            starts=np.repeat(bounds[:, 0], lengths),
            returns=np.repeat(returns, lengths),
        )
        self.next_observations = split_observations(observation_space, demonstrations.next_observations)
        self.epistemic = np.zeros(len(demonstrations), dtype=np.float32)
        self.instrumental = np.zeros(len(demonstrations), dtype=np.float32)
        self.has_signals = False
        self.has_scale = False  # whether rewards have been compared

    def __len__(self) -> int:
        return len(self.demonstrations)

    def draw(self, n: int) -> np.ndarray:
        """``n`` rows, uniformly."""
        return np.random.randint(0, len(self), size=n)

    def batch(
        self,
        rows: np.ndarray,
        actor: ActPCActor,
        env: VecNormalize | None,
        weights: RewardWeights,
        gamma: float,
        n_steps: int = 1,
        signals: tuple[Normalize, Normalize] | None = None,
    ) -> Batch:
        """:param rows: (B,) which transitions
        :param actor: turns observations into features
        :param env: VecNormalize whose statistics normalise observations and the task's rewards
        :param weights: of the parts of the reward
        :param gamma: discount
        :param n_steps: length of the returns, which end with the episode
        :param signals: what the stored signals pay, epistemic and instrumental; None for themselves
        :return: the transitions as the circuits see them
        """
        samples = self.episodes.take(rows, self.history)
        # Returns of n steps, or of fewer at the end of the episode
        window = rows[:, None] + np.arange(n_steps)
        counts = window < self.ends[rows][:, None]
        last = rows + counts.sum(1) - 1
        window = window.clip(max=len(self) - 1)
        task = self.demonstrations.rewards[window]
        if env is not None:
            task = env.normalize_reward(task)
        epistemic, instrumental = signals or STORED
        rewards = weights.task * task + weights.epistemic * epistemic(self.epistemic[window])
        rewards = rewards + weights.instrumental * instrumental(self.instrumental[window])
        rewards = (rewards * counts * gamma ** np.arange(n_steps)).sum(1)

        def column(values: np.ndarray) -> np.ndarray:
            return values.reshape(-1, 1).astype(np.float32, copy=False)

        next_history, next_mask = self.episodes.past(last, self.history if n_steps > 1 else 0, including=True)
        arrays = dict(
            observations=normalized(samples.observations, env),
            actions=samples.actions,
            next_observations=normalized(self._next(last), env),
            dones=column(self.demonstrations.terminations[last]),
            rewards=column(rewards),
            discounts=column(gamma ** counts.sum(1)),
            epistemic=None,
            instrumental=None,
            history=normalized(samples.history, env),
            history_mask=samples.history_mask,
            following_observations=normalized(self._next(rows), env) if n_steps > 1 and weights.epistemic else None,
            next_history=normalized(next_history, env),
            next_history_mask=next_mask,
        )
        moved = SignalReplaySamples(**to_device(arrays, actor.normalizer.mean.device))
        return Batch.of(moved, moved.rewards, actor)

    def _next(self, rows: np.ndarray) -> Observations:
        return map_observations(lambda array: array[rows], self.next_observations)

    def check_scale(self, rewards: np.ndarray) -> None:
        """
        Warn, once, where the environment's rewards cannot have the scale of the demonstrated ones.

        Maximum and mean of the positive rewards, and of the negative ones, then differ in the same direction. One alone may
        differ by behavior.

        :param rewards: of all environment steps so far; of few, or without a common sign, they say nothing
        """
        if self.has_scale or rewards.size < ENOUGH_REWARDS:
            return
        ratios: list[float] = []
        for sign in (1.0, -1.0):
            demonstrated, own = (sign * part[sign * part > 0.0] for part in (self.demonstrations.rewards, rewards))
            if len(demonstrated) and len(own):
                ratios += [demonstrated.mean() / own.mean(), demonstrated.max() / own.max()]
        self.has_scale = bool(ratios)
        if ratios and (min(ratios) > OTHER_SCALE or max(ratios) < 1 / OTHER_SCALE):
            warnings.warn(
                f"the rewards in the demonstrations are {min(ratios):.3g} to {max(ratios):.3g} times the environment's: bring "
                "them to its scale with dataclasses.replace(demonstrations, rewards=demonstrations.rewards * ...)",
                stacklevel=2,
            )

    def parts(self) -> Iterator[Any]:
        """All observations, some at a time."""
        for rows in np.array_split(np.arange(len(self)), 1 + len(self) // PART):
            yield self.episodes.take(rows).observations

    def show_to(self, normalize: VecNormalize) -> None:
        """Statistics of VecNormalize take in all observations, before anything learns from these."""
        for observations in self.parts():
            if isinstance(normalize.obs_rms, dict):
                for key, statistics in normalize.obs_rms.items():
                    statistics.update(observations[key])
            else:
                normalize.obs_rms.update(observations)

    def rescore(
        self,
        score: Callable[[Batch], tuple[np.ndarray, np.ndarray]],
        store: tuple[Normalize, Normalize],
        actor: ActPCActor,
        env: VecNormalize | None,
    ) -> None:
        """
        Signals of all transitions under the present circuits.

        :param score: r̂ of both signals of a batch, (B,) each
        :param store: what is stored of the epistemic and of the instrumental r̂
        :param actor: turns observations into features
        :param env: as for :meth:`batch`
        """
        for start in range(0, len(self), PART):
            rows = np.arange(start, min(start + PART, len(self)))
            epistemic, instrumental = score(self.batch(rows, actor, env, RewardWeights(0.0, 0.0, 0.0), 0.0))
            self.epistemic[rows], self.instrumental[rows] = store[0](epistemic), store[1](instrumental)
        self.has_signals = True
