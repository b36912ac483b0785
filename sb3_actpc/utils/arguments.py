"""What the constructors of ActPC, of its policy and of the baselines take. The kind and the range of a keyword stand in the
constructor's signature, where type checkers see them too; :func:`checked` holds the values to it before anything is made.
"""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import wraps
from numbers import Integral, Real
from typing import Annotated, Any, Literal, ParamSpec, get_args, get_origin

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.vec_env import VecEnv

from sb3_actpc.ngc.circuit import LARGEST_SIZE as LARGEST_LAYER
from sb3_actpc.utils.checks import KINDS, LARGEST_SIZE, check_kind, nearest
from sb3_actpc.utils.constructors import constructors

Parameters = ParamSpec("Parameters")
CIRCUITS = ("actor", "critic", "generator", "prior")
MAX_CRITICS = 100
MAX_SEED = 2**32 - 1  # NumPy's


@dataclass(frozen=True)
class Between:
    """Bounds of a number, both allowed; None passes."""

    low: float
    high: float = np.inf

    def __call__(self, name: str, value: Any) -> None:
        """:raises ValueError: naming the keyword, its value and the bounds"""
        if isinstance(value, bool):
            raise ValueError(f"{name}={value!r} must be a number")
        if value is not None and not self.low <= value <= self.high:
            bounds = f"at least {self.low}" if np.isinf(self.high) else f"between {self.low} and {self.high}"
            raise ValueError(f"{name}={value!r} must be {bounds}")


@dataclass(frozen=True)
class SubclassOf:
    """A class that extends another."""

    base: type

    def __call__(self, name: str, kind: Any) -> None:
        """:raises ValueError: naming the keyword, its value and the class to extend"""
        if not isinstance(kind, type) or not issubclass(kind, self.base):
            raise ValueError(f"{name}={kind!r} must be a subclass of {self.base.__name__}")


Share = Annotated[float, Between(0, 1)]
Weight = Annotated[float, Between(0)]
Count = Annotated[int, Between(0)]
Positive = Annotated[int, Between(1)]
Size = Annotated[int, Between(1, LARGEST_SIZE)]


def checked(init: Callable[Parameters, None]) -> Callable[Parameters, None]:
    """A constructor that refuses values which its annotations do not allow.

    :param init: an ``__init__``; a function (name, value) in an ``Annotated`` raises ValueError for a bad value
    :return: the same, checked; it names the nearest keyword to one that it does not know, and takes NumPy's numbers
    """
    signature = inspect.signature(init, eval_str=True)
    known = list(signature.parameters)[1:]
    is_open = any(parameter.kind is parameter.VAR_KEYWORD for parameter in signature.parameters.values())

    @wraps(init)
    def checking(*args: Parameters.args, **kwargs: Parameters.kwargs) -> None:
        for name in kwargs:
            if not is_open and name not in known:
                hint = nearest(name, known) or f"; choose from {', '.join(known)}"
                raise TypeError(f"{type(args[0]).__name__} has no keyword {name!r}{hint}")
        given = signature.bind(*args, **kwargs)
        given.apply_defaults()
        for name, value in given.arguments.items():
            given.arguments[name] = _plain(value)
            check_value(name, given.arguments[name], signature.parameters[name].annotation)
        init(*given.args, **given.kwargs)

    # help() shows names and defaults: with the checks, a page of them
    shown = [one.replace(annotation=one.empty) for one in signature.parameters.values()]
    checking.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
    return checking


def _plain(value: Any) -> Any:
    """Python's own numbers instead of NumPy's, which SB3 does not take everywhere."""
    if type(value) is tuple:
        return tuple(map(_plain, value))
    return value.item() if isinstance(value, np.generic) else value


def check_settings(kind: type, settings: Mapping[str, Any]) -> None:
    """ValueError for the first of the settings that a :func:`checked` constructor of a class would refuse, or that SB3's own,
    which check little, cannot work with."""
    annotations: dict[str, Any] = {}
    for init in constructors(kind):
        if hasattr(init, "__wrapped__"):
            own = inspect.signature(init.__wrapped__, eval_str=True).parameters.values()
            annotations = {**{one.name: one.annotation for one in own}, **annotations}
    annotations = {**OF_SB3, **annotations}
    for name in filter(annotations.__contains__, settings):
        check_value(name, settings[name], annotations[name])


def check_value(name: str, value: Any, annotation: Any) -> None:
    """:raises ValueError: naming the keyword, its value, what is allowed, and how to mend it"""
    kind, *checks = get_args(annotation) if get_origin(annotation) is Annotated else (annotation,)
    if get_origin(kind) is Literal:
        if not isinstance(value, str) or value not in get_args(kind):
            raise ValueError(f"{name}={value!r} is unknown; choose one of {list(get_args(kind))}")
    elif kind in KINDS:  # others are left to the functions in Annotated
        check_kind(name, value, kind)
    for check in checks:
        check(name, value)


# ---------------------------------------------------------------------- of the agent


def refuse_noise(name: str, noise: Any) -> None:
    """In a preset, of an algorithm of SB3: its noises are no plain values."""
    raise ValueError(f"{name!r} is not set here: use --set noise_type=normal --set noise_std=0.1")


def check_limit(name: str, limit: Any) -> None:
    """None, a number of episodes, or a number with its unit."""
    if limit is None:
        return
    number = limit
    unit = "episodes"
    if isinstance(limit, (tuple, list)) and len(limit) == 2:
        number, unit = limit
    is_number = isinstance(number, Integral) and not isinstance(number, bool) and int(number) >= 1
    if not is_number or unit not in ("episodes", "transitions"):
        raise ValueError(
            f"{name}={limit!r} must be a whole number of at least 1, of episodes, or (number, 'episodes' or 'transitions')"
        )


