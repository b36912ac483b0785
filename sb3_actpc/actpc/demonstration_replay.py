"""The demonstrations, as the agent uses them: imitated by the actor, predicted by the prior, mixed into the critic's batch."""

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_actpc.actpc.features import Batch, CircuitInputs
from sb3_actpc.actpc.reward_signals import STORED, Normalize
from sb3_actpc.actpc.self_imitation import Episodes, Observations
from sb3_actpc.actpc.transfer import to_device
from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.rows import split_observations

Score = Callable[[th.Tensor, th.Tensor, th.Tensor, th.Tensor | None], tuple[np.ndarray, np.ndarray]]
# environment steps before their rewards are compared with the demonstrated ones, and how many times larger one may be
ENOUGH_REWARDS, OTHER_SCALE = 500, 30.0


class DemonstrationReplay:
    """:param demonstrations: N transitions that fit the environment
    :param observation_space: the environment's
    :param action_space: the environment's
    :param history: H observations in the working memory; 0 for none
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        history: int,
    ) -> None:
        self.demonstrations, self.history = demonstrations, history
        bounds = demonstrations.episode_bounds
        self.ends = np.repeat(bounds[:, 1], bounds[:, 1] - bounds[:, 0])
        self.episodes = Episodes.from_demonstrations(demonstrations, observation_space, action_space)
        self.next_observations = Episodes(
            split_observations(observation_space, demonstrations.next_observations),
            self.episodes.actions,
            self.episodes.starts,
            self.episodes.returns,
        )
        self.epistemic, self.instrumental = np.zeros((2, len(demonstrations)), dtype=np.float32)
        self.has_signals = self.has_scale = False

    def __len__(self) -> int:
        return len(self.demonstrations)

    def sample(self, n: int, *how: Any) -> Batch:
        """``n`` transitions drawn uniformly; see :meth:`batch`."""
        return self.batch(np.random.randint(0, len(self), size=n), *how)

    def batch(
        self,
        rows: np.ndarray,
        inputs: CircuitInputs,
        weights: tuple[float, float, float],
        gamma: float,
        n_steps: int = 1,
        signals: tuple[Normalize, Normalize] | None = None,
    ) -> Batch:
        """:param rows: (B,) which transitions
        :param inputs: turns observations into features
        :param weights: (α_ext, α_ep, α_in)
        :param gamma: discount
        :param n_steps: length of the returns, which end with the episode
        :param signals: what the stored signals pay, epistemic and instrumental; None for themselves
        :return: the transitions as the circuits see them
        """
        samples = self.episodes.take(rows, self.history)
        steps = np.arange(n_steps)
        window = rows[:, None] + steps
        counts = window < self.ends[rows][:, None]
        last = rows + counts.sum(1) - 1
        rewards = self._rewards(window.clip(max=len(self) - 1), inputs, weights, signals or STORED) * counts * gamma**steps
        following = self._next(rows, inputs) if n_steps > 1 and weights[1] else None
        dones, discounts = self.demonstrations.terminations[last][:, None], gamma ** counts.sum(1, keepdims=True)
        columns = samples.actions, rewards.sum(1)[:, None], dones, discounts
        numbers = [column.astype(np.float32, copy=False) for column in columns]
        arrays = inputs.normalized(samples.observations), self._next(last, inputs), following, *numbers
        observed, bootstrap, following, actions, returns, dones, discounts = to_device(arrays, inputs.device)
        features, bootstrap_features = inputs.features(observed), inputs.features(bootstrap)
        next_past: tuple[Any, Any] = (None, None)
        if n_steps > 1:
            next_past = inputs.past(*self.episodes.past(last, self.history, including=True))
        memory, next_memory = inputs.memories(*inputs.past(samples.history, samples.history_mask), features, *next_past)
        return Batch(
            features=features,
            actions=actions,
            next_features=bootstrap_features if following is None else inputs.features(following),
            bootstrap_features=bootstrap_features,
            memory=memory,
            next_memory=next_memory,
            rewards=returns,
            dones=dones,
            discounts=discounts,
        )

    def _next(self, rows: np.ndarray, inputs: CircuitInputs) -> Observations:
        return inputs.normalized(self.next_observations.take(rows).observations)

    def _rewards(
        self,
        rows: np.ndarray,
        inputs: CircuitInputs,
        weights: tuple[float, float, float],
        signals: tuple[Normalize, Normalize],
    ) -> np.ndarray:
        """The weighted sum of the three parts at some rows, in the shape of ``rows``."""
        task = self.demonstrations.rewards[rows]
        if inputs.vec_normalize is not None:
            task = inputs.vec_normalize.normalize_reward(task)
        epistemic, instrumental = (
            signal(kind[rows]) for signal, kind in zip(signals, (self.epistemic, self.instrumental), strict=True)
        )
        return weights[0] * task + weights[1] * epistemic + weights[2] * instrumental

    def features(self, inputs: CircuitInputs) -> th.Tensor:
        """(N, n_features) of all observations, some at a time: there can be many images."""
        parts = [inputs.observations(observations) for observations in self._parts()]
        return th.cat([inputs.features(part) for part in parts])

    def show_to(self, normalize: VecNormalize) -> None:
        """Statistics of VecNormalize take in all observations, before anything learns from these."""
        for observations in self._parts():
            if isinstance(normalize.obs_rms, dict):
                for key, statistics in normalize.obs_rms.items():
                    statistics.update(observations[key])
            else:
                normalize.obs_rms.update(observations)

    def _parts(self) -> Iterator[Any]:
        for rows in np.array_split(np.arange(len(self)), 1 + len(self) // 1024):
            yield self.episodes.take(rows).observations

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
                f"the rewards in the demonstrations are {min(ratios):.3g} to {max(ratios):.3g} times the environment's: where "
                "they were recorded otherwise, bring them to its scale, as returns are compared and mixed: demonstrations = "
                "dataclasses.replace(demonstrations, rewards=demonstrations.rewards * ...)",
                stacklevel=2,
            )

    def rescore(self, score: Score, inputs: CircuitInputs, store: tuple[Normalize, Normalize]) -> None:
        """
        Signals of all transitions under the present circuits.

        :param score: (features, actions, next features, memory) -> r̂ of both signals, (B,) each
        :param inputs: turns observations into features
        :param store: what is stored of the epistemic and of the instrumental r̂
        """
        for start in range(0, len(self), 1024):
            rows = np.arange(start, min(start + 1024, len(self)))
            batch = self.batch(rows, inputs, (0.0, 0.0, 0.0), 0.0)
            epistemic, instrumental = score(batch.features, batch.actions, batch.next_features, batch.memory)
            self.epistemic[rows] = store[0](epistemic)
            self.instrumental[rows] = store[1](instrumental)
        self.has_signals = True
