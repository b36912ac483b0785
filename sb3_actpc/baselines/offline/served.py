"""Offline methods of other packages (BCQ and CQL by d3rlpy, HBC and IRIS by robomimic), evaluated like every other algorithm.

Each trains and acts in a process of its own, in the virtual environment that ``sb3-actpc baselines install`` makes: the
packages pin other versions than this one. Demonstrations go in and actions come out through a pipe
(:mod:`sb3_actpc.baselines.offline.servers.frames`), so the episodes are played here, in our environments.
"""

import json
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule

from sb3_actpc.baselines.bc_policies import LARGEST_INPUT, SMALLEST_SPREAD, State, StatefulPolicy
from sb3_actpc.baselines.offline.installation import environment_python
from sb3_actpc.baselines.offline.process import ServerProcess
from sb3_actpc.baselines.offline.servers.frames import Arrays, Values
from sb3_actpc.baselines.offline_algorithm import OfflineAlgorithm
from sb3_actpc.demonstrations import Demonstrations, scaled_actions
from sb3_actpc.utils.arguments import Between, checked

SERVERS = Path(__file__).resolve().parent / "servers"
D3RLPY_RATES = "actor_learning_rate, critic_learning_rate, ..."
ROBOMIMIC_RATES = "actor.optim_params.policy.learning_rate.initial, ..."


class ServedPolicy(StatefulPolicy):
    """A policy whose actions another process chooses, as its package's own evaluation does; the state is that process's, None
    where the method has none."""

    owner: "ServedAlgorithm"

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Box, lr_schedule: Schedule) -> None:
        super().__init__(observation_space, action_space, squash_output=True)

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        raise NotImplementedError("the actions are another process's: call predict()")

    def act(self, rows: th.Tensor, begins: np.ndarray, state: State | None) -> tuple[np.ndarray, State | None]:
        """See :class:`~sb3_actpc.baselines.bc_policies.StatefulPolicy`."""
        return self.owner.act(rows.cpu().numpy(), begins, state)


