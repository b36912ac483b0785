"""HBC and IRIS by robomimic, in robomimic's own virtual environment (see :mod:`sb3_actpc.baselines.offline.served`).

The observation is one low-dimensional key, ``flat``. Sequences are drawn as robomimic's ``SequenceDataset`` draws them: from
any transition on, the last one repeated beyond the end of the episode.
"""

import io
import random
import sys
import types
from typing import Any

import numpy as np
from frames import Arrays, Values, serve

KEY = "flat"


class Server:
    """Builds, trains and plays one of robomimic's hierarchical algorithms."""

    algorithm: Any
    transitions: Arrays

    def build(self, values: Values, arrays: Arrays) -> None:
        """``method_kwargs`` are of the ``algo`` part of robomimic's config."""
        stand_in_for_torchvision()
        import torch
        from robomimic.algo import algo_factory
        from robomimic.config import config_factory
        from robomimic.utils.obs_utils import initialize_obs_utils_with_config

        random.seed(values["seed"])
        torch.manual_seed(values["seed"])
        self.random = np.random.default_rng(values["seed"])
        self.batch_size = values["batch_size"]
        config = config_factory(values["method"])
        with config.values_unlocked():
            update(config.algo, values["method_kwargs"], "method_kwargs")
            planner = config.observation.planner if values["method"] == "hbc" else config.observation.value_planner.planner
            parts = [planner, config.observation.actor]
            if values["method"] == "iris":
                parts.append(config.observation.value_planner.value)
            for part in parts:
                part.modalities.obs.low_dim = [KEY]
            planner.modalities.subgoal.low_dim = [KEY]
        if not config.algo.actor.rnn.enabled:
            raise ValueError("method_kwargs.actor.rnn.enabled must be true: the actor that follows subgoals is recurrent here")
        self.interval, self.horizon = config.algo.subgoal_update_interval, config.algo.actor.rnn.horizon
        of_planner = config.algo.planner if values["method"] == "hbc" else config.algo.value_planner.planner
        self.length = of_planner.subgoal_horizon
        if self.horizon != self.length:
            raise ValueError(f"actor.rnn.horizon must be the subgoal_horizon {self.length}, found {self.horizon}")
        initialize_obs_utils_with_config(config)
        self.algorithm = algo_factory(
            values["method"], config, {KEY: [values["n_observations"]]}, values["n_actions"], torch.device("cpu")
        )

    def show(self, values: Values, arrays: Arrays) -> None:
        """Transitions to learn from."""
        self.transitions = arrays

    def train(self, values: Values, arrays: Arrays) -> tuple[Values, Arrays]:
        """One update of every part."""
        import torch

        shown = self.transitions
        starts = self.random.integers(len(shown["actions"]), size=self.batch_size)
        rows = np.minimum(starts[:, None] + np.arange(self.length), shown["last_rows"][starts, None])
        columns = {name: array[rows] for name, array in shown.items() if name != "last_rows"}
        drawn = {name: torch.from_numpy(column.astype(np.float32)) for name, column in columns.items()}
        batch = {
            "obs": {KEY: drawn["observations"]},
            "next_obs": {KEY: drawn["next_observations"]},
            "actions": drawn["actions"],
            "rewards": drawn["rewards"],
            "dones": drawn["terminations"],
        }
        self.algorithm.set_train()
        info = self.algorithm.train_on_batch(self.algorithm.process_batch_for_training(batch), epoch=0)
        log = self.algorithm.log_info(info)
        return {name.replace("/", "_").lower(): float(log[name]) for name in log if name.endswith("Loss")}, {}

    def predict(self, values: Values, arrays: Arrays) -> tuple[Values, Arrays]:
        """As robomimic's ``get_action``, for n episodes that need not begin together: a new subgoal every
        ``subgoal_update_interval`` steps, the actor's memory emptied every ``horizon`` steps. The state is state_subgoals
        (n, obs_dim), state_age (n,) and state_memory (n, n_memory).
        """
        import torch

        self.algorithm.set_eval()
        observations = torch.from_numpy(arrays["observations"].astype(np.float32))
        age = np.where(arrays["episode_starts"], 0, arrays.get("state_age", np.zeros(len(observations), dtype=np.int64)))
        policy = self.algorithm.actor.nets["policy"]
        with torch.no_grad():
            subgoals = self.subgoals(observations, age % self.interval == 0, arrays.get("state_subgoals"))
            empty = policy.get_rnn_init_state(batch_size=len(observations), device=torch.device("cpu"))
            memory = self.unflatten(arrays["state_memory"], empty) if "state_memory" in arrays else empty
            keep = torch.from_numpy(age % self.horizon != 0)[None, :, None]
            memory = tuple(torch.where(keep, old, new) for old, new in zip(parts_of(memory), parts_of(empty), strict=True))
            actions, after = policy.forward_step(
                {KEY: observations},
                goal_dict={KEY: subgoals},
                rnn_state=memory if isinstance(empty, tuple) else memory[0],
            )
        flat = torch.cat([part.transpose(0, 1).flatten(1) for part in parts_of(after)], dim=1)
        state = {"state_subgoals": subgoals.numpy(), "state_age": age + 1, "state_memory": flat.numpy()}
        return {}, {"actions": actions.numpy(), **state}

    def subgoals(self, observations: Any, is_due: np.ndarray, before: np.ndarray | None) -> Any:
        """The subgoals ``before``, (n, obs_dim), or new ones where they are due, (n,)."""
        import torch

        subgoals = torch.zeros_like(observations) if before is None else torch.from_numpy(before.copy())
        if is_due.any():
            due = torch.from_numpy(is_due)
            subgoals[due] = self.algorithm.planner.get_subgoal_predictions(obs_dict={KEY: observations[due]})[KEY]
        return subgoals

    def unflatten(self, memory: np.ndarray, like: Any) -> tuple[Any, ...]:
        """The parts of a memory, each (n_layers, n, hidden_size), as those of ``like``, from (n, n_memory)."""
        import torch

        parts = parts_of(like)
        n_layers, n, hidden = parts[0].shape
        pieces = torch.from_numpy(memory.copy()).view(n, len(parts), n_layers, hidden)
        return tuple(pieces[:, index].transpose(0, 1).contiguous() for index in range(len(parts)))

    def save(self, values: Values, arrays: Arrays) -> tuple[Values, Arrays]:
        """robomimic keeps none of its optimisers."""
        import torch

        buffer = io.BytesIO()
        torch.save(self.algorithm.serialize(), buffer)
        return {}, {"parameters": np.frombuffer(buffer.getvalue(), dtype=np.uint8)}

    def load(self, values: Values, arrays: Arrays) -> None:
        """What :meth:`save` returned."""
        import torch

        self.algorithm.deserialize(torch.load(io.BytesIO(arrays["parameters"].tobytes()), weights_only=True))


