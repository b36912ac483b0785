"""Model repositories for the Hugging Face hub, written offline, and the agents that come with the package.

``python -m sb3_actpc.experiments.cards RUN [RUN ...]`` puts the agents of runs among these, one for each task.
"""

import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_actpc.actpc import ActPC
from sb3_actpc.envs import UNSEEN_SEED
from sb3_actpc.experiments.runs.evaluation import NormalizedPredictor
from sb3_actpc.experiments.runs.presets import preset_entry
from sb3_actpc.experiments.runs.record import CONFIG, read_result, write_json
from sb3_actpc.experiments.runs.run import evaluate_run, load_run
from sb3_actpc.experiments.runs.schema import Run
from sb3_actpc.experiments.runs.video import video_note
from sb3_actpc.pretrained import AGENTS, INDEX, read_index, save_agent
from sb3_actpc.utils.files import atomic_write, file_hash, folder_name
from sb3_actpc.utils.weights import save_weights

PRESET, VIDEO = "preset.yml", "replay.mp4"
RESULT_KEYS = ("return", "return_std", "dense_return", "dense_return_std", "success", "eval_episodes", "timesteps", "seed")


def write_card(folder: Path, target: Path, n_episodes: int = 10, seed: int = UNSEEN_SEED, video: bool = True) -> list[str]:
    """Write a model repository of a finished run. Its ``model.zip`` is unpickled: open only runs that you trust.

    ``results.json`` is of ``n_episodes`` evaluation episodes, the first from ``seed``, which ``replay.mp4`` shows where asked
    for. Returns lines on the video, and on what was left out and why. FileNotFoundError when the folder is not that of a
    finished run, ValueError when the target holds files.
    """
    if target.is_dir() and any(target.iterdir()):
        raise ValueError(f"{target} holds files: choose an empty folder")
    read_result(folder)
    run, model = load_run(folder)
    result = evaluate_run(folder, n_episodes, seed)
    name = folder_name(f"{run.algo}-{run.env}")
    target.mkdir(parents=True, exist_ok=True)
    copied = {"model.zip": f"{name}.zip", CONFIG: CONFIG, NormalizedPredictor.FILE: NormalizedPredictor.FILE}
    for source, copy in copied.items():
        if (folder / source).is_file():
            shutil.copyfile(folder / source, target / copy)
    notes = []
    agent = getattr(model, "model", model)
    if isinstance(agent, OffPolicyAlgorithm):
        try:
            save_weights(agent, target / f"{name}.safetensors")
        except ValueError as error:
            notes.append(f"no {name}.safetensors: {error}")
    # as rl-zoo3's file names them, and the dense return
    measured = {"mean_reward": result["return"], "std_reward": result["return_std"], "is_deterministic": True}
    measured |= {"n_eval_episodes": n_episodes, "mean_dense_reward": result["dense_return"], "success": result["success"]}
    write_json(target / "results.json", measured)
    if video:
        notes.append(video_note(model, run.env, run.env_kwargs, target / VIDEO, seed))
    with atomic_write(target / PRESET, "w") as file:
        yaml.safe_dump({run.env: preset_entry(run)}, file, sort_keys=True)
    with atomic_write(target / "README.md", "w") as file:
        file.write(_card_text(run, result, name, (target / VIDEO).is_file()))
    return notes


def _card_text(run: Run, result: dict[str, Any], name: str, has_video: bool) -> str:
    """The card: metadata with the model index, then the use."""
    value = f"{result['return']:.2f} +/- {result['return_std']:.2f}"
    measured = {
        "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
        "dataset": {"name": run.env, "type": run.env},
        "metrics": [{"type": "mean_reward", "name": "mean_reward", "value": value, "verified": False}],
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
    words = ["sb3-actpc train", f"--algo {run.algo}", f"--env {run.env}", f"--steps {run.n_timesteps}", f"--seed {run.seed}"]
    own = [] if run.demonstrations == "shipped" else [f"--demonstrations {shlex.quote(run.demonstrations)}"]
    own += ["--gym-packages", *run.gym_packages] if run.gym_packages else []
    parts = [
        f"---\n{yaml.safe_dump(metadata, sort_keys=False)}---",
        f"# {run.algo} on {run.env}",
        f"An agent of {run.algo}, trained by `sb3_actpc`, a Stable-Baselines3 plugin.",
        "| | |\n| --- | --- |\n" + "\n".join(rows),
        *(["The first evaluation episode is in `replay.mp4`."] if has_video else []),
        f"## Use\n\n{_usage(run, name)}",
        f"## Training\n\n```bash\n{' '.join([*words, f'--preset {PRESET}', *own])}\n```\n\n`{PRESET}` has every setting, "
        f"`{CONFIG}` also the versions and the commit.",
    ]
    return "\n\n".join(parts) + "\n"


def _usage(run: Run, name: str) -> str:
    if run.algo != "actpc":
        return f"`{name}.zip` is a file of SB3's `save`. Loading it unpickles: load only files that you trust."
    code = [f"import {module}" for module in run.gym_packages]
    code += ["import sb3_actpc  # registers the tasks", f'model = sb3_actpc.ActPC.load("{name}.zip")  # unpickles']
    if run.normalize is None:
        env = f'gymnasium.make("{run.env}", **{run.env_kwargs})' if run.env_kwargs else f'"{run.env}"'
        code += ["import gymnasium"] if run.env_kwargs else []
        code.append(f'model = sb3_actpc.ActPC.from_weights("{name}.safetensors", {env})  # runs no code')
    elif run.normalize.get("norm_obs", True):
        code += [
            "from stable_baselines3.common.env_util import make_vec_env",
            "from stable_baselines3.common.vec_env import VecNormalize",
            f'env = make_vec_env("{run.env}", env_kwargs={run.env_kwargs})',
            f'env = VecNormalize.load("{NormalizedPredictor.FILE}", env)  # unpickles; the agent sees its observations',
            "env.training = False",
        ]
    return "```python\n" + "\n".join(code) + "\n```"


def bundle_agent(folder: Path, target: Path = AGENTS) -> Path:
    """Put the agent of a finished run of ActPC among those of the package (``target``, with its index), in the place of the
    one of its task: the agent's file. FileNotFoundError when the folder is not that of a finished run, ValueError when the
    run is of another algorithm, normalizes observations, or its file would be too large."""
    result = read_result(folder)
    run, model = load_run(folder)
    if not isinstance(model, ActPC):
        raise ValueError(f"{folder} holds {run.algo}: only runs of actpc without VecNormalize can be bundled")
    path = save_agent(model, target / f"{folder_name(run.env)}.safetensors")
    row: dict[str, Any] = {"file": path.name, "sha256": file_hash(path), "env_kwargs": run.env_kwargs}
    row |= {"preset": run.preset_name, "git_commit": run.git_commit}
    row |= {key: result[key] for key in RESULT_KEYS}
    write_json(target / INDEX, dict(sorted({**read_index(target), run.env: row}.items())))
    return path


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        print(bundle_agent(Path(argument)))
