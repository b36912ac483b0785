"""Recording: whoever acts, wherever, an episode's rows are what the environment showed, and only what is asked for is kept."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_actpc.demonstrations import Demonstrations, fit_demonstrations, recording
from tests.recordings import record


class Corridor(gym.Env[Any, Any]):
    """Counts its steps; ends by itself after ``length`` steps with success in every second episode."""

    def __init__(self, length: int = 4, reports: bool | str = True, is_dict: bool = False, dense: bool = False) -> None:
        self.length, self.reports, self.is_dict, self.dense, self.episode = length, reports, is_dict, dense, -1
        box = spaces.Box(-100, 100, (2,), np.float32)
        # not in alphabetical order
        self.observation_space = spaces.Dict([("state", box), ("goal", spaces.Box(-1, 1, (1,)))]) if is_dict else box
        self.action_space = spaces.Box(-2, 2, (1,), np.float32)

    def observe(self) -> Any:
        state = np.array([self.episode, self.t], dtype=np.float32)
        return {"state": state, "goal": np.full(1, 0.5, np.float32)} if self.is_dict else state

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.episode, self.t, self.last_seed = self.episode + 1, 0, seed
        return self.observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        succeeds = self.episode % 2 == 1
        info: dict[str, Any] = {"is_success": succeeds} if self.reports is True or (succeeds and self.reports) else {}
        if self.dense:
            info["dense_reward"] = 10.0 * self.t
        return self.observe(), float(self.t), self.t == self.length, False, info


def forward(_: Any) -> np.ndarray:
    return np.ones(1, dtype=np.float32)


class Noting:
    """SB3's predict, that notes what it is given; its state counts its own calls in an episode."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, Any, bool, bool]] = []
        self.started: list[int] = []

    def start(self, seed: int) -> None:
        self.started.append(seed)

    def predict(self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False) -> Any:
        self.calls.append((observation, state, bool(episode_start[0]), deterministic))
        return forward(observation), (state or 0) + 1


def test_rows_are_what_the_environment_showed() -> None:
    shown = Demonstrations.record(forward, Corridor(), 2, only_successes=False)
    assert shown.observations[:, 1].tolist() == [0, 1, 2, 3] * 2
    assert shown.next_observations[:, 1].tolist() == [1, 2, 3, 4] * 2
    assert shown.rewards.tolist() == [1, 2, 3, 4] * 2
    assert shown.terminations.tolist() == [False, False, False, True] * 2
    assert shown.episode_starts.tolist() == [0, 4]
    assert shown.dense_rewards is not None and shown.dense_rewards.tolist() == shown.rewards.tolist()
    assert shown.env_id == "Corridor"


def test_a_time_limit_is_no_termination_and_dense_rewards_are_kept_apart() -> None:
    shown = Demonstrations.record(forward, gym.wrappers.TimeLimit(Corridor(dense=True), 3), 1, only_successes=False)
    assert len(shown) == 3 and not shown.terminations.any()
    assert shown.dense_rewards is not None and shown.dense_rewards.tolist() == [10, 20, 30]
    assert shown.rewards.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("reports", "only_successes", "episodes"),
    [
        (True, None, [1, 3]),
        (True, True, [1, 3]),
        (True, False, [0, 1]),
        (False, None, [0, 1]),
        ("successes alone", True, [1, 3]),
        ("successes alone", None, [0, 1]),
    ],
)
def test_successes_only_unless_told_otherwise(reports: bool | str, only_successes: bool | None, episodes: list[int]) -> None:
    shown = Demonstrations.record(forward, Corridor(reports=reports), 2, only_successes)
    assert sorted(set(shown.observations[:, 0])) == episodes
    assert shown.metadata["n_tries"] == episodes[-1] + 1


def test_predict_is_given_its_own_state_and_told_of_every_new_episode() -> None:
    agent = Noting()
    Demonstrations.record(agent, Corridor(length=2), 2, only_successes=False, deterministic=False, seed=7)
    assert [call[1:] for call in agent.calls] == [(None, True, False), (1, False, False)] * 2
    assert agent.started == [7, 8]


