"""An update as a CUDA graph: its kernels are recorded once, and launched together from then on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch as th

from sb3_actpc.actpc.transfer import map_nested

# updates that run as ever before one of their kind is recorded: optimisers and libraries set up what they need
N_WARM_UP = 2
MOST_KINDS = 8  # of updates, each of which has a graph; then all are recorded anew


class CapturedUpdate:
    """
    An update that changes synapses in place, recorded once for every kind of batch and replayed.

    Launching some hundred small kernels one by one takes longer than running them. The graph reads copies of what it is given
    and the synapses where they lie; where these, or an optimiser's averages, have moved, or a setting has changed, it is
    recorded anew.

    :param update: of a nested tuple of tensors and Nones; it must not wait for the GPU
    :param stepped: the optimisers that it steps, which go with what it is given; the graph follows their learning rates
    :param settings: the numbers that the update reads beside tensors, which are constants of a graph
    """

    def __init__(
        self,
        update: Callable[[Any], None],
        stepped: Callable[[Any], list[th.optim.Optimizer]],
        settings: Callable[[], tuple[Any, ...]],
    ) -> None:
        self.update, self.stepped, self.settings = update, stepped, settings
        self._n_seen: dict[Any, int] = {}
        self._recorded: dict[Any, _Recorded] = {}

    def prepared(self, given: Any) -> Callable[[], None]:
        """
        :param given: what the update is of
        :return: what makes it; until then nothing has changed
        :raises RuntimeError: for an update that cannot be recorded
        """
        optimizers = self.stepped(given)
        state = [value for optimizer in optimizers for value in _state_of(optimizer)]
        # an optimiser that has just begun would be recorded as it begins
        has_begun = all(optimizer.state for optimizer in optimizers)
        if not has_begun:
            return partial(self.update, given)
        tensors = list(_tensors(given))
        shapes = [_shape(part) for part in _parts(given)]
        kind = (*shapes, *_same(tensors), *[one.data_ptr() for one in state], *_numbers(optimizers), *self.settings())
        if kind not in self._recorded:
            self._forget_others()
            self._n_seen[kind] = self._n_seen.get(kind, 0) + 1
            if self._n_seen[kind] <= N_WARM_UP:
                return partial(self.update, given)
            self._recorded[kind] = self._record(given, optimizers, state)
        return partial(self._recorded[kind].replay, list({id(tensor): tensor for tensor in tensors}.values()))

    def _forget_others(self) -> None:
        if max(len(self._recorded), len(self._n_seen)) >= MOST_KINDS:
            self._recorded, self._n_seen = {}, {}

    def _record(self, given: Any, optimizers: list[th.optim.Optimizer], state: list[th.Tensor]) -> _Recorded:
        copies = {id(tensor): th.empty_like(tensor) for tensor in _tensors(given)}
        device = state[0].device
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        rates = [th.zeros((), device=device) for _ in groups]
        graph = th.cuda.CUDAGraph()
        # while this lasts kernels are recorded and do not run
        with _with_rates(groups, rates), th.cuda.graph(graph, stream=th.cuda.Stream(device)):
            self.update(map_nested(lambda tensor: copies[id(tensor)], given))
        return _Recorded(graph, list(copies.values()), groups, rates, state)


@dataclass
class _Recorded:
    """
    A graph and what it reads.

    :param copies: of what the update is given
    :param groups: of parameters, whose learning rates a schedule moves
    :param rates: these as the graph reads them
    :param state: synapses and optimisers' averages, whose memory is nobody else's while there is a graph
    """

    graph: Any
    copies: list[th.Tensor]
    groups: list[dict[str, Any]]
    rates: list[th.Tensor]
    state: list[th.Tensor]
    numbers: list[float] = field(default_factory=list)  # the rates as they were set last

    def replay(self, tensors: list[th.Tensor]) -> None:
        numbers = [group["lr"] for group in self.groups]
        if numbers != self.numbers:
            self.numbers = numbers
            for rate, number in zip(self.rates, numbers, strict=True):
                rate.fill_(number)
        th._foreach_copy_(self.copies, tensors)
        self.graph.replay()


@contextmanager
def _with_rates(groups: list[dict[str, Any]], rates: list[th.Tensor]) -> Iterator[None]:
    """Learning rates as tensors: a number would be a constant of the graph."""
    before = [(group["lr"], group["capturable"]) for group in groups]
    try:
        for group, rate in zip(groups, rates, strict=True):
            group["lr"], group["capturable"] = rate, True
        yield
    finally:
        for group, (rate, capturable) in zip(groups, before, strict=True):
            group["lr"], group["capturable"] = rate, capturable


def _state_of(optimizer: th.optim.Optimizer) -> Iterator[th.Tensor]:
    """Its parameters and what it keeps of each."""
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            yield parameter
            yield from (value for value in optimizer.state.get(parameter, {}).values() if isinstance(value, th.Tensor))


def _numbers(optimizers: list[th.optim.Optimizer]) -> Iterator[Any]:
    """The optimisers' settings but their learning rates."""
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            yield from (value for name, value in group.items() if name not in ("params", "lr", "lr_scale", "capturable"))


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
