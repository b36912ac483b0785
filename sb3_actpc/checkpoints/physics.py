"""MuJoCo's simulation in the middle of an episode."""

import mujoco
import numpy as np

# each step makes these again, and their memory is not always that of the data
_IN_ARENA = ("efc_", "contact", "iefc_", "iM", "iLD", "iacc", "ifrc_")
_KIND = mujoco.mjtState.mjSTATE_INTEGRATION


def physics_arrays(data: mujoco.MjData) -> dict[str, np.ndarray]:
    """The real arrays whose sizes the model sets, by name; indices are scratch memory."""
    named = {name: getattr(data, name) for name in dir(data) if not name.startswith(("_", *_IN_ARENA))}
    arrays = {name: value for name, value in named.items() if isinstance(value, np.ndarray)}
    return {name: value for name, value in arrays.items() if value.dtype.kind == "f" and value.size}


def capture_physics(data: mujoco.MjData) -> dict[str, np.ndarray]:
    """The full integration state, (n,) float64 under "", and copies of the other arrays, since some lag behind the state."""
    state = np.empty(mujoco.mj_stateSize(data.model, _KIND))
    mujoco.mj_getState(data.model, data, state, _KIND)
    return {"": state, **{name: np.array(value) for name, value in physics_arrays(data).items()}}


def restore_physics(data: mujoco.MjData, arrays: dict[str, np.ndarray]) -> None:
    """Put back what :func:`capture_physics` returned; ValueError when it is of another simulation."""
    size, own = len(arrays[""]), mujoco.mj_stateSize(data.model, _KIND)
    if size != own:
        raise ValueError(f"the simulator had {size} state variables, this one has {own}")
    mujoco.mj_setState(data.model, data, arrays[""], _KIND)
    mujoco.mj_forward(data.model, data)
    for name, value in physics_arrays(data).items():
        if name in arrays and arrays[name].shape == value.shape:
            value[...] = arrays[name]
