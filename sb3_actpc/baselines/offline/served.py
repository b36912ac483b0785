"""Offline methods of d3rlpy, evaluated as every other algorithm is.

Each trains and acts in a process of its own, in the virtual environment that ``sb3-actpc baselines install d3rlpy`` makes,
because d3rlpy pins other versions than this package. Demonstrations go in and actions come out through a pipe
(:mod:`sb3_actpc.baselines.offline.servers.frames`). The episodes are played here, in our environments.
"""

import json
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule

from sb3_actpc.baselines.bc_policies import LARGEST_INPUT, SMALLEST_SPREAD
from sb3_actpc.baselines.offline.installation import environment_python
from sb3_actpc.baselines.offline.process import ServerProcess
from sb3_actpc.baselines.offline.servers.frames import Arrays, Values
from sb3_actpc.baselines.offline_algorithm import OfflineAlgorithm
from sb3_actpc.demonstrations import Demonstrations, scaled_actions
from sb3_actpc.utils.arguments import Between, checked

SERVER = Path(__file__).resolve().parent / "servers" / "d3rlpy_server.py"


class ServedPolicy(BasePolicy):
    """A policy whose actions another process chooses."""

    owner: "ServedAlgorithm"

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Box, lr_schedule: Schedule) -> None:
        super().__init__(observation_space, action_space, squash_output=True)

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        return th.as_tensor(self.owner.act(observation.float().flatten(1).cpu().numpy()), device=self.device)


class ServedAlgorithm(OfflineAlgorithm):
    """What the served methods share.

    The other process gets observations normalized by the demonstrations' mean and standard deviation, and actions scaled to
    [-1, 1]. It starts when it is first needed, computes on the CPU, and holds the networks, which are fetched to be saved. It
    ends with :meth:`close`, or with the agent.

    :param args: policy and env of :class:`~sb3_actpc.baselines.offline_algorithm.OfflineAlgorithm`
    :param batch_size: B
    :param method_kwargs: the method's own settings, by d3rlpy's names, and ``net_arch``, the hidden sizes of all networks
    :param timeout: seconds that one gradient step, or the start, may take
    :param options: further keywords as there; the learning rates are among ``method_kwargs``
    :raises ValueError: as there
    :raises ImportError: when d3rlpy's environment has not been made; the message names the command that does it
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": ServedPolicy}
    package: ClassVar[str] = "d3rlpy"
    method: ClassVar[str]
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
                "a rate of its own, set them in method_kwargs (actor_learning_rate, critic_learning_rate, ...)"
            )
        try:
            self.method_kwargs = json.loads(json.dumps(method_kwargs or {}))
        except TypeError as error:
            raise ValueError(f"method_kwargs={method_kwargs!r} must hold plain values alone: {error}") from None
        self.timeout = timeout
        self._process: ServerProcess | None = None
        super().__init__(*args, batch_size=batch_size, **options)

    def _setup_model(self) -> None:
        if not isinstance(self.observation_space, spaces.Box):
            raise ValueError(f"{type(self).__name__} needs Box observations, found {self.observation_space}")
        n_observations = int(np.prod(self.observation_space.shape))
        self.normalization = th.stack([th.zeros(n_observations), th.ones(n_observations)])  # mean, standard deviation
        self.trained = th.empty(0, dtype=th.uint8)  # the networks as bytes, when they were last fetched
        self._demonstrated: Arrays = {}
        if self.env is not None:
            self._command()  # before anything of a run is written
        super()._setup_model()
        self.policy.owner = self

    def _take(self, demonstrations: Demonstrations) -> None:
        assert isinstance(self.action_space, spaces.Box)
        if not len(self.trained):  # a loaded agent keeps the normalization that its networks learned with
            spread = np.maximum(demonstrations.observations.std(axis=0), SMALLEST_SPREAD)
            self.normalization = th.from_numpy(np.stack([demonstrations.observations.mean(axis=0), spread]))
        self._demonstrated = {
            "observations": self._normalized(demonstrations.observations),
            "next_observations": self._normalized(demonstrations.next_observations),
            "actions": scaled_actions(demonstrations, self.action_space),
            "rewards": demonstrations.rewards,
            "terminations": demonstrations.terminations,
        }
        if self._process is not None:
            self._process.ask("show", self._demonstrated)

    def _normalized(self, rows: np.ndarray) -> np.ndarray:
        mean, spread = self.normalization.cpu().numpy()
        return np.clip((rows - mean) / spread, -LARGEST_INPUT, LARGEST_INPUT).astype(np.float32)

    @classmethod
    def check_installed(cls) -> None:
        """:raises ImportError: when the package's environment has not been made; the message names the command that does it"""
        environment_python(cls.package)

    def _command(self) -> list[str]:
        """:raises ImportError: as :meth:`check_installed`"""
        return [str(environment_python(self.package)), "-s", "-u", str(SERVER)]

    def _server(self) -> ServerProcess:
        """The other process, started when it is not running: with the networks as they were last fetched, or new ones."""
        if self._process is None:
            process = ServerProcess(self._command(), f"{self.package}'s {self.method.upper()}", self.timeout)
            # without a seed every agent has another; one that goes on does not draw the same batches again
            seed = int(np.random.randint(2**31)) if self.seed is None else self.seed + self._n_updates
            process.ask(
                "build",
                method=self.method,
                n_observations=self.normalization.shape[1],
                n_actions=int(np.prod(self.action_space.shape or ())),
                batch_size=self.batch_size,
                seed=seed,
                method_kwargs=self.method_kwargs,
            )
            if len(self.trained):
                process.ask("load", {"parameters": self.trained.cpu().numpy()})
            if self._demonstrated:
                process.ask("show", self._demonstrated)
            self._process = process
        return self._process

    def close(self) -> None:
        """End the other process; what it has learned since the agent was last saved is lost."""
        if self._process is not None:
            self._process.close()
            self._process = None

    def _gradient_step(self) -> Values:
        return self._server().ask("train")[0]

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions (n, A), about in [-1, 1], for observations (n, obs_dim).

        :raises OSError: when the other process has failed
        :raises ValueError: when it has no finite action for every observation
        """
        _, answer = self._server().ask("predict", {"observations": self._normalized(observations)})
        actions = answer.get("actions")
        if actions is None or len(actions) != len(observations) or not np.isfinite(actions).all():
            raise ValueError(f"{self.package}'s {self.method.upper()} has no finite action for every observation")
        return np.clip(actions, -1, 1)

    def save(self, path: Any, exclude: Any = None, include: Any = None) -> None:
        """As SB3's; the networks are fetched first."""
        if self._process is not None or not len(self.trained):
            self.trained = th.from_numpy(self._server().ask("save")[1]["parameters"])
        super().save(path, exclude, include)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_process", "_demonstrated"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return [], ["trained", "normalization"]


class BCQ(ServedAlgorithm):
    """Batch-constrained Q-learning (Fujimoto et al., arXiv 1812.02900) by d3rlpy, as it is there."""

    method = "bcq"


class CQL(ServedAlgorithm):
    """Conservative Q-learning (Kumar et al., arXiv 2006.04779) by d3rlpy, as it is there."""

    method = "cql"
