"""The habit: the best proven actor, which is what the agent is for everyone but itself.

The circuit that learns is pressed by a critic that can be wrong, so it does not act for others at once. A *candidate*, the
slow average of the learning actor, is frozen and plays the episodes without exploration noise. When it is paid more
than the habit, by more than chance would have it, it becomes the habit. The warm-started clone is the first habit: what the
agent does is imitation until something better is proven; other clones can be candidates too. A habit that is paid less in the
end than the one before it gives way to that one again.
"""

from dataclasses import asdict, dataclass, field
from statistics import fmean
from typing import Any, Literal

Role = Literal["actor", "candidate", "habit"]
Verdict = Literal["accepted", "tied", "undecided", "rejected", "recalled"]

N_PROOFS = 2  # episodes of a candidate at least, before it is judged by less than a great loss
# environment steps, or episodes however short: of a candidate before it is judged, and of the habit after one not accepted
PROOF_STEPS, ENOUGH_PROOFS = 500, 10
MOST_PROOF_STEPS = 2000  # that a candidate has for a proof
# times as many: of a learner that is not surely better, and of one that gains where episodes are paid all or nothing
DOUBTFUL, RACING = 2, 4
MANY_PROOFS = 20  # episodes of a learner that are paid all or nothing, before it is accepted
# of the habit, which is frozen: with random goals the last twenty alone may all be unlucky; and of the learning actor
KEPT_RETURNS, KEPT_NOISY_RETURNS = 100, 2
# of what the imitated episodes were paid: a clone that is paid less by more is no good one, and no good beginning
SHORTFALL, GREAT_SHORTFALL = 0.1, 0.5
EARLY_CLONES = 2  # that are tried before anything is learned: where these do no better, it was not by chance
# standard errors: that a gain must pass at any time, and, unless paid all or nothing, after ``MOST_PROOF_STEPS``; the second
# is also a loss's before
SURE, LIKELY = 1.5, 0.5
# shares of the habit's mean return: what counts as a gain or a loss, and with what loss a candidate is rejected at once
SMALLEST_GAIN, GREAT_LOSS = 0.01, 0.2


@dataclass
class QuietEpisode:
    """An episode without exploration noise.

    :param env: in which environment
    :param role: who plays it
    :param episode_return: what it was paid; None while it runs
    :param length: its steps
    """

    env: int
    role: Role
    episode_return: float | None = None
    length: int = 0


