"""Playing whole episodes with a trained policy, and what a training writes as it goes: ``progress.csv``, where it is evaluated
every so often, and ``episodes.csv``, every episode of the training."""

import csv
import math
import pickle
import time
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path
from typing import Any, ClassVar, cast

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import PolicyPredictor
from torch import nn

from sb3_actpc.demonstrations.recording import ENDLESS
from sb3_actpc.experiments.runs.schema import Run
from sb3_actpc.utils.files import atomic_write
from sb3_actpc.utils.tasks import success_of

UNTRAINED_EPISODES = 5
EVALUATION_SEED_OFFSET = 1_000_000  # the episodes start from other states than the training's
PROGRESS, EPISODES = "progress.csv", "episodes.csv"
SUMMARY = ("dense_return", "dense_return_std", "return", "return_std", "success", "episode_length")  # of n episodes
OF_ACTOR = {"return": "actor_return", "dense_return": "actor_dense_return", "success": "actor_success"}  # columns


class NormalizedPredictor:
    """A policy that learned from the observations of SB3's ``VecNormalize``, for those of the bare environment: ``normalize``
    is a function of n of them, (n, obs_dim), or of a dictionary of such."""

    FILE = "vecnormalize.pkl"  # in a run's folder, as ``VecNormalize.save`` writes it

    def __init__(self, model: PolicyPredictor, normalize: Callable[[Any], Any]) -> None:
        self.model, self.normalize = model, normalize

    def predict(self, observation: Any, *further: Any, **options: Any) -> tuple[Any, Any]:
        """As SB3's, of the normalized observation."""
        return self.model.predict(self.normalize(observation), *further, **options)

    @classmethod
    def wrap(cls, model: BaseAlgorithm, policy: PolicyPredictor | None = None) -> PolicyPredictor:
        """The agent (or a policy of its), or with the present statistics of its environment where that normalizes."""
        wrapper = model.get_vec_normalize_env()
        acting = model if policy is None else policy
        return cls(acting, wrapper.normalize_obs) if wrapper is not None and wrapper.norm_obs else acting

    @classmethod
    def save(cls, model: BaseAlgorithm, folder: Path) -> None:
        """Write the statistics, where there are any, into the run's folder."""
        wrapper = model.get_vec_normalize_env()
        if wrapper is not None and wrapper.norm_obs:
            with atomic_write(folder / cls.FILE) as file:
                pickle.dump(wrapper, file)

    @classmethod
    def wrap_saved(cls, model: PolicyPredictor, folder: Path) -> PolicyPredictor:
        """The agent itself, or with the statistics that :meth:`save` wrote into the run's folder, which are unpickled."""
        if not (folder / cls.FILE).is_file():
            return model
        with open(folder / cls.FILE, "rb") as file:
            return cls(model, pickle.load(file).normalize_obs)


@dataclass(frozen=True)
class EpisodeStatistics:
    """What happened in n episodes; each array is (n,) float64."""

    dense_returns: np.ndarray  # sums of ``info["dense_reward"]`` (of the reward, where the environment does not report it)
    returns: np.ndarray  # sums of the reward
    successes: np.ndarray  # 1 or 0 as the last ``info`` reports it, NaN where no episode's does
    lengths: np.ndarray  # steps
    stages: list[str]  # ``info["stage"]`` at the end of each, "" where the environment does not report it

    def summary(self) -> dict[str, float | None]:
        """Means and standard deviations over the episodes; ``success`` is None where it is not reported."""
        dense = self.dense_returns
        own = self.returns
        values = (dense.mean(), dense.std(), own.mean(), own.std(), self.successes.mean(), self.lengths.mean())
        return {name: None if np.isnan(value) else float(value) for name, value in zip(SUMMARY, values, strict=True)}

    def failed_after(self) -> dict[str, int]:
        """Farthest stage of the episodes without success -> how many; empty where stages are not reported."""
        stages = (stage for stage, success in zip(self.stages, self.successes, strict=True) if not success)
        return dict(Counter(filter(None, stages)))


def says_one_return(summary: Mapping[str, Any]) -> bool:
    """Whether the dense returns of a summary equal the sparse ones: the environment reports none, or its reward is dense."""
    return all(summary[f"dense_{name}"] == summary[name] for name in ("return", "return_std"))