DemonstrationLimit = Annotated[int | tuple[int, str] | None, check_limit]


def check_env(name: str, env: Any) -> None:
    """None is for agents that are loaded to be played."""
    if env is not None and not isinstance(env, (str, gym.Env, VecEnv)):
        raise ValueError(f"{name}={env!r} must be an environment or the id of one, such as 'Pendulum-v1'")


def check_learning_rate(name: str, learning_rate: Any) -> None:
    """A number that is not negative, or a function that begins with one."""
    try:
        start = float(learning_rate(1.0)) if callable(learning_rate) else learning_rate
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name}={learning_rate!r} must be a number, or a function of the remaining progress (1 to 0): {error}"
        ) from error
    check_value(name, start, Weight)


def check_train_freq(name: str, train_freq: Any) -> None:
    """A number of steps, or a number with its unit."""
    is_pair = isinstance(train_freq, tuple) and len(train_freq) == 2
    frequency, unit = train_freq if is_pair else (train_freq, "step")
    is_known = isinstance(train_freq, TrainFreq) or unit in ("step", "episode")
    if not is_known or not isinstance(frequency, int) or not 1 <= frequency <= LARGEST_SIZE:
        raise ValueError(f"{name}={train_freq!r} must be a whole number of at least 1, or (number, 'step' or 'episode')")


def check_noise(name: str, noise: Any) -> None:
    """None, a standard deviation, or one of SB3's."""
    if isinstance(noise, Real):
        check_value(name, noise, Weight)
    elif noise is not None and not isinstance(noise, ActionNoise):
        raise ValueError(
            f"{name}={noise!r} must be None, a standard deviation, or one of SB3's, such as NormalActionNoise(mean, sigma)"
        )


def check_nudge(name: str, nudge: Any) -> None:
    """None, or above 0 and at most 1."""
    if nudge is not None and not 0.0 < nudge <= 1.0:
        raise ValueError(f"{name}={nudge!r} must be above 0 and at most 1")


def check_actions(space: gym.spaces.Box) -> None:
    """:raises ValueError: when a dimension of the actions has no finite extent, or they are whole numbers"""
    with np.errstate(over="ignore", invalid="ignore"):
        is_finite = np.all(np.isfinite(space.high - space.low))  # the largest numbers that there are stand for no bound too
    if not is_finite:
        raise ValueError(f"action_space={space} must have finite bounds: set them with gymnasium's TransformAction")
    if not np.issubdtype(space.dtype, np.floating):  # SB3's buffer would cut scaled actions off to whole numbers
        raise ValueError(
            f"action_space={space} must have a floating dtype: wrap the environment, so that it rounds its actions"
        )
    fixed = np.argwhere(space.low >= space.high)
    if len(fixed):
        where = tuple(map(int, fixed[0]))
        raise ValueError(
            f"action_space={space}: dimension {where[0] if len(where) == 1 else where} has low == high == {space.low[where]}; "
            "wrap the environment to leave it out of the action"
        )


# keywords of SB3's constructors, as theirs that are not ``checked`` mean them
OF_SB3: dict[str, Any] = {
    "learning_rate": Annotated[Any, check_learning_rate],
    **dict.fromkeys(("buffer_size", "batch_size", "n_steps", "n_epochs", "stats_window_size"), Size),
    **dict.fromkeys(("policy_delay", "target_update_interval"), Positive),
    **dict.fromkeys(("gamma", "tau", "gae_lambda"), Share),
    **dict.fromkeys(("learning_starts", "vf_coef", "target_policy_noise"), Weight),
    "train_freq": Annotated[Any, check_train_freq],
    "gradient_steps": Annotated[int, Between(-1)],
    "target_kl": Annotated[float | None, Between(0)],
    "action_noise": Annotated[Any, refuse_noise],
    "use_sde": bool,
    "tensorboard_log": str | None,
}


# ---------------------------------------------------------------------- of the policy


def check_net_arch(name: str, net_arch: Any) -> None:
    """Sizes of hidden layers for all circuits, or for each; None for the default."""
    parts = net_arch if isinstance(net_arch, dict) else {"pi": net_arch}
    unknown = sorted(set(parts) - {"pi", "qf", "generator", "prior"}, key=str)
    if unknown:
        raise ValueError(f"{name} has unknown keys {unknown}; choose from pi, qf, generator, prior")
    for sizes in parts.values():
        layers = [] if sizes is None else sizes
        is_list = isinstance(layers, (list, tuple))
        if not is_list or not all(isinstance(size, Integral) and 1 <= int(size) <= LARGEST_LAYER for size in layers):
            raise ValueError(f"{name}={sizes!r} must be a list of layer sizes, whole numbers from 1 to {LARGEST_LAYER}")


def check_circuit(name: str, settings: Any) -> None:
    """What a circuit can have of its own beside the keywords of every circuit."""
    for key, value in (settings or {}).items():
        where = f"{name}[{key!r}]"
        if key == "batch_size":
            check_value(where, value, Size)
        elif key == "learning_rate":
            check_value(where, value, Annotated[float, Between(0, LARGEST_SIZE)])
        elif key == "output_activation" and name == "actor_kwargs":
            check_value(where, value, Literal["tanh", "clamp"])


def check_optimizer(name: str, kind: Any) -> None:
    """A class of ``torch.optim`` that steps by the changes alone."""
    SubclassOf(th.optim.Optimizer)(name, kind)
    closure = inspect.signature(kind.step).parameters.get("closure")
    if closure is not None and closure.default is closure.empty:
        raise ValueError(f"{name}={kind!r} asks for a loss again and again; circuits have none: use one such as Adam or SGD")
