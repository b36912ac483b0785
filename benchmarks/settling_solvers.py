"""What each way to settle reaches for the matrix products it spends, on circuits that have learned.

    python benchmarks/settling_solvers.py --updates 3000 --output benchmarks/results/settling_solvers.csv

A critic (6 outputs with one target) and a generator (17 outputs) learn HalfCheetah transitions under smooth random actions, by
the sweep. Then one batch is settled by each solver, and compared with the state after 2,500 small steps of eq. 1: energy over
the projection's, and the cosine of the changes it asks for, first layer to last. A unit is one product of 256 x 256; the
projection before (1) and the changes after (1) are every solver's.
"""

import argparse
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th

from sb3_actpc.ngc import NGCCircuit, SettledState

BATCH_SIZE, WIDTH, REFERENCE_STEPS = 256, 256, 2500


def transitions(n: int = 6000) -> dict[str, th.Tensor]:
    """Normalised observations, actions, rewards and next observations, (n, ·) each."""
    env, rng = gym.make("HalfCheetah-v5"), np.random.default_rng(0)
    rows: list[tuple[np.ndarray, ...]] = []
    observation, _ = env.reset(seed=0)
    action = np.zeros(6)
    for _ in range(n):
        action = 0.8 * action + 0.5 * rng.normal(size=6)
        clipped = np.clip(action, -1, 1)
        following, reward, _, over, _ = env.step(clipped)
        rows.append((observation, clipped, np.array([float(reward)]), following))
        observation = env.reset()[0] if over else following
    values = zip("oarn", zip(*rows, strict=True), strict=True)
    columns = {name: th.as_tensor(np.array(column), dtype=th.float32) for name, column in values}
    mean, std = columns["o"].mean(0), columns["o"].std(0)
    return {**columns, "o": (columns["o"] - mean) / std, "n": (columns["n"] - mean) / std}


def draw(data: dict[str, th.Tensor], kind: str) -> tuple[th.Tensor, th.Tensor]:
    """Inputs and targets of one batch."""
    rows = th.randint(0, len(data["o"]), (BATCH_SIZE,))
    target = (3 * data["r"][rows]).expand(-1, 6) if kind == "critic" else data["n"][rows]
    return th.cat([data["o"][rows], data["a"][rows]], dim=1), target


def learned(data: dict[str, th.Tensor], kind: str, n_updates: int) -> NGCCircuit:
    """A circuit after ``n_updates`` sweeps."""
    circuit = NGCCircuit(23, 6 if kind == "critic" else 17, (WIDTH, WIDTH), settling="scheduled")
    circuit.optimizer = th.optim.Adam(circuit.parameter_groups(4e-4), fused=True)
    for _ in range(n_updates):
        circuit.apply_changes(circuit.hebbian_update(circuit.settle(*draw(data, kind))))
    return circuit


def solve(circuit: NGCCircuit, solver: str, steps: int, x: th.Tensor, target: th.Tensor) -> SettledState:
    """The state after ``steps`` steps."""
    twin = NGCCircuit(circuit.sizes[0], circuit.sizes[-1], circuit.sizes[1:-1], **keywords_of(solver, steps))
    twin.load_state_dict(circuit.state_dict(), strict=False)
    if solver == "state":
        twin.update_settling_rates(30)
    return twin.settle(x, target)


def keywords_of(solver: str, steps: int) -> dict:
    """Of the circuit that settles so."""
    if solver == "sweep":
        return {"settling": "scheduled"}
    return {"dynamics": solver, "n_settling_steps": steps, "settling_tolerance": 0.0}


def compare(data: dict[str, th.Tensor], kind: str, n_updates: int) -> list[dict]:
    """A row for each solver and number of steps."""
    circuit = learned(data, kind, n_updates)
    x, target = draw(data, kind)
    start = 0.5 * (target - circuit.project(x)).square().sum(1).mean()
    rest = circuit.hebbian_update(solve(circuit, "state", REFERENCE_STEPS, x, target)).weights
    solvers = [
        ("sweep", 0),
        *(("state", k) for k in (10, 100)),
        *(("krylov", k) for k in (1, 2, 3, 4, 6)),
    ]
    rows = []
    for solver, steps in solvers:
        state = solve(circuit, solver, steps, x, target)
        cosines = [
            float(th.nn.functional.cosine_similarity(a.flatten(), b.flatten(), dim=0))
            for a, b in zip(circuit.hebbian_update(state).weights, rest, strict=True)
        ]
        energy = float(state.total_discrepancy().mean() / start) if steps else float("nan")
        rows.append(
            {
                "circuit": kind,
                "solver": solver,
                "steps": steps,
                "products": 2 * steps or 1,
                "energy over the projection's": round(energy, 3),
                **{f"cosine, layer {layer}": round(cosine, 3) for layer, cosine in enumerate(cosines, start=1)},
            }
        )
    return rows


def main() -> None:
    """Learn, settle, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", type=int, default=3000)
    parser.add_argument("--output", type=Path, default=None)
    args = parser.parse_args()
    th.manual_seed(0)
    data = transitions()
    table = pd.DataFrame([row for kind in ("critic", "generator") for row in compare(data, kind, args.updates)])
    print(table.to_string(index=False))
    if args.output:
        table.to_csv(args.output, index=False)


if __name__ == "__main__":
    main()
