"""An update as a CUDA graph: its kernels are recorded once, and launched together from then on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch as th

# updates that run as ever before one of their kind is recorded: optimisers and libraries set up what they need
N_WARM_UP = 2


class CapturedUpdate:
    """
    An update that changes synapses in place, recorded once for every kind of batch and replayed.

    Launching some hundred small kernels one by one takes longer than running them. The graph reads copies of what it is given
    and the synapses where they lie; where these, or an optimiser's averages, have moved, or a setting has changed, it is
    recorded anew.

    :param update: of a nested tuple of tensors and Nones; it must not wait for the GPU
    :param optimizers: those that it steps; the graph follows their learning rates
    :param settings: the numbers that the update reads beside tensors, which are constants of a graph
    :raises RuntimeError: when called, for an update that cannot be recorded
    """

    def __init__(
        self, update: Callable[[Any], None], optimizers: list[th.optim.Optimizer], settings: Callable[[], tuple[Any, ...]]
    ) -> None:
        self.update, self.optimizers, self.settings = update, optimizers, settings
        self._rates: list[th.Tensor] = []  # learning rates, which a schedule moves, as the graphs read them
        self._set: list[float] = []
        self._n_seen: dict[Any, int] = {}
        self._recorded: dict[Any, tuple[Any, list[th.Tensor]]] = {}  # graph, and what it reads

    def __call__(self, given: Any) -> None:
        tensors = list(_tensors(given))
        shapes = [_shape(part) for part in _parts(given)]
        kind = (*shapes, *_same(tensors), *self._addresses(), *self.settings())
        if kind not in self._recorded:
            self._n_seen[kind] = self._n_seen.get(kind, 0) + 1
            if self._n_seen[kind] <= N_WARM_UP:
                self.update(given)
                return
            self._recorded[kind] = self._record(given)
        graph, copies = self._recorded[kind]
        self._follow_rates()
        th._foreach_copy_(copies, list({id(tensor): tensor for tensor in tensors}.values()))
        graph.replay()

    @property
    def _groups(self) -> list[dict[str, Any]]:
        """Of parameters; a loaded file's are others."""
        return [group for optimizer in self.optimizers for group in optimizer.param_groups]

    def _record(self, given: Any) -> tuple[Any, list[th.Tensor]]:
        copies = {id(tensor): th.empty_like(tensor) for tensor in _tensors(given)}
        graph = new_graph()
        with self._rates_as_tensors(), capture(graph):
            self.update(_replaced(given, copies))
        return graph, list(copies.values())

    @contextmanager
    def _rates_as_tensors(self) -> Iterator[None]:
        """A number would be a constant of the graph."""
        groups = self._groups
        if not self._rates:
            self._rates = [th.zeros((), device=group["params"][0].device) for group in groups]
            self._set = [0.0] * len(groups)
        before = [(group["lr"], group["capturable"]) for group in groups]
        try:
            for group, rate in zip(groups, self._rates, strict=True):
                group["lr"], group["capturable"] = rate, True
            yield
        finally:
            for group, (rate, capturable) in zip(groups, before, strict=True):
                group["lr"], group["capturable"] = rate, capturable

    def _follow_rates(self) -> None:
        for index, (group, rate) in enumerate(zip(self._groups, self._rates, strict=True)):
            if group["lr"] != self._set[index]:
                self._set[index] = group["lr"]
                rate.fill_(group["lr"])

    def _addresses(self) -> Iterator[int]:
        """Where every optimiser's first synapses lie, and their averages; a loaded file's lie elsewhere."""
        for optimizer in self.optimizers:
            first = optimizer.param_groups[0]["params"][0]
            yield first.data_ptr()
            for value in optimizer.state.get(first, {}).values():
                if isinstance(value, th.Tensor):
                    yield value.data_ptr()


def new_graph() -> Any:
    """A CUDA graph."""
    return th.cuda.CUDAGraph()


def capture(graph: Any) -> Any:
    """While this context lasts, kernels are recorded into the graph and do not run."""
    return th.cuda.graph(graph)


def _parts(given: Any) -> Iterator[Any]:
    """Tensors and Nones, depth first."""
    for part in given:
        if isinstance(part, tuple):
            yield from _parts(part)
        else:
            yield part


def _tensors(given: Any) -> Iterator[th.Tensor]:
    return (part for part in _parts(given) if part is not None)


def _shape(part: th.Tensor | None) -> tuple[int, ...] | None:
    return None if part is None else tuple(part.shape)


def _same(tensors: list[th.Tensor]) -> list[int]:
    """Of every tensor, which one of them it is: circuits with one batch size are given one batch."""
    first: dict[int, int] = {}
    return [first.setdefault(id(tensor), index) for index, tensor in enumerate(tensors)]


def _replaced(given: Any, copies: dict[int, th.Tensor]) -> Any:
    if given is None:
        return None
    if isinstance(given, th.Tensor):
        return copies[id(given)]
    parts = [_replaced(part, copies) for part in given]
    return type(given)(*parts) if hasattr(given, "_fields") else tuple(parts)
