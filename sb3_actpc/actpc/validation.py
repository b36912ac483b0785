"""All checks that single keywords cannot make: settings that must agree, policies, buffers, environments and files."""

import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim, get_obs_shape
from stable_baselines3.common.type_aliases import TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv

from sb3_actpc.actpc.policies import POLICIES, ActPCPolicy
from sb3_actpc.ngc.activations import ACTIVATIONS
from sb3_actpc.utils.checks import Settings, check_finite, check_kind, nearest
from sb3_actpc.utils.constructors import constructor_keywords
from sb3_actpc.utils.nested import map_observations

LARGEST_BOUND = 1e6  # of an observation; larger ones stand for none
_OF_ANOTHER_VERSION = "{path} is of another version of sb3_actpc ({why}): load it with that one"

# ------------------------------------------------------------------ settings


def check_agreement(
    alpha_ep: float, optimize_memory_usage: bool, bootstrap: str, n_steps: int, n_envs: int, train_freq: Any
) -> None:
    """:raises ValueError: for keywords of the agent that do not go together"""
    if alpha_ep and optimize_memory_usage:
        raise ValueError(
            f"alpha_ep={alpha_ep:g} does not work with optimize_memory_usage=True, which overwrites an episode's last "
            "observation with the next episode's first: use optimize_memory_usage=False or alpha_ep=0"
        )
    if bootstrap == "literal" and n_steps > 1:
        raise ValueError(
            f"n_steps={n_steps} does not work with bootstrap='literal', which values the action taken: use n_steps=1"
        )
    by_episode = isinstance(train_freq, tuple) and train_freq[1] in ("episode", TrainFrequencyUnit.EPISODE)
    if n_envs > 1 and by_episode:
        raise ValueError(
            f"train_freq=({train_freq[0]}, 'episode') needs one environment, not n_envs={n_envs}: use a number of steps"
        )


def check_own_learning_rates(kwargs_of: Mapping[str, Settings | None], start: float) -> None:
    """:raises ValueError: where a circuit's own rate would be a multiple of the agent's, which starts at 0"""
    for name, settings in kwargs_of.items():
        own = (settings or {}).get("learning_rate")
        if own and not start:
            raise ValueError(
                f"{name}_kwargs has learning_rate={own}, a multiple of the agent's, which begins at 0: begin above"
            )


def check_policy(name: str, policy: Any) -> None:
    """:raises ValueError: when it is neither the name of a policy nor a subclass of :class:`ActPCPolicy`"""
    is_name = isinstance(policy, str) and policy in POLICIES
    if not is_name and not (isinstance(policy, type) and issubclass(policy, ActPCPolicy)):
        raise ValueError(f"{name}={policy!r} must be one of {list(POLICIES)}, or a subclass of {ActPCPolicy.__name__}")


def check_policy_kwargs(
    policy_class: type[BasePolicy], policy_kwargs: Mapping[str, Any], settling: str, is_gated: bool
) -> Settings:
    """
    The policy's keywords with what the agent sets.

    :param policy_class: the policy's class
    :param policy_kwargs: the user's
    :param settling: the agent's, for all circuits
    :param is_gated: whether guidance has a deployment gate
    :return: keywords of the policy, which checks their values
    :raises ValueError: naming keywords that the class does not take, or that the agent sets
    """
    if "is_gated" in policy_kwargs:
        raise ValueError("policy_kwargs has 'is_gated', which guidance sets: use guidance_kwargs=dict(gate=...)")
    circuits = policy_kwargs.get("circuit_kwargs") or {}
    check_kind("circuit_kwargs", circuits, Settings | None)
    chosen = circuits.get("settling", settling)
    if not isinstance(chosen, str) or chosen != settling:
        raise ValueError(f"circuit_kwargs has settling={chosen!r} but the agent's is {settling!r}; pass settling=")
    given: Settings = {**policy_kwargs, "circuit_kwargs": {**circuits, "settling": settling}}
    if is_gated:
        given["is_gated"] = True
    known = {*constructor_keywords(policy_class)} - {"observation_space", "action_space", "lr_schedule"}
    unknown = sorted(set(given) - known)
    if "activation_fn" in unknown:
        raise ValueError(
            f"policy_kwargs has activation_fn={given['activation_fn']!r}: activations are chosen by name, with "
            f"policy_kwargs=dict(circuit_kwargs=dict(activation=...)), one of {sorted(ACTIVATIONS)}"
        )
    if {*unknown} & {*constructor_keywords(ActPCPolicy)}:
        raise ValueError(
            f"{policy_class.__name__} does not take {unknown}, which ActPC gives it: let its __init__ take **kwargs and pass "
            "them on to ActPCPolicy's"
        )
    if unknown:
        raise ValueError(f"policy_kwargs has unknown keys {unknown}; choose from {sorted(known)}")
    return given


