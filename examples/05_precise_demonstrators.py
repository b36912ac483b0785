"""Three small tasks of one's own, their controllers, and what clones of these make of 10 and 30 episodes.

Clones either imitate what is shown or also, with noise, what lies between the episodes; by default the demonstrations are
asked which. No extras; some minutes. The table is in docs/recipe.md.
"""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_actpc import ActPC
from sb3_actpc.demonstrations import Demonstrations

warnings.simplefilter("ignore")
N_TRIALS, FIRST_TRIAL = 100, 50_000


class OwnTask(gym.Env[np.ndarray, np.ndarray]):
    """Paid 1 where it succeeds, which ends the episode; cut after 100 steps. Actions are in [-1, 1]."""

    n_observations, n_actions = 6, 2

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.n_observations,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (self.n_actions,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.n_steps = 0
        self.start()
        return self.observe().astype(np.float32), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.move(np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0))
        self.n_steps += 1
        succeeds = bool(self.distance() < 0.08)
        is_cut = self.n_steps == 100 and not succeeds
        return self.observe().astype(np.float32), float(succeeds), succeeds, is_cut, {"is_success": succeeds}


class TwoLinks(OwnTask):
    """An arm of two links, whose tip is to be at a target."""

    n_observations = 8

    def start(self) -> None:
        self.joints = self.np_random.uniform([-3.0, 0.5], [3.0, 2.5])
        angle, radius = self.np_random.uniform(-3.0, 3.0), self.np_random.uniform(0.6, 1.8)
        self.target = radius * np.array([np.cos(angle), np.sin(angle)])

    def tip(self) -> np.ndarray:
        first, second = self.joints[0], self.joints.sum()
        return np.array([np.cos(first) + np.cos(second), np.sin(first) + np.sin(second)])

    def observe(self) -> np.ndarray:
        return np.concatenate([np.cos(self.joints), np.sin(self.joints), self.tip(), self.target])

    def move(self, action: np.ndarray) -> None:
        self.joints = self.joints + 0.1 * action

    def distance(self) -> float:
        return float(np.linalg.norm(self.tip() - self.target))

    def control(self, _: np.ndarray) -> np.ndarray:
        first, second = self.joints[0], self.joints.sum()
        rows = [[-np.sin(first) - np.sin(second), -np.sin(second)], [np.cos(first) + np.cos(second), np.cos(second)]]
        slopes = np.array(rows)
        damped = slopes @ slopes.T + 0.05 * np.eye(2)
        return np.clip(slopes.T @ np.linalg.solve(damped, 5.0 * (self.target - self.tip())), -1.0, 1.0).astype(np.float32)


class Cart(OwnTask):
    """A cart that turns and drives, to a target."""

    def start(self) -> None:
        self.position, self.target = self.np_random.uniform(-1.0, 1.0, (2, 2))
        self.heading = self.np_random.uniform(-3.0, 3.0)

    def observe(self) -> np.ndarray:
        return np.concatenate([self.position, [np.cos(self.heading), np.sin(self.heading)], self.target])

    def move(self, action: np.ndarray) -> None:
        self.heading += 0.3 * action[1]
        self.position = self.position + 0.05 * action[0] * np.array([np.cos(self.heading), np.sin(self.heading)])

    def distance(self) -> float:
        return float(np.linalg.norm(self.position - self.target))

    def control(self, _: np.ndarray) -> np.ndarray:
        way = self.target - self.position
        turn = (np.arctan2(way[1], way[0]) - self.heading + np.pi) % (2.0 * np.pi) - np.pi
        return np.array([np.clip(np.cos(turn), 0.0, 1.0), np.clip(3.0 * turn, -1.0, 1.0)], dtype=np.float32)


class Fetch(OwnTask):
    """A thing that is fetched, and carried to one place."""

    n_observations, n_actions = 10, 3
    place = np.array([0.5, -0.5, 0.2])

    def start(self) -> None:
        self.hand, self.thing = self.np_random.uniform(-1.0, 1.0, (2, 3))
        self.holds = False

    def observe(self) -> np.ndarray:
        return np.concatenate([self.hand, self.thing, self.thing - self.hand, [float(self.holds)]])

    def move(self, action: np.ndarray) -> None:
        self.hand = self.hand + 0.06 * action
        self.holds = self.holds or bool(np.linalg.norm(self.hand - self.thing) < 0.06)
        self.thing = self.hand.copy() if self.holds else self.thing

    def distance(self) -> float:
        return float(np.linalg.norm(self.thing - self.place))

    def control(self, _: np.ndarray) -> np.ndarray:
        goal = self.place if self.holds else self.thing
        return np.clip(8.0 * (goal - self.hand), -1.0, 1.0).astype(np.float32)


def success(model: ActPC, env: OwnTask) -> float:
    """Share of the trials, whose starts are always the same."""
    n = 0
    for trial in range(N_TRIALS):
        observation, info = env.reset(seed=FIRST_TRIAL + trial)
        is_over = False
        while not is_over:
            observation, _, terminated, truncated, info = env.step(model.predict(observation)[0])
            is_over = terminated or truncated
        n += info["is_success"]
    return n / N_TRIALS


print("task      episodes  asked  without noise  with it")
for task in (TwoLinks, Cart, Fetch):
    for n_episodes in (10, 30):
        env = task()
        shown = Demonstrations.record(env.control, env, n_episodes=n_episodes, seed=1000)
        found = []
        for noise in (None, 0.0, 1.0):
            imitates = {"ensemble_size": 1, "noise": noise}
            model = ActPC("MlpPolicy", task(), demonstrations=shown, refresh_kwargs=imitates, actor_warm_start=3000, seed=3)
            if noise is None:
                found.append(model.imitation.noise)
                continue
            model.pretrain()
            found.append(success(model, task()))
        print(
            f"{task.__name__:8}  {n_episodes:8}  {'noise' if found[0] else 'none':5}  {found[1]:13.2f}  {found[2]:7.2f}",
            flush=True,
        )
