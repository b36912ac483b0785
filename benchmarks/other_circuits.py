"""One update of the same circuit in other libraries of predictive coding: batch 256, 24-256-256-6, K = 10, tied, Adam.

    python benchmarks/other_circuits.py ours
    python benchmarks/other_circuits.py ngclearn      # pip install sb3-actpc[bench]
    python benchmarks/other_circuits.py pcx           # pip install pcx, in an environment of its own: it needs jax < 0.5

Prints the median processor time of projection, ten settling steps and change, in milliseconds. They do not fit into one
environment, so that each is measured by a call of its own; take turns, and compare medians of several. JAX compiles the whole
update of pcx; ngc-learn's processes (projection, step, change) are compiled one by one, its way of use.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np

BATCH_SIZE, SIZES, N_STEPS, RATE = 256, (24, 256, 256, 6), 10, 4e-4
BETA = 0.1  # of the states


def data() -> tuple[np.ndarray, np.ndarray]:
    """Inputs and targets of one batch."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(BATCH_SIZE, SIZES[0])).astype(np.float32)
    return x, np.sin(x[:, : SIZES[-1]])


def ours() -> Callable[[], object]:
    """Eq. 1 to the letter."""
    import torch as th

    from sb3_actpc.ngc import NGCCircuit

    th.set_num_threads(1)
    settling = {"dynamics": "state", "n_settling_steps": N_STEPS, "settling_rate": BETA}
    circuit = NGCCircuit(SIZES[0], SIZES[-1], SIZES[1:-1], feedback="tied", activation="tanh", **settling)
    circuit.optimizer = th.optim.Adam(circuit.parameter_groups(RATE), fused=True)
    x, target = map(th.as_tensor, data())
    return lambda: circuit.apply_changes(circuit.hebbian_update(circuit.settle(x, target)))


def pcx() -> Callable[[], object]:
    """As in its documentation: energies, their gradients by autograd, and one compiled function for the update."""
    import jax
    import optax
    import pcx.functional as pxf
    import pcx.nn as pxnn
    import pcx.predictive_coding as pxc
    import pcx.utils as pxu

    class Circuit(pxc.EnergyModule):
        def __init__(self) -> None:
            super().__init__()
            self.layers = [pxnn.Linear(n_in, n_out) for n_in, n_out in pairwise(SIZES)]
            self.vodes = [pxc.Vode() for _ in self.layers]
            self.vodes[-1].h.frozen = True

        def __call__(self, x: jax.Array, target: jax.Array | None) -> jax.Array:
            for layer, vode in zip(self.layers, self.vodes, strict=True):
                x = vode(layer(x if layer is self.layers[0] else jax.nn.tanh(x)))
            if target is not None:
                self.vodes[-1].set("h", target)
            return self.vodes[-1].get("u")

    states = pxu.M(pxc.VodeParam | pxc.VodeParam.Cache).to((None, 0))

    @pxf.vmap(states, in_axes=(0, 0), out_axes=0)
    def project(x: jax.Array, target: jax.Array, *, model: Circuit) -> jax.Array:
        return model(x, target)

    @pxf.vmap(states, in_axes=(0,), out_axes=(None, 0), axis_name="batch")
    def energy(x: jax.Array, *, model: Circuit) -> tuple[jax.Array, jax.Array]:
        output = model(x, None)
        return jax.lax.psum(model.energy(), "batch"), output

    @pxf.jit()
    def update(x: jax.Array, target: jax.Array, *, model: Circuit, of_states: pxu.Optim, of_weights: pxu.Optim) -> None:
        model.train()
        with pxu.step(model, pxc.STATUS.INIT, clear_params=pxc.VodeParam.Cache):
            project(x, target, model=model)
        of_states.init(pxu.M_hasnot(pxc.VodeParam, frozen=True)(model))
        for _ in range(N_STEPS):
            with pxu.step(model, clear_params=pxc.VodeParam.Cache):
                gradient = pxf.value_and_grad(pxu.M_hasnot(pxc.VodeParam, frozen=True).to([False, True]), has_aux=True)(energy)
                _, change = gradient(x, model=model)
            of_states.step(model, change["model"])
        of_states.clear()
        with pxu.step(model, clear_params=pxc.VodeParam.Cache):
            _, change = pxf.value_and_grad(pxu.M(pxnn.LayerParam).to([False, True]), has_aux=True)(energy)(x, model=model)
        of_weights.step(model, change["model"], scale_by=1.0 / BATCH_SIZE)

    model = Circuit()
    x, target = map(jax.numpy.asarray, data())
    with pxu.step(model, pxc.STATUS.INIT, clear_params=pxc.VodeParam.Cache):
        project(x, target, model=model)
    of_states = pxu.Optim(lambda: optax.sgd(BETA))
    of_weights = pxu.Optim(lambda: optax.adam(RATE), pxu.M(pxnn.LayerParam)(model))

    def one() -> None:
        update(x, target, model=model, of_states=of_states, of_weights=of_weights)
        jax.block_until_ready(model.layers[0].nn.weight.get())

    return one


