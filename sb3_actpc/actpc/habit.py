"""The habit: the best proven actor, which is what the agent is for everyone but itself.

The circuit that learns is pressed by a critic that can be wrong, so it does not act for others at once. A *candidate*, the
slow average of the learning actor, is frozen and plays every second episode without exploration noise. When it is paid more
than the habit, it becomes the habit; when two, with none that held its own between them, are paid next to nothing of that,
the learning actor starts again from the habit. The warm-started clone is the first habit: what the agent does is imitation
until something better is proven.
"""

from dataclasses import asdict, dataclass, field
from statistics import fmean, stdev
from typing import Any, Literal

Role = Literal["actor", "candidate", "habit"]
Verdict = Literal["accepted", "tied", "rejected", "relapsed"]

N_PROOFS = 2  # episodes of a candidate at least, before it is accepted
PROOF_STEPS = 500  # environment steps of a candidate at least, before it is judged
ENOUGH_PROOFS = 10  # episodes after which a candidate is judged however short they were
KEPT_RETURNS = 5  # of the habit's episodes
# shares of the habit's mean return: what a candidate must gain, and with what losses it is rejected, or has collapsed
PROVEN_GAIN, REJECTED_LOSS, RELAPSED_LOSS = 0.03, 0.2, 0.6


@dataclass
class Trials:
    """
    Who plays which episode, and what follows from its return. Holds no circuits: the agent copies them as it is told.

    Episodes alternate: with exploration noise by the learning actor, without by the habit or a candidate. Losses are shares
    of the absolute mean return of the habit. A tie changes nothing: where nothing more is paid, imitation stays. A habit that
    was paid nothing at all has nothing to lose: any candidate not below 0 is accepted.

    :param n_envs: environments, each with an episode of its own
    """

    n_envs: int
    roles: list[Role] = field(default_factory=list)
    generations: list[int] = field(default_factory=list)  # which candidate an environment plays
    generation: int = 0
    returns: list[float] = field(default_factory=list)  # so far, of the running episodes
    lengths: list[int] = field(default_factory=list)
    habit_returns: list[float] = field(default_factory=list)
    candidate_returns: list[float] = field(default_factory=list)
    candidate_steps: int = 0
    collapses: int = 0  # candidates that lost ``RELAPSED_LOSS`` since one held its own
    tests_habit: bool = True  # the next quiet episode is the habit's: its return must be known, or known better

    def __post_init__(self) -> None:
        if not self.roles:
            self.begin_all()

    def begin_all(self) -> None:
        """All environments were reset: episodes that were running do not count."""
        self.roles = ["actor"] * self.n_envs
        self.generations, self.lengths = [0] * self.n_envs, [0] * self.n_envs
        self.returns = [0.0] * self.n_envs

    @property
    def habit_return(self) -> float:
        """Mean of the habit's last returns; 0 where there is none yet."""
        return fmean(self.habit_returns) if self.habit_returns else 0.0

    def needs_candidate(self) -> bool:
        """Whether the next quiet episode is the first of a new candidate, which is then taken from the learning actor."""
        present = zip(self.roles, self.generations, strict=True)  # one that was judged meanwhile may still be playing
        return not self.tests_habit and not self.candidate_returns and ("candidate", self.generation) not in present

    def step(self, env: int, reward: float) -> None:
        """:param env: which environment
        :param reward: what its step was paid"""
        self.returns[env] += reward
        self.lengths[env] += 1

    def end(self, env: int) -> Verdict | None:
        """
        The episode of ``env`` has ended.

        :return: "accepted": the candidate becomes the habit; "tied": it is dropped, being neither better nor much worse;
            "rejected": it is dropped, being worse; "relapsed": the second collapse, the learning actor goes back to the
            habit; None: nothing follows yet
        """
        role, episode_return, length = self.roles[env], self.returns[env], self.lengths[env]
        self.returns[env], self.lengths[env] = 0.0, 0
        if role == "habit":
            self.habit_returns = [*self.habit_returns, episode_return][-KEPT_RETURNS:]
            self.tests_habit = False
        if role != "candidate" or self.generations[env] != self.generation:
            return None
        self.candidate_returns.append(episode_return)
        self.candidate_steps += length
        return self._judge()

    def begin(self, env: int) -> None:
        """A new episode of ``env`` begins: noisy and quiet ones take turns."""
        quiet: Role = "habit" if self.tests_habit else "candidate"
        self.roles[env] = quiet if self.roles[env] == "actor" else "actor"
        self.generations[env] = self.generation

    def _judge(self) -> Verdict | None:
        own, n = self.candidate_returns, len(self.candidate_returns)
        if n < ENOUGH_PROOFS and self.candidate_steps < PROOF_STEPS:
            return None
        mean, habit = fmean(own), self.habit_return
        error = stdev(own) / n**0.5 if n > 1 else 0.0
        verdict: Verdict = "tied"
        if mean + error < habit - REJECTED_LOSS * abs(habit):
            verdict = "rejected"
            self.collapses += mean + error < habit - RELAPSED_LOSS * abs(habit)
        elif n < N_PROOFS:
            return None
        elif mean >= habit + PROVEN_GAIN * abs(habit):
            verdict, self.habit_returns = "accepted", own[-KEPT_RETURNS:]
        if self.collapses == 2:
            verdict = "relapsed"
        if verdict != "rejected":
            self.collapses = 0
        self.tests_habit = verdict != "accepted"
        self.candidate_returns, self.candidate_steps = [], 0
        self.generation += 1
        return verdict

    def checkpoint_state(self) -> dict[str, Any]:
        """Everything, as plain values."""
        return asdict(self)