# ------------------------------------------------------------------ buffers


def check_n_steps(n_steps: int, relabels: bool, optimize_memory_usage: bool = False) -> None:
    """:raises ValueError: for n-step returns where they cannot be had"""
    for is_set, name in ((relabels, "hindsight relabelling"), (optimize_memory_usage, "optimize_memory_usage=True")):
        if is_set and n_steps > 1:
            raise ValueError(f"n_steps={n_steps} does not work with {name}; use n_steps=1 or leave it out")


def check_buffer_class(given: type[ReplayBuffer] | None, observation_space: spaces.Space) -> None:
    """:raises ValueError: for a class that is no replay buffer, or is for other observations"""
    if given is None:
        return
    if not (isinstance(given, type) and issubclass(given, ReplayBuffer)):
        raise ValueError(f"replay_buffer_class={given!r} must be None or a subclass of SB3's ReplayBuffer")
    has_parts = isinstance(observation_space, spaces.Dict)
    if issubclass(given, DictReplayBuffer) != has_parts:
        fix = "DictReplayBuffer, HerReplayBuffer" if has_parts else "ReplayBuffer"
        raise ValueError(
            f"replay_buffer_class={given.__name__} does not keep observations of {observation_space}: use {fix} or None"
        )


def check_buffer_kwargs(kind: type[ReplayBuffer], given: Mapping[str, Any], of_agent: Iterable[str]) -> None:
    """:raises ValueError: for keywords that the buffer does not take, or that the agent sets"""
    for name in given.keys() & set(of_agent):
        raise ValueError(f"replay_buffer_kwargs has {name!r}: give it to the agent (history: policy_kwargs['memory_history'])")
    known = constructor_keywords(kind)
    for name in given.keys() - known:
        raise ValueError(f"replay_buffer_kwargs has {name!r}, which {kind.__name__} does not take{nearest(name, known)}")


def check_goal_env(kind: type[ReplayBuffer], env: VecEnv, observation_space: spaces.Space) -> None:
    """:raises ValueError: where hindsight cannot relabel goals"""
    assert isinstance(observation_space, spaces.Dict)
    if not {"achieved_goal", "desired_goal"} <= set(observation_space) or not env.has_attr("compute_reward"):
        raise ValueError(
            f"replay_buffer_class={kind.__name__} relabels goals: the environment needs 'achieved_goal' and "
            "'desired_goal' in its observations, and compute_reward, as gymnasium_robotics.GoalEnv has them"
        )


def check_loaded_buffer(
    path: Any, loaded: Any, is_own: bool, n_envs: int, observation_space: spaces.Space, action_space: spaces.Space
) -> None:
    """:raises ValueError: for a buffer of another algorithm, number of environments or shapes"""
    needed = n_envs, get_obs_shape(observation_space), get_action_dim(action_space)
    held = getattr(loaded, "n_envs", None), getattr(loaded, "obs_shape", None), getattr(loaded, "action_dim", None)
    if not is_own or held != needed:
        shapes = "{} environments, observations of {} and {} actions".format
        raise ValueError(
            f"{path} holds a {type(loaded).__name__} of {shapes(*held)}: this agent, of {shapes(*needed)}, needs what "
            "save_replay_buffer of such an ActPC has written"
        )


# ------------------------------------------------------------------ environments


def check_observations(observations: Any, step: int) -> None:
    """:raises ValueError: for observations that are not finite in float32, which circuits see"""

    def check(array: np.ndarray) -> None:
        with np.errstate(over="ignore"):
            seen = array.astype(np.float32) if array.dtype == np.float64 else array
        check_finite("environment", "observations", seen, step)

    map_observations(check, observations)


