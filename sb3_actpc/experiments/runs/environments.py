"""The environments of a run: one way to make them, whatever the algorithm."""

import contextlib
import importlib
import io
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.preprocessing import check_for_nested_spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_actpc.experiments.runs.algorithms import find_in_working_folder
from sb3_actpc.utils.checks import named_in_errors, nearest

MAX_EVALUATION_ENVS = 10


def make_env(env_id: str, env_kwargs: Mapping[str, Any], render_mode: str | None = None) -> gym.Env[Any, Any]:
    """Make an environment, this package's tasks included; ValueError when it does not take the keywords, or SB3 not its
    observations."""
    register_tasks(env_id)
    options = dict(env_kwargs) if render_mode is None else {**env_kwargs, "render_mode": render_mode}
    try:
        env = gym.make(env_id, **options)
    except TypeError as error:
        raise ValueError(f"{env_id}: {error}") from error
    try:
        check_for_nested_spaces(env.observation_space)
    except NotImplementedError as error:
        env.close()
        raise ValueError(f"{env_id}: {error} Register it with gymnasium.wrappers.FlattenObservation around it") from error
    return env


def make_eval_envs(env_id: str, env_kwargs: Mapping[str, Any], n_episodes: int) -> list[gym.Env[Any, Any]]:
    """As many environments as episodes are played side by side, at most ``MAX_EVALUATION_ENVS``."""
    return [make_env(env_id, env_kwargs) for _ in range(min(n_episodes, MAX_EVALUATION_ENVS))]


def make_train_env(
    env_id: str, env_kwargs: Mapping[str, Any], n_envs: int, seed: int, normalize: Mapping[str, Any] | None = None
) -> VecEnv:
    """The environment that an agent learns in: SB3's ``Monitor`` and ``DummyVecEnv``, and where asked for ``VecNormalize``.
    The seed is the first's; the others have those that follow."""
    arguments = {"env_id": env_id, "env_kwargs": env_kwargs}
    env = make_vec_env(make_env, n_envs=n_envs, seed=seed, env_kwargs=arguments)
    with named_in_errors(f"normalize={normalize}"):
        return env if normalize is None else VecNormalize(env, **normalize)


def register_tasks(env_id: str) -> None:
    """Register the tasks of gymnasium-robotics with Gymnasium where they are meant; this package's are."""
    if ":" not in env_id and env_id not in gym.registry:
        # not installed: Gymnasium will say that the id is unknown; installed: it prints a note on tasks of another kind
        with contextlib.suppress(ImportError), contextlib.redirect_stderr(io.StringIO()):
            importlib.import_module("gymnasium_robotics")


def check_env_id(env_id: str, gym_packages: Sequence[str] = ()) -> None:
    """Check that an environment is registered; ids with a module (``module:Name-v0``) are left to ``gymnasium.make``.
    Modules that register environments are imported first, also from the working folder. gymnasium.error.Error where the id is
    unknown, ModuleNotFoundError where a module is missing."""
    find_in_working_folder()
    for module in [*gym_packages, *env_id.split(":")[:-1]]:
        importlib.import_module(module)
    register_tasks(env_id)
    if ":" not in env_id:
        try:
            gym.spec(env_id)
        except gym.error.Error as error:
            hint = f"{nearest(env_id, gym.registry)}; if a module of yours registers it, give MODULE:{env_id}"
            raise gym.error.Error(f"{error}{hint}") from error
