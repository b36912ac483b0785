"""Model repositories for the Hugging Face hub, written offline, and the agents that come with the package.

``python -m sb3_actpc.experiments.cards RUN [RUN ...]`` puts the run with the median return of each task among the agents.
"""

import json
import shlex
import shutil
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_actpc.actpc import ActPC
from sb3_actpc.experiments.runs.evaluation import NormalizedPredictor, Predictor
from sb3_actpc.experiments.runs.presets import RUN_KEYS
from sb3_actpc.experiments.runs.record import CONFIG, read_result
from sb3_actpc.experiments.runs.run import evaluate_run, load_run
from sb3_actpc.experiments.runs.schema import Run
from sb3_actpc.experiments.runs.video import RenderingUnavailable, record_video
from sb3_actpc.pretrained import AGENTS, INDEX, read_index, save_agent
from sb3_actpc.utils.files import atomic_write, file_hash, folder_name
from sb3_actpc.utils.weights import save_weights

PRESET = "preset.yml"
RESULT_KEYS = ("return", "return_std", "dense_return", "dense_return_std", "success", "eval_episodes", "timesteps", "seed")


@dataclass(frozen=True)
class Card:
    """
    A model repository that was written.

    :param folder: its folder
    :param files: names of the files in it
    :param notes: what was left out, and why
    """

    folder: Path
    files: list[str]
    notes: list[str]


def write_card(folder: Path, target: Path, n_episodes: int = 10, seed: int = 0, video: bool = True) -> Card:
    """
    Write a model repository of a finished run. Its ``model.zip`` is unpickled: open only runs that you trust.

    :param folder: of the run
    :param target: folder to write; it must be empty or missing
    :param n_episodes: evaluation episodes for ``results.json``
    :param seed: of the first of them
    :param video: whether to record ``replay.mp4``
    :raises FileNotFoundError: when the folder is not that of a finished run
    :raises ValueError: when the target holds files
    """
    if target.is_dir() and any(target.iterdir()):
        raise ValueError(f"{target} holds files: choose an empty folder")
    read_result(folder)
    run, model = load_run(folder)
    result = evaluate_run(folder, n_episodes, seed)
    name = f"{run.algo}-{folder_name(run.env)}"
    target.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(folder / "model.zip", target / f"{name}.zip")
    shutil.copyfile(folder / CONFIG, target / CONFIG)
    notes = _write_weights(model, target / f"{name}.safetensors")
    if (folder / NormalizedPredictor.FILE).is_file():
        shutil.copyfile(folder / NormalizedPredictor.FILE, target / NormalizedPredictor.FILE)
    _write_json(target / "results.json", _results(result))
    if video:
        notes += _write_video(run, model, target / "replay.mp4", seed)
    with atomic_write(target / PRESET, "w") as file:
        yaml.safe_dump(_preset(run), file, sort_keys=True)
    with atomic_write(target / "README.md", "w") as file:
        file.write(card_text(run, result, name, (target / "replay.mp4").is_file()))
    return Card(target, sorted(path.name for path in target.iterdir()), notes)


def card_text(run: Run, result: dict[str, Any], name: str, has_video: bool) -> str:
    """
    The card: metadata with the model index, then the use.

    :param run: as trained
    :param result: of :func:`~sb3_actpc.experiments.runs.run.evaluate_run`
    :param name: of the model's files, without suffix
    :param has_video: whether the repository holds ``replay.mp4``
    """
    value = f"{result['return']:.2f} +/- {result['return_std']:.2f}"
    metric = {"type": "mean_reward", "name": "mean_reward", "value": value}
    measured = {
        "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
        "dataset": {"name": run.env, "type": run.env},
        "metrics": [{**metric, "verified": False}],
    }
    metadata = {
        "library_name": "stable-baselines3",
        "tags": [run.env, "deep-reinforcement-learning", "reinforcement-learning", "stable-baselines3", "sb3_actpc"],
        "model-index": [{"name": run.algo, "results": [measured]}],
    }
    rows = [
        f"| mean return | {value} |",
        f"| dense return | {result['dense_return']:.2f} +/- {result['dense_return_std']:.2f} |",
        f"| evaluation episodes | {result['eval_episodes']}, deterministic |",
        f"| training | {run.n_timesteps} steps, seed {run.seed} |",
    ]
    parts = [
        f"---\n{yaml.safe_dump(metadata, sort_keys=False)}---",
        f"# {run.algo} on {run.env}",
        f"An agent of {run.algo}, trained by [sb3_actpc](https://pypi.org/project/sb3-actpc/), a Stable-Baselines3 plugin.",
        "| | |\n| --- | --- |\n" + "\n".join(rows),
        *(["The first evaluation episode is in `replay.mp4`."] if has_video else []),
        f"## Use\n\n{_usage(run, name)}",
        f"## Training\n\n```bash\n{_command(run)}\n```\n\n`{PRESET}` has every setting, `{CONFIG}` also the versions "
        "and the commit.",
    ]
    return "\n\n".join(parts) + "\n"


