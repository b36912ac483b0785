"""Dense-reward experts and the demonstrations they give for the sparse tasks.

An expert is a Stable-Baselines3 agent trained on the *dense* base task of a sparse one (as the demonstrators of
Ororbia & Mali, arXiv 2209.09174, were: PPO for 2000 episodes). Its deterministic policy is then rolled out in the sparse
task, and the successful episodes become a :class:`~sb3_actpc.demonstrations.dataset.Demonstrations`.

Training writes whole checkpoints, each one complete or absent, so a stopped run goes on from the newest one.
"""

import json
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import yaml
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import nn

from sb3_actpc.demonstrations.dataset import Demonstrations
from sb3_actpc.demonstrations.recording import Report, silent
from sb3_actpc.envs import dense_env_id

EXPERT_ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"ppo": PPO, "td3": TD3, "sac": SAC}
DEFAULT_EXPERT_EPISODES = 2000  # of the paper's demonstrators
N_EVALUATION_EPISODES = 10  # enough to notice a policy that falls over now and then
_ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}
_CHECKPOINT_PREFIX = "step_"


@dataclass(frozen=True)
class ExpertTraining:
    """What makes one expert; two runs with the same fields may share a work directory.

    :param env_id: a sparse task's id, for example ``"SparseHalfCheetah-v5"``; the expert learns its dense base task
    :param algorithm: one of ``EXPERT_ALGORITHMS``
    :param seed: seed of the agent and of its environments
    :param n_envs: parallel copies of the task (the transitions per update stay the same)
    """

    env_id: str
    algorithm: str = "ppo"
    seed: int = 0
    n_envs: int = 1

    def __post_init__(self) -> None:
        if self.algorithm not in EXPERT_ALGORITHMS:
            raise ValueError(f"algorithm={self.algorithm!r} is not one of {sorted(EXPERT_ALGORITHMS)}: choose one of these")
        if self.n_envs < 1:
            raise ValueError(f"n_envs={self.n_envs} must be at least 1: give the number of parallel environments")
        dense_env_id(self.env_id)

    @property
    def dense_id(self) -> str:
        """Id of the dense base task, for example ``"HalfCheetah-v5"``."""
        return dense_env_id(self.env_id)


@dataclass(frozen=True)
class Expert:
    """A trained agent with the observation statistics it was trained with.

    :param model: the Stable-Baselines3 agent
    :param normalization: its ``VecNormalize`` wrapper (its statistics are frozen), or None
    :param n_steps: environment steps it was trained for
    :param mean_return: mean dense return of its deterministic policy when it was saved
    """

    model: BaseAlgorithm
    normalization: VecNormalize | None
    n_steps: int
    mean_return: float

    def start(self, seed: int) -> None:
        """A new episode begins; a deterministic policy has nothing to prepare."""

    def predict(self, observation: np.ndarray) -> np.ndarray:
        """Deterministic action in the environment's units.

        :param observation: (obs_dim,) raw observation
        :return: (action_dim,) action within the action space
        """
        if self.normalization is not None:
            normalized = self.normalization.normalize_obs(observation)
            assert isinstance(normalized, np.ndarray)
            observation = normalized
        return self.model.predict(observation, deterministic=True)[0]


