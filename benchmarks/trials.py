"""What an agent's trials keep of what its learner gains, simulated: no circuit, only who is paid what how often.

    python benchmarks/trials.py                  # the race of docs/recipe.md, "All or nothing"
    python benchmarks/trials.py --gaits          # its recalled habits, "Rare falls"
    python benchmarks/trials.py --failure 500 --success 400 --runs 600

An episode succeeds, and is paid in full, or fails; a gait that falls is paid a part, by chance. The learner follows a curve of
the steps, or of what its habit has; a candidate is the learner as it was when it was frozen. Prints, for the agent's rule and
for one that is simpler (trials that end after 4,000 steps; habits that are never recalled), what the habit has in the end,
mean and worst twentieth over the runs: the chance of a success, or the mean return over that of the first habit.
"""

import argparse
import random
from collections.abc import Callable
from dataclasses import dataclass
from statistics import fmean
from typing import NamedTuple
from unittest.mock import patch

from sb3_actpc.actpc import habit
from sb3_actpc.actpc.habit import Trials

LONGEST = 1000  # steps of a gait's episode


class Player(NamedTuple):
    """Who plays: the chance of a success, what that is paid, and the standard deviation of it."""

    chance: float
    pays: float = 1.0
    deviation: float = 0.0


Curve = Callable[[int, Player], Player]  # steps and the habit -> the learner


@dataclass
class Coin:
    """All or nothing.

    :param success: steps of an episode that succeeds
    :param failure: steps of one that fails
    """

    success: int
    failure: int
    pressed_from: int = 7000  # environment steps: critic's warm-up, and the first candidate's age
    noise: float = 0.0  # what exploration takes from the learner's chance

    def play(self, rng: random.Random, player: Player) -> tuple[float, int]:
        succeeds = rng.random() < player.chance
        return float(succeeds), self.success if succeeds else self.failure

    def mean(self, player: Player) -> float:
        return player.chance


@dataclass
class Gait:
    """Who falls is paid a part, and the episode ends.

    :param ends: whether it does, or goes on without being paid
    """

    ends: bool
    pressed_from: int = 3500
    noise: float = 0.1

    def play(self, rng: random.Random, player: Player) -> tuple[float, int]:
        if rng.random() < player.chance:
            return rng.gauss(player.pays, player.deviation), LONGEST
        part = rng.uniform(0.05, 0.95)
        return part * player.pays, int(part * LONGEST) if self.ends else LONGEST

    def mean(self, player: Player) -> float:
        return player.pays * (0.5 + 0.5 * player.chance)


def coin(first: float, chance: Callable[[int, float], float]) -> tuple[Player, Curve]:
    return Player(first), lambda steps, now: Player(chance(steps, now.chance))


def fixed(*learner: float) -> Curve:
    return lambda steps, now: Player(*learner)


def towards(first: Player, last: Player, steps_needed: int) -> tuple[Player, Curve]:
    def curve(steps: int, now: Player) -> Player:
        share = min(1.0, steps / steps_needed)
        return Player(*(one + share * (other - one) for one, other in zip(first, last, strict=True)))

    return first, curve


