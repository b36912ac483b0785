"""SB3's replay buffers with a share of demonstrations in every batch, for any SB3 off-policy algorithm."""

from operator import itemgetter
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc.demonstrations import Demonstrations, scaled_actions
from sb3_actpc.demonstrations.rows import split_observations
from sb3_actpc.utils.arguments import Share, checked
from sb3_actpc.utils.nested import map_observations


def fill_with_demonstrations(
    buffer: ReplayBuffer, demonstrations: Demonstrations, observation_space: spaces.Space, action_space: spaces.Box
) -> None:
    """Add every demonstrated transition to a buffer for one environment with room for all; an episode that did not
    terminate ends as by a time limit. Actions are scaled to [-1, 1]; observations are a Box, or a Dict of Boxes."""
    observations = split_observations(observation_space, demonstrations.observations)
    actions = scaled_actions(demonstrations, action_space)
    next_observations = split_observations(observation_space, demonstrations.next_observations)
    ends = np.zeros(len(demonstrations), dtype=bool)
    ends[demonstrations.episode_bounds[:, 1] - 1] = True
    for row in range(len(demonstrations)):
        one = itemgetter(slice(row, row + 1))
        buffer.add(
            map_observations(one, observations),
            map_observations(one, next_observations),
            one(actions),
            one(demonstrations.rewards),
            one(ends),
            [{"TimeLimit.truncated": bool(ends[row] and not demonstrations.terminations[row])}],
        )


class WithDemonstrations(ReplayBuffer):
    """What the buffers of this module add to SB3's; combine it with one of them.

    The demonstrations stay in a buffer of their own, of the SB3 class, so that whatever that class does to its transitions
    (n-step returns, hindsight relabelling, normalisation) is done to them too. They come last in the batch.

    ActPC does not use these classes: its demonstrations carry two internal signals and a working memory (see
    :class:`sb3_actpc.actpc.demonstration_replay.DemonstrationReplay`). What both share is in
    :mod:`sb3_actpc.demonstrations`.

    :param demonstrations: transitions that fit the environment, or None for none
    :param demonstration_fraction: share of each batch, between 0 and 1
    :raises ValueError: for a share out of range
    """

    _own_keywords: ClassVar[tuple[str, ...]] = ()  # of a subclass, not for the demonstrations' buffer

    @checked
    def __init__(
        self, *args: Any, demonstrations: Demonstrations | None = None, demonstration_fraction: Share = 0.5, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self.demonstration_fraction = demonstration_fraction
        self.demonstrated: ReplayBuffer | None = None
        if demonstrations is not None:
            skipped = {"n_envs", "optimize_memory_usage", *self._own_keywords}
            kwargs = {key: value for key, value in kwargs.items() if key not in skipped}
            kind: Any = next(base for base in type(self).__mro__ if base.__module__.startswith("stable_baselines3."))
            self.demonstrated = kind(len(demonstrations), *args[1:], n_envs=1, **kwargs)
            assert isinstance(self.action_space, spaces.Box)
            fill_with_demonstrations(self.demonstrated, demonstrations, self.observation_space, self.action_space)

    def n_demonstrated(self, batch_size: int) -> int:
        """How many of B transitions are demonstrated ones; they are the last rows."""
        return 0 if self.demonstrated is None else round(self.demonstration_fraction * batch_size)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Any:
        """B transitions: those of the agent, then those of the demonstrations; ``env`` as SB3's."""
        n_demonstrated = self.n_demonstrated(batch_size)
        if self.demonstrated is None or not n_demonstrated:
            return super().sample(batch_size, env)
        self.demonstrated.device = self.device
        demonstrated = self.demonstrated.sample(n_demonstrated, env)
        if n_demonstrated == batch_size:
            return demonstrated
        return join_batches(super().sample(batch_size - n_demonstrated, env), demonstrated)


class DemonstrationReplayBuffer(WithDemonstrations):
    """SB3's replay buffer with demonstrations; see :class:`WithDemonstrations`."""


class DemonstrationNStepReplayBuffer(WithDemonstrations, NStepReplayBuffer):
    """SB3's n-step replay buffer with demonstrations, whose returns are n-step too."""


class DemonstrationDictReplayBuffer(WithDemonstrations, DictReplayBuffer):
    """SB3's replay buffer for Dict observations with demonstrations."""


class DemonstrationHerReplayBuffer(WithDemonstrations, HerReplayBuffer):
    """SB3's hindsight replay buffer with demonstrations, which are relabelled as the agent's own transitions are."""

    def set_env(self, env: VecEnv) -> None:
        """:param env: the environment whose ``compute_reward`` relabels"""
        super().set_env(env)
        if isinstance(self.demonstrated, HerReplayBuffer) and self.demonstrated.env is None:
            self.demonstrated.set_env(env)


def demonstration_buffer_class(
    given: type[ReplayBuffer] | str | None, observation_space: spaces.Space, n_steps: int = 1
) -> type[WithDemonstrations]:
    """The class of this module that does what a class of SB3's, or its name, does; ValueError for another class, or n-step
    returns with Dict observations."""
    is_dict = isinstance(observation_space, spaces.Dict)
    if n_steps > 1 and (is_dict or given is not None):
        raise ValueError(f"n_steps={n_steps} works with vector observations and replay_buffer_class=None alone; use n_steps=1")
    if n_steps > 1:
        return DemonstrationNStepReplayBuffer
    if given is None:
        given = DictReplayBuffer if is_dict else ReplayBuffer
    if isinstance(given, type) and issubclass(given, WithDemonstrations):
        return given
    same: dict[Any, type[WithDemonstrations]] = {
        ReplayBuffer: DemonstrationReplayBuffer,
        DictReplayBuffer: DemonstrationDictReplayBuffer,
        HerReplayBuffer: DemonstrationHerReplayBuffer,
    }
    names = {kind.__name__: kind for kind in same}
    kind = names.get(given) if isinstance(given, str) else given
    if kind not in same:
        raise ValueError(f"replay_buffer_class={given!r} cannot hold demonstrations: choose None or one of {sorted(names)}")
    return same[kind]


def join_batches(own: Any, demonstrated: Any) -> Any:
    """Two batches of SB3's, named tuples of tensors (B, ...) and (C, ...), as one, (B + C, ...); fields that SB3 leaves at
    None stay None."""

    def join(mine: Any, theirs: Any) -> Any:
        if isinstance(mine, dict):
            return {key: th.cat([part, theirs[key]]) for key, part in mine.items()}
        return None if mine is None else th.cat([mine, theirs])

    return own._replace(**{name: join(mine, getattr(demonstrated, name)) for name, mine in own._asdict().items()})
