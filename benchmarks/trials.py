"""What the deployment gate keeps of what the actor gains, simulated: no circuits, only returns.

    python benchmarks/trials.py
    python benchmarks/trials.py --failure 500 --success 400 --runs 600

Either an episode succeeds and has the return 1, or it fails; or the robot falls at a random time and gets a part of the full
return; or the return counts steps beyond a line. The actor follows a curve of environment steps; a challenger is the actor
as it was when it was copied. Prints the deployed policy's mean return at the end: mean, and worst twentieth, over the runs.
It is the chance of a success in the first table; in the others, 1 is the first policy's.
"""

import argparse
import random
from collections.abc import Callable
from dataclasses import dataclass
from statistics import fmean
from typing import NamedTuple

from sb3_actpc.guidance.policy_selection import PolicySelection

LONGEST = 1000  # steps of an episode without a fall


class Player(NamedTuple):
    """A policy: the chance of an episode without failure, its return, and the standard deviation of that."""

    chance: float
    full: float = 1.0
    deviation: float = 0.0


Curve = Callable[[int, Player], Player]  # environment steps and the deployed policy -> the actor


@dataclass
class Success:
    """
    Episodes succeed or fail.

    :param success: steps of an episode that succeeds
    :param failure: steps of one that fails
    """

    success: int = 150
    failure: int = 500
    learns_from: int = 7000
    noise: float = 0.0

    def play(self, rng: random.Random, player: Player) -> tuple[float, int]:
        succeeds = rng.random() < player.chance
        return float(succeeds), self.success if succeeds else self.failure

    def mean(self, player: Player) -> float:
        return player.chance


@dataclass
class Fall:
    """
    An episode without a fall has the full return; one with a fall a random part.

    :param ends: whether a fall ends the episode, or it goes on without reward
    """

    ends: bool
    learns_from: int = 3500
    noise: float = 0.1  # what exploration takes from the chance

    def play(self, rng: random.Random, player: Player) -> tuple[float, int]:
        if rng.random() < player.chance:
            return rng.gauss(player.full, player.deviation), LONGEST
        part = rng.uniform(0.05, 0.95)
        return part * player.full, int(part * LONGEST) if self.ends else LONGEST

    def mean(self, player: Player) -> float:
        return player.full * (0.5 + 0.5 * player.chance)


def chance(first: float, curve: Callable[[int, float], float]) -> tuple[Player, Curve]:
    return Player(first), lambda steps, now: Player(curve(steps, now.chance))


def constant(*actor: float) -> Curve:
    return lambda steps, now: Player(*actor)


def towards(first: Player, last: Player, steps_needed: int) -> tuple[Player, Curve]:
    def curve(steps: int, now: Player) -> Player:
        share = min(1.0, steps / steps_needed)
        return Player(*(one + share * (other - one) for one, other in zip(first, last, strict=True)))

    return first, curve


SUCCESSES: dict[str, tuple[Player, Curve]] = {
    "from 0.6 to 0.95 by 50,000 steps": chance(0.6, lambda steps, now: min(0.95, 0.6 + 0.35 * steps / 50_000)),
    "from 0.7 to 0.95 by 80,000": chance(0.7, lambda steps, now: min(0.95, 0.7 + 0.25 * steps / 80_000)),
    "from 0.4 next to 0.7, to 0.95 by 80,000": chance(0.7, lambda steps, now: min(0.95, 0.4 + 0.55 * steps / 80_000)),
    "a tenth above the deployed policy, from 0.6": chance(0.6, lambda steps, now: min(0.95, now + 0.1)),
    "from 0.95 to 1 by 50,000": chance(0.95, lambda steps, now: min(1.0, 0.95 + 0.05 * steps / 50_000)),
    "0.95 next to 0.85": chance(0.85, lambda steps, now: 0.95),
    "1 next to 0.85": chance(0.85, lambda steps, now: 1.0),
    "1 next to 0.95": chance(0.95, lambda steps, now: 1.0),
    "0.7 next to 0.5": chance(0.5, lambda steps, now: 0.7),
    "0.35 next to 0.55": chance(0.55, lambda steps, now: 0.35),
    "0.15 next to 0.55": chance(0.55, lambda steps, now: 0.15),
    "a tenth below the deployed policy, from 0.9": chance(0.9, lambda steps, now: now - 0.1),
    "a tenth below, from 0.6": chance(0.6, lambda steps, now: now - 0.1),
    "a twentieth below, from 0.85": chance(0.85, lambda steps, now: now - 0.05),
}