def are_equal(one: nn.Module, other: nn.Module) -> bool:
    """Whether two modules of equal structure have the same parameters and buffers."""
    theirs = other.state_dict()
    return all(th.equal(value, theirs[name]) for name, value in one.state_dict().items())


def play_episodes(model: PolicyPredictor, envs: Sequence[gym.Env[Any, Any]], n_episodes: int, seed: int) -> EpisodeStatistics:
    """Play whole episodes with the deterministic policy, carrying its recurrent state; their numbers are in the order of the
    seeds. Episode i starts from ``reset(seed=seed + i)``, so that two calls with one seed start from the same states. The
    environments, at least one, are stepped side by side, each playing at most one episode at a time, so that the policy is
    asked once for all of them and short episodes are not counted more often than long ones. ValueError for less than one
    episode or environment."""
    if n_episodes < 1 or not envs:
        raise ValueError(f"expected at least one episode and one environment, found {n_episodes} and {len(envs)}")
    dense_returns, returns, successes, lengths = np.zeros((4, n_episodes))
    played = EpisodeStatistics(dense_returns, returns, successes, lengths, [""] * n_episodes)
    for first in range(0, n_episodes, len(envs)):
        _play_side_by_side(model, envs[: n_episodes - first], seed, first, played)
    if not np.isnan(played.successes).all():  # an environment may report successes alone
        np.nan_to_num(played.successes, copy=False)
    return played


def _play_side_by_side(
    model: PolicyPredictor, envs: Sequence[gym.Env[Any, Any]], seed: int, first: int, played: EpisodeStatistics
) -> None:
    """Episodes ``first``, ``first + 1``, ..., one in each environment, noted in what has been ``played``."""
    observations = [env.reset(seed=seed + first + i)[0] for i, env in enumerate(envs)]
    playing, episode_start = np.ones((2, len(envs)), dtype=bool)
    state = None
    while playing.any():
        actions, state = model.predict(_stacked(observations), state=state, episode_start=episode_start, deterministic=True)
        episode_start = np.zeros(len(envs), dtype=bool)
        for i in np.flatnonzero(playing):
            observations[i], reward, terminated, truncated, info = envs[i].step(actions[i])
            played.dense_returns[first + i] += dense_reward(info, reward)
            played.returns[first + i] += float(reward)
            success = success_of(info)
            played.successes[first + i] = np.nan if success is None else success
            played.lengths[first + i] += 1
            played.stages[first + i] = info.get("stage", "")
            playing[i] = not (terminated or truncated)
            if playing[i] and played.lengths[first + i] == ENDLESS:
                warnings.warn(
                    f"an evaluation episode has gone on for {ENDLESS} steps: limit it with gymnasium.wrappers.TimeLimit, or "
                    "max_episode_steps= of gymnasium.register, if it never ends",
                    stacklevel=4,
                )


def _stacked(observations: Sequence[Any]) -> Any:
    """n observations as one batch: (n, ...), or a dictionary of such."""
    if isinstance(observations[0], dict):
        return {key: np.stack([observation[key] for observation in observations]) for key in observations[0]}
    return np.stack(observations)


def dense_reward(info: Mapping[str, Any], otherwise: Any) -> float:
    """What an environment reports beside its reward; ``otherwise`` where it reports nothing.

    :raises ValueError: for NaN and infinity, of which no mean could be made
    """
    reward = info.get("dense_reward", otherwise)
    if not math.isfinite(reward):
        name = "info['dense_reward']" if "dense_reward" in info else "reward"
        raise ValueError(f"environment: {name} is {float(reward)}: check the environment")
    return float(reward)