class ServedAlgorithm(OfflineAlgorithm):
    """What the four have in common.

    Observations are normalised by the demonstrations' mean and standard deviation, actions scaled to [-1, 1], before the other
    process gets them. It is started when it is first needed, computes on the CPU, and holds the networks; they are fetched to
    be saved. It ends with :meth:`close`, or when the agent is collected.

    :param args: policy and env of :class:`~sb3_actpc.baselines.offline_algorithm.OfflineAlgorithm`
    :param batch_size: B
    :param method_kwargs: the method's own settings, by the names that its package gives them
    :param timeout: seconds that one gradient step, or the start, may take
    :param options: further keywords as there; the learning rates are among ``method_kwargs``
    :raises ValueError: as there
    :raises ImportError: when the package's environment has not been made; the message names the command that does it
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": ServedPolicy}
    package: ClassVar[str]
    method: ClassVar[str]
    rates: ClassVar[str]  # names of the learning rates in ``method_kwargs``, for a message
    policy: ServedPolicy

    @checked
    def __init__(
        self,
        *args: Any,
        batch_size: int = 100,
        method_kwargs: dict[str, Any] | None = None,
        timeout: Annotated[float, Between(1)] = 300.0,
        **options: Any,
    ) -> None:
        if "learning_rate" in options:
            raise ValueError(
                f"learning_rate={options['learning_rate']!r} has no effect on {type(self).__name__}: each of its networks has "
                f"a rate of its own, set them in method_kwargs ({self.rates})"
            )
        try:
            self.method_kwargs = json.loads(json.dumps(method_kwargs or {}))
        except TypeError as error:
            raise ValueError(f"method_kwargs={method_kwargs!r} must hold plain values alone: {error}") from None
        self.timeout = timeout
        self._process: ServerProcess | None = None
        self._state_names: list[str] = []
        super().__init__(*args, batch_size=batch_size, **options)

    def _setup_model(self) -> None:
        if not isinstance(self.observation_space, spaces.Box):
            raise ValueError(f"{type(self).__name__} needs Box observations, found {self.observation_space}")
        n_observations = int(np.prod(self.observation_space.shape))
        self.normalization = th.stack([th.zeros(n_observations), th.ones(n_observations)])  # mean, standard deviation
        self.trained = th.empty(0, dtype=th.uint8)  # the networks as bytes, when they were last fetched
        self._shown: Arrays = {}
        if self.env is not None:
            self._command()  # before anything of a run is written
        super()._setup_model()
        self.policy.owner = self

    def _take(self, shown: Demonstrations) -> None:
        assert isinstance(self.action_space, spaces.Box)
        if not len(self.trained):  # a loaded agent keeps the normalisation that its networks learned with
            spread = np.maximum(shown.observations.std(axis=0), SMALLEST_SPREAD)
            self.normalization = th.from_numpy(np.stack([shown.observations.mean(axis=0), spread]))
        bounds = shown.episode_bounds
        self._shown = {
            "observations": shown.observations,
            "next_observations": shown.next_observations,
            "actions": scaled_actions(shown, self.action_space),
            "rewards": shown.rewards,
            "terminations": shown.terminations,
            "last_rows": np.repeat(bounds[:, 1] - 1, bounds[:, 1] - bounds[:, 0]),
        }
        if self._process is not None:
            self._process.ask("show", self._normalized_demonstrations())

    def _normalized_demonstrations(self) -> Arrays:
        rows = {name: self._normalized(self._shown[name]) for name in ("observations", "next_observations")}
        return {**self._shown, **rows}

    def _normalized(self, rows: np.ndarray) -> np.ndarray:
        mean, spread = self.normalization.cpu().numpy()
        return np.clip((rows - mean) / spread, -LARGEST_INPUT, LARGEST_INPUT).astype(np.float32)

    @classmethod
    def check_installed(cls) -> None:
        """:raises ImportError: when the package's environment has not been made; the message names the command that does it"""
        environment_python(cls.package)

    def _command(self) -> list[str]:
        """:raises ImportError: as :meth:`check_installed`"""
        return [str(environment_python(self.package)), "-s", "-u", str(SERVERS / f"{self.package}_server.py")]

    def _server(self) -> ServerProcess:
        """The other process, started when it is not running: with the networks as they were last fetched, or new ones."""
        if self._process is None:
            name = f"{self.package}'s {self.method.upper()}"
            process = ServerProcess(self._command(), name, self.timeout, th.get_num_threads())
            assert self.observation_space.shape is not None and self.action_space.shape is not None
            process.ask(
                "build",
                method=self.method,
                n_observations=int(np.prod(self.observation_space.shape)),
                n_actions=int(np.prod(self.action_space.shape)),
                batch_size=self.batch_size,
                # as in SB3 no seed is another one each time; an agent that goes on does not draw the same batches again
                seed=int(np.random.randint(2**31)) if self.seed is None else self.seed + self._n_updates,
                method_kwargs=self.method_kwargs,
            )
            if len(self.trained):
                process.ask("load", {"parameters": self.trained.cpu().numpy()})
            if self._shown:
                process.ask("show", self._normalized_demonstrations())
            self._process = process
        return self._process

    def close(self) -> None:
        """End the other process; what it has learned since the agent was last saved is lost."""
        if self._process is not None:
            self._process.close()
            self._process = None

    def _gradient_step(self) -> Values:
        """Of every part of the method."""
        return self._server().ask("train")[0]

    def act(self, observations: np.ndarray, starts: np.ndarray, state: State | None) -> tuple[np.ndarray, State | None]:
        """Actions (n, A), about in [-1, 1], and the next state, for observations (n, obs_dim); ``starts`` (n,) is true where
        an episode begins. OSError when the other process has failed."""
        arrays = {"observations": self._normalized(observations), "episode_starts": starts}
        if state is not None:
            arrays |= dict(zip(self._state_names, state, strict=True))
        _, answer = self._server().ask("predict", arrays)
        actions = answer.pop("actions", None)
        if actions is None or actions.shape[0] != len(observations) or not np.isfinite(actions).all():
            raise ValueError(f"{self.package}'s {self.method.upper()} has no finite action for every observation")
        self._state_names = list(answer)
        return actions, tuple(answer.values()) or None

    def save(self, path: Any, exclude: Any = None, include: Any = None) -> None:
        """As SB3's; the networks are fetched first."""
        if self._process is not None or not len(self.trained):
            self.trained = th.from_numpy(self._server().ask("save")[1]["parameters"])
        super().save(path, exclude, include)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_process", "_shown", "_state_names"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return [], ["trained", "normalization"]


class BCQ(ServedAlgorithm):
    """Batch-constrained Q-learning (Fujimoto et al., arXiv 1812.02900) by d3rlpy, as it is there.

    ``method_kwargs`` are those of d3rlpy's ``BCQConfig``, and ``net_arch``, the hidden sizes of all networks.
    """

    package, method, rates = "d3rlpy", "bcq", D3RLPY_RATES


class CQL(ServedAlgorithm):
    """Conservative Q-learning (Kumar et al., arXiv 2006.04779) by d3rlpy, as it is there.

    ``method_kwargs`` are those of d3rlpy's ``CQLConfig``, and ``net_arch``, the hidden sizes of all networks.
    """

    package, method, rates = "d3rlpy", "cql", D3RLPY_RATES


class HBC(ServedAlgorithm):
    """Hierarchical behaviour cloning (Mandlekar et al., arXiv 2003.06085) by robomimic: subgoals, and an actor that follows.

    Difference from robomimic's runs: the observation is one key, not one for each of robosuite's parts. ``method_kwargs``
    are what is to change in the ``algo`` part of robomimic's config.
    """

    package, method, rates = "robomimic", "hbc", ROBOMIMIC_RATES


class IRIS(ServedAlgorithm):
    """Implicit reinforcement without interaction at scale (Mandlekar et al., arXiv 1911.05321) by robomimic.

    :class:`HBC` with a value function (BCQ) that chooses among sampled subgoals.
    """

    package, method, rates = "robomimic", "iris", ROBOMIMIC_RATES
