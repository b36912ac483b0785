"""Environments in the middle of an episode: simulator, wrappers' counters and generators, as plain data."""

from typing import Any

import gymnasium as gym
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from sb3_actpc.checkpoints.callables import class_state, is_library
from sb3_actpc.checkpoints.encoding import Decoder, Encoder, LostValue, OpaqueValue
from sb3_actpc.utils.tasks import task_id

# what the constructors make again, and the time of the clock
_SKIPPED = {"venv", "env", "class_attributes", "results_writer", "obs_spaces", "metadata", "_metadata", "spec", "_cached_spec"}
_SKIPPED |= {"t_start"}
_SKIPPED_WITHIN = {"metadata", "spec"}  # of an environment that is no wrapper, which may keep its state under the other names
_OWN_STATE = "checkpoint_state()"  # the name of what an environment's own method returned
_OF_CLASS = "class "  # before the names of a class's own attributes
_GENERATORS = {"generator", "random_state", "random", "space"}  # kinds of stored values


def vec_env_layers(env: VecEnv) -> list[VecEnv]:
    """The environment, the one it wraps, and so on, outermost first."""
    return [env, *vec_env_layers(env.venv)] if isinstance(env, VecEnvWrapper) else [env]


def env_name(env: VecEnv) -> str:
    """The Gymnasium id of the task, or the class of an environment that has none; never an empty text."""
    if (env_id := task_id(env)) is not None:
        return env_id
    innermost = vec_env_layers(env)[-1]
    return type(innermost.envs[0].unwrapped if isinstance(innermost, DummyVecEnv) else innermost).__qualname__


def capture_vec_env(env: VecEnv, encoder: Encoder, where: str) -> dict[str, Any]:
    """The training environment with its wrappers as JSON; environments whose state cannot be stored are named in it with
    the reason."""
    *wrappers, innermost = vec_env_layers(env)
    if isinstance(innermost, DummyVecEnv):
        envs = [_capture_env(one, encoder, f"{where}.{index}") for index, one in enumerate(innermost.envs)]
    else:
        reason = f"the environments of a {type(innermost).__qualname__} run in other processes"
        envs = [{"reasons": [reason], "layers": []} for _ in range(env.num_envs)]
    kept = [{name: one for name, one in vars(wrapper).items() if name not in _SKIPPED} for wrapper in wrappers]
    return {
        "envs": envs,
        "classes": [type(wrapper).__qualname__ for wrapper in wrappers],
        "wrappers": [encoder.encode_some(attributes, where) for attributes in kept],  # settings cannot all be stored
        "seeds": encoder.encode([innermost._seeds, innermost._options], f"{where}.seeds"),  # for the next reset
    }


def restore_vec_env(env: VecEnv, record: dict[str, Any], decoder: Decoder) -> list[tuple[int, str]]:
    """Put back what :func:`capture_vec_env` returned into an environment made as the captured one was: (index, reason) of each
    environment whose episode must start again. ValueError when it is wrapped in another way."""
    *wrappers, innermost = vec_env_layers(env)
    kinds = [type(wrapper).__qualname__ for wrapper in wrappers]
    if kinds != record["classes"] or len(record["envs"]) != env.num_envs:
        raise ValueError(
            f"the checkpoint's environment has {len(record['envs'])} copies wrapped in {record['classes']}, this one "
            f"{env.num_envs} wrapped in {kinds}: make it as it was made before"
        )
    lost = []
    for index, entry in enumerate(record["envs"]):
        is_here = isinstance(innermost, DummyVecEnv)
        reasons = _restore_env(innermost.envs[index], entry, decoder) if is_here else entry["reasons"]  # type: ignore[attr-defined]
        if reasons:
            lost.append((index, "; ".join(reasons)))
    for wrapper, attributes in zip(wrappers, record["wrappers"], strict=True):
        set_attributes(wrapper, attributes, decoder)
    innermost._seeds, innermost._options = decoder.decode(record["seeds"])
    return lost


def set_attributes(owner: Any, attributes: dict[str, Any], decoder: Decoder) -> None:
    """Put stored attributes back; those that cannot be made stay as they are."""
    for name, node in attributes.items():
        try:
            setattr(owner, name, decoder.decode(node, vars(owner).get(name)))
        except LostValue:
            continue


