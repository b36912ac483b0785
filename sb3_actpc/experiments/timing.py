"""What ``sb3-actpc bench`` measures beside the update: steps of training, acting, and growth with sizes."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    from sb3_actpc import ActPC
    from sb3_actpc.ngc import NGCCircuit

TASKS = ("SparseHopper-v5", "SparseHalfCheetah-v5")
BATCH_SIZE, WIDTH, N_FILLED = 256, 256, 1000
N_STEPS = 50  # environment steps of one measurement
SWEEP = {"feedback": "learned", "feedback_start": "mirrored"}
# the entry that others are divided by, and what their ratio is called then
TRAINING_UNITS = {f"SB3 TD3, {task}": f"SB3 TD3's time for a step of {task}" for task in TASKS}
ACTING_UNIT = {"NumPy, one observation": "NumPy's time"}

Entries = dict[str, Callable[[], object]]


def training(device: str) -> list[tuple[Entries, dict[str, str]]]:
    """
    Every task's learners, one update for each environment step, batch and layers alike; SBX's where ``sbx-rl`` is installed.

    :param device: torch device
    :return: for every task what is timed, and by what it is divided
    """
    return [(_learners(task, device), {base: unit}) for (base, unit), task in zip(TRAINING_UNITS.items(), TASKS, strict=True)]


def _learners(task: str, device: str) -> Entries:
    from stable_baselines3 import TD3

    from sb3_actpc import ActPC
    from sb3_actpc.experiments.runs import preset

    shared: dict[str, Any] = {"learning_starts": 100, "batch_size": BATCH_SIZE, "buffer_size": 100 * N_FILLED, "seed": 0}
    same: dict[str, Any] = {"train_freq": 1, "gradient_steps": 1, **shared}
    quick = {"prior_updates": 1, "actor_warm_start": 0, "critic_warmup": 0}
    bare: dict[str, Any] = {"policy_kwargs": {"circuit_kwargs": SWEEP}}
    sizes: dict[str, Any] = {"policy_kwargs": {"net_arch": [WIDTH, WIDTH]}}
    models: dict[str, OffPolicyAlgorithm] = {
        f"SB3 TD3, {task}": TD3("MlpPolicy", task, device=device, **sizes, **same),
        f"bare, learned sweep, {task}": ActPC("MlpPolicy", task, device=device, compile=False, **bare, **same),
        f"shipped, {task}": ActPC(env=task, device=device, compile=False, **{**preset(task, "actpc"), **quick, **shared}),
    }
    if find_spec("sbx"):
        import sbx

        models[f"SBX TD3, {task}"] = sbx.TD3("MlpPolicy", task, **sizes, **same)
    return {name: _learner(model) for name, model in models.items()}


def _learner(model: OffPolicyAlgorithm, n_envs: int = 1) -> Callable[[], object]:
    from stable_baselines3.common.logger import configure

    model.set_logger(configure(None, []))
    model.learn(2 * N_STEPS * n_envs)
    return lambda: model.learn(N_STEPS * n_envs, reset_num_timesteps=False)


def acting() -> Entries:
    """One observation through a net of two hidden layers: NumPy's products, and ours on the way that collecting takes."""
    import numpy as np

    from sb3_actpc import ActPC

    agent: ActPC = ActPC("MlpPolicy", TASKS[1], device="cpu", seed=0)
    layers = [(w.numpy(), b.numpy()) for w, b in zip(agent.actor.circuit.weights, agent.actor.circuit.biases, strict=True)]
    observation = np.zeros((1, 17), dtype=np.float32)

    def by_numpy() -> np.ndarray:
        h = observation
        for weights, bias in layers[:-1]:
            h = np.clip(h @ weights.T + bias, 0.0, 6.0)
        return np.tanh(h @ layers[-1][0].T + layers[-1][1])

    circuits = [agent.actor.circuit]
    return {
        "NumPy, one observation": by_numpy,
        "the circuit, one observation": lambda: agent.actor.circuit.project(agent.inputs.tensor(observation)),
        "collecting, one observation": lambda: agent.actor.roll_out(observation, None, None, circuits),
        "predict(), one observation": lambda: agent.predict(observation),
    }


# ---------------------------------------------------------------------- growth


def growth() -> list[tuple[Entries, dict[str, str]]]:
    """
    What grows with K, width, batch and number of environments, over the smallest of its kind, and its matrix products.

    :return: for every kind what is timed, and by what it is divided
    """
    kinds = {
        "K": [(steps, _Size(steps=steps)) for steps in (5, 10, 20, 40)],
        "width": [(width, _Size(width=width)) for width in (128, 256, 512, 1024)],
        "batch": [(batch, _Size(batch=batch)) for batch in (64, 256, 1024)],
    }
    groups = []
    for kind, sizes in kinds.items():
        updates: Entries = {f"one update of eq. 1, {kind} = {value}": size.update() for value, size in sizes}
        products: Entries = {f"its products, {kind} = {value}": size.products() for value, size in sizes}
        unit = f"{kind} = {sizes[0][0]}"
        groups.append((updates | products, {next(iter(entries)): unit for entries in (updates, products)}))
    environments: Entries = {f"{N_STEPS} updates and steps, {n} environments": _environments(n) for n in (1, 4, 16)}
    return [*groups, (environments, {next(iter(environments)): "one environment"})]


class _Size(NamedTuple):
    steps: int = 10
    width: int = 256
    batch: int = 256

    def circuit(self) -> NGCCircuit:
        from sb3_actpc.ngc import NGCCircuit

        return NGCCircuit(24, 6, (self.width, self.width), dynamics="state", n_settling_steps=self.steps)

    def update(self) -> Callable[[], object]:
        import torch as th

        circuit, x, target = self.circuit(), th.randn(self.batch, 24), th.randn(self.batch, 6)
        circuit.optimizer = th.optim.Adam(circuit.parameter_groups(1e-4), fused=True)
        return lambda: circuit.apply_changes(circuit.hebbian_update(circuit.settle(x, target)))

    def products(self) -> Callable[[], object]:
        import torch as th

        wide, narrow = self.circuit().weights[1:]
        hidden, output = th.randn(self.batch, self.width), th.randn(self.batch, 6)
        up, down, change = th.empty_like(hidden), th.empty_like(output), th.empty_like(wide)

        def products() -> None:
            for _ in range(self.steps):
                th.mm(hidden, wide.t(), out=up)
                th.mm(hidden, narrow.t(), out=down)
                th.mm(output, narrow, out=up)
                th.mm(hidden, wide, out=up)
            th.mm(hidden, wide.t(), out=up)  # the projection before
            th.mm(hidden.t(), hidden, out=change)  # the changes after

        return products


def _environments(n: int) -> Callable[[], object]:
    from stable_baselines3.common.env_util import make_vec_env

    from sb3_actpc import ActPC

    keywords: dict[str, Any] = {"batch_size": BATCH_SIZE, "buffer_size": 100 * N_FILLED, "compile": False, "seed": 0}
    model: ActPC = ActPC("MlpPolicy", make_vec_env(TASKS[1], n), device="cpu", gradient_steps=1, **keywords)
    return _learner(model, n)