@pytest.mark.parametrize("action", [0.5, None, [0.1, 0.2], [[0.1]], [3.0], (np.zeros(1), None)])
def test_an_action_of_another_shape_or_out_of_bounds_is_refused_where_it_is_made(action: Any) -> None:
    def act(observation: np.ndarray) -> Any:
        return action if observation[1] == 2 else np.zeros(1)

    with pytest.raises(ValueError, match=r"the demonstrator gives .* at step 2: Corridor takes an array of Box\(-2.0, 2.0"):
        Demonstrations.record(act, Corridor(), 1, only_successes=False)


def test_several_demonstrators_take_turns_and_try_again_where_they_fail() -> None:
    first, second = Noting(), Noting()
    Demonstrations.record([first, second], Corridor(length=1), 2, seed=0)
    assert first.started == [0, 1], "the first try fails"
    assert second.started == [2, 3]


def test_dict_observations_are_flattened_in_the_order_of_their_space() -> None:
    env = Corridor(is_dict=True)
    shown = Demonstrations.record(forward, env, 1)
    expected = spaces.utils.flatten(env.observation_space, {"state": np.array([1, 2]), "goal": np.array([0.5])})
    assert shown.observations[2].tolist() == list(expected)


class WritesOn(Corridor):
    """Shows one array, on which it goes on writing, as it does on the actions that it is given."""

    def observe(self) -> Any:
        self.__dict__.setdefault("shown", np.zeros(2, np.float32))[:] = self.episode, self.t
        return self.shown

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        action[:] = -9.0
        return super().step(action)


def test_rows_are_copies_of_what_environment_and_demonstrator_write_on() -> None:
    held = np.zeros(1, np.float32)

    def act(observation: np.ndarray) -> np.ndarray:
        held[:] = observation[1] / 4
        return held

    shown = Demonstrations.record(act, WritesOn(), 1, only_successes=False)
    assert shown.observations[:, 1].tolist() == [0, 1, 2, 3]
    assert shown.next_observations[:, 1].tolist() == [1, 2, 3, 4]
    assert shown.actions.ravel().tolist() == [0, 0.25, 0.5, 0.75]


class Clock(Corridor):
    """Observes the seconds since 1970 in double precision, and a constant."""

    def __init__(self) -> None:
        super().__init__(length=10, reports=False)
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def observe(self) -> Any:
        return np.array([0.5, 1.7e9 + self.t])


def test_features_that_float32_cannot_follow_are_named() -> None:
    with pytest.warns(UserWarning, match="cannot tell apart successive values of column 1: let the environment") as warned:
        Demonstrations.record(forward, Clock(), 2)
    assert len(warned) == 1


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("env_id", ["SparseHopper-v5", "GoalReacher-v5", "Pendulum-v1"])
def test_no_feature_of_usual_tasks_is_named(env_id: str) -> None:
    record(env_id)


def test_a_model_sees_observations_as_its_vec_normalize_shows_them() -> None:
    env = VecNormalize(DummyVecEnv([lambda: Corridor()]))
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, n_epochs=1, device="cpu", seed=0).learn(16)
    shown = Demonstrations.record(model, Corridor(), 1)
    expected = model.predict(env.normalize_obs(shown.observations), deterministic=True)[0]
    np.testing.assert_allclose(shown.actions, expected, atol=1e-6)
    assert not np.allclose(shown.actions, model.predict(shown.observations, deterministic=True)[0])


def test_an_episode_that_goes_on_and_on_is_said_to(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "ENDLESS", 4)
    with pytest.warns(UserWarning, match="gone on for 4 steps.*TimeLimit"):
        Demonstrations.record(lambda _: np.zeros(1), Corridor(length=5), 1)


