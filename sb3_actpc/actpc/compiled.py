"""One update as one graph: all changes from the synapses as they stand, compiled, or on a GPU captured with their steps."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_actpc.actpc.captured import CapturedUpdate
from sb3_actpc.actpc.cloning import Imitated
from sb3_actpc.actpc.features import Batch
from sb3_actpc.ngc import HebbianChanges, NGCCircuit

# compiling takes one to three minutes on a CPU, and saves a quarter of an update's products and calls
ENOUGH_UPDATES = 200_000
ASSUMED_LENGTH = 100  # of an episode, where none was shown
MOST_GRAPHS = 64  # of all agents in a process together, each with two; torch gives up after eight


class _Given(NamedTuple):
    """What an update starts from beside the synapses: tensors alone, so that other values need no other graph."""

    weights: tuple[th.Tensor, th.Tensor | None]  # of refresh and pressure, 0-d; None where there is no pressure yet
    actor: Batch | None  # None where the actor waits
    critic: Batch | None  # None where nobody asks the critics
    generator: Batch
    imitated: Imitated | None
    target_noise: th.Tensor | None  # (B, A)


_Changes = list[tuple[list[th.Tensor], list[th.Tensor], list[th.Tensor]]]  # of every circuit: weights, biases, memory


class CompiledUpdate:
    """
    The update of an agent whose circuits all sweep (``settling="scheduled"``) or settle by eq. 1 (``dynamics="state"``),
    compiled by ``torch.compile``; on a GPU, where all sweep, captured as a CUDA graph, which takes no time.

    No circuit reads in an update what another has just changed, so that all changes come from one graph. The optimisers'
    steps, decay, bounds and the targets' move are as ever; a CUDA graph holds them too. Equal to the eager update but for
    rounding.

    :param agent: whose circuits are updated
    :param captures: as a CUDA graph
    """

    def __init__(self, agent: Any, captures: bool = False) -> None:
        self.agent, self.captures = agent, captures
        if captures:
            self._captured = CapturedUpdate(self._change_all, self._stepped, self._settings)
        else:
            from torch._dynamo import config  # takes a second

            config.recompile_limit = max(config.recompile_limit, MOST_GRAPHS)
            self._compiled = th.compile(self._all_changes, fullgraph=True, dynamic=False)
        self._has_warned = False
        # to a GPU numbers go slowly; a tensor for each name, as one that comes twice asks for another graph
        self._weight = lru_cache(8)(lambda name, weight: th.tensor(float(weight), device=agent.device))

    def _settings(self) -> tuple[Any, ...]:
        """Of the agent, which a user may change, beside what comes with every batch."""
        agent = self.agent
        of_circuits = [
            (circuit.weight_decay, circuit.weight_bound, circuit.memory_weight) for _, circuit in agent.policy.named_circuits()
        ]
        own = agent.tau, agent.target_update_interval, agent.scale_pressure, agent.bootstrap, agent.alpha_ep
        return *own, agent.policy.nudge, *of_circuits

    def _stepped(self, given: _Given) -> list[th.optim.Optimizer]:
        return [circuit.optimizer for circuit in self._changing(given)]

    def ready(self) -> bool:
        """Whether nothing is measured and, as each other update would be compiled anew, this one has all its parts: something
        is imitated, and the pressure has begun. Warns once where compiling was asked for (True) and a part is missing."""
        agent = self.agent
        if self.captures:
            return not agent.diagnostics.active
        if agent._n_updates <= agent.critic_warmup:
            return False
        missing = self._missing_part()
        if missing and agent.compile is True and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"compile=True: updates run eagerly while {missing}, as the compiled one imitates and is pressed at once; "
                "change that, or leave compile out",
                stacklevel=2,
            )
        return not missing and not agent.diagnostics.active

    def _missing_part(self) -> str:
        """Why there is no such update, or nothing."""
        agent = self.agent
        for name in ("actor_pressure", "refresh_weight"):
            if not getattr(agent, name):
                return f"{name}=0"
        is_imitating = bool(agent.imitation.parts())
        return "" if is_imitating else "nothing is imitated (no demonstrations=, and no paid episode of its own yet)"

    @th.no_grad()
    def __call__(self, actor: Batch | None, critic: Batch, generator: Batch) -> bool:
        """
        :param actor: the rows of the sampled batch that the actor learns from, None where it waits; the others likewise
        :return: whether the update was made; where compiling fails and nobody asked for it ("auto") it is given up, with a
            warning, and nothing has changed
        """
        agent = self.agent
        # drawn in the order of the eager update
        imitated = None if actor is None else agent._imitated(actor)
        refresh, pressure = (self._weight(name, getattr(agent, name)) for name in ("refresh_weight", "actor_pressure"))
        asked = critic if agent.actor_pressure else None
        noise = None if asked is None else agent._target_noise(asked)
        given = _Given((refresh, pressure if agent.is_pressing else None), actor, asked, generator, imitated, noise)
        try:
            update = self._prepared(given)
        except Exception as error:
            if agent.compile is True:
                raise
            agent._compiled = None
            done = "recording" if self.captures else "compiling"
            warnings.warn(
                f"updates run eagerly, as {done} them failed ({type(error).__name__}); compile=False does not try, and "
                "compile=True shows the error",
                stacklevel=2,
            )
            return False
        update()
        return True

    def _prepared(self, given: _Given) -> Callable[[], None]:
        """What makes the update; until then nothing has changed."""
        return self._captured.prepared(given) if self.captures else partial(self._apply, given, self._compiled(given))

    def _change_all(self, given: _Given) -> None:
        self._apply(given, self._all_changes(given))

    def _apply(self, given: _Given, found: _Changes) -> None:
        for circuit, changes in zip(self._changing(given), found, strict=True):
            circuit.apply_changes(HebbianChanges(*changes))
        self.agent._follow_circuits()

    def _changing(self, given: _Given) -> list[NGCCircuit]:
        """Those that :meth:`_all_changes` is about, in its order."""
        agent = self.agent
        is_acting = given.actor is not None and (given.imitated is not None or given.weights[1] is not None)
        actor = [agent.actor.circuit] if is_acting else []
        critics = [] if given.critic is None else [*agent.critic]
        return [*actor, *critics, *([agent.generator] if agent.alpha_ep else [])]

    def _all_changes(self, given: _Given) -> _Changes:
        agent = self.agent
        changes = [] if given.actor is None else [agent._actor_changes(given.actor, given.imitated, *given.weights)]
        changes += [] if given.critic is None else agent._critic_changes(given.critic, given.target_noise)
        changes += [agent._generator_changes(given.generator)] if agent.alpha_ep else []
        return [(change.weights, change.biases, change.memory) for change in changes if change is not None]


def compiled_update(agent: Any, total_timesteps: int) -> CompiledUpdate | None:
    """
    The compiled or captured update that ``agent.compile`` asks for, or None where the eager one is meant or is all there is.

    :param agent: set up
    :param total_timesteps: of the run: "auto" compiles from ``ENOUGH_UPDATES`` updates on, and captures always
    :raises ValueError: when it is asked for (True) of circuits that do not sweep
    """
    circuits = [circuit for _, circuit in agent.policy.named_circuits()]
    if agent.device.type == "cuda":
        captures = all(map(_can_be_captured, circuits))
        if agent.compile is True and not captures:
            raise ValueError(
                "compile=True on a GPU needs settling='scheduled', as eq. 1's rates wait for it, and Adam; on a CPU "
                "(device='cpu') eq. 1 is compiled too"
            )
        return CompiledUpdate(agent, captures=True) if captures and agent.compile is not False else None
    is_fixed = all(circuit.has_fixed_steps for circuit in circuits)
    if agent.compile is True and not is_fixed:
        raise ValueError(
            "compile=True needs settling='scheduled', or circuit_kwargs=dict(dynamics='state'): steps that stop at a "
            "tolerance are no fixed graph"
        )
    earned = agent.compile == "auto" and total_timesteps * updates_per_step(agent) >= ENOUGH_UPDATES
    if not is_fixed or not (earned or agent.compile is True):
        return None
    if not _has_compiler():
        agent.logger.info("compile: no C++ compiler here, updates run eagerly")
        return None
    return CompiledUpdate(agent)


def _can_be_captured(circuit: NGCCircuit) -> bool:
    """Whether an update neither waits for the GPU (rates of eq. 1 do) nor steps an optimiser that might."""
    defaults = circuit.optimizer.defaults
    return circuit.settling == "scheduled" and bool(defaults.get("fused")) and "capturable" in defaults


def updates_per_step(agent: Any) -> float:
    """Updates for each transition collected; episodes are taken to be as long as those that were shown."""
    every, length = agent.train_freq, 1.0
    assert isinstance(every, TrainFreq)
    if agent.gradient_steps < 0:
        return 1.0
    if every.unit is TrainFrequencyUnit.EPISODE:
        shown = None if agent.expert is None else agent.expert.demonstrations
        length = ASSUMED_LENGTH if shown is None else len(shown.rewards) / shown.n_episodes
    return agent.gradient_steps / (every.frequency * length * agent.n_envs)


def _has_compiler() -> bool:
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        return bool(get_cpp_compiler())
    except (InvalidCxxCompiler, OSError):
        return False
