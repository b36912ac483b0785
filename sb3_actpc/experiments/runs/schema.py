"""What a run is: one class from a file, or the command line, to ``config.json``.

A :class:`Run` holds what a user chose. :func:`~sb3_actpc.experiments.runs.presets.resolve` fills in the rest, from the preset
among others, and the filled one is what ``config.json`` holds, what goes to a worker, and what a stopped run goes on with.
A part of a run (an entry of a comparison's file, say) is a :class:`Run` too; :func:`merged` puts parts together.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, AliasChoices, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from sb3_actpc.experiments.runs.algorithms import known_algorithm
from sb3_actpc.utils.checks import nearest
from sb3_actpc.utils.files import folder_name

VERSION = 2  # of config.json
MAX_SEED = 2**31 - 1  # other generators get a seed derived from it, which must be below 2**32
# what decides the outcome of a run, apart from its seed
CONTENT = (
    "algo env env_kwargs policy n_timesteps n_envs noise_type noise_std normalize settings demonstrations_sha256 eval_freq "
    "eval_episodes target_return keep"
).split()
# what resolve() and the beginning of the training fill in
FILLED = ("is_resolved", "demonstrations_sha256", "demonstrators_return", "versions", "git_commit", "dirty")


def _number(value: Any) -> Any:
    """Texts such as ``"1e5"`` are numbers, truth values are none."""
    if isinstance(value, bool):
        raise ValueError("must be a number")
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError as error:
        raise ValueError("must be a number") from error


def _keywords(value: Any) -> Any:
    """As in rl-zoo3: true, false, or keywords."""
    if value is True:
        return {}
    return None if value is False else value


Count = Annotated[int, BeforeValidator(_number), Field(ge=1)]
Seed = Annotated[int, BeforeValidator(_number), Field(ge=0, le=MAX_SEED)]
Real = Annotated[float, BeforeValidator(_number), Field(allow_inf_nan=False)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$")]
Keywords = dict[str, Any]


class Schema(BaseModel):
    """Immutable, and with errors of one line that name the key, the value, and the nearest known key."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def __init__(self, **given: Any) -> None:
        try:
            super().__init__(**given)
        except ValidationError as error:
            raise ValueError(_describe(error, self.known_keys())) from error

    @classmethod
    def known_keys(cls) -> list[str]:
        """Every name that a value can be given by."""
        return sorted({*cls.model_fields, "steps"} - set(FILLED))


