"""Offline methods of d3rlpy, which pins other versions than this package: each trains and acts in a process of its own
(:mod:`sb3_actpc.baselines.d3rlpy_server`), in a virtual environment that :func:`install` makes."""

import os
import shutil
import subprocess
import sys
from multiprocessing import Pipe
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_actpc.baselines.bc import NormalizingPolicy, OfflineAlgorithm
from sb3_actpc.demonstrations import Demonstrations, scaled_actions
from sb3_actpc.utils.arguments import checked

SERVER = Path(__file__).resolve().parent / "d3rlpy_server.py"
# torch by number, so that no CUDA libraries come with it where an index of CPU wheels is set
PACKAGES = ("torch==2.13.0", "numpy==1.26.4", "d3rlpy==2.8.1")


def _place() -> Path:
    given = os.environ.get("SB3_ACTPC_BASELINES")
    return (Path(given) if given else Path.home() / ".cache" / "sb3_actpc" / "baselines").absolute() / "d3rlpy"


def environment_python() -> Path:
    """The interpreter of d3rlpy's environment; ImportError, which says how to make it, when there is none."""
    if not (_place() / "complete").exists():
        raise ImportError(f"d3rlpy is not installed in {_place()}: run sb3-actpc baselines install d3rlpy")
    return _place() / "bin" / "python"


def install() -> None:
    """Make d3rlpy's environment anew, in ``$SB3_ACTPC_BASELINES`` or ``~/.cache/sb3_actpc/baselines``. OSError when a step
    fails; what pip says goes to the terminal."""
    shutil.rmtree(_place(), ignore_errors=True)
    place = str(_place())
    for command in ([sys.executable, "-m", "venv", place], [f"{place}/bin/python", "-m", "pip", "install", *PACKAGES]):
        if subprocess.run(command, check=False).returncode:
            raise OSError(f"{' '.join(command)} failed")
    (_place() / "complete").touch()


class ServerProcess:
    """A child process that answers calls through a pipe; it ends with this object, and with this process.

    :param command: what starts it; the number of the pipe is added
    """

    def __init__(self, command: list[str]) -> None:
        self._channel, theirs = Pipe()
        self._process = subprocess.Popen(
            [*command, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            start_new_session=True,  # Ctrl-C is for the parent, who then closes the pipe
        )
        theirs.close()

    def call(self, method: str, *arguments: Any) -> Any:
        """What the method there returns; OSError when that process has ended, ValueError when the method fails."""
        try:
            self._channel.send((method, arguments))
            succeeded, answer = self._channel.recv()
        except (EOFError, ConnectionError):
            raise OSError(f"the process of {SERVER.name} has ended with exit code {self._process.wait()}") from None
        except BaseException:  # an interruption: the next answer would not fit its question
            self.close()
            raise
        if not succeeded:
            raise ValueError(f"{SERVER.name}: {answer}")
        return answer

    def close(self) -> None:
        """End the process."""
        self._channel.close()
        self._process.kill()
        self._process.wait()

    __del__ = close


class ServedPolicy(NormalizingPolicy):
    """A policy whose actions another process chooses."""

    owner: "ServedAlgorithm"

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        rows = self.normalized(observation).cpu().numpy()
        return th.as_tensor(self.owner.server.call("predict", rows), device=self.device).clamp(-1, 1)


class ServedAlgorithm(OfflineAlgorithm):
    """What the served methods share.

    The other process gets observations normalized by the demonstrations' mean and standard deviation, and actions scaled to
    [-1, 1]. It starts when it is first needed, computes on the CPU, holds the networks, and ends with the agent.

    :param args: policy and env of :class:`~sb3_actpc.baselines.bc.OfflineAlgorithm`
    :param batch_size: B
    :param method_kwargs: the method's own settings, by d3rlpy's names, and ``net_arch``, the hidden sizes of all networks
    :param options: further keywords as there; the learning rates are among ``method_kwargs``
    :raises ValueError: as there
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": ServedPolicy}
    method: ClassVar[str]

    @checked
    def __init__(self, *args: Any, batch_size: int = 100, method_kwargs: dict[str, Any] | None = None, **options: Any) -> None:
        if "learning_rate" in options:
            raise ValueError("learning_rate has no effect: set actor_learning_rate, ... in method_kwargs")
        self.method_kwargs = method_kwargs or {}
        self.trained = b""  # the networks, when the agent was last saved
        self._process: ServerProcess | None = None
        super().__init__(*args, batch_size=batch_size, **options)

    @classmethod
    def check_installed(cls) -> None:
        """:raises ImportError: when d3rlpy's environment has not been made; the message names the command that does it"""
        environment_python()

    def _new_policy(self) -> ServedPolicy:
        policy = super()._new_policy()
        policy.owner = self
        return policy

    def _take(self, demonstrations: Demonstrations) -> None:
        if not self.trained:  # a loaded agent keeps the normalization that its networks learned with
            self.policy.fit_normalization(demonstrations.observations)
        self._transitions = {
            "observations": demonstrations.observations,
            "next_observations": demonstrations.next_observations,
            "actions": scaled_actions(demonstrations, self.action_space),  # type: ignore[arg-type]
            "rewards": demonstrations.rewards[:, None],
            "terminals": demonstrations.terminations[:, None].astype(np.float32),
        }

    @property
    def server(self) -> ServerProcess:
        """The other process, started when it is not running.

        :raises ImportError: as :meth:`check_installed`
        """
        if self._process is None:
            process = ServerProcess([str(environment_python()), "-I", str(SERVER)])
            # without a seed every agent has another; one that goes on does not draw the same batches again
            seed = int(np.random.randint(2**31)) if self.seed is None else self.seed + self._n_updates
            self._random = np.random.default_rng(seed)
            sizes = self.policy.n_inputs, self.policy.n_outputs
            process.call("build", self.method, *sizes, self.batch_size, seed, self.method_kwargs, self.trained)
            self._process = process
        return self._process

    def _gradient_step(self) -> dict[str, float]:
        server = self.server
        rows = self._random.integers(len(self._transitions["actions"]), size=self.batch_size)
        batch = {name: part[rows] for name, part in self._transitions.items()}
        for name in ("observations", "next_observations"):
            batch[name] = self.policy.normalized(batch[name]).cpu().numpy()
        return server.call("train", batch)

    def save(self, path: Any, exclude: Any = None, include: Any = None) -> None:
        """As SB3's; the networks are fetched first."""
        self.trained = self.server.call("save")
        super().save(path, exclude, include)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_process", "_transitions", "_random"]


class BCQ(ServedAlgorithm):
    """Batch-constrained Q-learning (Fujimoto et al., arXiv 1812.02900) by d3rlpy, as it is there."""

    method = "BCQ"


class CQL(ServedAlgorithm):
    """Conservative Q-learning (Kumar et al., arXiv 2006.04779) by d3rlpy, as it is there."""

    method = "CQL"
