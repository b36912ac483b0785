"""Trained agents that come with the package: the deployed policy of a finished run in a small safetensors file."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import safetensors.torch
import torch as th
from stable_baselines3.common.type_aliases import GymEnv

from sb3_actpc.actpc import ActPC
from sb3_actpc.utils.checks import nearest
from sb3_actpc.utils.files import atomic_write, file_hash
from sb3_actpc.utils.settings import constructor_settings, read_settings
from sb3_actpc.utils.weights import check_spaces, read_tensors

AGENTS = Path(__file__).parent / "agents"
INDEX = "index.json"
FORMAT = "sb3_actpc agent 1"
LARGEST_FILE = 500_000  # bytes
BUFFER_SIZE = 10_000  # transitions: a bundled agent acts, it has none to keep
_KEYWORDS = ("gamma", "settling", "policy_kwargs")  # what the policy's shape and its circuits depend on


def read_index(folder: Path = AGENTS) -> dict[str, dict[str, Any]]:
    """
    Rows of the bundled agents by environment id.

    :param folder: with ``index.json`` and the agents' files
    :return: file, SHA-256, environment keywords, and the result of the run; empty where there is no index
    """
    path = folder / INDEX
    if not path.is_file():
        return {}
    rows: dict[str, dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))
    return rows


def find_agent(env_id: str, folder: Path = AGENTS) -> dict[str, Any]:
    """
    The row of one bundled agent.

    :raises ValueError: when no agent is bundled for this environment
    """
    index = read_index(folder)
    if env_id not in index:
        choice = ", ".join(sorted(index)) or "none"
        hint = nearest(env_id, index)
        raise ValueError(f"no agent is bundled for {env_id!r}{hint}: choose from {choice}, or train one with sb3-actpc train")
    return index[env_id]


def load_pretrained(env_id: str, env: GymEnv | None = None, folder: Path = AGENTS, **keywords: Any) -> ActPC:
    """
    A bundled agent, to act: ``predict`` is that of the run's deployed policy.

    Its critic is not in the file and is untrained. Train a new agent to go on learning.

    :param env_id: the environment that it was trained on, such as ``SparseReacher-v5``
    :param env: an environment with the same spaces; by default one is made from the id
    :param folder: with ``index.json`` and the agents' files
    :param keywords: constructor keywords that replace the stored ones, such as ``device``
    :raises ValueError: when no agent is bundled, the file is damaged, or the spaces differ
    """
    row = find_agent(env_id, folder)
    path = folder / row["file"]
    if not path.is_file() or file_hash(path) != row["sha256"]:
        raise ValueError(f"{path} is missing or not the file that {INDEX} lists: install the package again")
    return load_agent(path, gym.make(env_id, **row["env_kwargs"]) if env is None else env, **keywords)


def save_agent(model: ActPC, path: Path) -> Path:
    """
    Write the deployed policy of an agent, without its error synapses and the other circuits.

    :param model: a trained agent
    :param path: the file to write
    :return: the file
    :raises ValueError: when a setting has no name, or the file would pass ``LARGEST_FILE`` bytes
    """
    settings = constructor_settings(model)
    if settings["policy"] is None or "policy_kwargs" in settings["unnamed"]:
        raise ValueError(f"{path}: the policy's class or policy_kwargs cannot be written by name; use model.save() instead")
    keywords = {name: settings["keywords"][name] for name in _KEYWORDS}
    header = {
        "format": FORMAT,
        "settings": {"policy": settings["policy"], "keywords": keywords, "unnamed": []},
        "observation_space": str(model.observation_space),
        "action_space": str(model.action_space),
    }
    circuit = "actor.circuit." if model.actor.deployed is None else "actor.deployed."
    tensors = _acting_tensors(model.policy.state_dict(), circuit)
    content = safetensors.torch.save(tensors, metadata={"sb3_actpc": json.dumps(header)})
    if len(content) > LARGEST_FILE:
        raise ValueError(f"{path} would have {len(content)} bytes, at most {LARGEST_FILE} are allowed: use a smaller net_arch")
    with atomic_write(path) as file:
        file.write(content)
    return path


def load_agent(path: Path, env: GymEnv | str, **keywords: Any) -> ActPC:
    """
    Make an agent from a file of :func:`save_agent`. No code in the file is run.

    :param path: the file
    :param env: an environment with the spaces of the training, or its id
    :param keywords: constructor keywords that replace the stored ones
    :raises ValueError: when it is no such file, the spaces differ, or keywords are for learning
    """
    header, tensors = read_tensors(path, "save_agent")
    if header.get("format") != FORMAT:
        raise ValueError(f"{path} has the format {header.get('format')!r}, this version reads {FORMAT!r}")
    refused = sorted({"demonstrations", "guidance", "guidance_kwargs", "policy_kwargs"} & keywords.keys())
    if refused:
        raise ValueError(f"{refused[0]}= does not go with a bundled agent, which only acts: train a new agent instead")
    settings = read_settings(header["settings"], {"buffer_size": BUFFER_SIZE, "guidance": "none", **keywords})
    model = ActPC(env=env, **settings)
    check_spaces(model, header, path)
    state = model.policy.state_dict()
    if _acting_tensors(state, "actor.circuit.").keys() != tensors.keys():
        raise ValueError(f"{path} does not fit its own settings: it is damaged or of another version")
    model.policy.load_state_dict({**state, **tensors})
    model.actor.circuit.mirror_feedback()
    model.only_acts = True
    return model


def _acting_tensors(state: Mapping[str, th.Tensor], circuit: str) -> dict[str, th.Tensor]:
    """What ``predict`` needs, with the acting circuit under the name ``actor.circuit``; error synapses take no part."""
    others = tuple(name for name in ("actor.circuit.", "actor.deployed.") if name != circuit)
    kept = {}
    for name, tensor in state.items():
        if name.startswith("actor.") and not name.startswith(others) and ".feedback_weights." not in name:
            kept[name.replace(circuit, "actor.circuit.")] = tensor.detach().cpu().contiguous().clone()
    return kept
