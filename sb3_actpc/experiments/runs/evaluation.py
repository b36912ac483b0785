"""Playing whole episodes with a trained policy, and doing so every so often while it is trained."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path
from typing import Any, Protocol, cast

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_actpc.experiments.runs.episode_log import CsvCallback, dense_reward
from sb3_actpc.utils.files import atomic_write

UNTRAINED_EPISODES = 5
PROGRESS = "progress.csv"
OF_ACTOR = {"return": "actor_return", "dense_return": "actor_dense_return", "success": "actor_success"}  # columns


class Predictor(Protocol):
    """Anything that acts like an SB3 algorithm or policy."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Any, Any]:
        """Actions, (n, action_dim), and the next recurrent state, for n observations."""


class NormalizedPredictor:
    """A policy that learned from the observations of SB3's ``VecNormalize``, for those of the bare environment: ``normalize``
    is a function of n of them, (n, obs_dim), or of a dictionary of such."""

    FILE = "normalization.npz"  # in a run's folder

    def __init__(self, model: Predictor, normalize: Callable[[Any], Any]) -> None:
        self.model, self.normalize = model, normalize

    def predict(self, observation: Any, *further: Any, **options: Any) -> tuple[Any, Any]:
        """See :class:`Predictor`."""
        return self.model.predict(self.normalize(observation), *further, **options)

    @classmethod
    def wrap(cls, model: BaseAlgorithm, policy: Predictor | None = None) -> Predictor:
        """The agent (or a policy of its), or with the present statistics of its environment where that normalizes."""
        wrapper = model.get_vec_normalize_env()
        acting = model if policy is None else policy
        return cls(acting, wrapper.normalize_obs) if wrapper is not None and wrapper.norm_obs else acting

    @classmethod
    def save(cls, model: BaseAlgorithm, folder: Path) -> None:
        """Write the statistics, where there are any, into the run's folder."""
        wrapper = model.get_vec_normalize_env()
        if wrapper is None or not wrapper.norm_obs:
            return
        found: Any = wrapper.obs_rms
        arrays = {"limit": np.array(wrapper.clip_obs)}
        for key, statistics in (found if isinstance(found, dict) else {"": found}).items():
            arrays |= {f"mean{key}": statistics.mean, f"spread{key}": np.sqrt(statistics.var + wrapper.epsilon)}
        with atomic_write(folder / cls.FILE) as file:
            np.savez(file, **arrays)

    @classmethod
    def wrap_saved(cls, model: Predictor, folder: Path) -> Predictor:
        """The agent itself, or with the statistics that :meth:`save` wrote into the run's folder."""
        if not (folder / cls.FILE).is_file():
            return model
        with np.load(folder / cls.FILE, allow_pickle=False) as file:
            stored = dict(file)

        def normalize(rows: Any, key: str = "") -> Any:
            if isinstance(rows, dict):
                return {name: normalize(part, name) for name, part in rows.items()}
            if f"mean{key}" not in stored:  # VecNormalize was given some of the parts alone
                return rows
            limit = stored["limit"]
            return np.clip((rows - stored[f"mean{key}"]) / stored[f"spread{key}"], -limit, limit).astype(np.float32)

        return cls(model, normalize)


@dataclass(frozen=True)
class EpisodeStatistics:
    """What happened in n episodes; each array is (n,) float64."""

    dense_returns: np.ndarray  # sums of ``info["dense_reward"]`` (of the reward, where the environment does not report it)
    returns: np.ndarray  # sums of the reward
    successes: np.ndarray  # 1 where ``info["is_success"]`` was true at the end, NaN where the environment does not report it
    lengths: np.ndarray  # steps
    stages: list[str]  # ``info["stage"]`` at the end of each, "" where the environment does not report it

    def summary(self) -> dict[str, float | None]:
        """Means and standard deviations over the episodes; ``success`` is None where it is not reported."""
        success = float(self.successes.mean())
        return {
            "dense_return": float(self.dense_returns.mean()),
            "dense_return_std": float(self.dense_returns.std()),
            "return": float(self.returns.mean()),
            "return_std": float(self.returns.std()),
            "success": None if np.isnan(success) else success,
            "episode_length": float(self.lengths.mean()),
        }

    def failed_after(self) -> dict[str, int]:
        """Farthest stage of the episodes without success -> how many; empty where stages are not reported."""
        stages = (stage for stage, success in zip(self.stages, self.successes, strict=True) if not success)
        return dict(Counter(filter(None, stages)))