def check_step(observations: Any, rewards: np.ndarray, infos: list[dict[str, Any]], step: int) -> None:
    """:raises ValueError: for observations, last ones of episodes among them, or rewards that are not finite"""
    check_observations(observations, step)
    for info in infos:
        if "terminal_observation" in info:
            check_observations(info["terminal_observation"], step)
    check_finite("environment", "rewards", rewards, step)


def finite_bounds(observation_space: spaces.Space, is_normalised: bool) -> np.ndarray:
    """
    :return: the lowest and the highest observation, (2, n)
    :raises ValueError: where observations have no bounds, or VecNormalize normalises them already
    """
    space = observation_space
    bounds = np.stack([space.low, space.high]) if isinstance(space, spaces.Box) else np.full(1, np.inf)
    if bounds.ndim != 2 or not np.all(np.abs(bounds) < LARGEST_BOUND) or is_normalised:
        raise ValueError(
            f"observation_normalization='bounds' needs a flat Box whose bounds are below {LARGEST_BOUND:g}, and no "
            f"VecNormalize(norm_obs=True): observation_space={space}; where there are no bounds, use "
            "VecNormalize(env, norm_reward=False) with 'none'"
        )
    return bounds


# ------------------------------------------------------------------ warnings


def warn_of_idle_settings(has_demonstrations: bool, imitates: bool, alphas: tuple[float, float, float]) -> None:
    """Warns of a signal without its prior, and of an agent that has imitated demonstrations and has none now.

    :param has_demonstrations: whether there are demonstrations
    :param imitates: whether the agent has imitated some, and refresh still has a weight
    :param alphas: (α_ext, α_ep, α_in)
    """
    if has_demonstrations:
        return
    alpha_ext, alpha_ep, alpha_in = alphas
    if imitates:
        warnings.warn(
            "the agent was taught by demonstrations and goes on without them, so that nothing of them is imitated: pass "
            "demonstrations= again, as from_weights(path, env, demonstrations=...)",
            stacklevel=6,
        )
    if alpha_in:
        warnings.warn(
            f"alpha_in={alpha_in:g} has no effect without demonstrations=, which the prior learns from: rewards are "
            f"alpha_ext={alpha_ext:g} times the task's and alpha_ep={alpha_ep:g} times the epistemic signal",
            stacklevel=6,
        )


def warn_of_endless_episodes(n_steps: int, has_gate: bool, relabels: bool) -> None:
    """Warns where something waits for an episode to end that has not ended in ``n_steps`` steps."""
    waits: list[str] = []
    if has_gate:
        waits.append("the deployed policy changes with whole episodes")
    if relabels:
        waits.append("hindsight learns from episodes that have ended")
    if waits:
        warnings.warn(
            f"an episode has gone on for {n_steps} steps: {' and '.join(waits)}, so end them with "
            "gymnasium.wrappers.TimeLimit",
            stacklevel=3,
        )


# ------------------------------------------------------------------ files


@contextmanager
def named_file_errors(path: str | PathLike[str]) -> Iterator[None]:
    """SB3's errors for a file of another version, or of another algorithm, become ValueErrors that say so."""
    try:
        yield
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith("sb3_actpc"):
            raise
        raise ValueError(_OF_ANOTHER_VERSION.format(path=path, why=error)) from error
    except ValueError as error:
        if not str(error).startswith("policy="):
            raise
        raise ValueError(f"{path} holds no ActPC: load it with the class that saved it ({error})") from error
    except RuntimeError as error:
        if "in state_dict" not in str(error):
            raise
        raise ValueError(
            f"{path} holds a policy with other parts: leave out guidance=, guidance_kwargs= and policy_kwargs=, or load it "
            "with the version of sb3_actpc that saved it"
        ) from error


def check_expert_rows(stored: int, present: int) -> None:
    """:raises ValueError: when a checkpoint was taken with other demonstrations"""
    if stored != present:
        raise ValueError(
            f"the checkpoint's agent has {stored} demonstrated transitions, this one {present}: pass the same demonstrations="
        )
