"""How far the critic's word can be taken: whether actions gain what it says that they gain."""

from dataclasses import asdict, dataclass, field, replace
from math import erfc, exp
from typing import Any

import numpy as np

WINDOW = 2000.0  # noisy steps, over which the weight of an episode falls to a third
FEWEST = 3  # steps of an episode, below which it says nothing
ENOUGH = 200.0  # of all, below which nothing is disproven
DOUBT = 0.05  # a slope that is as negative by chance less often than this is held against the critic


@dataclass
class Step:
    """
    A step of the learning actor with exploration noise, before it is learned.

    :param said: what the critic says that the noise ε gains by its direction, (Q(s, μ(s) + ε) - Q(s, μ(s) - ε)) / 2; it has
        not learned the step by then
    :param value: what it says that the state is worth, Q(s, μ(s))
    :param reward: what the step was paid
    """

    said: float
    value: float
    reward: float


@dataclass
class Calibration:
    """
    The slope of what noise gains on what the critic says that it gains.

    An action's gain is r + γ Q(s', μ(s')) - Q(s, μ(s)): what it was paid and what the next state is worth, beyond what the
    state was worth. What is said is said before the step is learned, so that the critic cannot know; and both are taken about
    their episode's mean, so that they say nothing of how well it ranks states. Noise is compared with the opposite noise: what
    the critic takes off for any noise says nothing of its direction, and goes with the errors of its values. A critic that is
    right has a slope of 1 (calibration by linear regression: Cox, 1958), one that guesses a slope of 0, and one whose
    gradient points downhill less.

    :param n_envs: environments, each with an episode of its own
    """

    n_envs: int
    running: list[list[Step]] = field(default_factory=list)
    # sums over the window: of weights, and of said², gained², said x gained about their episodes' means
    n: float = 0.0
    said_squared: float = 0.0
    gained_squared: float = 0.0
    products: float = 0.0

    def __post_init__(self) -> None:
        if not self.running:
            self.begin_all()
        self.running = [[Step(**step) if isinstance(step, dict) else step for step in steps] for steps in self.running]

    def begin_all(self) -> None:
        """All environments were reset, or another actor learns: episodes that were running do not count."""
        self.running = [[] for _ in range(self.n_envs)]

    def forgotten(self, n_envs: int) -> "Calibration":
        """
        In other environments, of a critic that goes on: what is known stays, running episodes do not.

        :param n_envs: environments
        """
        return replace(self, n_envs=n_envs, running=[])

    def step(self, env: int, said: float, value: float, reward: float, gamma: float) -> None:
        """A step of ``env``; see :class:`Step`. An episode that goes on and on is counted piece by piece."""
        if len(self.running[env]) >= WINDOW:
            self._count(self.running[env], [], gamma)
            self.running[env] = []
        self.running[env].append(Step(said, value, reward))

    def end(self, env: int, gamma: float, terminated: bool) -> None:
        """
        The episode of ``env`` has ended.

        :param gamma: discount
        :param terminated: whether nothing follows; after a time limit the last step's gain is unknown
        """
        steps, self.running[env] = self.running[env], []
        self._count(steps, [0.0] * terminated, gamma)

    def _count(self, steps: list[Step], after: list[float], gamma: float) -> None:
        """``after``: what is worth what comes after the last of the steps, if that is known."""
        values = np.array([step.value for step in steps] + after)
        said, rewards = (np.array([getattr(step, name) for step in steps])[: len(values) - 1] for name in ("said", "reward"))
        if len(said) < FEWEST:
            return
        gained = rewards + gamma * values[1:] - values[:-1]
        said, gained = said - said.mean(), gained - gained.mean()
        old = exp(-len(said) / WINDOW)
        self.n = old * self.n + len(said)
        self.said_squared = old * self.said_squared + float(said @ said)
        self.gained_squared = old * self.gained_squared + float(gained @ gained)
        self.products = old * self.products + float(said @ gained)

    @property
    def slope(self) -> float:
        """1 for a critic that is right; 0 while nothing is known."""
        return self.products / self.said_squared if self.said_squared else 0.0

    @property
    def error(self) -> float:
        """The slope's standard error."""
        left = max(self.gained_squared - self.slope * self.products, 0.0)
        return (left / max(self.n - 2.0, 1.0) / self.said_squared) ** 0.5 if self.said_squared else 0.0

    @property
    def trust(self) -> float:
        """How likely so negative a slope is of a critic that knows nothing (p-value, two-sided), over ``DOUBT``; 1 at most,
        and for a positive one. What its word is worth, if not less than nothing, the radius leaves to outcomes."""
        if self.slope >= 0.0 or self.n < ENOUGH:
            return 1.0
        return min(1.0, erfc(-self.slope / self.error / 2**0.5) / DOUBT) if self.error else 0.0

    def checkpoint_state(self) -> dict[str, Any]:
        """Everything, as plain values."""
        return asdict(self)
