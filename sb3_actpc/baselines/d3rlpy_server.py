"""BCQ and CQL by d3rlpy: a program that runs in d3rlpy's own virtual environment (see :mod:`sb3_actpc.baselines.served`).

It imports only the standard library, numpy, torch and d3rlpy. Its argument is the number of a pipe, through which it is given
the names and arguments of :class:`Server`'s methods, and sends back whether one succeeded, with its result or its error.
"""

import io
import random
import sys
import traceback
from contextlib import redirect_stderr
from dataclasses import fields
from multiprocessing.connection import Connection
from typing import Any

import numpy as np


class Server:
    """Builds, trains and plays one of d3rlpy's algorithms."""

    def build(
        self, method: str, n_inputs: int, n_actions: int, batch_size: int, seed: int, kwargs: dict[str, Any], trained: bytes
    ) -> None:
        """``kwargs`` are those of d3rlpy's config, and ``net_arch``, the hidden sizes of all networks; ``trained`` is what
        :meth:`save` returned, or empty."""
        with redirect_stderr(io.StringIO()):  # old Gym, which it imports, complains at length
            import d3rlpy

        random.seed(seed)
        d3rlpy.seed(seed)
        hidden = d3rlpy.models.VectorEncoderFactory(hidden_units=kwargs.pop("net_arch", [256, 256]))
        config = getattr(d3rlpy.algos, f"{method}Config")
        encoders = {field.name: hidden for field in fields(config) if field.name.endswith("_encoder_factory")}
        self.algorithm = config(batch_size=batch_size, **encoders, **kwargs).create(device=False)
        self.algorithm.create_impl((n_inputs,), n_actions)
        if trained:
            self.algorithm.impl.load_model(io.BytesIO(trained))

    def train(self, batch: dict[str, np.ndarray]) -> dict[str, float]:
        """One update on (B, ...) observations, actions, rewards, next_observations and terminals: the losses."""
        from d3rlpy.dataset import TransitionMiniBatch

        # neither method reads the next actions
        unused = {"next_actions": np.zeros_like(batch["actions"]), "transitions": []}
        intervals = np.ones_like(batch["rewards"])
        losses = self.algorithm.update(TransitionMiniBatch(**batch, **unused, intervals=intervals))
        return {name: float(loss) for name, loss in losses.items()}

    def predict(self, observations: np.ndarray) -> np.ndarray:
        """Actions (n, A) for observations (n, obs_dim)."""
        return self.algorithm.predict(observations).astype(np.float32)

    def save(self) -> bytes:
        """All parameters, those of the optimisers too."""
        buffer = io.BytesIO()
        self.algorithm.impl.save_model(buffer)
        return buffer.getvalue()


def serve(server: Any) -> None:
    """Call the methods that are asked for, until the other side closes the pipe."""
    channel = Connection(int(sys.argv[-1]))
    while True:
        try:
            method, arguments = channel.recv()
        except EOFError:
            return
        try:
            channel.send((True, getattr(server, method)(*arguments)))
        except Exception as error:
            traceback.print_exc()
            channel.send((False, f"{type(error).__name__}: {error}"))


if __name__ == "__main__":
    serve(Server())
