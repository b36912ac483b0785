"""BCQ and CQL by d3rlpy, in d3rlpy's own virtual environment (see :mod:`sb3_actpc.baselines.offline.served`)."""

import io
import random
import sys
from typing import Any

import numpy as np
from frames import Arrays, Values, serve


class Server:
    """Builds, trains and plays one of d3rlpy's algorithms."""

    algorithm: Any
    transitions: Arrays

    def build(self, values: Values, arrays: Arrays) -> None:
        """``method_kwargs`` are those of d3rlpy's config, and ``net_arch``, the hidden sizes of all networks."""
        import d3rlpy

        random.seed(values["seed"])
        d3rlpy.seed(values["seed"])
        self.random = np.random.default_rng(values["seed"])
        kwargs = dict(values["method_kwargs"])
        hidden = d3rlpy.models.VectorEncoderFactory(hidden_units=kwargs.pop("net_arch", [256, 256]))
        parts = {"bcq": ("actor", "critic", "imitator"), "cql": ("actor", "critic")}[values["method"]]
        config = {"bcq": d3rlpy.algos.BCQConfig, "cql": d3rlpy.algos.CQLConfig}[values["method"]]
        encoders = {f"{part}_encoder_factory": hidden for part in parts}
        self.algorithm = config(batch_size=values["batch_size"], **encoders, **kwargs).create(device=False)
        self.algorithm.create_impl((values["n_observations"],), values["n_actions"])

    def show(self, values: Values, arrays: Arrays) -> None:
        """Transitions to learn from."""
        self.transitions = arrays

    def train(self, values: Values, arrays: Arrays) -> tuple[Values, Arrays]:
        """One update."""
        from d3rlpy.dataset import TransitionMiniBatch

        rows = self.random.integers(len(self.transitions["actions"]), size=self.algorithm.batch_size)
        drawn = {name: array[rows] for name, array in self.transitions.items()}
        batch = TransitionMiniBatch(
            observations=drawn["observations"],
            actions=drawn["actions"],
            rewards=drawn["rewards"][:, None],
            next_observations=drawn["next_observations"],
            next_actions=np.zeros_like(drawn["actions"]),  # neither method reads them
            terminals=drawn["terminations"].astype(np.float32)[:, None],
            intervals=np.ones((len(rows), 1), dtype=np.float32),
            transitions=[],
        )
        return {name: float(loss) for name, loss in self.algorithm.update(batch).items()}, {}

    def predict(self, values: Values, arrays: Arrays) -> tuple[Values, Arrays]:
        """Actions (n, A)."""
        return {}, {"actions": self.algorithm.predict(arrays["observations"]).astype(np.float32)}

    def save(self, values: Values, arrays: Arrays) -> tuple[Values, Arrays]:
        """Those of the optimisers too."""
        buffer = io.BytesIO()
        self.algorithm.impl.save_model(buffer)
        return {}, {"parameters": np.frombuffer(buffer.getvalue(), dtype=np.uint8)}

    def load(self, values: Values, arrays: Arrays) -> None:
        """What :meth:`save` returned."""
        self.algorithm.impl.load_model(io.BytesIO(arrays["parameters"].tobytes()))


if __name__ == "__main__":
    sys.exit(serve(Server()))
