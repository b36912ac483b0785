"""Hindsight experience replay with demonstrations, as the paper's baseline has it."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.baselines.demonstration_buffers import DemonstrationHerReplayBuffer, WithDemonstrations
from sb3_actpc.baselines.prioritized import DemonstrationPrioritizedHerReplayBuffer
from sb3_actpc.baselines.td3 import DDPGDemo
from sb3_actpc.utils.arguments import Share, checked


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
        ``beta_increment`` and ``epsilon`` (see :class:`~sb3_actpc.baselines.prioritized.PrioritizedHerReplayBuffer`)
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
        self._has_episode = False
        buffer = {"n_sampled_goal": 1, "goal_selection_strategy": "final", **(replay_buffer_kwargs or {})}
        options = {"cloning_weight": 0.0, "demonstration_fraction": 0.5, **options, "replay_buffer_kwargs": buffer}
        super().__init__(*args, **options)

    def _replay_class(self) -> type[WithDemonstrations]:
        keys = set(getattr(self.observation_space, "spaces", {}))
        if not {"observation", "achieved_goal", "desired_goal"} <= keys:
            raise ValueError(
                f"HER needs a goal task (Dict observations with observation, achieved_goal and desired_goal), found "
                f"{self.observation_space}: use a Goal... task such as GoalReacher-v5"
            )
        return DemonstrationPrioritizedHerReplayBuffer if self.prioritized else DemonstrationHerReplayBuffer

    @property
    def random_action_probability(self) -> float:
        """ε at the present step."""
        return max(self.random_action_end, self.random_action_start * self.random_action_decay**self.num_timesteps)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        actions, scaled = super()._sample_action(learning_starts, action_noise, n_envs)
        random = np.random.random(n_envs) < self.random_action_probability
        if random.any():
            drawn = np.array([self.action_space.sample() for _ in range(n_envs)])
            scaled = np.where(random[:, None], self.policy.scale_action(drawn), scaled)
            actions = self.policy.unscale_action(scaled)
        return actions, scaled

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """DDPG's updates; none before the first episode has ended, since hindsight needs one."""
        buffer = self.replay_buffer
        if isinstance(buffer, HerReplayBuffer) and not self._has_episode and buffer.n_demonstrated(batch_size) < batch_size:  # type: ignore[attr-defined]
            self._has_episode = bool((buffer.ep_length > 0).any())
            if not self._has_episode:
                return
        super().train(gradient_steps, batch_size)

    def _critic_loss(self, values: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """The squared errors by importance weight; the priorities follow the errors of the first critic."""
        buffer: Any = self.replay_buffer
        n_own = len(targets) - buffer.n_demonstrated(len(targets))
        if not n_own or getattr(buffer, "importance_weights", None) is None:
            return super()._critic_loss(values, targets)
        weights = th.ones_like(targets)
        weights[:n_own] = buffer.importance_weights
        errors = (values[0] - targets).detach()[:n_own, 0]
        buffer.update_priorities(errors.cpu().numpy())
        return (weights * (values - targets).square()).mean(dim=(1, 2)).sum()

    def _log_training(self) -> None:
        self.logger.record("rollout/random_action_probability", self.random_action_probability)
        super()._log_training()
