"""Environments in the middle of an episode: simulator, wrappers' counters and generators, as plain data."""

import importlib
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from sb3_actpc.checkpoints.encoding import Decoder, Encoder, LostValue, OpaqueValue, class_state, is_library
from sb3_actpc.utils.tasks import task_id

# what the constructors make anew, and the time of the clock
_SKIPPED = {"venv", "env", "class_attributes", "results_writer", "obs_spaces", "metadata", "_metadata", "spec", "_cached_spec"}
_SKIPPED |= {"t_start"}
_SKIPPED_WITHIN = {"metadata", "spec"}  # of an environment that is no wrapper, which may keep its state under the other names
# under this name, what an environment's own checkpoint_state() returned
_OWN_STATE = "checkpoint_state()"
_OF_CLASS = "class "  # before the names of a class's own attributes
_GENERATORS = {"generator", "random_state", "random", "space"}  # kinds of stored values
# of MuJoCo's data: made anew in each step, and where there are none their memory belongs to something else
_IN_ARENA = ("efc_", "contact", "iefc_", "iM", "iLD", "iacc", "ifrc_")


def vec_env_layers(env: VecEnv) -> list[VecEnv]:
    """The environment, the one it wraps, and so on, outermost first."""
    return [env, *vec_env_layers(env.venv)] if isinstance(env, VecEnvWrapper) else [env]


def env_layers(env: gym.Env[Any, Any]) -> list[gym.Env[Any, Any]]:
    """The wrappers of one environment, outermost first, the environment itself, and those that are attributes of these, with
    their own wrappers; each of them once. What is in ``checkpoint_skipped`` is left out."""
    return [layer for _, layer in _named_layers(env)]


def _named_layers(env: gym.Env[Any, Any]) -> list[tuple[str, gym.Env[Any, Any]]]:
    """The layers, each with its class, and before it the attribute that holds it where that is not a wrapper's ``env``."""
    found: list[tuple[str, gym.Env[Any, Any]]] = []

    def add(layer: gym.Env[Any, Any], held_as: str) -> None:
        if any(layer is other for _, other in found):
            return
        found.append((held_as + type(layer).__qualname__, layer))
        skipped = getattr(layer, "checkpoint_skipped", ())
        held = {name: one for name, one in vars(layer).items() if isinstance(one, gym.Env) and name not in skipped}
        if isinstance(layer, gym.Wrapper):
            add(layer.env, "")
        for name in sorted(held):
            add(held[name], f"{name}: ")

    add(env, "")
    return found


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
    record: dict[str, Any] = {"wrappers": []}
    # what the next reset will be given
    record["seeds"] = encoder.encode([innermost._seeds, innermost._options], f"{where}.seeds")
    for index, wrapper in enumerate(wrappers):
        kind, kept = type(wrapper).__qualname__, {name: one for name, one in vars(wrapper).items() if name not in _SKIPPED}
        # these hold settings besides what is known to change
        record["wrappers"].append({"class": kind, "attributes": encoder.encode_some(kept, f"{where}.{kind}{index}")})
    if isinstance(innermost, DummyVecEnv):
        record["envs"] = [capture_env(one, encoder, f"{where}.{index}") for index, one in enumerate(innermost.envs)]
    else:
        reason = f"the environments of a {type(innermost).__qualname__} run in other processes"
        record["envs"] = [{"reason": reason} for _ in range(env.num_envs)]
    return record