@pytest.mark.parametrize(
    "space", [spaces.Discrete(3), spaces.MultiBinary(2), spaces.Dict(state=spaces.Box(-1, 1, (2,)), cell=spaces.Discrete(3))]
)
def test_observations_that_are_no_boxes_are_refused(space: spaces.Space[Any]) -> None:
    env = Corridor()
    env.observation_space = space
    with pytest.raises(ValueError, match=r"need Box observations or a Dict of Boxes, found (Discrete|MultiBinary)"):
        Demonstrations.record(forward, env, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"demonstrator": 3}, "3 must have SB3's predict, or be a function"),
        ({"n_episodes": 0}, "n_episodes=0 must be at least 1"),
        ({"n_episodes": 1.5}, "n_episodes=1.5 must be at least 1, a whole number"),
        ({"n_episodes": "3"}, "n_episodes='3' must be at least 1, a whole number"),
        ({"max_tries": 0}, "max_tries=0 must be at least 1, a whole number"),
        ({"max_tries": "3"}, "max_tries='3' must be at least 1, a whole number"),
        ({"seed": -1}, "seed=-1 must be at least 0, a whole number"),
        ({"demonstrator": []}, r"\[\] must have SB3's predict"),
        ({"env": "CartPole-v1"}, "Box action space, found Discrete"),
        ({"env": Corridor(), "n_episodes": 2, "max_tries": 3}, "only 1 of 3 episodes succeeded in Corridor, 2 are needed"),
        (
            {"env": Corridor(reports=False), "only_successes": True},
            "needs an environment whose info has is_success or success",
        ),
        ({"env": 3}, "env must be a Gymnasium environment or the id of one, found 3"),
    ],
)
def test_wrong_arguments_are_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Demonstrations.record(**{"demonstrator": forward, "env": Corridor(), "n_episodes": 1, **change})


@dataclass
class Trajectory:
    """As imitation.data.types.TrajectoryWithRew."""

    obs: Any
    acts: Any
    infos: Any
    terminal: bool
    rews: Any = None


class DictObs:
    """As imitation.data.types.DictObs."""

    def __init__(self, parts: dict[str, np.ndarray]) -> None:
        self.parts = parts

    def unwrap(self) -> dict[str, np.ndarray]:
        return self.parts


class TestTrajectories:
    def test_of_the_imitation_library(self) -> None:
        observations = np.arange(8.0).reshape(4, 2)
        ended = Trajectory(observations, np.ones((3, 1)), [{}] * 3, True, np.array([0.0, 0.0, 1.0]))
        cut = Trajectory(observations, np.ones((3, 1)), [{}, {}, {"TimeLimit.truncated": True}], True, np.zeros(3))
        shown = Demonstrations.from_trajectories([ended, cut], "Named-v0")
        assert shown.observations.tolist() == [[0, 1], [2, 3], [4, 5]] * 2
        assert shown.next_observations.tolist() == [[2, 3], [4, 5], [6, 7]] * 2
        assert shown.terminations.tolist() == [False, False, True, False, False, False]
        assert shown.rewards.tolist() == [0, 0, 1, 0, 0, 0]
        assert shown.dense_rewards is None

    def test_without_infos_the_registered_time_limit_tells_what_was_cut(self) -> None:
        """imitation's rollout drops the infos, and calls cut episodes terminal."""
        lengths = (50, 49)  # the Reacher's limit, and one less
        told = [Trajectory(np.zeros((n + 1, 10)), np.zeros((n, 2)), None, True, np.zeros(n)) for n in lengths]
        shown = Demonstrations.from_trajectories(told, "gymnasium:Reacher-v5")
        assert shown.terminations[[49, 98]].tolist() == [False, True]
        with pytest.warns(UserWarning, match="of Named-v0, whose time limit is not known.*exclude_infos=False"):
            assert Demonstrations.from_trajectories(told, "Named-v0").terminations[[49, 98]].all()

    @pytest.mark.parametrize(
        ("info", "terminates"), [({}, False), ({"TimeLimit.truncated": False}, True), ({"TimeLimit.truncated": True}, False)]
    )
    def test_infos_without_the_time_limits_key_are_judged_by_the_length(self, info: dict[str, Any], terminates: bool) -> None:
        """Gymnasium's TimeLimit does not write it; Stable-Baselines3 does."""
        whole = Trajectory(np.zeros((51, 10)), np.zeros((50, 2)), [{}] * 49 + [info], True, np.zeros(50))
        assert Demonstrations.from_trajectories([whole], "Reacher-v5").terminations[-1] == terminates

    @pytest.mark.parametrize(
        ("n_seen", "n", "infos", "message"),
        [
            (4, 3, [{}] * 2, "at least 1 action and an info of each, found 3 acts, 2 infos"),
            (1, 0, [], "at least 1 action and an info of each, found 0 acts, 0 infos"),
            (2, 2, None, "an observation more than actions, found 2 and 2"),
        ],
    )
    def test_what_does_not_fit_together_is_refused(self, n_seen: int, n: int, infos: Any, message: str) -> None:
        short = Trajectory(np.zeros((n_seen, 2)), np.zeros((n, 1)), infos, False, np.zeros(n))
        with pytest.raises(ValueError, match=message):
            Demonstrations.from_trajectories([short], "Named-v0")
        states = Trajectory(np.arange(4), np.ones((3, 1)), None, False, np.zeros(3))
        with pytest.raises(ValueError, match=r"need Box observations, found obs of shape \(4,\)"):
            Demonstrations.from_trajectories([states], "Named-v0")

    def test_without_rewards_the_last_step_is_paid_as_said(self) -> None:
        plain = Trajectory(np.zeros((3, 2)), np.zeros((2, 1)), [{"dense_reward": 1.0}, {"dense_reward": 2.0}], True)
        with pytest.raises(ValueError, match="without rews need final_reward"):
            Demonstrations.from_trajectories([plain], "Named-v0")
        shown = Demonstrations.from_trajectories([plain], "Named-v0", final_reward=1.0)
        assert shown.rewards.tolist() == [0, 1]
        assert shown.dense_rewards is not None and shown.dense_rewards.tolist() == [1, 2]

    def test_dict_observations_need_a_space(self) -> None:
        parts = DictObs({"goal": np.full((3, 1), 9.0), "state": np.arange(6.0).reshape(3, 2)})
        trajectory = Trajectory(parts, np.zeros((2, 1)), None, False, np.zeros(2))
        with pytest.raises(ValueError, match="need observation_space"):
            Demonstrations.from_trajectories([trajectory], "Named-v0")
        space = Corridor(is_dict=True).observation_space
        shown = Demonstrations.from_trajectories([trajectory], "Named-v0", observation_space=space)
        first = spaces.utils.flatten(space, {"goal": np.array([9.0]), "state": np.array([0.0, 1.0])})
        assert shown.observations[0].tolist() == list(first)


