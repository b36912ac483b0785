"""The demonstrations of an algorithm, shared by ActPC and the baselines."""

import os
from pathlib import Path
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.fitting import fit_demonstrations
from sb3_actpc.utils.arguments import DemonstrationLimit, check_actions, check_limit, checked


class LearnsFromDemonstrations(BaseAlgorithm):
    """Keeps what the user passed as demonstrations, and fits it to the environment on request.

    :param policy: as SB3's
    :param env: as SB3's
    :param demonstrations: a path, or a :class:`~sb3_actpc.demonstrations.dataset.Demonstrations`; None learns without
    :param n_demonstrations: use only this many episodes, the first ones; ``(300, "transitions")`` for so many transitions
    :param options: keywords of the algorithm; dictionaries among them are copied, since SB3 adds keys to some
    """

    @checked
    def __init__(
        self,
        policy: Any,
        env: GymEnv | str | None,
        *,
        demonstrations: Demonstrations | str | Path | None = None,
        n_demonstrations: DemonstrationLimit = None,
        **options: Any,
    ) -> None:
        # a saved agent holds the path as text, which every system can read
        self.demonstrations = os.fspath(demonstrations) if isinstance(demonstrations, Path) else demonstrations
        self.n_demonstrations = n_demonstrations
        super().__init__(policy, env, **_copied(options))

    @property
    def has_normalized_observations(self) -> bool:
        """Whether VecNormalize changes the observations."""
        return self._vec_normalize_env is not None and bool(self._vec_normalize_env.norm_obs)

    def _check_actions(self) -> None:
        """:raises ValueError: for actions that cannot be scaled to [-1, 1], or that are whole numbers"""
        if isinstance(self.action_space, spaces.Box):
            check_actions(self.action_space)

    def _fitted_demonstrations(self) -> Demonstrations:
        """The demonstrations as the environment would have recorded them.

        :raises ValueError: for demonstrations that do not fit the environment
        :raises FileNotFoundError: when the file is missing
        """
        assert self.demonstrations is not None
        check_limit("n_demonstrations", self.n_demonstrations)
        observed, acted = self.observation_space, self.action_space
        try:
            return fit_demonstrations(self.demonstrations, self.env, observed, acted, self.n_demonstrations)
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{error}; load(path, env=env, demonstrations=...) gives a loaded agent others") from error


def _copied(settings: dict[str, Any]) -> dict[str, Any]:
    """The same settings in new dictionaries, at every depth."""
    return {name: _copied(value) if isinstance(value, dict) else value for name, value in settings.items()}