def hyperparams_path(name: str) -> Path:
    """Path of one of the package's YAML files, installed or in a source checkout.

    :param name: file name, for example ``"experts.yml"``
    :raises FileNotFoundError: if neither place has it
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "hyperparams", package.parent / "hyperparams"):
        if (folder / name).is_file():
            return folder / name
    raise FileNotFoundError(f"hyperparams file {name!r} is not in the package: reinstall sb3-actpc")


def expert_hyperparams(algorithm: str, dense_id: str) -> dict[str, Any]:
    """Settings of one expert, from ``hyperparams/experts.yml`` (source: rl-zoo3's tuned files).

    :param algorithm: one of ``EXPERT_ALGORITHMS``
    :param dense_id: id of the dense task; its version is ignored
    :return: keywords as in the file
    """
    with open(hyperparams_path("experts.yml"), encoding="utf-8") as file:
        by_task = yaml.safe_load(file)[algorithm]
    return dict(by_task.get(dense_id.split("-v")[0], by_task["default"]))


def _algorithm_kwargs(training: ExpertTraining, n_steps: int, n_actions: int) -> dict[str, Any]:
    """Keywords of the Stable-Baselines3 class, without the environment and ``normalize``."""
    kwargs = expert_hyperparams(training.algorithm, training.dense_id)
    kwargs.pop("normalize", None)
    if "policy_kwargs" in kwargs:
        policy_kwargs = dict(kwargs["policy_kwargs"])
        if "activation_fn" in policy_kwargs:
            policy_kwargs["activation_fn"] = _ACTIVATIONS[policy_kwargs["activation_fn"]]
        kwargs["policy_kwargs"] = policy_kwargs
    if training.algorithm == "ppo":
        kwargs["n_steps"] = max(2, kwargs.get("n_steps", 2048) // training.n_envs)
        return kwargs
    noise_std = kwargs.pop("action_noise_std", 0.0)
    if noise_std > 0.0:
        kwargs["action_noise"] = NormalActionNoise(np.zeros(n_actions), np.full(n_actions, noise_std))
    if training.n_envs > 1:
        kwargs["gradient_steps"] = -1  # as many as transitions collected
    kwargs["buffer_size"] = max(training.n_envs, min(1_000_000, n_steps))
    return kwargs


def default_expert_steps(env_id: str) -> int:
    """Steps of 2000 full episodes of a task, the training of the paper's demonstrators."""
    spec = gym.spec(dense_env_id(env_id))
    assert spec.max_episode_steps is not None
    return DEFAULT_EXPERT_EPISODES * spec.max_episode_steps


def evaluate_expert(expert: Expert, dense_id: str, n_episodes: int = N_EVALUATION_EPISODES, seed: int = 0) -> float:
    """Mean return of an expert's deterministic policy on a dense task.

    :param expert: the expert
    :param dense_id: id of the dense task
    :param n_episodes: episodes played, with the seeds ``seed`` to ``seed + n_episodes - 1``
    :param seed: seed of the first episode
    """
    env = gym.make(dense_id)
    returns = np.zeros(n_episodes)
    for episode in range(n_episodes):
        observation, _ = env.reset(seed=seed + episode)
        done = False
        while not done:
            observation, reward, terminated, truncated, _ = env.step(expert.predict(observation))
            returns[episode] += float(reward)
            done = terminated or truncated
    env.close()
    return float(returns.mean())


def _save_checkpoint(folder: Path, expert: Expert, training: ExpertTraining) -> None:
    """Write one checkpoint as a folder that appears complete or not at all."""
    temporary = folder.with_name(folder.name + ".tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    expert.model.save(temporary / "model.zip")
    if isinstance(expert.model, OffPolicyAlgorithm):
        expert.model.save_replay_buffer(temporary / "replay_buffer.pkl")
    if expert.normalization is not None:
        expert.normalization.save(str(temporary / "normalization.pkl"))
    state = {"training": asdict(training), "n_steps": expert.n_steps, "mean_return": expert.mean_return}
    (temporary / "state.json").write_text(json.dumps(state, indent=2), encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    temporary.rename(folder)


def _checkpoint_states(work_dir: Path) -> dict[Path, dict[str, Any]]:
    """All complete checkpoints of a work directory, oldest first, with their ``state.json``."""
    folders = sorted(folder for folder in work_dir.glob(f"{_CHECKPOINT_PREFIX}*") if folder.suffix != ".tmp")
    return {folder: json.loads((folder / "state.json").read_text(encoding="utf-8")) for folder in folders}


def _prune_checkpoints(work_dir: Path) -> None:
    """Keep the newest checkpoint, to go on from, and the best one, to demonstrate with (without its replay buffer)."""
    states = _checkpoint_states(work_dir)
    newest = max(states)
    best = max(states, key=lambda folder: states[folder]["mean_return"])
    for folder in set(states) - {newest, best}:
        shutil.rmtree(folder)
    if best != newest:
        (best / "replay_buffer.pkl").unlink(missing_ok=True)


def _check_work_dir(work_dir: Path, training: ExpertTraining) -> None:
    """Refuse a work directory that holds another expert.

    :raises ValueError: naming both
    """
    wanted = asdict(training)
    for state in _checkpoint_states(work_dir).values():
        if state["training"] != wanted:
            raise ValueError(f"{work_dir} holds the expert {state['training']}, not {wanted}: give another work directory")


def _load_checkpoint(folder: Path, training: ExpertTraining, env: VecEnv) -> Expert:
    """Load a checkpoint onto ``env`` (a plain ``VecEnv``; the statistics are wrapped around it)."""
    state = json.loads((folder / "state.json").read_text(encoding="utf-8"))
    normalization = None
    if (folder / "normalization.pkl").is_file():
        normalization = env = VecNormalize.load(str(folder / "normalization.pkl"), env)
    model = EXPERT_ALGORITHMS[training.algorithm].load(folder / "model.zip", env=env, device="cpu")
    return Expert(model, normalization, state["n_steps"], state["mean_return"])


def _new_expert(training: ExpertTraining, n_steps: int, env: VecEnv) -> Expert:
    """An untrained expert on ``env``."""
    hyperparams = expert_hyperparams(training.algorithm, training.dense_id)
    normalization = None
    if hyperparams.get("normalize", False):
        normalization = env = VecNormalize(env, gamma=hyperparams.get("gamma", 0.99))
    kwargs = _algorithm_kwargs(training, n_steps, env.action_space.shape[0])  # type: ignore[index]
    model = EXPERT_ALGORITHMS[training.algorithm](env=env, seed=training.seed, device="cpu", **kwargs)
    return Expert(model, normalization, 0, -float("inf"))


class _CheckpointCallback(BaseCallback):
    """Evaluate, report and save between two updates; stop at ``target_return``."""

    def __init__(
        self, expert: Expert, training: ExpertTraining, work_dir: Path, every: int, target_return: float | None, report: Report
    ) -> None:
        super().__init__()
        self.expert = expert
        self.training_settings = training
        self.work_dir = work_dir
        self.every = every
        self.target_return = float("inf") if target_return is None else target_return
        self.report = report
        self.next_save = expert.n_steps + every
        self.reached = False

    def checkpoint(self) -> None:
        """Evaluate the present policy and save it."""
        n_steps = self.model.num_timesteps
        current = replace(self.expert, n_steps=n_steps)
        mean_return = evaluate_expert(current, self.training_settings.dense_id, seed=10_000 + self.training_settings.seed)
        self.reached = mean_return >= self.target_return
        folder = self.work_dir / f"{_CHECKPOINT_PREFIX}{n_steps:09d}"
        _save_checkpoint(folder, replace(current, mean_return=mean_return), self.training_settings)
        _prune_checkpoints(self.work_dir)
        self.report(
            f"{n_steps} steps: mean dense return {mean_return:.1f} of {N_EVALUATION_EPISODES} deterministic episodes; "
            f"saved {folder}"
        )

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps >= self.next_save:
            self.next_save = self.model.num_timesteps + self.every
            self.checkpoint()

    def _on_step(self) -> bool:
        return not self.reached


def train_expert(
    training: ExpertTraining,
    n_steps: int,
    work_dir: str | Path,
    save_every: int = 50_000,
    target_return: float | None = None,
    report: Report = silent,
) -> Expert:
    """Train an expert on the dense task, or go on from the newest checkpoint in ``work_dir``.

    A continued run draws new random numbers and starts a new episode: it is not the same, number by number, as one that
    was never stopped.

    :param training: task, algorithm, seed
    :param n_steps: environment steps in all, those of earlier runs included
    :param work_dir: folder of the checkpoints; the newest and the best one are kept
    :param save_every: steps between two checkpoints, each with an evaluation of 10 deterministic episodes
    :param target_return: stop at the first checkpoint whose mean dense return reaches it, None for never
    :param report: takes one line of progress per checkpoint
    :return: the checkpoint with the highest mean dense return
    :raises ValueError: if ``work_dir`` holds another expert, or ``n_steps`` or ``save_every`` is below 1
    """
    for name, value in (("n_steps", n_steps), ("save_every", save_every)):
        if value < 1:
            raise ValueError(f"{name}={value} must be at least 1: give a number of environment steps")
    work_dir = Path(work_dir)
    work_dir.mkdir(parents=True, exist_ok=True)
    _check_work_dir(work_dir, training)
    states = _checkpoint_states(work_dir)
    reached = target_return is not None and any(state["mean_return"] >= target_return for state in states.values())
    if not reached and max((state["n_steps"] for state in states.values()), default=0) < n_steps:
        _continue_training(training, n_steps, work_dir, save_every, target_return, report)
    return load_expert(training, work_dir)


def _continue_training(
    training: ExpertTraining, n_steps: int, work_dir: Path, save_every: int, target_return: float | None, report: Report
) -> None:
    """Train from the newest checkpoint, or from nothing, and save a last checkpoint."""
    states = _checkpoint_states(work_dir)
    start = max(states) if states else None
    n_done = states[start]["n_steps"] if start is not None else 0
    env = make_vec_env(training.dense_id, n_envs=training.n_envs, seed=training.seed + n_done)
    if start is None:
        expert = _new_expert(training, n_steps, env)
    else:
        expert = _load_checkpoint(start, training, env)
        if isinstance(expert.model, OffPolicyAlgorithm):
            expert.model.load_replay_buffer(start / "replay_buffer.pkl")
        set_random_seed(training.seed + n_done)
        report(f"going on from {start}")
    callback = _CheckpointCallback(expert, training, work_dir, save_every, target_return, report)
    expert.model.learn(n_steps - n_done, callback=callback, reset_num_timesteps=start is None)
    if not callback.reached:
        callback.checkpoint()
    env.close()


def load_expert(training: ExpertTraining, work_dir: str | Path) -> Expert:
    """Load the checkpoint with the highest mean dense return.

    :param training: as given to :func:`train_expert`
    :param work_dir: folder of the checkpoints
    :raises FileNotFoundError: if there is no checkpoint
    :raises ValueError: if the folder holds another expert
    """
    work_dir = Path(work_dir)
    states = _checkpoint_states(work_dir)
    if not states:
        raise FileNotFoundError(f"no expert checkpoint in {work_dir}: train one with `sb3-actpc demos collect`")
    _check_work_dir(work_dir, training)
    best = max(states, key=lambda folder: states[folder]["mean_return"])
    expert = _load_checkpoint(best, training, make_vec_env(training.dense_id, n_envs=1))
    if expert.normalization is not None:
        expert.normalization.training = False
    return expert


def collect_demonstrations(
    expert: Expert,
    env_id: str,
    n_episodes: int = 20,
    seed: int = 0,
    max_tries: int | None = None,
    metadata: dict[str, Any] | None = None,
    report: Report = silent,
) -> Demonstrations:
    """Roll out an expert's deterministic policy in the sparse task and keep the successful episodes.

    :param expert: the expert
    :param env_id: id of the sparse task
    :param n_episodes: successful episodes wanted
    :param seed: try number i is reset with the seed ``seed + i``
    :param max_tries: episodes played at most, None for ``10 * n_episodes``
    :param metadata: JSON values to keep with the demonstrations
    :param report: takes one line of progress per kept episode
    :return: observations and next observations (N, obs_dim), actions (N, action_dim) in environment units, sparse and
        dense rewards (N,), all float32
    :raises ValueError: if fewer than ``n_episodes`` of ``max_tries`` episodes succeed, or ``n_episodes`` is below 1
    """
    kept = {"expert_steps": expert.n_steps, "expert_mean_dense_return": expert.mean_return, **(metadata or {})}
    return Demonstrations.record(expert.predict, env_id, n_episodes, True, True, seed, max_tries, kept, report)
