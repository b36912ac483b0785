"""What an agent's trials keep of what its learner gains, simulated: no circuit, only who succeeds how often.

    python benchmarks/trials.py                  # the race of docs/recipe.md, "All or nothing"
    python benchmarks/trials.py --failure 500 --success 400 --runs 600

An episode succeeds, which pays 1 and takes so many steps, or fails. The learner's chance of a success follows a curve of the
steps, or of what its habit has; a candidate has the chance that the learner had when it was frozen. Prints, for the agent's
rule and for trials that end after 4,000 steps, the habit's chance in the end, mean and worst twentieth over the runs.
"""

import argparse
import random
from collections.abc import Callable
from statistics import fmean
from unittest.mock import patch

from sb3_actpc.actpc import habit
from sb3_actpc.actpc.habit import Trials

PRESSED_FROM = 7000  # environment steps: critic's warm-up, and the first candidate's age
Curve = Callable[[int, float], float]  # steps and the habit's chance -> the learner's

LEARNERS: dict[str, tuple[float, Curve]] = {
    "from 0.6 to 0.95 by 50,000 steps": (0.6, lambda steps, now: min(0.95, 0.6 + 0.35 * steps / 50_000)),
    "from 0.7 to 0.95 by 80,000": (0.7, lambda steps, now: min(0.95, 0.7 + 0.25 * steps / 80_000)),
    "from 0.4 beside 0.7, to 0.95 by 80,000": (0.7, lambda steps, now: min(0.95, 0.4 + 0.55 * steps / 80_000)),
    "a tenth above its habit, from 0.6": (0.6, lambda steps, now: min(0.95, now + 0.1)),
    "from 0.95 to 1 by 50,000": (0.95, lambda steps, now: min(1.0, 0.95 + 0.05 * steps / 50_000)),
    "0.95 beside 0.85": (0.85, lambda steps, now: 0.95),
    "always, beside 0.85": (0.85, lambda steps, now: 1.0),
    "always, beside 0.95": (0.95, lambda steps, now: 1.0),
    "a tenth below its habit, from 0.9": (0.9, lambda steps, now: now - 0.1),
    "a tenth below, from 0.6": (0.6, lambda steps, now: now - 0.1),
    "a twentieth below, from 0.85": (0.85, lambda steps, now: now - 0.05),
}


def final_chance(rng: random.Random, first: float, curve: Curve, total: int, success: int, failure: int) -> float:
    """
    :param first: the first habit's chance
    :param total: environment steps
    :param success: steps of an episode that succeeds
    :param failure: steps of one that fails
    :return: the last habit's chance
    """
    trials, steps, now, candidate = Trials(1), 0, first, 0.0
    while steps < total:
        chance = {"actor": curve(steps, now), "habit": now, "candidate": candidate}[trials.roles[0]]
        succeeds = rng.random() < chance
        trials.step(0, float(succeeds))
        trials.lengths[0] = success if succeeds else failure
        steps += trials.lengths[0]
        if trials.end(0, has_learned=steps > PRESSED_FROM) == "accepted":
            now = candidate
        if trials.begin(0):
            candidate = curve(steps, now)
    return now


def cell(learner: tuple[float, Curve], total: int, arguments: argparse.Namespace) -> str:
    """Mean, and the worst twentieth, of so many runs."""
    rng = random.Random(arguments.seed)
    ends = sorted(final_chance(rng, *learner, total, arguments.success, arguments.failure) for _ in range(arguments.runs))
    return f"{fmean(ends):.3f} ({ends[len(ends) // 20]:.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--success", type=int, default=150, help="steps of an episode that succeeds")
    parser.add_argument("--failure", type=int, default=500, help="steps of one that fails")
    parser.add_argument("--steps", type=int, nargs="+", default=[50_000, 100_000])
    arguments = parser.parse_args()
    rules = {"without a race": habit.DOUBTFUL, "with it": habit.RACING}
    heads = [f"{rule}, {steps:,} steps" for steps in arguments.steps for rule in rules]
    print("| the learner | " + " | ".join(heads) + " |\n" + "| --- " * (len(heads) + 1) + "|")
    for name, learner in LEARNERS.items():
        cells = []
        for steps in arguments.steps:
            for times in rules.values():
                with patch.object(habit, "RACING", times):
                    cells.append(cell(learner, steps, arguments))
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