def test_demonstrations_of_the_dense_base_task_fit_the_sparse_one() -> None:
    """Paid as the sparse task pays the same actions."""
    options: dict[str, Any] = {"condition": "forward", "threshold": 0.5, "max_episode_steps": 200}
    rng = np.random.default_rng(0)
    with gym.make("HalfCheetah-v5", max_episode_steps=200) as dense:
        shown = Demonstrations.record(lambda _: rng.uniform(-1, 1, 6).astype(np.float32), dense, 1)
    env = DummyVecEnv([lambda: gym.make("SparseHalfCheetah-v5", **options)])
    fitted = fit_demonstrations(shown, env, env.observation_space, env.action_space)
    with gym.make("SparseHalfCheetah-v5", **options) as sparse:
        sparse.reset(seed=0)
        paid = [sparse.step(action)[1] for action in shown.actions]
    assert fitted.rewards.tolist() == paid and 0 < sum(paid) < len(paid)
    assert np.array_equal(fitted.dense_rewards, shown.rewards)
    env.close()


@pytest.mark.parametrize(
    ("recorded_id", "env_id", "message"),
    [
        ("SparseWalker2d-v5", "GoalHalfCheetah-v5", "SparseWalker2d-v5"),
        ("Walker2d-v5", "GoalHalfCheetah-v5", "Walker2d-v5"),
        ("Walker2d-v5", "HalfCheetah-v5", r"record them in this environment, .* rename them: .*env_id='HalfCheetah-v5'"),
    ],
)
def test_another_tasks_demonstrations_are_named(recorded_id: str, env_id: str, message: str) -> None:
    """The Walker2d's rows are as long as the HalfCheetah's."""
    env = DummyVecEnv([lambda: gym.make(env_id)])
    with pytest.raises(ValueError, match=message):
        fit_demonstrations(record(recorded_id), env, env.observation_space, env.action_space)
    env.close()


def test_a_success_that_is_no_number_is_named() -> None:
    class Named(gym.Wrapper):  # type: ignore[type-arg]
        def step(self, action: Any) -> Any:
            *result, info = self.env.step(action)
            return *result, {**info, "is_success": {"task": True}}

    with pytest.raises(ValueError, match=r"must be true or false, found \{'task': True\}"):
        Demonstrations.record(lambda _: np.zeros(1), Named(gym.make("Pendulum-v1")), 1)
