"""The examination of a critic, where its true values are known in closed form, and of states rebuilt from recordings."""

import random
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th

from sb3_actpc import ActPC
from sb3_actpc.cli import main
from sb3_actpc.demonstrations.dataset import Demonstrations, shipped_demonstrations
from sb3_actpc.envs import SPARSE_MUJOCO_IDS
from sb3_actpc.experiments.examination import FILE, examine, rebuilt_states

ENV_ID = "Rotation-v0"
GAMMA, OFFSET, WANTED = 0.9, 0.2, 0.3
TURN = np.array([[0.8, -0.6], [0.6, 0.8]])
QUICK: dict[str, Any] = {"n_states": 12, "horizon": 6}


class RotationEnv(gym.Env[np.ndarray, np.ndarray]):
    """The state turns, whatever the action; a step is paid -|a - WANTED s|^2, and densely the opposite."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(-2.0, 2.0, (2,), np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.place = np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1.0, 1.0, 2)
        return self.place, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        reward = -float(np.square(action - WANTED * self.place).sum())
        self.place = TURN @ self.place
        return self.place, reward, False, False, {"dense_reward": -reward}


for env_id, kind in ((ENV_ID, "RotationEnv"), ("HeldRotation-v0", "HeldRotationEnv"), ("ChangingRotation-v0", "ChangingEnv")):
    if env_id not in gym.registry:
        gym.register(env_id, f"{__name__}:{kind}", max_episode_steps=10)


class HeldRotationEnv(gym.Env[np.ndarray, np.ndarray]):
    """The same in an attribute."""

    def __init__(self) -> None:
        self.env: gym.Env[np.ndarray, np.ndarray] = RotationEnv()
        self.observation_space, self.action_space = self.env.observation_space, self.env.action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        return self.env.reset(seed=seed)

    def step(self, action: np.ndarray) -> Any:
        return self.env.step(action)


class ChangingEnv(HeldRotationEnv):
    """It holds another one from the third reset on: the second episode's states cannot be put into it."""

    n_resets = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.n_resets += 1
        if self.n_resets > 2:
            self.env = gym.wrappers.TimeLimit(RotationEnv(), 50)
        return super().reset(seed=seed)


class RotationAgent:
    """a = (WANTED + OFFSET) s; what the examination asks of an agent, without circuits."""

    gamma, demonstrations, expert = GAMMA, None, None
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    policy = SimpleNamespace(scale_action=lambda actions: actions, unscale_action=lambda actions: actions)
    inputs = SimpleNamespace(observations=th.as_tensor, features=lambda observations: observations.double())

    def predict(self, observations: np.ndarray, state: Any, episode_start: Any, deterministic: bool) -> tuple[np.ndarray, Any]:
        return (WANTED + OFFSET) * observations, state