class CsvCallback(BaseCallback):
    """Writes rows into a CSV file; a checkpoint keeps those written so far, and the attributes ``kept``."""

    columns: ClassVar[tuple[str, ...]]
    kept: ClassVar[tuple[str, ...]]

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def begin_file(self) -> None:
        """Start the file; not called for a run that goes on from a checkpoint."""
        with atomic_write(self.path, "w") as file:
            csv.writer(file, lineterminator="\n").writerow(self.columns)

    def append(self, row: Mapping[str, Any]) -> None:
        """Write a row, by the names of the columns."""
        with open(self.path, "a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, self.columns, lineterminator="\n").writerow(row)

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {**{name: getattr(self, name) for name in self.kept}, "rows": self.path.read_text(encoding="utf-8")}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """Go on where the checkpoint was taken; rows written after it are dropped, they will be written again."""
        for name in self.kept:
            setattr(self, name, state[name])
        with atomic_write(self.path, "w") as file:
            file.write(state["rows"])


class EpisodeLog(CsvCallback):
    """Appends a row to ``episodes.csv`` when a training episode ends, exploration noise and all.

    ``return`` is the sum of the environment's rewards, ``dense_return`` that of ``info["dense_reward"]`` (the
    same again where the environment does not report it), ``success`` is ``info["is_success"]`` or ``info["success"]`` at the
    end (empty where neither is reported), ``timesteps`` and ``seconds`` are those of the training until then.
    ``actions_crc32`` is the CRC-32 of all actions of the training so far: two runs that have the same number have taken the
    same actions. ``clock`` gives the seconds that the training has taken so far.
    """

    columns = ("episode", "timesteps", "seconds", "length", "return", "dense_return", "success", "actions_crc32")
    kept = ("n_episodes", "dense_returns", "actions")

    def __init__(self, folder: Path, clock: Callable[[], float]) -> None:
        super().__init__(folder / EPISODES)
        self.clock = clock
        self.n_episodes = self.actions = 0
        self.dense_returns: list[float] = []  # of the running episode of each environment

    def _on_training_start(self) -> None:
        self.dense_returns = [0.0] * self.training_env.num_envs

    def cut_running_episodes(self) -> None:
        """The episodes begun will not be finished: a resumed run starts them again."""
        self.dense_returns = [0.0] * len(self.dense_returns)

    def _on_step(self) -> bool:
        self.actions = zlib.crc32(np.ascontiguousarray(self.locals["actions"]).tobytes(), self.actions)
        for index, info in enumerate(self.locals["infos"]):
            self.dense_returns[index] += dense_reward(info, 0.0)
            if self.locals["dones"][index]:
                self._end(info, self.dense_returns[index] if "dense_reward" in info else info["episode"]["r"])
                self.dense_returns[index] = 0.0
        return True

    def _end(self, info: dict[str, Any], dense_return: float) -> None:
        self.n_episodes += 1
        row = {
            "episode": self.n_episodes,
            "timesteps": self.num_timesteps,
            "seconds": round(self.clock(), 2),
            "length": info["episode"]["l"],  # of SB3's Monitor, as the next: before any normalisation
            "return": round(info["episode"]["r"], 6),
            "dense_return": round(dense_return, 6),
            "success": success_of(info),
            "actions_crc32": self.actions,
        }
        self.append(row)


class EvaluationCallback(CsvCallback):
    """Evaluates before the first step (offline methods excepted), then every ``eval_freq`` steps, and at the end.

    Each evaluation starts its episodes from the same seeds, appends a row to ``progress.csv`` and saves ``model.zip`` (with
    ``keep="best"`` only where no dense return before was higher). ``seconds`` are those since :meth:`begin`, the evaluations'
    own (``evaluation_seconds``) among them; ``updates`` are the agent's. Where the deployed policy is not the one that learns
    (ActPC with its gate), the columns ``OF_ACTOR`` are of its moving average.

    :param envs: environments that only this callback uses, closed by their owner
    :param run: says when, how long and in which folder
    :param report: given one line of text after each evaluation
    """

    columns = ("timesteps", "updates", "seconds", "evaluation_seconds", *SUMMARY, *OF_ACTOR.values())
    kept = ("evaluation_seconds", "best_return", "last_timesteps", "wall_seconds")

    def __init__(self, envs: Sequence[gym.Env[Any, Any]], run: Run, report: Callable[[str], None]) -> None:
        super().__init__(run.folder / PROGRESS)
        self.envs, self.run, self.report = envs, run, report
        self.best_return = -np.inf
        self.evaluation_seconds = 0.0
        self.last_timesteps = -1
        self._started = time.perf_counter()

    def begin(self, model: BaseAlgorithm) -> None:
        """A new run. An untrained agent is evaluated at once. It fails for as long as an episode may last, which takes minutes
        in robosuite's tasks, so that it plays ``UNTRAINED_EPISODES`` at most. One that warms up is evaluated when it has, an
        offline method's only when it has learned."""
        self.model = model
        self._started = time.perf_counter()
        self.begin_file()
        if getattr(model, "is_offline", False):
            self.last_timesteps = 0
        elif not getattr(model, "imitates_first", False):
            self._evaluate(min(self.run.eval_episodes, UNTRAINED_EPISODES))

    @property
    def wall_seconds(self) -> float:
        """Seconds since :meth:`begin`, the time while the run was stopped left out."""
        return time.perf_counter() - self._started

    @wall_seconds.setter
    def wall_seconds(self, seconds: float) -> None:
        self._started = time.perf_counter() - seconds

    def _on_rollout_start(self) -> None:
        """Step 0 is what an agent can do before its first one, after its warm start."""
        if self.last_timesteps < 0 and not self.num_timesteps:  # a resumed run has its rows by now
            self._evaluate(self.run.eval_episodes)

    def _on_step(self) -> bool:
        # at the last step, the update that belongs to it is still to come
        is_last = self.num_timesteps >= self.model._total_timesteps
        every = self.run.eval_freq or 1
        if not is_last and self.num_timesteps // every > max(self.last_timesteps, 0) // every:
            self._evaluate(self.run.eval_episodes)
        return self.run.target_return is None or self.best_return < self.run.target_return

    def _on_training_end(self) -> None:
        if self.last_timesteps != self.num_timesteps:
            self._evaluate(self.run.eval_episodes)

    def _evaluate(self, n_episodes: int) -> None:
        started = time.perf_counter()
        seed = self.run.seed + EVALUATION_SEED_OFFSET
        summary = play_episodes(NormalizedPredictor.wrap(self.model), self.envs, n_episodes, seed).summary()
        of_actor = self._evaluate_actor(summary, n_episodes, seed)
        dense_return = summary["dense_return"] or 0.0
        if self.run.keep == "last" or dense_return >= self.best_return:
            NormalizedPredictor.save(self.model, self.run.folder)
            with atomic_write(self.run.folder / "model.zip") as file:
                self.model.save(cast(BufferedIOBase, file))
        self.best_return = max(self.best_return, dense_return)
        self.evaluation_seconds += time.perf_counter() - started
        self.last_timesteps = self.num_timesteps
        row: dict[str, Any] = {
            **summary,
            **of_actor,
            "timesteps": self.num_timesteps,
            "updates": getattr(self.model, "_n_updates", 0),
            "seconds": round(self.wall_seconds, 2),
            "evaluation_seconds": round(self.evaluation_seconds, 2),
        }
        self.append(row)
        for name in ("dense_return", "return", "success"):
            if summary[name] is not None:
                self.logger.record(f"eval/{name}", summary[name])
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)  # a row of the agent's own figures beside each evaluation
        shown = f"return {summary['dense_return']:9.1f} ± {summary['dense_return_std']:<7.1f}"
        if not says_one_return(summary):
            shown = f"dense {shown} sparse return {summary['return']:7.1f} "
        success = "" if summary["success"] is None else f" success {summary['success']:.2f}"
        self.report(f"step {self.num_timesteps:>8}  {shown}{success}")

    def _evaluate_actor(self, summary: Mapping[str, float | None], n_episodes: int, seed: int) -> dict[str, float | None]:
        """The columns ``OF_ACTOR``; none without a deployment gate. ``summary`` is of the deployed policy, whose episodes are
        not played twice where the actor is that policy, as after BC."""
        agent: Any = self.model
        if getattr(getattr(agent, "actor", None), "deployed", None) is None:
            return {}
        learning = agent.actor_policy
        if not are_equal(learning.acting, agent.actor.acting):
            summary = play_episodes(NormalizedPredictor.wrap(agent, learning), self.envs, n_episodes, seed).summary()
        return {column: summary[name] for name, column in OF_ACTOR.items()}