COINS: dict[str, tuple[Player, Curve]] = {
    "from 0.6 to 0.95 by 50,000 steps": coin(0.6, lambda steps, now: min(0.95, 0.6 + 0.35 * steps / 50_000)),
    "from 0.7 to 0.95 by 80,000": coin(0.7, lambda steps, now: min(0.95, 0.7 + 0.25 * steps / 80_000)),
    "from 0.4 beside 0.7, to 0.95 by 80,000": coin(0.7, lambda steps, now: min(0.95, 0.4 + 0.55 * steps / 80_000)),
    "a tenth above its habit, from 0.6": coin(0.6, lambda steps, now: min(0.95, now + 0.1)),
    "from 0.95 to 1 by 50,000": coin(0.95, lambda steps, now: min(1.0, 0.95 + 0.05 * steps / 50_000)),
    "0.95 beside 0.85": coin(0.85, lambda steps, now: 0.95),
    "always, beside 0.85": coin(0.85, lambda steps, now: 1.0),
    "always, beside 0.95": coin(0.95, lambda steps, now: 1.0),
    "a tenth below its habit, from 0.9": coin(0.9, lambda steps, now: now - 0.1),
    "a tenth below, from 0.6": coin(0.6, lambda steps, now: now - 0.1),
    "a twentieth below, from 0.85": coin(0.85, lambda steps, now: now - 0.05),
}
GOES_ON, FALLS = Gait(ends=False), Gait(ends=True)
GAITS: dict[str, tuple[Gait, tuple[Player, Curve]]] = {
    "one in ten fails, beside none": (GOES_ON, (Player(1.0, 900, 5), fixed(0.9, 910, 5))),
    "one in four, beside one in ten": (GOES_ON, (Player(0.9, 900, 5), fixed(0.75, 905, 5))),
    "none, beside one in four": (GOES_ON, (Player(0.75, 900, 5), fixed(1.0, 903, 5))),
    "six per cent more by 15,000 steps": (GOES_ON, towards(Player(1.0, 840, 3), Player(1.0, 890, 3), 15_000)),
    "falls half the time, beside 0.3": (FALLS, (Player(0.7, 851, 3), fixed(0.5, 851, 3))),
    "0.3, beside half the time": (FALLS, (Player(0.5, 851, 3), fixed(0.7, 851, 3))),
    "from 0.8 to never by 15,000": (FALLS, towards(Player(0.2, 851, 3), Player(1.0, 851, 3), 15_000)),
    "from 0.6 to 0.2, and faster": (FALLS, towards(Player(0.4, 800, 20), Player(0.8, 900, 20), 15_000)),
    "a poor one more than doubles": (FALLS, towards(Player(0.8, 400, 40), Player(0.9, 900, 20), 15_000)),
    "falls more often than its habit, by 0.15": (
        FALLS,
        (Player(0.6, 850, 20), lambda steps, now: Player(max(now.chance - 0.15, 0.0), *now[1:])),
    ),
}


def last_habit(
    rng: random.Random, kind: Coin | Gait, learner: tuple[Player, Curve], total: int, recalls: bool = True
) -> Player:
    """
    :param kind: how an episode goes
    :param learner: the first habit, and the learner's curve
    :param total: environment steps
    :param recalls: whether a habit can give way to the one before it
    :return: the last habit
    """
    (now, curve), trials, steps = learner, Trials(1), 0
    candidate = former = now
    while steps < total:
        actor = curve(steps, now)
        noisy = actor._replace(chance=max(actor.chance - kind.noise, 0.0))
        paid, length = kind.play(rng, {"actor": noisy, "habit": now, "candidate": candidate}[trials.roles[0]])
        trials.step(0, paid)
        trials.lengths[0] = length
        steps += length
        verdict = trials.end(0, has_learned=steps > kind.pressed_from)
        if verdict == "accepted":
            former, now = now, candidate
        elif verdict == "recalled":
            now = former
        if not recalls:
            trials.former_returns = []
        if trials.begin(0):
            candidate = curve(steps, now)
    return now


def cell(kind: Coin | Gait, learner: tuple[Player, Curve], total: int, recalls: bool, arguments: argparse.Namespace) -> str:
    """Mean, and the worst twentieth, of so many runs."""
    rng = random.Random(arguments.seed)
    ends = sorted(kind.mean(last_habit(rng, kind, learner, total, recalls)) for _ in range(arguments.runs))
    unit = kind.mean(learner[0]) if isinstance(kind, Gait) else 1.0
    return f"{fmean(ends) / unit:.3f} ({ends[len(ends) // 20] / unit:.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--gaits", action="store_true", help="gaits that fall at times, in the place of all or nothing")
    parser.add_argument("--success", type=int, default=150, help="steps of an episode that succeeds, all or nothing")
    parser.add_argument("--failure", type=int, default=500, help="steps of one that fails")
    parser.add_argument("--steps", type=int, nargs="+", help="default: 50,000 and 100,000; gaits 15,000 and 50,000")
    arguments = parser.parse_args()
    rules = {"without a race": (habit.DOUBTFUL, True), "with it": (habit.RACING, True)}
    kind, totals = Coin(arguments.success, arguments.failure), arguments.steps or [50_000, 100_000]
    rows: dict[str, tuple[Coin | Gait, tuple[Player, Curve]]] = {name: (kind, learner) for name, learner in COINS.items()}
    if arguments.gaits:
        rules = {"never recalled": (habit.RACING, False), "recalled": (habit.RACING, True)}
        totals, rows = arguments.steps or [15_000, 50_000], {**GAITS}
    heads = [f"{rule}, {steps:,} steps" for steps in totals for rule in rules]
    print("| the learner | " + " | ".join(heads) + " |\n" + "| --- " * (len(heads) + 1) + "|")
    for name, (kind_of_row, learner) in rows.items():
        cells = []
        for steps in totals:
            for times, recalls in rules.values():
                with patch.object(habit, "RACING", times):
                    cells.append(cell(kind_of_row, learner, steps, recalls, arguments))
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