def _layers(env: gym.Env[Any, Any]) -> list[tuple[str, gym.Env[Any, Any]]]:
    """The wrappers of one environment, outermost first, the environment itself, and those that are attributes of these, with
    their own wrappers, each once; before them their class, and the attribute that holds one that is not wrapped. What is in
    ``checkpoint_skipped`` is left out."""
    found: list[tuple[str, gym.Env[Any, Any]]] = []

    def add(layer: gym.Env[Any, Any], held_as: str) -> None:
        if any(layer is other for _, other in found):
            return
        found.append((held_as + type(layer).__qualname__, layer))
        skipped = getattr(layer, "checkpoint_skipped", ())
        if isinstance(layer, gym.Wrapper):
            add(layer.env, "")
        for name, one in sorted(vars(layer).items()):
            if isinstance(one, gym.Env) and name not in skipped:
                add(one, f"{name}: ")

    add(env, "")
    return found


def _capture_env(env: gym.Env[Any, Any], encoder: Encoder, where: str) -> dict[str, Any]:
    layers, reasons = _layers(env), []
    entries: list[dict[str, Any]] = [
        {"class": name, "number": encoder.add(layer, {"kind": "layer"}), "attributes": {}, "is_lost": False}
        for name, layer in layers
    ]
    encoder.keeps_views = True
    for (kind, layer), entry in zip(layers, entries, strict=True):
        for name, value in _layer_values(layer).items():
            try:
                entry["attributes"][name] = encoder.encode(value, f"{where}.{kind}.{name}")
            except OpaqueValue as error:
                reasons.append(str(error))
                entry["is_lost"] = True
    encoder.keeps_views = False
    return {"reasons": reasons, "layers": entries}


def _layer_values(layer: gym.Env[Any, Any]) -> dict[str, Any]:
    """Attributes but those in ``checkpoint_skipped``, and first what the layer says of the objects that these hold."""
    skipped = _SKIPPED if isinstance(layer, gym.Wrapper) else _SKIPPED_WITHIN
    values = {_OWN_STATE: layer.checkpoint_state()} if hasattr(layer, "checkpoint_state") else {}
    for kind in type(layer).__mro__:
        if not is_library(kind.__module__):
            values |= {f"{_OF_CLASS}{kind.__qualname__}.{name}": value for name, value in class_state(kind).items()}
    skipped = {*skipped, *getattr(layer, "checkpoint_skipped", ())}
    return values | {name: value for name, value in vars(layer).items() if name not in skipped}


def _restore_env(env: gym.Env[Any, Any], record: dict[str, Any], decoder: Decoder) -> list[str]:
    """Put back what can be, and return why the episode starts again, or nothing. Where it does, that is each layer of the same
    class in the same place that was stored whole, its physics left out, and of the others the random generators alone."""
    layers, stored, reasons = _layers(env), record["layers"], list(record["reasons"])
    kinds, old = [kind for kind, _ in layers], [entry["class"] for entry in stored]
    if kinds != old:
        reasons.append(f"it is made of {kinds}, the checkpoint's of {old}")
    starts_again = bool(reasons)
    present = [(layer, entry) for (kind, layer), entry in zip(layers, stored, strict=False) if kind == entry["class"]]
    for layer, entry in present:
        decoder.add(entry["number"], layer)
    for layer, entry in present:
        for name, node in entry["attributes"].items():
            kind = decoder.kind_of(node)
            if (entry["is_lost"] and kind not in _GENERATORS) or (starts_again and kind == "physics"):
                continue
            try:
                _restore_attribute(layer, name, node, decoder)
            except ValueError as error:
                reasons.append(f"{type(layer).__qualname__}.{name}: {error}")
    for layer, _ in present if reasons else ():
        if isinstance(layer, Monitor):
            layer.needs_reset = True
    lost = [entry["class"] for entry in stored if entry["is_lost"]]
    return [*reasons, f"of {', '.join(lost)} the random generators alone go on"] if lost else reasons


def _restore_attribute(layer: Any, name: str, node: Any, decoder: Decoder) -> None:
    if name == _OWN_STATE:
        layer.restore_checkpoint_state(decoder.decode(node))
        return
    owner, attribute = layer, name
    existing = vars(layer).get(name)
    if name.startswith(_OF_CLASS):
        class_name, _, attribute = name.removeprefix(_OF_CLASS).rpartition(".")
        owner = next((one for one in type(layer).__mro__ if one.__qualname__ == class_name), None)
        if owner is None or is_library(owner.__module__):
            raise LostValue(f"it was of the class {class_name}, which is not there now")
        existing = class_state(owner).get(attribute)
    value = decoder.decode(node, existing)
    if value is not existing:
        setattr(owner, attribute, value)