def parts_of(memory: Any) -> tuple[Any, ...]:
    """Both parts of an LSTM's memory, or the one of a GRU's."""
    return memory if isinstance(memory, tuple) else (memory,)


def update(config: Any, values: dict[str, Any], where: str) -> None:
    """Change values, mappings in mappings, in a part of robomimic's config, which the user calls ``where``; ValueError for a
    key that it does not have."""
    for key, value in values.items():
        if key not in config:
            raise ValueError(f"{where} has no setting {key!r}: choose one of {', '.join(sorted(config))}")
        if isinstance(value, dict) != isinstance(config[key], dict):
            kind = "a mapping" if isinstance(config[key], dict) else "a plain value"
            raise ValueError(f"{where}.{key}={value!r} must be {kind}")
        if isinstance(value, dict):
            update(config[key], value, f"{where}.{key}")
        else:
            config[key] = value


def stand_in_for_torchvision() -> None:
    """robomimic imports torchvision for images, which are not used here, and its wheels do not fit every build of torch."""
    try:
        import torchvision  # noqa: F401
    except (ImportError, OSError, RuntimeError):
        names = ("torchvision", "torchvision.transforms", "torchvision.transforms.functional", "torchvision.models")
        modules = {name: types.ModuleType(name) for name in names}
        for name, module in modules.items():
            parent, _, child = name.rpartition(".")
            if parent:
                setattr(modules[parent], child, module)
        for name in ("Lambda", "Compose"):
            setattr(modules["torchvision.transforms"], name, object)
        sys.modules.update(modules)


if __name__ == "__main__":
    sys.exit(serve(Server()))