class Run(Schema):
    """One training run, or a part of what is said about it; ValueError, in one line that names the value, when one is wrong.
    What is None is by default the preset's, if it can say so, and is filled in by
    :func:`~sb3_actpc.experiments.runs.presets.resolve`; None that is said for ``noise_type`` or ``normalize`` is none."""

    env: str = ""  # Gymnasium id of the task
    algo: Annotated[str, AfterValidator(known_algorithm)] = "actpc"  # key of ``ALGORITHMS``, or ``MODULE:CLASS``
    preset: str | None = None  # a file's name in ``hyperparams/``, or a path ending in ``.yml``; by default ``algo``
    # environment steps to train for
    n_timesteps: Count | None = Field(default=None, validation_alias=AliasChoices("n_timesteps", "steps"))
    seed: Seed = 0  # of the agent and of the training environment
    # ``"shipped"`` (the package's file for a sparse task), ``"none"``, a path, or the id of a Minari dataset
    demonstrations: str = "shipped"
    # the algorithm's keywords that replace the preset's; ``"policy_kwargs.net_arch"`` replaces one value in a mapping. Once
    # filled in: all of them
    settings: Keywords = Field(default_factory=dict)
    env_kwargs: Keywords = Field(default_factory=dict)  # of the environment, added to the preset's
    policy: str | None = None  # name of SB3's policy
    n_envs: Annotated[Count, Field(le=1024)] | None = None  # parallel training environments
    noise_type: Literal["normal", "ornstein-uhlenbeck"] | None = None  # of the action noise
    noise_std: Annotated[Real, Field(ge=0)] | None = None  # its standard deviation
    normalize: Annotated[Keywords | None, BeforeValidator(_keywords)] = None  # keywords of SB3's ``VecNormalize``, or true
    eval_freq: Count | None = None  # environment steps between two evaluations; by default a tenth of the training
    eval_episodes: Count = 10  # in each evaluation
    # environment steps between two checkpoints, 0 for none; by default as ``eval_freq``
    checkpoint_freq: Annotated[int, BeforeValidator(_number), Field(ge=0)] | None = None
    keep: Literal["last", "best"] = "last"  # the agent of which evaluation (best: dense return) is kept as ``model.zip``
    target_return: Real | None = None  # the training ends at the first evaluation whose mean dense return reaches it
    output: str | None = None  # run folder; by default ``runs/<env>/<algo>_<preset>_seed<seed>``
    device: str = "cpu"  # torch's
    threads: Annotated[Count, Field(le=1024)] = 1  # that torch uses
    progress: bool = True  # show a progress bar
    continuable: bool = True  # keep the last checkpoint of a finished run, so that it can be given more steps
    gym_packages: tuple[str, ...] = ()  # modules that register the environment; the working folder is looked in
    task: str | None = None  # of a comparison; ``env`` may be another version of it
    name: Name | None = None  # of this way of running the algorithm in a comparison, a variant
    about: str = ""  # what the variant is, for a report
    task_prefix: str | None = None  # what the variant's environment begins with, instead of the task's ``Sparse``
    is_resolved: bool = False  # whether everything is filled in; the rest is filled in as well
    demonstrations_sha256: str | None = None  # of the file's content
    demonstrators_return: float | None = None  # mean dense return of the demonstrations
    versions: dict[str, str] = Field(default_factory=dict)  # of the packages
    git_commit: str | None = None  # of the source checkout that ran
    dirty: bool | None = None  # whether files differed from that commit

    @property
    def id(self) -> str:
        """Ten hex digits made from what decides the outcome of a filled run."""
        return content_id(self.model_dump(), self.seed)

    @property
    def preset_name(self) -> str:
        """Name of the preset without folder and suffix."""
        return Path(self.preset).stem if self.preset else self.algo.rpartition(":")[2]

    @property
    def folder(self) -> Path:
        """The run's own."""
        if self.output is not None:
            return Path(self.output)
        return Path("runs") / folder_name(self.env) / f"{self.algo.rpartition(':')[2]}_{self.preset_name}_seed{self.seed}"

    @property
    def label(self) -> str:
        """Task, variant and seed, for people."""
        return f"{self.task or self.env} {self.name or self.algo} seed {self.seed}"


def merged(*parts: Run) -> dict[str, Any]:
    """Keywords of a :class:`Run`: everything that was said in the parts; what is said later counts more, ``settings`` and
    ``env_kwargs`` are put together."""
    said: dict[str, Any] = {}
    for part in parts:
        for name in part.model_fields_set:
            value = getattr(part, name)
            said[name] = {**said.get(name, {}), **value} if name in ("settings", "env_kwargs") else value
    return said


def content_id(record: Mapping[str, Any], seed: int | None = None) -> str:
    """Ten hex digits from what decides the outcome in a run's ``config.json``, ``keep`` where it is not the default; without a
    seed, an id that all seeds share."""
    known = {name: record[name] for name in CONTENT if record.get(name) is not None}
    content = {name: value for name, value in known.items() if (name, value) != ("keep", "last")}
    text = json.dumps({**content, "seed": seed}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def _describe(error: ValidationError, known: list[str]) -> str:
    """The first mistake, in one line."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"unknown key {key!r}{nearest(key, known)}: expected some of {', '.join(known)}"
    message = re.sub("^(Input|String) should", "must", first["msg"].removeprefix("Value error, "))
    return message if message.startswith(f"{key}=") else f"{key}={first['input']!r} {message}"