def true_values(features: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """-|a - WANTED s|^2, then for ever the policy's -OFFSET^2 |s|^2, since turning leaves |s| as it is."""
    later = -(OFFSET**2) * features.square().sum(1) / (1.0 - GAMMA)
    return -(actions.double() - WANTED * features).square().sum(1) + GAMMA * later


def found(table: pd.DataFrame, group: str = "all") -> dict[str, float]:
    part = table[table.group == group]
    return dict(zip(part.measure, part.value, strict=True))


def test_the_true_critic_is_worth_following() -> None:
    """The true values rank as the returns do, a small step along them always pays, and their tail completes the returns."""
    measures = found(examine(RotationAgent(), ENV_ID, perturbation=0.01, values=true_values, **QUICK).table)
    assert measures["rank_correlation_paid"] == pytest.approx(1.0)
    assert measures["rank_correlation_dense"] == pytest.approx(-1.0)
    assert measures["along_wins_paid"] == measures["along_over_random_paid"] == 1.0
    assert measures["against_wins_paid"] == measures["along_wins_dense"] == measures["along_ties_paid"] == 0.0
    assert measures["calibration_bias"] == pytest.approx(0.0, abs=1e-6)
    # states of one episode are worth the same, and are ranked by rounding
    assert measures["calibration_correlation"] == pytest.approx(1.0, abs=0.1)


def test_the_negated_critic_misleads() -> None:
    """Ranks are reversed, and a step along the gradient never pays."""
    examination = examine(RotationAgent(), ENV_ID, values=lambda *pair: -true_values(*pair), perturbation=0.01, **QUICK)
    measures = found(examination.table)
    assert measures["rank_correlation_paid"] == pytest.approx(-1.0)
    assert measures["along_wins_paid"] == measures["along_over_random_paid"] == 0.0
    assert measures["against_wins_paid"] == 1.0


def test_a_critic_without_a_slope_moves_nothing() -> None:
    """Along and against are then the policy itself: nothing but ties, and no correlation to speak of. Random moves do move."""
    measures = found(examine(RotationAgent(), ENV_ID, values=lambda f, a: 0.0 * true_values(f, a), **QUICK).table)
    assert measures["along_ties_paid"] == 1.0
    assert measures["along_gain_paid"] == 0.0
    assert np.isnan(measures["rank_correlation_paid"])
    assert measures["random_gain_paid"] != 0.0


def test_an_environment_that_is_held_is_set_into_its_episode_too() -> None:
    options: dict[str, Any] = {"values": true_values, **QUICK}
    plain, held = (examine(RotationAgent(), name, **options).rows for name in (ENV_ID, "HeldRotation-v0"))
    pd.testing.assert_frame_equal(plain, held)
    with pytest.raises(ValueError, match=r"middle of an ep.*'env: \w*TimeLimit', 'RotationEnv'\], .*'env: RotationEnv'\]"):
        examine(RotationAgent(), "ChangingRotation-v0", **options)


@pytest.mark.parametrize("hold", [1, 3])
def test_a_move_has_its_length_and_lasts_as_long_as_it_is_held(hold: int) -> None:
    """Along the gradient, towards WANTED s: the distance d shrinks by the step, so r gains d^2 - (d - step)^2 each time."""
    size = 0.01
    rows = examine(RotationAgent(), ENV_ID, values=true_values, perturbation=size, hold=hold, **QUICK).rows
    paid = rows[rows.move != "random"].pivot(index="state", columns="move", values="paid")
    distance = np.sqrt(-paid.policy / sum(GAMMA**t for t in range(QUICK["horizon"])))
    step = size * 2**0.5
    expected = (distance**2 - (distance - step) ** 2) * sum(GAMMA**t for t in range(hold))
    np.testing.assert_allclose(paid.along - paid.policy, expected, rtol=1e-3)


def test_the_table_counts_its_states() -> None:
    """Half of the states are of noisy episodes; without demonstrations there are no distances and no thirds."""
    table = examine(RotationAgent(), ENV_ID, values=true_values, **QUICK).table
    assert dict(zip(table.group, table.states, strict=True)) == {"all": 12, "noisy": 6, "own": 6}


@pytest.mark.parametrize(("name", "value"), [("n_states", 0), ("horizon", 0), ("hold", 0), ("noise", -1), ("perturbation", 3)])
def test_numbers_out_of_range_are_named(name: str, value: float) -> None:
    wrong: dict[str, Any] = {name: value}
    with pytest.raises(ValueError, match=f"{name}={value}"):
        examine(RotationAgent(), ENV_ID, values=true_values, **wrong)


def small_agent(env_id: str, **keywords: Any) -> ActPC:
    return ActPC(
        "MlpPolicy", env_id, settling="scheduled", policy_kwargs={"net_arch": [16]}, seed=0, buffer_size=500, **keywords
    )


def test_the_agent_and_the_generators_are_left_as_they_are() -> None:
    """By default the values are those of the critic that presses the actor."""
    agent = small_agent(ENV_ID)
    before = [parameter.clone() for parameter in agent.policy.parameters()]
    states = random.getstate(), np.random.get_state()[1].tolist(), th.get_rng_state()  # type: ignore[index]
    rows = examine(agent, ENV_ID, n_states=4, horizon=3).rows
    assert all(map(th.equal, before, agent.policy.parameters()))
    assert random.getstate() == states[0]
    assert np.random.get_state()[1].tolist() == states[1]  # type: ignore[index]
    assert th.equal(th.get_rng_state(), states[2])

    def critic(features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return agent.critic.first().project(th.cat([features, actions], dim=1)).mean(1)

    pd.testing.assert_frame_equal(rows, examine(agent, ENV_ID, values=critic, n_states=4, horizon=3).rows)


def test_demonstrated_states_are_examined_apart() -> None:
    """Each is itself the nearest to the demonstrations; the agent's own are split by distance into thirds."""
    env_id = "SparseHopper-v5"
    agent = small_agent(env_id, demonstrations=shipped_demonstrations(env_id), n_demonstrations=2)
    examination = examine(agent, env_id, n_states=18, horizon=3)
    sources = examination.rows.groupby("source")
    assert set(examination.table.group) == {"all", "demonstrated", "own", "noisy", "near", "middle", "far"}
    assert sources.state.nunique().to_dict() == {"demonstrated": 6, "own": 6, "noisy": 6}
    assert sources.distance.max()["demonstrated"] < 0.2 < sources.distance.max()["noisy"]
    furthest = examination.rows[examination.rows.source != "demonstrated"].groupby("state").distance.first()
    assert (examination.table[examination.table.group == "far"].states == 4).all()
    assert furthest.min() >= 0.0


@pytest.mark.parametrize("env_id", [env_id for env_id in SPARSE_MUJOCO_IDS if env_id.endswith("v5")])
def test_a_rebuilt_state_goes_on_as_the_recording_did(env_id: str) -> None:
    """The demonstrated action leads from it to what was observed and paid next."""
    known = Demonstrations.load(shipped_demonstrations(env_id)).select(n_episodes=1)
    positions, velocities, usable = rebuilt_states(known, env_id)
    env = gym.make(env_id)
    simulation: Any = env.unwrapped
    for row in usable[[5, len(usable) // 2, -1]]:
        env.reset(seed=0)
        origin = 0.0 if "Reacher" in env_id else simulation.data.qpos[0]
        positions[row, 0] += origin
        simulation.set_state(positions[row], velocities[row])
        observation, reward, *_ = env.step(known.actions[row + 1])
        np.testing.assert_allclose(observation, known.next_observations[row + 1], atol=1e-3)
        assert reward == known.rewards[row + 1]


def test_the_command_writes_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    preset = tmp_path / "small.yml"
    preset.write_text(
        f"{ENV_ID}: {{n_timesteps: 30, policy: MlpPolicy, settling: scheduled, learning_starts: 10, "
        "policy_kwargs: {net_arch: [16]}}\n"
    )
    folder = tmp_path / "run"
    train = ["train", "--env", ENV_ID, "--algo", "actpc", "--preset", str(preset), "--eval-episodes", "1"]
    assert main([*train, "--output", str(folder)]) == 0
    assert main(["examine", str(folder), "--states", "4", "--horizon", "3"]) == 0
    assert "rank_correlation_paid" in capsys.readouterr().out
    table = pd.read_csv(folder / FILE)
    assert list(table.columns) == ["group", "measure", "states", "value", "standard_error"]
    assert (table[table.group == "all"].states == 4).all()
    assert main(["examine", str(tmp_path)]) == 2