@dataclass
class Trials:
    """
    Who plays which episode, and what follows from its return. Holds no circuits: the agent copies them as it is told.

    Episodes alternate: one with exploration noise by the learning actor, then as many steps without (an episode at least) by
    the habit or a candidate; episodes that soon end in a fall would else be few. A candidate's first ``N_PROOFS`` follow each
    other. A gain must pass a share of the habit's absolute mean return and ``SURE`` of its own standard errors, from the
    variance that candidate and habit have in common, and a loss that share and ``LIKELY``. In between the candidate plays on,
    unless it surely is neither; when it has had its steps, the share is enough of a loss, and ``LIKELY`` of a gain. A learner
    that is paid less than the habit where it plays with noise has twice the steps: two good episodes may be luck. And a
    gain must be worth what has not been seen: a candidate that has played less often than the habit has had fewer occasions
    to fall, and plays on until it has had as many, or ``ENOUGH_PROOFS``, if it gains no more than that risk. After a
    candidate that did not prove itself the habit plays again: what made it the habit was partly luck.

    Where an episode is paid all or nothing, as a lifted cube is, a few say little, and whoever looks after each of them finds
    a gain in the end. Beside a habit that is paid at all a learner then has twice the steps in any case, plays
    ``MANY_PROOFS`` episodes in them if it can, and must gain ``SURE`` of its standard errors to the end. While it gains,
    it has as many again, a *race* in which it takes turns with the habit, whose own return was partly luck; what is then
    neither is undecided, and no reason to go farther. With the habit's and the noisy episodes that is three times as long.

    Clones of the same demonstrations can do very differently, by their first synapses alone. So while the habit is paid less
    than what it imitates, further clones are candidates: before anything is learned, where ``GREAT_SHORTFALL`` of it is
    missing, ``EARLY_CLONES`` of them; then, where ``SHORTFALL`` is, after a rejected learner, or after the second in a row
    where the learner is paid more than the habit even with noise, and the first rejection may have been chance. Learning
    begins anew with one that is accepted.

    :param n_envs: environments, each with an episode of its own
    """

    n_envs: int
    roles: list[Role] = field(default_factory=list)
    generations: list[int] = field(default_factory=list)  # which candidate an environment plays
    generation: int = 0
    n_judged: int = 0  # candidates; a recall is about the habit
    returns: list[float] = field(default_factory=list)  # so far, of the running episodes
    lengths: list[int] = field(default_factory=list)
    quiet: list[QuietEpisode] = field(default_factory=list)  # that run, or wait for one that does; as they began
    quiet_due: list[int] = field(default_factory=list)  # steps without noise that are still due, for each environment
    habit_returns: list[float] = field(default_factory=list)
    former_returns: list[float] = field(default_factory=list)  # of the habit before, while it may be recalled
    is_by_clone: bool = False  # a clone has taken its place
    noisy_returns: list[float] = field(default_factory=list)  # the learning actor's last ones
    candidate_returns: list[float] = field(default_factory=list)
    candidate_steps: int = 0
    habit_proofs: int = 0  # episodes since the last verdict, and their steps
    habit_steps: int = 0
    habit_is_due: bool = False  # in a race: the candidate has played the last quiet episode
    imitated_return: float = 0.0  # what the imitated episodes were paid
    n_clones: int = 0  # that may still be tried
    n_tried: int = 0  # that were
    begun_at: int = 0  # update at which learning began with the present clone
    on_trial: bool = False  # there is a candidate that is not judged yet
    is_clone: bool = False  # it is one, not the learning actor's average
    has_learned: bool = False
    n_rejected: int = 0  # learners in a row
    tests_habit: bool = True  # before the next candidate: its return must be known, or known better
    skipped: list[int] = field(default_factory=list)  # environments whose running episode began otherwise

    def __post_init__(self) -> None:
        if not self.roles:
            self.begin_all()
        self.quiet = [QuietEpisode(**one) if isinstance(one, dict) else one for one in self.quiet]  # of a checkpoint

    def begin_all(self) -> None:
        """All environments were reset: episodes that were running do not count."""
        self.roles = ["actor"] * self.n_envs
        self.generations = [self.generation] * self.n_envs
        self.lengths, self.quiet_due = ([0] * self.n_envs for _ in range(2))
        self.returns, self.quiet, self.skipped = [0.0] * self.n_envs, [], []

    def forgotten(self, n_envs: int, goes_on: bool = False) -> "Trials":
        """
        Those of another habit, or of other environments: what was paid says nothing any more.

        :param n_envs: environments
        :param goes_on: whether the running episodes do; they count for nothing
        """
        new = Trials(n_envs, n_clones=self.n_clones, n_tried=self.n_tried, begun_at=self.begun_at)
        new.skipped = [env for env in range(n_envs) if goes_on and (self.lengths[env] or env in self.skipped)]
        return new

    @property
    def habit_return(self) -> float:
        """Mean of the habit's last returns; 0 where there is none yet."""
        return fmean(self.habit_returns) if self.habit_returns else 0.0

    def noisy_gain(self, env: int) -> float:
        """
        Of the episode of ``env``, which has had its last step, over the habit's mean return, as a share of that or of the
        most that an episode is paid beyond it, whichever is larger: so what is paid all or nothing gains in the mean where it
        is paid more often. From -1 to 1; 0 where it is not the learning actor's, where a verdict fell while it ran, or where
        the habit has no return yet.
        """
        if self.roles[env] != "actor" or self.generations[env] != self.generation or not self.habit_returns:
            return 0.0
        gain = self.returns[env] - self.habit_return
        unit = max(abs(self.habit_return), max(self.habit_returns) - self.habit_return, gain)
        return max(-1.0, gain / unit) if unit else -float(gain < 0.0)

    def is_ahead(self) -> bool:
        """Whether the learning actor is paid more than the habit, even with noise."""
        return len(self.noisy_returns) >= N_PROOFS and fmean(self.noisy_returns) > self.habit_return

    def needs_clone(self) -> bool:
        """Whether the next candidate is a clone."""
        is_due = self.n_rejected > self.is_ahead() if self.has_learned else self.n_judged < EARLY_CLONES
        if not self.n_clones or not is_due:
            return False
        shortfall = SHORTFALL if self.has_learned else GREAT_SHORTFALL
        return self.habit_return < self.imitated_return - shortfall * abs(self.imitated_return)

    def skip(self, env: int, is_last: bool) -> None:
        """
        A random action, or a later step of an episode that began with one, or with another habit: it proves nothing.

        :param env: which environment
        :param is_last: whether its episode ends with it; the next one may count
        """
        others = [other for other in self.skipped if other != env]
        self.skipped = others if is_last else [*others, env]

    def step(self, env: int, reward: float) -> None:
        """:param env: which environment
        :param reward: what its step was paid"""
        self.returns[env] += reward
        self.lengths[env] += 1

    def end(self, env: int, has_learned: bool) -> Verdict | None:
        """
        The episode of ``env`` has ended.

        :param has_learned: whether the learning actor differs from the habit by more than imitation; before, clones alone are
            candidates
        :return: "accepted": the candidate becomes the habit; "tied": it is dropped, being neither proven better nor worse;
            "undecided": it is dropped, its episodes being too few; "rejected": it is dropped, being worse; "recalled": the
            habit before becomes the habit again, and a candidate, if there is one, is dropped; None: nothing follows yet
        """
        self.has_learned = has_learned
        role, episode_return, length = self.roles[env], self.returns[env], self.lengths[env]
        self.returns[env], self.lengths[env] = 0.0, 0
        self.quiet_due[env] = length if role == "actor" else self.quiet_due[env] - length
        if role == "actor" and self.generations[env] == self.generation:  # else another actor began it
            self.noisy_returns = [*self.noisy_returns, episode_return][-KEPT_NOISY_RETURNS:]
        for one in self.quiet:
            if one.env == env and one.episode_return is None:
                one.episode_return, one.length = episode_return, length
        verdict: Verdict | None = None
        while self.quiet and (ended := self.quiet[0].episode_return) is not None:
            first = self.quiet.pop(0)
            verdict = self._count(first.role, ended, first.length) or verdict
        return verdict

    def _count(self, role: Role, episode_return: float, length: int) -> Verdict | None:
        """A quiet episode, once those that began before it have ended: of several environments the first to end are short."""
        self.habit_is_due = role == "candidate"
        if role == "candidate":
            self.candidate_returns.append(episode_return)
            self.candidate_steps += length
            verdict = self._judge()
            if verdict is not None:
                self._conclude(verdict)
            return verdict
        self.habit_returns = [*self.habit_returns, episode_return][-KEPT_RETURNS:]
        self.habit_proofs, self.habit_steps = self.habit_proofs + 1, self.habit_steps + length
        self.tests_habit = len(self.habit_returns) < N_PROOFS or not _is_tried(self.habit_proofs, self.habit_steps)
        if not self.former_returns or self.habit_return >= fmean(self.former_returns):
            return None
        self._conclude("recalled")
        return "recalled"

    def begin(self, env: int) -> bool:
        """
        A new episode of ``env`` begins: a noisy one, then quiet ones of as many steps.

        :return: whether a new candidate plays it, which is to be made now: a clone where ``is_clone`` says so, else the
            learning actor's average
        """
        has_candidate = self.on_trial or (not self.tests_habit and (self.has_learned or self.needs_clone()))
        is_habits_turn = self.habit_is_due and self._is_race()
        quiet: Role = "candidate" if has_candidate and not is_habits_turn else "habit"
        begins = self.on_trial and len(self.candidate_returns) < N_PROOFS  # its first episodes follow each other
        is_quiet = begins or self.roles[env] == "actor" or self.quiet_due[env] > 0
        self.roles[env] = quiet if is_quiet else "actor"
        self.generations[env] = self.generation
        if is_quiet:
            self.quiet.append(QuietEpisode(env, quiet))
        if self.roles[env] != "candidate" or self.on_trial:
            return False
        self.on_trial, self.is_clone = True, self.needs_clone()
        self.n_clones, self.n_tried = self.n_clones - self.is_clone, self.n_tried + self.is_clone
        return True

    def _judge(self) -> Verdict | None:
        """What the candidate's returns say beside the habit's; None while they say too little."""
        own, n = self.candidate_returns, len(self.candidate_returns)
        gain, unit = fmean(own) - self.habit_return, abs(self.habit_return)
        smallest, error = SMALLEST_GAIN * unit, self._standard_error()
        great_loss = gain + SURE * error < -GREAT_LOSS * unit
        if not _is_tried(n, self.candidate_steps) and not (n >= N_PROOFS and great_loss):
            return None
        is_coin = self._is_coin()
        is_doubtful = is_coin or not (self.is_clone or self.is_ahead())
        is_early = self.candidate_steps < MOST_PROOF_STEPS * (DOUBTFUL if is_doubtful else 1)
        has_time = is_early or (is_coin and gain > 0.0 and self.candidate_steps < MOST_PROOF_STEPS * RACING)
        if great_loss:
            return "rejected"
        if n < N_PROOFS:
            return None
        if gain < -max(smallest, LIKELY * error if has_time else 0.0):
            return "rejected"
        if gain > 0.0 and gain >= max(smallest, (SURE if has_time or is_coin else LIKELY) * error):
            is_few = is_coin and is_early and n < MANY_PROOFS
            return "accepted" if gain >= self._unseen_risk() * unit and not is_few else None
        is_open = abs(gain) + SURE * error > smallest
        return "tied" if not is_open else None if has_time else "undecided" if is_coin else "tied"

    def _is_coin(self) -> bool:
        """Whether a learner is judged, and all paid episodes of it and the habit are paid the same, and the habit has one."""
        paid = {*self.habit_returns, *self.candidate_returns} - {0.0}
        return not self.is_clone and self.habit_return > 0.0 and len(paid) == 1

    def _is_race(self) -> bool:
        """Whether candidate and habit take turns."""
        has_played = len(self.candidate_returns) >= N_PROOFS and self.candidate_steps >= MOST_PROOF_STEPS * DOUBTFUL
        return self.on_trial and has_played and self._is_coin()

    def _unseen_risk(self) -> float:
        """By how much more likely the candidate's next episode is a first fall than the habit's, by the rule of succession:
        after n episodes without one that is 1 / (n + 2) (Laplace)."""
        n_habit = min(len(self.habit_returns), ENOUGH_PROOFS)
        return max(1.0 / (len(self.candidate_returns) + 2) - 1.0 / (n_habit + 2), 0.0)

    def _conclude(self, verdict: Verdict) -> None:
        """The candidate or the habit is judged: what is counted begins anew."""
        is_other = verdict in ("accepted", "recalled")  # the habit is
        if verdict == "accepted":
            self.former_returns, self.habit_returns = self.habit_returns, self.candidate_returns[-KEPT_RETURNS:]
            self.is_by_clone = self.is_clone
        elif verdict == "recalled":
            self.habit_returns, self.former_returns = self.former_returns, []
        if is_other:
            self.noisy_returns = [] if self.is_by_clone else self.noisy_returns
            # what the old habit has begun elsewhere is no return of the new one
            self.roles = ["actor" if role == "habit" else role for role in self.roles]
            self.has_learned = self.has_learned and not self.is_by_clone  # the next learner begins with it
        self.n_rejected = self.n_rejected + 1 if verdict == "rejected" and not self.is_clone else 0
        self.tests_habit = verdict != "accepted"
        self.quiet = [one for one in self.quiet if one.role == "habit" and not is_other]
        self.candidate_returns, self.candidate_steps, self.on_trial = [], 0, False
        self.habit_proofs, self.habit_steps = 0, 0
        self.generation += 1
        self.n_judged += verdict != "recalled"

    def _standard_error(self) -> float:
        """Of the difference of the two means, from the variance within both."""
        samples = [sample for sample in (self.candidate_returns, self.habit_returns) if sample]
        squares = sum((one - mean) ** 2 for sample, mean in zip(samples, map(fmean, samples), strict=True) for one in sample)
        degrees = max(sum(map(len, samples)) - 2, 1)
        return (squares / degrees * sum(1 / len(sample) for sample in samples)) ** 0.5

    def checkpoint_state(self) -> dict[str, Any]:
        """Everything, as plain values."""
        return asdict(self)


def _is_tried(n_episodes: int, n_steps: int) -> bool:
    return n_episodes >= ENOUGH_PROOFS or n_steps >= PROOF_STEPS