def says_one_return(summary: Mapping[str, Any]) -> bool:
    """Whether the dense returns of a summary equal the sparse ones: the environment reports none, or its reward is dense."""
    return all(summary[f"dense_{name}"] == summary[name] for name in ("return", "return_std"))


def play_episodes(model: Predictor, envs: Sequence[gym.Env[Any, Any]], n_episodes: int, seed: int) -> EpisodeStatistics:
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
    return played


def _play_side_by_side(
    model: Predictor, envs: Sequence[gym.Env[Any, Any]], seed: int, first: int, played: EpisodeStatistics
) -> None:
    """Episodes ``first``, ``first + 1``, ..., one in each environment, noted in what has been ``played``."""
    observations = [env.reset(seed=seed + first + i)[0] for i, env in enumerate(envs)]
    playing, episode_start = np.ones((2, len(envs)), dtype=bool)
    state = None
    while playing.any():
        actions, state = model.predict(stacked(observations), state=state, episode_start=episode_start, deterministic=True)
        episode_start = np.zeros(len(envs), dtype=bool)
        for i in np.flatnonzero(playing):
            observations[i], reward, terminated, truncated, info = envs[i].step(actions[i])
            played.dense_returns[first + i] += dense_reward(info, reward)
            played.returns[first + i] += float(reward)
            played.successes[first + i] = info.get("is_success", np.nan)
            played.lengths[first + i] += 1
            played.stages[first + i] = info.get("stage", "")
            playing[i] = not (terminated or truncated)


def stacked(observations: Sequence[Any]) -> Any:
    """n observations as one batch: (n, ...), or a dictionary of such."""
    if isinstance(observations[0], dict):
        return {key: np.stack([observation[key] for observation in observations]) for key in observations[0]}
    return np.stack(observations)