@dataclass
class Locomotion:
    """Returns count steps beyond a line that takes 150 steps to reach; one episode in ten stops early."""

    learns_from: int = 1500
    noise: float = 0.1

    def play(self, rng: random.Random, player: Player) -> tuple[float, int]:
        if player.full < 0.0:  # noise sets it free
            return (-player.full, LONGEST) if player.chance < STUCK else (0.0, LONGEST)
        if rng.random() < player.chance:
            episode_return = max(rng.gauss(player.full, player.deviation), 0.0)
        else:
            episode_return = rng.uniform(0.0, 0.5) * player.full
        return episode_return, min(150 + int(episode_return), LONGEST)

    def mean(self, player: Player) -> float:
        return max(player.full, 0.0) * (player.chance + 0.25 * (1.0 - player.chance))


STUCK = 0.85  # noise takes a tenth from a chance of 0.9


def by_thousands(*returns: float) -> tuple[Player, Curve]:
    """The actor's return after 0, 1,000, 2,000 steps and so on, then the last one."""
    players = [Player(0.9, full, 30) for full in returns]
    return players[0], lambda steps, now: players[min(steps // 1000, len(players) - 1)]


# as measured of the actor's moving average, on the Hopper and, from 180, on the Walker2d
UNSTEADY: dict[str, tuple[Player, Curve]] = {
    "308 to 710, with a drop at 6,000": by_thousands(308, 308, 237, 266, 351, 619, 105, 727, 710),
    "308 to 800, without": by_thousands(308, 308, 246, 207, 541, 844, 844, 500, 800),
    "308 to 800, with a drop at 7,000": by_thousands(308, 308, 260, 324, 316, 478, 850, 473, 570, 800),
    "180 to 850, from 3,000 on": by_thousands(180, 180, 300, 850),
    "180 to 850, from 5,000 on": by_thousands(180, 180, 180, 250, 400, 850),
    "180 to 850, with a drop at 6,000": by_thousands(180, 180, 300, 850, 850, 850, 150, 150, 850),
    "stuck at 0 without noise, from 5,000 on": by_thousands(308, 308, 308, 308, 308, -800),
    "stays at 308": by_thousands(308, 308, 300, 310, 300, 310),
    "falls from 308 to 200": by_thousands(308, 308, 240, 200, 240, 200),
}
GOES_ON = Fall(ends=False)
ENDS = Fall(ends=True)
FALLS: dict[str, tuple[Fall, tuple[Player, Curve]]] = {
    "one in ten fails, next to none": (GOES_ON, (Player(1.0, 900, 5), constant(0.9, 910, 5))),
    "one in four, next to one in ten": (GOES_ON, (Player(0.9, 900, 5), constant(0.75, 905, 5))),
    "none, next to one in four": (GOES_ON, (Player(0.75, 900, 5), constant(1.0, 903, 5))),
    "six per cent more by 15,000 steps": (GOES_ON, towards(Player(1.0, 840, 3), Player(1.0, 890, 3), 15_000)),
    "falls half the time, next to 0.3": (ENDS, (Player(0.7, 851, 3), constant(0.5, 851, 3))),
    "0.3, next to half the time": (ENDS, (Player(0.5, 851, 3), constant(0.7, 851, 3))),
    "from 0.8 to never by 15,000": (ENDS, towards(Player(0.2, 851, 3), Player(1.0, 851, 3), 15_000)),
    "from 0.6 to 0.2, and faster": (ENDS, towards(Player(0.4, 800, 20), Player(0.8, 900, 20), 15_000)),
    "more than doubles": (ENDS, towards(Player(0.8, 400, 40), Player(0.9, 900, 20), 15_000)),
    "falls more often than the deployed policy, by 0.15": (
        ENDS,
        (Player(0.6, 850, 20), lambda steps, now: Player(max(now.chance - 0.15, 0.0), *now[1:])),
    ),
}


def last_deployed(
    rng: random.Random, kind: Success | Fall | Locomotion, actor: tuple[Player, Curve], total: int, **settings: float
) -> tuple[Player, float]:
    """
    :param kind: how an episode goes
    :param actor: the first deployed policy, and the actor's curve
    :param total: environment steps
    :param settings: of :class:`PolicySelection`
    :return: the deployed policy in the end, and the share of steps in evaluation episodes
    """
    deployed, curve = actor
    challenger = previous = deployed
    selection = PolicySelection(1, **settings)  # type: ignore[arg-type]
    copied_at = steps = 0
    while steps < total:
        learner = curve(steps, deployed) if steps > kind.learns_from else actor[0]
        explores = learner._replace(chance=max(learner.chance - kind.noise, 0.0))
        players = {"average": explores, "incumbent": deployed, "challenger": challenger, "previous": previous}
        episode_return, length = kind.play(rng, players[selection.roles[0]])
        selection.running[0] = episode_return
        selection.steps += length
        if selection.roles[0] != "average":
            selection.evaluation_steps += length
        steps += length
        decision = selection.end_episode(0, steps > max(kind.learns_from, copied_at) + 1000)
        if decision == "promoted":
            previous, deployed = deployed, challenger
        elif decision == "rolled back":
            deployed = previous
        if selection.begin_episode(0, steps > max(kind.learns_from, copied_at) + 1000):
            challenger = curve(steps, deployed)
            copied_at = steps
    return deployed, selection.evaluation_steps / selection.steps


def row(
    kind: Success | Fall | Locomotion, actor: tuple[Player, Curve], totals: list[int], runs: int, seed: int, **settings: float
) -> str:
    """Mean, and worst twentieth, of so many runs for each number of steps."""
    unit = 1.0 if isinstance(kind, Success) else kind.mean(actor[0])
    cells = []
    for total in totals:
        rng = random.Random(seed)
        ends = sorted(kind.mean(last_deployed(rng, kind, actor, total, **settings)[0]) / unit for _ in range(runs))
        cells.append(f"{fmean(ends):.3f} ({ends[len(ends) // 20]:.2f})")
    return " | ".join(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--success", type=int, default=150, help="steps of an episode that succeeds")
    parser.add_argument("--failure", type=int, default=500, help="steps of one that fails")
    parser.add_argument("--set", nargs="*", default=[], help="settings of the gate, as budget=10")
    arguments = parser.parse_args()
    settings = {
        name: int(value) if value.isdigit() else float(value) for name, value in (one.split("=") for one in arguments.set)
    }
    kind = Success(arguments.success, arguments.failure)
    print("| the actor | 50,000 steps | 100,000 steps |\n| --- | --- | --- |")
    for name, actor in SUCCESSES.items():
        print(f"| {name} | {row(kind, actor, [50_000, 100_000], arguments.runs, arguments.seed, **settings)} |", flush=True)
    print("\n| the actor | 15,000 steps | 50,000 steps |\n| --- | --- | --- |")
    for name, (fall, actor) in FALLS.items():
        print(f"| {name} | {row(fall, actor, [15_000, 50_000], arguments.runs, arguments.seed, **settings)} |", flush=True)
    print("\n| the actor | 5,000 steps | 10,000 steps | 15,000 steps | 50,000 steps |\n| --- | --- | --- | --- | --- |")
    for name, actor in UNSTEADY.items():
        totals = [5_000, 10_000, 15_000, 50_000]
        print(f"| {name} | {row(Locomotion(), actor, totals, arguments.runs, arguments.seed, **settings)} |", flush=True)


if __name__ == "__main__":
    main()