def restore_vec_env(env: VecEnv, record: dict[str, Any], decoder: Decoder) -> list[tuple[int, str]]:
    """Put back what :func:`capture_vec_env` returned into an environment made as the captured one was: (index, reason) of each
    environment whose episode must start again. ValueError when it is wrapped in another way."""
    *wrappers, innermost = vec_env_layers(env)
    kinds, stored = [type(wrapper).__qualname__ for wrapper in wrappers], [entry["class"] for entry in record["wrappers"]]
    if kinds != stored or len(record["envs"]) != env.num_envs:
        raise ValueError(
            f"the checkpoint's environment has {len(record['envs'])} copies wrapped in {stored}, this one {env.num_envs} "
            f"wrapped in {kinds}: make it as it was made before"
        )
    lost = []
    for index, entry in enumerate(record["envs"]):
        one = innermost.envs[index] if isinstance(innermost, DummyVecEnv) else None
        reason = entry.get("reason") or _layers_mismatch(one, entry)
        reasons = [reason] if reason else []
        if one is not None:
            reasons += _restore_layers(one, entry, decoder, starts_again=bool(reasons))
        if reasons:
            lost.append((index, "; ".join(reasons)))
    for wrapper, entry in zip(wrappers, record["wrappers"], strict=True):
        for name, node in entry["attributes"].items():
            set_attribute(wrapper, name, node, decoder)
    innermost._seeds, innermost._options = decoder.decode(record["seeds"])
    return lost


def capture_env(env: gym.Env[Any, Any], encoder: Encoder, where: str) -> dict[str, Any]:
    """The state of one environment, its wrappers and the environments that it holds as JSON, ``where`` being its path in the
    checkpoint; with a "reason" where it cannot be stored, and the numbers of the layers that are "lost"."""
    layers = _named_layers(env)
    record: dict[str, Any] = {"classes": [name for name, _ in layers], "layers": [], "lost": []}
    reasons = []
    with encoder.environment([layer for _, layer in layers]):
        for depth, (_, layer) in enumerate(layers):
            attributes: dict[str, Any] = {}
            record["layers"].append(attributes)
            for name, value in _layer_values(layer).items():
                path = f"{where}.{depth}.{name}"
                try:
                    if type(value).__name__ == "MjData" and type(value).__module__.startswith("mujoco"):
                        attributes[name] = {"physics": encoder.encode(capture_physics(value.model, value), path)}
                        encoder.add_memory(_physics_arrays(value), path)
                    else:
                        attributes[name] = encoder.encode_alone(value, path)
                except OpaqueValue as error:
                    reasons.append(str(error))
                    record["lost"] = sorted({*record["lost"], depth})
    return {**record, "reason": "; ".join(reasons)} if reasons else record


def _layer_values(layer: gym.Env[Any, Any]) -> dict[str, Any]:
    """Attributes but those in ``checkpoint_skipped``, and first what the layer says of the objects that these hold."""
    made_anew = _SKIPPED if isinstance(layer, gym.Wrapper) else _SKIPPED_WITHIN
    skipped = {*made_anew, *getattr(layer, "checkpoint_skipped", ())}
    own = {_OWN_STATE: layer.checkpoint_state()} if hasattr(layer, "checkpoint_state") else {}
    for kind in type(layer).__mro__:
        if not is_library(kind.__module__):
            own |= {f"{_OF_CLASS}{kind.__qualname__}.{name}": value for name, value in class_state(kind).items()}
    return own | {name: value for name, value in vars(layer).items() if name not in skipped}


def _layers_mismatch(env: gym.Env[Any, Any] | None, entry: dict[str, Any]) -> str | None:
    classes = None if env is None else [name for name, _ in _named_layers(env)]
    if classes == entry.get("classes"):
        return None
    return f"it is made of {classes}, the checkpoint's of {entry.get('classes')}"


def restore_env(env: gym.Env[Any, Any], entry: dict[str, Any], decoder: Decoder) -> None:
    """Put back what :func:`capture_env` returned into an environment made as the captured one was. ValueError when the layers
    differ, or something in them."""
    mismatch = _layers_mismatch(env, entry)
    reasons = [mismatch] if mismatch else _restore_layers(env, entry, decoder)
    if reasons:
        raise ValueError(f"the environment cannot be set into the middle of an episode: {'; '.join(reasons)}")


