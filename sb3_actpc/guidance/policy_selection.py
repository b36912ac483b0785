"""The deployment gate: which policy ``predict`` uses, decided by evaluation episodes without noise during learning.

An *incumbent* is deployed. The actor's moving average explores. A *challenger*, a frozen copy of it, plays evaluation
episodes until it has as many as the incumbent; then both take turns. A group sequential test on the difference of mean
returns promotes or rejects the challenger; its threshold falls with the number of episodes (O'Brien and Fleming, Biometrics
1979). If exploration returns of the average are as clearly better, it is the next challenger, and one evaluation episode
confirms it: it may be stuck without noise. A promoted policy and the one before it then play further episodes. By these alone
it may be rolled back: of the returns that promoted it, its own were lucky and the others unlucky.
"""

import math
from dataclasses import dataclass, field
from statistics import fmean
from typing import Literal

Role = Literal["average", "challenger", "incumbent", "previous"]
Decision = Literal["promoted", "rejected", "rolled back"]


@dataclass
class PolicySelection:
    """
    Who plays the next episode, and what follows from returns. Holds no circuits.

    :param n_envs: environments
    :param share: share of environment steps in evaluation episodes above which none begins
    :param promote: standard errors by which the challenger's mean return must exceed the incumbent's after ``budget``
        episodes; after n of them sqrt(budget / n) times as many. A copy is tested although exploration does not speak for it:
        noise may hide what it gained
    :param promote_supported: the same where exploration returns speak for it, and for these
    :param reject: standard errors by which it, or a new incumbent that is rolled back, must fall short
    :param budget: evaluation episodes of a policy in a test, at most
    :param min_episodes: evaluation episodes of a policy before any decision
    :param n_rechecks: further episodes of a promoted policy, and of the one before it; compared from ``min_episodes`` on
    """

    n_envs: int
    share: float = 0.25
    promote: float = 0.4
    promote_supported: float = 0.2
    reject: float = 0.5
    budget: int = 20
    min_episodes: int = 2
    n_rechecks: int = 4
    steps: int = 0
    evaluation_steps: int = 0
    has_challenger: bool = False
    incumbent_returns: list[float] = field(default_factory=list)
    challenger_returns: list[float] = field(default_factory=list)
    has_previous: bool = False
    previous_returns: list[float] = field(default_factory=list)  # since it was replaced
    n_deciding: int = 0  # returns of the incumbent that promoted it
    exploration_returns: list[float] = field(default_factory=list)  # the newest of the average, some time after the last copy
    support: list[float] = field(default_factory=list)  # exploration returns for which the challenger was copied at once
    worst: float = math.inf  # return of any episode, exploration episodes included
    n_needed: int = 0  # returns of the incumbent before the next challenger begins
    roles: list[Role] = field(default_factory=list)
    running: list[float] = field(default_factory=list)
    n_promoted: int = 0
    n_rejected: int = 0
    n_rolled_back: int = 0

    def __post_init__(self) -> None:
        self.n_needed = max(self.n_needed, self.min_episodes)
        if len(self.roles) != self.n_envs:
            self.reset()

    def reset(self) -> None:
        """All running episodes are cut: exploration episodes begin."""
        self.roles = ["average"] * self.n_envs
        self.running = [math.nan] * self.n_envs  # a part of an episode has no return

    def step(self, env: int, reward: float, begins: bool) -> None:
        """One environment step of ``env`` with the task's reward; ``begins`` with the first of an episode."""
        self.running[env] = reward + (0.0 if begins else self.running[env])
        self.steps += 1
        if self.roles[env] != "average":
            self.evaluation_steps += 1

    def end_episode(self, env: int, actor_differs: bool) -> Decision | None:
        """The episode of ``env`` has ended: what its return decides, if anything. See :meth:`begin_episode`."""
        role = self.roles[env]
        episode_return = self.running[env]
        self.roles[env] = "average"
        self.running[env] = 0.0
        if math.isnan(episode_return):
            return None
        self.worst = min(self.worst, episode_return)
        if role == "average":
            if actor_differs:
                self.exploration_returns = [*self.exploration_returns, episode_return][-self.budget :]
            n = min(len(self.exploration_returns), len(self.incumbent_returns))
            if not self.support and n and self._exceed(self.exploration_returns, self.promote_supported):
                self.support = self.exploration_returns
                self.has_challenger = False  # an older copy makes room
            return None
        if role == "incumbent":
            self.incumbent_returns.append(episode_return)
        elif role == "previous":
            self.previous_returns.append(episode_return)
        elif self.has_challenger:
            self.challenger_returns.append(episode_return)
        return self._decide()

    def begin_episode(self, env: int, actor_differs: bool) -> bool:
        """Choose who plays the next episode of ``env``; ``actor_differs`` where the actor has learned since the last copy.
        True where a new challenger begins: the caller then copies the average."""
        # one at a time: of several that begin together, the short episodes would be counted first
        is_busy = any(role != "average" for role in self.roles)
        if is_busy or self.evaluation_steps > self.share * self.steps:
            return False
        n_incumbent = len(self.incumbent_returns)
        rechecks = self.has_previous and len(self.previous_returns) < self.n_rechecks
        is_ready = n_incumbent >= self.n_needed and not rechecks
        begins = actor_differs and not self.has_challenger and (is_ready or bool(self.support))
        if begins:
            self.has_challenger = True
            self.challenger_returns = []
            self.exploration_returns = []
        # steps that the incumbent does not need are saved for the challenger
        n_needed = self.budget if self.has_challenger else self.n_needed
        if rechecks and not self.has_challenger:
            n_further = n_incumbent - self.n_deciding
            self.roles[env] = "previous" if len(self.previous_returns) <= n_further else "incumbent"
        elif self.has_challenger and (len(self.challenger_returns) <= n_incumbent or n_incumbent >= n_needed):
            self.roles[env] = "challenger"
        elif n_incumbent < n_needed:
            self.roles[env] = "incumbent"
        return begins

    def _exceed(self, ours: list[float], threshold: float) -> bool:
        """Both get a pseudo-episode of the worst return: a policy with few episodes may not have failed yet."""
        gain, error = compare([*ours, self.worst], [*self.incumbent_returns, self.worst])
        return gain > threshold * (self.budget / len(ours)) ** 0.5 * error

    def _decide(self) -> Decision | None:
        n = len(self.challenger_returns)
        if self.has_challenger and n:
            ours = [*self.support, *self.challenger_returns]
            threshold = self.promote_supported if self.support else self.promote
            loss, error = compare(self.incumbent_returns, self.challenger_returns)
            # one evaluation episode is enough for a copy that exploration speaks for
            if loss < 0 and len(ours) >= self.min_episodes and self._exceed(ours, threshold):
                self.n_deciding = n
                self.n_needed = n + self.n_rechecks
                self.has_previous = True
                self.previous_returns = []
                self.incumbent_returns = self.challenger_returns
                self.exploration_returns = []
                self.n_promoted += 1
                return self._end_test("promoted")
            is_enough = n >= self.min_episodes or bool(self.support)
            if (is_enough and loss > self.reject * error) or n >= self.budget:
                self.n_needed = min(len(self.incumbent_returns) + 1, self.budget)
                self.n_rejected += 1
                return self._end_test("rejected")
        further = self.incumbent_returns[self.n_deciding :]
        if self.has_previous and min(len(further), len(self.previous_returns)) >= self.min_episodes:
            loss, error = compare(self.previous_returns, further)
            if loss > self.reject * error:
                self.incumbent_returns = self.previous_returns
                self.previous_returns = []
                self.has_previous = False
                self.n_rolled_back += 1
                return self._end_test("rolled back")
        return None

    def _end_test(self, decision: Decision) -> Decision:
        self.has_challenger = False
        self.support = []
        return decision


def compare(ours: list[float], theirs: list[float]) -> tuple[float, float]:
    """mean(ours) - mean(theirs) of at least one return each, and its standard error from the pooled variance."""
    means = [fmean(ours), fmean(theirs)]
    squares = sum((one - mean) ** 2 for sample, mean in zip((ours, theirs), means, strict=True) for one in sample)
    degrees = max(len(ours) + len(theirs) - 2, 1)
    return means[0] - means[1], (squares / degrees * (1 / len(ours) + 1 / len(theirs))) ** 0.5
