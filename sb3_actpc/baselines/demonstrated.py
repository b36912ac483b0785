"""SB3's replay buffers and off-policy algorithms with a share of demonstrations in every batch."""

import warnings
from operator import itemgetter
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from torch.utils._pytree import tree_map

from sb3_actpc.demonstrations import Demonstrations, scaled_actions
from sb3_actpc.demonstrations.mixin import LearnsFromDemonstrations
from sb3_actpc.demonstrations.rows import split_observations
from sb3_actpc.utils.arguments import Share, checked
from sb3_actpc.utils.nested import map_observations
from sb3_actpc.utils.rollouts import StoresLastTransition


class DemonstrationReplayBuffer(ReplayBuffer):
    """SB3's replay buffer with demonstrations; combine it with another of SB3's, as the classes below do.

    The demonstrations stay in a buffer of their own, of the SB3 class, so that whatever that class does to its transitions
    (n-step returns, hindsight relabelling, normalisation) is done to them too. They come last in the batch.

    :param demonstrations: transitions that fit the environment, or None for none
    :param demonstration_fraction: share of each batch
    :raises ValueError: for a share out of range
    """

    @checked
    def __init__(
        self, *args: Any, demonstrations: Demonstrations | None = None, demonstration_fraction: Share = 0.5, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self.demonstration_fraction = demonstration_fraction
        self.demonstrated: ReplayBuffer | None = None
        if demonstrations is not None:
            kind: Any = next(base for base in type(self).__mro__ if base.__module__.startswith("stable_baselines3."))
            single = {**kwargs, "n_envs": 1, "optimize_memory_usage": False}
            self.demonstrated = kind(len(demonstrations), *args[1:], **single)
            self._show(self.demonstrated, demonstrations)

    def _show(self, buffer: ReplayBuffer, shown: Demonstrations) -> None:
        """Add every transition; an episode that did not terminate ends as by a time limit."""
        assert isinstance(self.action_space, spaces.Box)
        seen, following = (
            split_observations(self.observation_space, rows) for rows in (shown.observations, shown.next_observations)
        )
        actions = scaled_actions(shown, self.action_space)
        ends = np.zeros(len(shown), dtype=bool)
        ends[shown.episode_bounds[:, 1] - 1] = True
        for row in range(len(shown)):
            one = itemgetter(slice(row, row + 1))
            infos = [{"TimeLimit.truncated": bool(ends[row] and not shown.terminations[row])}]
            observations = map_observations(one, seen), map_observations(one, following)
            buffer.add(*observations, one(actions), one(shown.rewards), one(ends), infos)

    def n_demonstrated(self, batch_size: int) -> int:
        """How many of B transitions are demonstrated ones; they are the last rows."""
        return 0 if self.demonstrated is None else round(self.demonstration_fraction * batch_size)

    def can_sample(self, batch_size: int) -> bool:
        """Whether there are transitions to draw."""
        return self.n_demonstrated(batch_size) == batch_size or self._has_own()

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """B transitions: those of the agent, then those of the demonstrations; ``env`` as SB3's."""
        n_demonstrated = self.n_demonstrated(batch_size)
        if self.demonstrated is None or not n_demonstrated:
            return self._sample_own(batch_size, env)
        demonstrated = self.demonstrated.sample(n_demonstrated, env)
        if n_demonstrated == batch_size:
            return demonstrated
        return join_batches(self._sample_own(batch_size - n_demonstrated, env), demonstrated)

    def _has_own(self) -> bool:
        return self.size() > 0

    def _sample_own(self, batch_size: int, env: VecNormalize | None) -> Any:
        return super().sample(batch_size, env)

    def cut_running_episodes(self) -> None:
        """The environments are reset in mid-episode: what is stored of these episodes ends as by a time limit."""
        if self.full or self.pos:
            newest = self.pos - 1
            self.timeouts[newest] = np.logical_or(self.timeouts[newest], np.logical_not(self.dones[newest]))


class DemonstrationNStepReplayBuffer(DemonstrationReplayBuffer, NStepReplayBuffer):
    """SB3's n-step replay buffer with demonstrations, whose returns are n-step too."""


class DemonstrationDictReplayBuffer(DemonstrationReplayBuffer, DictReplayBuffer):
    """SB3's replay buffer for Dict observations with demonstrations."""


class DemonstrationHerReplayBuffer(DemonstrationReplayBuffer, HerReplayBuffer):
    """SB3's hindsight replay buffer with demonstrations, which are relabelled as the agent's own transitions are."""

    def set_env(self, env: VecEnv) -> None:
        """:param env: the environment whose ``compute_reward`` relabels, of a buffer that was loaded"""
        super().set_env(env)
        if isinstance(self.demonstrated, HerReplayBuffer):
            self.demonstrated.set_env(env)

    def _has_own(self) -> bool:
        return bool(self.ep_length.any())  # goals come from episodes that have ended

    def cut_running_episodes(self) -> None:
        """As :meth:`DemonstrationReplayBuffer.cut_running_episodes`."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # SB3 warns that it does what is asked for
            self.truncate_last_trajectory()


def join_batches(own: Any, demonstrated: Any) -> Any:
    """Two batches of SB3's, named tuples of tensors (B, ...) and (C, ...), as one, (B + C, ...); fields that SB3 leaves at
    None stay None."""

    def join(mine: th.Tensor | None, theirs: Any) -> th.Tensor | None:
        return None if mine is None else th.cat([mine, theirs])

    return tree_map(join, own, demonstrated)


class DemonstratedAlgorithm(LearnsFromDemonstrations, StoresLastTransition):
    """An off-policy algorithm whose replay buffer, which the observations and ``n_steps`` decide, holds demonstrations.

    An agent that is loaded without an environment, to be played, gets a buffer of one transition and does not look for its
    demonstrations; :meth:`set_env` makes the whole buffer.

    :param args: policy and env, as SB3's
    :param demonstration_fraction: share of each batch that comes from the demonstrations; without them it has no effect
    :param options: keywords of :class:`LearnsFromDemonstrations` and of the algorithm
    :raises ValueError: as there, for a share out of range, for a ``replay_buffer_class``, and for n-step returns of Dict
        observations
    """

    replay_buffer: DemonstrationReplayBuffer

    @checked
    def __init__(self, *args: Any, demonstration_fraction: Share = 0.5, **options: Any) -> None:
        self.demonstration_fraction = demonstration_fraction
        super().__init__(*args, **options)

    def _setup_model(self) -> None:
        self._check_actions()
        if self.replay_buffer_class is not None:
            raise ValueError(f"replay_buffer_class={self.replay_buffer_class!r} must be None; for hindsight replay use HER")
        if self.n_steps > 1 and isinstance(self.observation_space, spaces.Dict):
            raise ValueError(f"n_steps={self.n_steps} must be 1 with Dict observations: SB3 has no n-step returns for them")
        buffer = self.replay_buffer = self._make_replay_buffer()
        kwargs, self.replay_buffer_kwargs = self.replay_buffer_kwargs, {}
        super()._setup_model()
        # SB3 replaces None by its own default, and SBX makes a buffer of its own, of a class that has no such keywords
        self.replay_buffer_class, self.replay_buffer_kwargs = None, kwargs
        self.replay_buffer = buffer

    def _replay_class(self) -> type[DemonstrationReplayBuffer]:
        if isinstance(self.observation_space, spaces.Dict):
            return DemonstrationDictReplayBuffer
        return DemonstrationReplayBuffer if self.n_steps == 1 else DemonstrationNStepReplayBuffer

    def _make_replay_buffer(self, size: int | None = None) -> DemonstrationReplayBuffer:
        kind, is_played = self._replay_class(), self.env is None
        kwargs = dict(self.replay_buffer_kwargs)
        if issubclass(kind, NStepReplayBuffer):
            kwargs |= {"n_steps": self.n_steps, "gamma": self.gamma}  # SB3 adds those of an agent that is loaded
        if issubclass(kind, HerReplayBuffer):
            if "desired_goal" not in getattr(self.observation_space, "spaces", {}):
                raise ValueError(
                    f"{type(self).__name__}: hindsight needs a goal task such as GoalReacher-v5, found observations of "
                    f"{self.observation_space}"
                )
            kwargs["env"] = self.env
        return kind(
            1 if is_played else size or self.buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            demonstrations=None if is_played or self.demonstrations is None else self._fitted_demonstrations(),
            demonstration_fraction=self.demonstration_fraction,
            **kwargs,
        )

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """As SB3's. An agent that was loaded without an environment gets its replay buffer now. The demonstrations are fitted
        to this environment, whose rewards relabelled transitions get."""
        was_played = self.env is None
        super().set_env(env, force_reset)
        if was_played and self.replay_buffer.buffer_size == 1:  # no other was loaded
            self.replay_buffer = self._make_replay_buffer()
        elif self.demonstrations is not None:
            self.replay_buffer.demonstrated = self._make_replay_buffer(1).demonstrated
        if isinstance(self.replay_buffer, HerReplayBuffer):
            self.replay_buffer.env = self.env

    def load_replay_buffer(self, *args: Any, **options: Any) -> None:
        """As SB3's, which unpickles: load files that you trust. The demonstrations stay those of the agent."""
        demonstrated = self.replay_buffer.demonstrated
        super().load_replay_buffer(*args, **options)
        if demonstrated is not None:
            self.replay_buffer.demonstrated = demonstrated