class EvaluationCallback(CsvCallback):
    """Evaluates before the first step (offline methods excepted), then every ``eval_freq`` steps, and at the end.

    Each evaluation starts its episodes from the same seeds, appends a row to ``progress.csv`` and saves
    ``model.zip`` (written under another name and renamed, so that a stopped run leaves a whole one), where the agent of the
    best evaluation is to be kept only when no dense return before was higher. ``seconds`` are those
    since :meth:`begin`, the evaluations' own (``evaluation_seconds``) among them; ``updates`` are the agent's. Where the
    deployed policy is not the one that learns (ActPC with its gate), the columns ``OF_ACTOR`` are of its moving average.

    :param envs: environments that only this callback uses, closed by their owner
    :param eval_freq: environment steps between two evaluations, of ``eval_episodes`` each; their first episode is of ``seed``
    :param report: given one line of text after each evaluation
    :param keeps_best: keep the agent of the best evaluation, not that of the last
    :param target_return: end the training at the first evaluation whose mean dense return reaches it; None for never
    """

    columns = (
        "timesteps",
        "updates",
        "seconds",
        "evaluation_seconds",
        "dense_return",
        "dense_return_std",
        "return",
        "return_std",
        "success",
        "episode_length",
        *OF_ACTOR.values(),
    )
    kept = ("evaluation_seconds", "best_return", "last_summary", "last_timesteps")

    def __init__(
        self,
        envs: Sequence[gym.Env[Any, Any]],
        folder: Path,
        eval_freq: int,
        eval_episodes: int,
        seed: int,
        report: Callable[[str], None],
        keeps_best: bool = False,
        target_return: float | None = None,
    ) -> None:
        super().__init__(folder / PROGRESS)
        self.envs, self.folder, self.seed, self.report = envs, folder, seed, report
        self.eval_freq, self.eval_episodes, self.keeps_best = eval_freq, eval_episodes, keeps_best
        self.target_return = target_return
        self.best_return = -np.inf
        self.evaluation_seconds = 0.0
        self.last_summary: dict[str, float | None] = {}
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
            self._evaluate(min(self.eval_episodes, UNTRAINED_EPISODES))

    @property
    def wall_seconds(self) -> float:
        """Seconds since :meth:`begin`, the time while the run was stopped left out."""
        return time.perf_counter() - self._started

    def checkpoint_state(self) -> dict[str, Any]:
        """What a checkpoint keeps: timers, the last evaluation and the rows written so far."""
        return {**super().checkpoint_state(), "wall_seconds": self.wall_seconds}

    def restore_checkpoint_state(self, state: dict[str, Any]) -> None:
        """Go on where the checkpoint was taken, with its timers."""
        super().restore_checkpoint_state(state)
        self._started = time.perf_counter() - state["wall_seconds"]

    def _on_rollout_start(self) -> None:
        """Step 0 is what an agent can do before its first one, after its warm start."""
        if self.last_timesteps < 0 and not self.num_timesteps:  # a resumed run has its rows by now
            self._evaluate()

    def _on_step(self) -> bool:
        # at the last step, the update that belongs to it is still to come
        is_last = self.num_timesteps >= self.model._total_timesteps
        if not is_last and self.num_timesteps - self.last_timesteps >= self.eval_freq:
            self._evaluate()
        return self.target_return is None or self.best_return < self.target_return

    def _on_training_end(self) -> None:
        if self.last_timesteps != self.num_timesteps:
            self._evaluate()

    def _evaluate(self, n_episodes: int | None = None) -> None:
        started = time.perf_counter()
        n_episodes = self.eval_episodes if n_episodes is None else n_episodes
        statistics = play_episodes(NormalizedPredictor.wrap(self.model), self.envs, n_episodes, self.seed)
        self.last_summary = statistics.summary()
        of_actor = self._evaluate_actor(n_episodes)
        dense_return = float(statistics.dense_returns.mean())
        if not self.keeps_best or dense_return >= self.best_return:
            NormalizedPredictor.save(self.model, self.folder)
            with atomic_write(self.folder / "model.zip") as file:
                self.model.save(cast(BufferedIOBase, file))
        self.best_return = max(self.best_return, dense_return)
        now = time.perf_counter()
        self.evaluation_seconds += now - started
        self.last_timesteps = self.num_timesteps
        row: dict[str, Any] = {
            **self.last_summary,
            **of_actor,
            "timesteps": self.num_timesteps,
            "updates": getattr(self.model, "_n_updates", 0),
            "seconds": round(self.wall_seconds, 2),
            "evaluation_seconds": round(self.evaluation_seconds, 2),
        }
        self.append(row)
        for name in ("dense_return", "return", "success"):
            if self.last_summary[name] is not None:
                self.logger.record(f"eval/{name}", self.last_summary[name])
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)  # a row of the agent's own figures beside each evaluation
        summary, success = self.last_summary, self.last_summary["success"]
        shown = [f"return {summary['dense_return']:9.1f} ± {summary['dense_return_std']:<7.1f}"]
        if not says_one_return(summary):
            shown = [f"dense {shown[0]}", f"sparse return {summary['return']:7.1f} "]
        shown += [] if success is None else [f"success {success:.2f}"]
        self.report(f"step {self.num_timesteps:>8}  {' '.join(shown)}")

    def _evaluate_actor(self, n_episodes: int) -> dict[str, float | None]:
        """The columns ``OF_ACTOR``; none without a deployment gate."""
        agent: Any = self.model
        if getattr(getattr(agent, "actor", None), "deployed", None) is None:
            return {}
        learning = NormalizedPredictor.wrap(agent, agent.actor_policy)
        summary = play_episodes(learning, self.envs, n_episodes, self.seed).summary()
        return {column: summary[name] for name, column in OF_ACTOR.items()}