def _usage(run: Run, name: str) -> str:
    if run.algo != "actpc":
        return f"`{name}.zip` is a file of SB3's `save`. Loading it unpickles: load only files that you trust."
    code = ["import sb3_actpc  # registers the tasks", f'model = sb3_actpc.ActPC.load("{name}.zip")  # unpickles']
    if run.normalize is None:
        code.append(f'model = sb3_actpc.ActPC.from_weights("{name}.safetensors", "{run.env}")  # runs no code')
    return "```python\n" + "\n".join(code) + "\n```"


def _command(run: Run) -> str:
    words = ["sb3-actpc train", f"--algo {run.algo}", f"--env {run.env}", f"--steps {run.n_timesteps}", f"--seed {run.seed}"]
    demonstrations = [] if run.demonstrations == "shipped" else [f"--demonstrations {shlex.quote(run.demonstrations)}"]
    return " ".join([*words, f"--preset {PRESET}", *demonstrations])


def _preset(run: Run) -> dict[str, Any]:
    """The settings of a run as a preset file has them."""
    own = {name: getattr(run, name) for name in RUN_KEYS if getattr(run, name)}
    return {run.env: json.loads(json.dumps({**own, **run.settings}))}  # tuples become lists


def _results(result: dict[str, Any]) -> dict[str, Any]:
    """As rl-zoo3's file names them, and the dense return."""
    return {
        "mean_reward": result["return"],
        "std_reward": result["return_std"],
        "is_deterministic": True,
        "n_eval_episodes": result["eval_episodes"],
        "mean_dense_reward": result["dense_return"],
        "success": result["success"],
    }


def _write_weights(model: Predictor, path: Path) -> list[str]:
    agent = getattr(model, "model", model)
    if not isinstance(agent, OffPolicyAlgorithm):
        return [f"no {path.name}: {type(agent).__name__} is not an off-policy algorithm"]
    try:
        save_weights(agent, path)
    except ValueError as error:
        return [f"no {path.name}: {error}"]
    return []


def _write_video(run: Run, model: Predictor, path: Path, seed: int) -> list[str]:
    try:
        record_video(model, run.env, run.env_kwargs, path, seed)
    except RenderingUnavailable as error:
        return [f"no {path.name}: rendering is not available here ({' '.join(str(error).split())})"]
    return []


def _write_json(path: Path, content: dict[str, Any]) -> None:
    with atomic_write(path, "w") as file:
        json.dump(content, file, indent=2)
        file.write("\n")


def bundle_agents(folders: Sequence[Path], target: Path = AGENTS) -> list[Path]:
    """
    Put agents among those of the package: for every task the run with the median return (the lower of two).

    :param folders: of finished runs of ActPC
    :param target: folder of the agents, with its index
    :return: the agents' files
    :raises FileNotFoundError: when a folder is not that of a finished run
    :raises ValueError: when a run is of another algorithm, normalizes observations, or its file would be too large
    """
    results: dict[str, list[tuple[float, Path]]] = {}
    for folder in folders:
        result = read_result(folder)
        results.setdefault(result["env"], []).append((result["return"], folder))
    return [_bundle(_median(runs), target) for runs in results.values()]


def _median(runs: list[tuple[float, Path]]) -> Path:
    middle = statistics.median_low(value for value, _ in runs)
    return next(folder for value, folder in sorted(runs) if value == middle)


def _bundle(folder: Path, target: Path) -> Path:
    run, model = load_run(folder)
    if not isinstance(model, ActPC):
        raise ValueError(f"{folder} holds {run.algo}: only runs of actpc without VecNormalize can be bundled")
    result = read_result(folder)
    path = save_agent(model, target / f"{folder_name(run.env)}.safetensors")
    row: dict[str, Any] = {"file": path.name, "sha256": file_hash(path), "env_kwargs": run.env_kwargs}
    row |= {"preset": run.preset_name, "git_commit": run.git_commit}
    row |= {key: result[key] for key in RESULT_KEYS}
    index = {**read_index(target), run.env: row}
    _write_json(target / INDEX, dict(sorted(index.items())))
    return path


if __name__ == "__main__":
    for written in bundle_agents([Path(argument) for argument in sys.argv[1:]]):
        print(written)