def ngclearn() -> Callable[[], object]:
    """Rate and error cells joined by Hebbian synapses; feedback is set to their transposes, and states go on from the last."""
    import jax
    from ngclearn import MethodProcess
    from ngclearn.components import GaussianErrorCell, HebbianSynapse, RateCell, StaticSynapse
    from ngclearn.utils.distribution_generator import DistributionGenerator
    from ngcsimlib.context import Context

    keys = iter(jax.random.split(jax.random.PRNGKey(0), 12))
    with Context("circuit"):
        cells = [
            RateCell(
                f"z{layer}",
                n_units=n,
                tau_m=1.0 / BETA if 0 < layer < 3 else 0.0,
                act_fx="tanh" if 0 < layer < 3 else "identity",
                batch_size=BATCH_SIZE,
                key=next(keys),
            )
            for layer, n in enumerate(SIZES)
        ]
        errors = [GaussianErrorCell(f"e{layer}", n_units=n, batch_size=BATCH_SIZE) for layer, n in enumerate(SIZES) if layer]
        up = [
            HebbianSynapse(
                f"W{layer}",
                shape=(SIZES[layer - 1], SIZES[layer]),
                eta=RATE,
                optim_type="adam",
                weight_init=DistributionGenerator.uniform(-0.0625, 0.0625),
                bias_init=DistributionGenerator.constant(0.0),
                sign_value=-1.0,
                batch_size=BATCH_SIZE,
                key=next(keys),
            )
            for layer in (1, 2, 3)
        ]
        down = [
            StaticSynapse(f"E{layer}", shape=(SIZES[layer], SIZES[layer - 1]), batch_size=BATCH_SIZE, key=next(keys))
            for layer in (2, 3)
        ]
        for synapse, source, error, cell in zip(up, cells[:-1], errors, cells[1:], strict=True):
            source.zF >> synapse.inputs
            synapse.outputs >> error.mu
            cell.z >> error.target
            source.zF >> synapse.pre
            error.dmu >> synapse.post
        for synapse, error, own, cell in zip(down, errors[1:], errors[:-1], cells[1:-1], strict=True):
            error.dmu >> synapse.inputs
            synapse.outputs >> cell.j
            own.dtarget >> cell.j_td
        step, change = MethodProcess("step"), MethodProcess("change")
        for part in (*down, *cells, *up, *errors):
            step = step >> part.advance_state
        for part in up:
            change = change >> part.evolve
    x, target = map(jax.numpy.asarray, data())

    def one() -> None:
        for synapse, other in zip(down, up[1:], strict=True):
            synapse.weights.set(other.weights.get().T)
        for k in range(N_STEPS):
            cells[0].j.set(x)
            cells[-1].j.set(target)
            step.run(t=float(k), dt=1.0)
        change.run(t=float(N_STEPS), dt=1.0)
        jax.block_until_ready(up[0].weights.get())

    return one


def main() -> None:
    """Parse, time, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("package", choices=["ours", "ngclearn", "pcx"])
    parser.add_argument("--rounds", type=int, default=50)
    args = parser.parse_args()
    update, times = {"ours": ours, "ngclearn": ngclearn, "pcx": pcx}[args.package](), []
    for _ in range(args.rounds + 3):
        start = time.process_time()
        update()
        times.append(time.process_time() - start)
    print(f"{args.package}: {1000 * statistics.median(times[3:]):.1f} ms, at least {1000 * min(times[3:]):.1f}")


if __name__ == "__main__":
    main()
