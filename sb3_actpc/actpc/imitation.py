"""What an agent imitates, and how its clones do: the steps that are drawn, and what is made of the room between them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_actpc.actpc.cloning import Cloning, Imitated
from sb3_actpc.actpc.held_out import N_ASKED, N_UPDATES, random_numbers_of_its_own, split, typical_error
from sb3_actpc.actpc.room import Room
from sb3_actpc.actpc.self_imitation import Episodes, imitated_return, is_by_return, sample_union
from sb3_actpc.actpc.transfer import to_device
from sb3_actpc.ngc import NGCCircuit

ROOM_DECAY = 1.0  # of clones' synapses where the demonstrations leave room, which small synapses guess better
HELD = "\nthe habit teaches the learning actor too, in the states that are replayed"
MOST_BLUR = 1.5  # of their error on episodes that are held out, over that of clones that imitate what is shown alone


class Imitation:
    """
    The demonstrations and the agent's own paid episodes, as they are imitated. Begun anew where the demonstrations are others.

    :param agent: whose they are
    """

    def __init__(self, agent: Any) -> None:
        self.agent = agent
        self._room: Room | None = None  # None before that is asked
        self._noise_helps: bool | None = None  # likewise

    def parts(self) -> list[Episodes]:
        """What refresh and clones draw from: the demonstrations and the self-imitation memory."""
        agent = self.agent
        memory = agent.replay_buffer.self_imitation
        own = [] if memory is None or memory.episodes is None else [memory.episodes]
        return own if agent.expert is None else [agent.expert.episodes, *own]

    def mean_return(self) -> float:
        """What the imitated episodes were paid, as often as they are drawn."""
        return imitated_return(self.parts(), self.agent.refresh.weighting)

    def sample(self, n: int, noise: float = 0.0, parts: list[Episodes] | None = None, room: Room | None = None) -> Imitated:
        """Features, actions and working memory of ``n`` imitated steps, or of steps of ``parts``; with noise, of steps between
        the demonstrations, or those of ``room``."""
        agent, parts = self.agent, parts or self.parts()
        inputs, room = agent.inputs, (room or self.room) if noise else None
        if room is not None:
            for part in parts:
                room.measure(part)
        samples = sample_union(parts, n, agent.memory_history, agent.refresh.weighting)
        arrays = inputs.normalized(samples.observations), samples.actions.astype(np.float32, copy=False)
        observed, actions = to_device(arrays, inputs.device)
        features = inputs.features(observed)
        if room is not None and samples.neighbours is not None:
            features, actions = room.between(features, actions, samples.neighbours, noise)
        return features, actions, inputs.memory(*inputs.past(samples.history, samples.history_mask))

    def features_of(self, episodes: Episodes, rows: np.ndarray) -> th.Tensor:
        """(B, n_features) of (B,) rows, some at a time: there can be many images."""
        inputs = self.agent.inputs
        parts = [episodes.take(some).observations for some in np.array_split(rows, 1 + len(rows) // 1024)]
        return th.cat([inputs.features(inputs.observations(part)) for part in parts])

    # ------------------------------------------------------------------ clones

    def clone_into(self, circuit: NGCCircuit, number: int = 0) -> Cloning:
        """
        What makes an actor's circuit a clone of whatever is imitated by now.

        :param circuit: the actor
        :param number: 0 for the first clone, 1 for the first further one
        """
        agent, n_updates = self.agent, self.agent.actor_warm_start
        if agent.expert is not None and agent.inputs.are_normalised:  # which knows more by now than when it was measured
            self._room = None
            self._noise_helps = self._noise_helps if number else None
            for part in self.parts():
                part.neighbours = None

        def sample(n: int) -> Imitated:
            now = agent.imitation  # another one where the demonstrations were replaced meanwhile
            return now.sample(n, now.noise_of(number))

        decay = self.decay if n_updates else None
        return Cloning(circuit, agent.policy.make_actor, sample, n_updates, agent.refresh.ensemble_size, decay)

    @property
    def room(self) -> Room | None:
        """What lies between the demonstrations; None without any."""
        expert = self.agent.expert
        if expert is not None and self._room is None:
            self._room = self._room_of(expert.episodes)
        return self._room

    def _room_of(self, shown: Episodes) -> Room:
        return Room(shown, self.features_of, is_by_return([shown], self.agent.refresh.weighting))

    @property
    def guesses(self) -> bool:
        """Whether the demonstrations leave room, so that clones guess what is done between them."""
        return self.room is not None and self.room.is_wide

    @property
    def is_held(self) -> bool:
        """Whether the habit holds the learning actor: as asked for, or by default where clones guess: refresh alone moves it
        freely there, and that a grip was lost is seen hundreds of steps later, if at all. Where all demonstrations return 0
        the habit is nothing to be held to. Decided once, with the trust region's unit."""
        agent, region, asked_for = self.agent, self.agent.policy.trust_region, self.agent.refresh.habit
        if region is None or agent.pretrained:
            return region is not None and bool(region.holds)
        if not self._has_teacher:
            return False
        return self.guesses and bool(agent.expert.episodes.returns.any()) if asked_for is None else asked_for

    @property
    def is_taught(self) -> bool:
        """Whether it then teaches it, too, what to do in the states that are replayed."""
        return self.is_held and self._has_teacher

    @property
    def _has_teacher(self) -> bool:
        """A habit that is no clone has nothing to teach, and an actor that only imitates needs nobody to hold it."""
        agent = self.agent
        has_roles = agent.actor_pressure and agent.refresh_weight and agent.actor_warm_start
        return bool(has_roles) and agent.expert is not None

    @property
    def noise(self) -> float:
        """Noise on what the first clone imitates: as asked for, or by default 1 where the demonstrations leave room, unless
        clones of some of them then tell worse what is done in the others, and 0 where not; 0 with a single demonstration,
        which has no neighbours."""
        asked_for, expert = self.agent.refresh.noise, self.agent.expert
        if expert is not None and asked_for is not None:
            return float(asked_for) if expert.demonstrations.n_episodes > 1 else 0.0
        return float(self.guesses and self._is_as_precise())

    def noise_of(self, number: int) -> float:
        """
        Noise on what a clone imitates. A step's error does not say all of what brings an episode home, so where nothing is
        asked for and there is room, every other further clone imitates the other way, and has to prove itself.

        :param number: 0 for the first clone, 1 for the first further one
        """
        is_open = self.agent.refresh.noise is None and self.guesses
        return 1.0 - self.noise if is_open and number % 2 else self.noise

    def _is_as_precise(self) -> bool:
        """Whether a clone that imitates between demonstrations is about as precise where none was shown as one that does not,
        or more. Asked once; what is drawn for it is drawn by nobody else."""
        agent = self.agent
        if self._noise_helps is None:
            parts, helps = split(agent.expert.episodes), True
            if parts is not None and agent.actor_warm_start:
                if agent.verbose:
                    print("two short clones are asked whether to imitate steps between the demonstrations", flush=True)
                with random_numbers_of_its_own(agent.device):
                    without, between = (self._error_when_held_out(noise, *parts) for noise in (0.0, 1.0))
                helps = between <= MOST_BLUR * without
            self._noise_helps = helps
        return self._noise_helps

    def _error_when_held_out(self, noise: float, shown: Episodes, held_out: Episodes) -> float:
        make_actor, room = self.agent.policy.make_actor, self._room_of(shown) if noise else None
        n_updates = min(N_UPDATES, self.agent.actor_warm_start)
        cloning = Cloning(
            make_actor(), make_actor, lambda n: self.sample(n, noise, [shown], room), n_updates, weight_decay=self.decay
        )
        return typical_error(cloning, self.sample(N_ASKED, parts=[held_out]))

    @property
    def decay(self) -> float | None:
        """Of clones' synapses: as asked for, or by default ``ROOM_DECAY`` where they guess, or imitate steps between
        demonstrations, and None, which is their circuits' own, where not."""
        refresh = self.agent.refresh
        if refresh.weight_decay is not None:
            return float(refresh.weight_decay)
        return ROOM_DECAY if self.guesses or (refresh.noise is not None and self.noise) else None

    def checkpoint_state(self) -> bool | None:
        """What was asked of the demonstrations, for a checkpoint."""
        return self._noise_helps

    def restore_checkpoint_state(self, state: bool | None) -> None:
        """:param state: what :meth:`checkpoint_state` returned"""
        self._noise_helps = state

    # ------------------------------------------------------------------ in words

    def describe(self) -> str:
        """What is imitated, how clones do, and whether the habit teaches; two lines or three."""
        return (
            f"imitated: {self._describe_parts()}\n"
            f"noise on what the first clone imitates: {self.noise:g} of a step's length"
            f"{', and steps between the episodes' if self.noise else ''}"
            f"{'; every other further clone the other way' if self.noise_of(1) != self.noise else ''}"
            f"{HELD if self.is_taught else ''}"
        )

    def _describe_parts(self) -> str:
        agent = self.agent
        is_of_nothing = agent.expert is None and agent.replay_buffer.self_imitation is None
        if is_of_nothing or not (agent.refresh_weight or agent.actor_warm_start):
            return "nothing"
        own = "" if agent.expert is not None else "own episodes, "
        if agent.refresh.weighting == "uniform":
            return f"{own}every step alike"
        if agent.expert is None:
            return f"{own}by their returns"
        n = agent.expert.episodes.effective_number()
        if not n:
            return "every step alike, as no demonstration's return is positive"
        return f"by returns, as if {n:.1f} of {agent.expert.demonstrations.n_episodes} episodes"