def _restore_layers(env: gym.Env[Any, Any], entry: dict[str, Any], decoder: Decoder, starts_again: bool = False) -> list[str]:
    """Put back what can be, and return what cannot. Where the episode ``starts_again`` that is each layer of the same class in
    the same place that was stored whole, its physics left out, and of the others the random generators alone."""
    layers, stored, reasons = _named_layers(env), entry.get("classes", []), []
    present = [layer if [kind] == stored[place : place + 1] else None for place, (kind, layer) in enumerate(layers)]
    lost = entry.get("lost", range(len(stored))) if "reason" in entry else ()
    with decoder.environment(present):
        for place, (layer, attributes) in enumerate(zip(present, entry.get("layers", []), strict=False)):
            for name, node in attributes.items() if layer is not None else ():
                kinds = {*node, node.get("kind")} if isinstance(node, dict) else set()
                if (place in lost and not _GENERATORS & kinds) or (starts_again and "physics" in kinds):
                    continue
                try:
                    _restore_attribute(layer, name, node, decoder)
                except LostValue as error:
                    reasons.append(f"{type(layer).__qualname__}.{name}: {error}")
    for layer in present if starts_again or reasons else ():
        if isinstance(layer, Monitor):
            layer.needs_reset = True
    if lost:
        reasons.append(f"of {', '.join(stored[place] for place in lost)} the random generators alone go on")
    return reasons


def _restore_attribute(layer: Any, name: str, node: Any, decoder: Decoder) -> None:
    if name == _OWN_STATE:
        layer.restore_checkpoint_state(decoder.decode(node))
    elif name.startswith(_OF_CLASS):
        _restore_class_attribute(layer, name.removeprefix(_OF_CLASS), node, decoder)
    elif isinstance(node, dict) and "physics" in node:
        data = getattr(layer, name)
        restore_physics(data.model, data, decoder.decode(node["physics"]))
    else:
        set_attribute(layer, name, node, decoder)


def _restore_class_attribute(layer: Any, name: str, node: Any, decoder: Decoder) -> None:
    class_name, _, attribute = name.rpartition(".")
    kind = next((one for one in type(layer).__mro__ if one.__qualname__ == class_name), None)
    if kind is None or is_library(kind.__module__):
        raise LostValue(f"it was of the class {class_name}, which is not there now")
    existing = class_state(kind).get(attribute)
    value = decoder.decode(node, existing)
    if value is not existing:
        setattr(kind, attribute, value)


def set_attribute(owner: Any, name: str, node: Any, decoder: Decoder) -> None:
    """Put a stored attribute back; what can be changed in place is."""
    existing = vars(owner).get(name)
    value = decoder.decode(node, existing)
    if value is not existing:
        setattr(owner, name, value)


def capture_physics(model: Any, data: Any) -> dict[str, np.ndarray]:
    """The full integration state of an ``MjData``, (n,) float64 under "", and every other array of it by its name, since
    some of them lag behind the state."""
    mujoco = importlib.import_module("mujoco")
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    return {"": state, **{name: np.array(value) for name, value in _physics_arrays(data).items()}}


def restore_physics(model: Any, data: Any, arrays: dict[str, np.ndarray]) -> None:
    """Put back what :func:`capture_physics` returned; ValueError when it is of another simulation."""
    mujoco = importlib.import_module("mujoco")
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    size, own = len(arrays[""]), mujoco.mj_stateSize(model, kind)
    if size != own:
        raise ValueError(
            f"the checkpoint's simulator has a state of size {size}, this one of {own}: use the same task and the same MuJoCo"
        )
    mujoco.mj_setState(model, data, arrays[""], kind)
    mujoco.mj_forward(model, data)
    for name, value in _physics_arrays(data).items():
        stored = arrays.get(name)
        if stored is not None and stored.shape == value.shape:
            value[...] = stored


def _physics_arrays(data: Any) -> dict[str, np.ndarray]:
    """Real arrays of the model's sizes; indices are scratch memory."""
    named = {name: getattr(data, name) for name in dir(data) if not name.startswith(("_", *_IN_ARENA))}
    arrays = {name: value for name, value in named.items() if isinstance(value, np.ndarray)}
    return {name: value for name, value in arrays.items() if value.dtype.kind == "f" and value.size}
