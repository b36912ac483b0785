"""Hindsight replay: the goal tasks, the priorities, the exploration, and that it learns what it is made for."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc import ActPC, preset, shipped_demonstrations
from sb3_actpc.actpc.buffers import CombinedDictReplayBuffer, CombinedHerReplayBuffer
from sb3_actpc.baselines import HER
from sb3_actpc.baselines.her import PrioritizedHerReplayBuffer
from sb3_actpc.demonstrations import Demonstrations, fit_demonstrations
from sb3_actpc.envs import GOAL_MUJOCO_IDS, sparse_env_id
from sb3_actpc.experiments.runs import Run, train_run
from sb3_actpc.experiments.runs.environments import make_env
from tests.checkpoints.runs import assert_same, learn_in_two, learn_straight
from tests.recordings import record

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date.*", "ignore:.*infinity.*")
SMALL = {"policy_kwargs": {"net_arch": [16]}, "batch_size": 16, "buffer_size": 700, "seed": 1, "learning_starts": 0}


# ---------------------------------------------------------------------- goal tasks


@pytest.mark.parametrize("env_id", GOAL_MUJOCO_IDS)
def test_a_goal_task_is_its_sparse_task_with_goals(env_id: str) -> None:
    """Same states, same pay, same ends; the goals alone decide the pay."""
    goal, sparse = gym.make(env_id), gym.make(sparse_env_id(env_id))
    check_env(goal, skip_render_check=True)
    row, _ = goal.reset(seed=3)
    observation, _ = sparse.reset(seed=3)
    goal.action_space.seed(3)
    for _ in range(30):
        assert np.isin(row["observation"], observation).all()
        action = goal.action_space.sample()
        row, reward, terminated, truncated, info = goal.step(action)
        observation, paid, *ends, expected = sparse.step(action)
        assert reward == paid
        assert [terminated, truncated] == ends and info["dense_reward"] == expected["dense_reward"]
        assert reward == goal.get_wrapper_attr("compute_reward")(row["achieved_goal"], row["desired_goal"], {})
        # what was achieved would have been paid as a goal
        assert goal.get_wrapper_attr("compute_reward")(row["achieved_goal"], row["achieved_goal"], {}) == 1.0
        if terminated or truncated:
            break
    goal.close()
    sparse.close()


def test_what_the_reacher_observes_of_its_target_is_in_the_goal_alone() -> None:
    """Or a relabelled transition would show two targets."""
    env = gym.make("GoalReacher-v5")
    observe = env.get_wrapper_attr("observation")
    env.reset(seed=0)
    task = env.unwrapped
    before = observe(task._get_obs())
    task.set_state(task.data.qpos + np.array([0, 0, 0.05, 0.05]), task.data.qvel)
    after = observe(task._get_obs())
    assert np.array_equal(before["observation"], after["observation"])
    assert not np.array_equal(before["desired_goal"], after["desired_goal"])
    assert after["desired_goal"] == pytest.approx(task.get_body_com("target")[:2])
    assert after["achieved_goal"] == pytest.approx(task.get_body_com("fingertip")[:2])
    env.close()


def test_a_condition_without_a_position_has_no_goal_version() -> None:
    with pytest.raises(ValueError, match="condition='forward' has no goal"):
        gym.make("GoalHopper-v5", condition="forward")


@pytest.mark.parametrize("kind", ["Sparse", ""])
@pytest.mark.parametrize("env_id", ["GoalReacher-v5", "GoalReacher-v4", "GoalHopper-v5", "GoalSwimmer-v4"])
def test_demonstrations_of_either_task_without_goals_become_those_that_the_goal_task_records(env_id: str, kind: str) -> None:
    """The same random actions from the same seeds, recorded in both."""
    env = make_vec_env(env_id)
    shown = fit_demonstrations(record(env_id.replace("Goal", kind)), env, env.observation_space, env.action_space)
    live = gym.make(env_id, max_episode_steps=12)
    live.action_space.seed(0)
    rows, rewards = [], []
    for episode in range(2):
        row, _ = live.reset(seed=episode)
        done = False
        while not done:
            rows.append(gym.spaces.flatten(live.observation_space, row))
            row, reward, terminated, truncated, _ = live.step(live.action_space.sample())
            rewards.append(reward)
            done = terminated or truncated
    assert shown.env_id == env_id
    assert shown.observations == pytest.approx(np.array(rows), abs=1e-4)
    assert shown.rewards.tolist() == rewards
    again = fit_demonstrations(shown, env, env.observation_space, env.action_space)
    assert np.array_equal(again.observations, shown.observations) and again.env_id == env_id
    env.close()
    live.close()


# ---------------------------------------------------------------------- priorities


def goal_buffer(size: int = 40, **options: float) -> PrioritizedHerReplayBuffer:
    env = make_vec_env("GoalReacher-v5")
    return PrioritizedHerReplayBuffer(
        size, env.observation_space, env.action_space, env, n_sampled_goal=1, goal_selection_strategy="final", **options
    )


def add_episode(buffer: HerReplayBuffer, number: int, length: int) -> None:
    """Its transitions achieve (number, step) and wish for (0, 0)."""
    for step in range(length):
        goal = np.array([[number, step]], dtype=float)
        row = {"observation": np.zeros((1, 6)), "achieved_goal": goal - [[0, 1]], "desired_goal": np.zeros((1, 2))}
        done = np.array([step == length - 1])
        buffer.add(row, {**row, "achieved_goal": goal}, np.zeros((1, 2)), np.zeros(1), done, [{}])


def test_every_transition_is_there_twice_with_its_own_and_with_its_episodes_last_goal() -> None:
    buffer = goal_buffer()
    add_episode(buffer, 1, 4)
    add_episode(buffer, 2, 6)
    add_episode(buffer, 3, 2)
    batch = buffer.sample(240)
    wished = [tuple(goal) for goal in batch.observations["desired_goal"].tolist()]
    assert sorted(set(wished)) == [(0, 0), (1, 3), (2, 5), (3, 1)]
    for goal, share in (((0, 0), 0.5), ((1, 3), 4 / 24), ((2, 5), 6 / 24), ((3, 1), 2 / 24)):
        assert wished.count(goal) / 240 == pytest.approx(share, abs=0.02)
    assert (buffer.importance_weights == 1).all()  # new transitions all have the same priority
    reached = (batch.next_observations["achieved_goal"] == batch.observations["desired_goal"]).all(dim=1)
    assert (batch.rewards[reached] == 1).all()


def test_transitions_are_drawn_by_their_errors_and_weighed_against_it() -> None:
    """Of ten transitions, each with two goals, one has an error of 16: its priority is 4."""
    buffer = goal_buffer(alpha=0.5, beta=0.4, beta_increment=0.1, epsilon=0.0)
    add_episode(buffer, 1, 10)

    def is_the_one(batch) -> np.ndarray:
        is_second = batch.next_observations["achieved_goal"][:, 1] == 2
        return (is_second & (batch.observations["desired_goal"][:, 0] == 0)).numpy()

    chosen = is_the_one(buffer.sample(20))
    assert chosen.sum() == 1  # all are equal: each is drawn once
    buffer.update_priorities(np.where(chosen, -16.0, 1.0))
    chosen = is_the_one(buffer.sample(2300))
    assert chosen.mean() == pytest.approx(4 / 23, abs=0.005)
    weights = buffer.importance_weights[:, 0].numpy()
    assert weights[chosen] == pytest.approx(4**-0.5) and weights[~chosen] == pytest.approx(1.0)  # beta was 0.4 and is 0.5
    assert buffer.beta == pytest.approx(0.6)
    add_episode(buffer, 2, 1)
    assert buffer.priorities[10, 0].tolist() == [4.0, 4.0]


def test_an_overwritten_episode_is_drawn_no_more() -> None:
    buffer = goal_buffer(size=10)
    add_episode(buffer, 1, 6)
    add_episode(buffer, 2, 4)
    add_episode(buffer, 3, 2)  # overwrites the first two steps of the first episode: all of it goes
    numbers = np.concatenate([buffer.sample(32).next_observations["achieved_goal"][:, 0] for _ in range(20)])
    assert set(numbers.tolist()) == {2.0, 3.0}


# ---------------------------------------------------------------------- the algorithm


def make(**options: object) -> HER:
    return HER("MultiInputPolicy", "GoalReacher-v5", **{**SMALL, "demonstrations": record("SparseReacher-v5"), **options})


def test_random_actions_become_rarer_down_to_their_smallest_share() -> None:
    model = make(demonstrations=None, random_action_decay=0.99)
    for steps, share in ((0, 1.0), (50, 0.99**50), (1000, 0.32)):
        model.num_timesteps = steps
        assert model.random_action_probability == pytest.approx(share)
    share = {"random_action_start": 0.4, "random_action_decay": 1.0, "random_action_end": 0.1}
    model = make(demonstrations=None, train_freq=600, **share)
    for parameter in model.actor.parameters():
        parameter.data.zero_()  # always acts 0
    model.learn(600)
    assert model.replay_buffer.actions[:600].any(axis=(1, 2)).mean() == pytest.approx(0.4, abs=0.06)


def weights(model: HER) -> np.ndarray:
    return np.concatenate([parameter.detach().numpy().ravel() for parameter in model.policy.parameters()])


@pytest.mark.parametrize("prioritized", [True, False])
def test_it_learns_from_its_own_episodes_and_from_demonstrations_with_relabelled_goals(prioritized: bool) -> None:
    model = make(prioritized=prioritized, cloning_weight=1.0)
    before = weights(model)
    model.learn(49)
    assert np.array_equal(before, weights(model))  # no episode has ended
    model.learn(5, reset_num_timesteps=False)
    assert not np.array_equal(before, weights(model))
    shown = model.replay_buffer.demonstrated.sample(200)
    ends = record("SparseReacher-v5").next_observations[[11, 23]]
    last = {tuple(np.round(row[8:10] + row[4:6], 4)) for row in ends.astype(np.float64)}
    relabelled = {tuple(np.round(goal, 4)) for goal in shown.observations["desired_goal"][100:].double().numpy()}
    assert relabelled == last


@pytest.mark.parametrize(("alpha", "matters"), [(0.0, False), (0.6, True)])
def test_the_loss_is_weighed_where_priorities_differ(alpha: float, matters: bool) -> None:
    """With α = 0 they are all 1, whatever the errors are, and so are the weights, whatever β is."""
    kwargs = {"alpha": alpha, "beta_increment": 0.0}
    none, full = (make(replay_buffer_kwargs={**kwargs, "beta": beta}).learn(60) for beta in (0.0, 1.0))
    assert np.array_equal(weights(none), weights(full)) is not matters
    assert (len(np.unique(none.replay_buffer.priorities[:50])) > 2) is matters


def test_a_stopped_run_goes_on_bit_for_bit(tmp_path) -> None:
    straight = learn_straight(make, tmp_path / "straight", 120)
    resumed = learn_in_two(make, tmp_path / "two", 120, 75)
    assert_same(straight, resumed)
    mine, theirs = straight.replay_buffer, resumed.replay_buffer
    assert mine.checkpoint_state() == theirs.checkpoint_state()
    assert np.array_equal(mine.priorities, theirs.priorities)


def test_a_saved_replay_buffer_relabels_again(tmp_path) -> None:
    model = make().learn(60)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = make()
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    assert len(loaded.replay_buffer.sample(16).rewards) == 16


@pytest.mark.parametrize("agent", [HER, ActPC])
def test_relabelled_transitions_get_the_rewards_of_the_environment_that_was_set(agent: type[HER] | type[ActPC]) -> None:
    kwargs = {"learning_starts": 100} if agent is HER else {"learning_starts": 100, "replay_buffer_class": HerReplayBuffer}
    model = agent("MultiInputPolicy", "GoalReacher-v5", **kwargs)
    model.set_env(make_vec_env("GoalReacher-v5", env_kwargs={"miss_reward": -1.0}))
    rewards = model.learn(60).replay_buffer.sample(200).rewards
    assert set(rewards.unique().tolist()) <= {-1.0, 1.0}


def test_random_actions_have_the_shape_of_the_environments() -> None:
    class Folded(gym.ActionWrapper):
        def __init__(self) -> None:
            super().__init__(gym.make("GoalReacher-v5"))
            self.action_space = gym.spaces.Box(-1.0, 1.0, (2, 1))

        def action(self, action: np.ndarray) -> np.ndarray:
            return action[:, 0]

        def compute_reward(self, *args: Any) -> Any:
            return self.unwrapped.compute_reward(*args)

    model = HER("MultiInputPolicy", make_vec_env(Folded, n_envs=3), random_action_start=0.5, buffer_size=300).learn(30)
    assert model.replay_buffer.actions.shape[1:] == (3, 2)


def test_a_task_without_goals_is_refused() -> None:
    with pytest.raises(ValueError, match="such as GoalReacher-v5"):
        HER("MlpPolicy", "SparseReacher-v5")


@pytest.mark.parametrize("share", [None, 0.0, 1.0])
def test_some_goals_of_actpcs_hindsight_were_reached_in_any_episode(share: float | None) -> None:
    env = make_vec_env("GoalReacher-v5")
    given = {} if share is None else {"random_goals": share}
    buffer = CombinedHerReplayBuffer(40, env.observation_space, env.action_space, env, combined=False, **given)
    for number in (1, 2, 3, 4):
        add_episode(buffer, number, 10)
    batch = buffer.sample(10_000)
    own, wished = batch.next_observations["achieved_goal"].numpy(), batch.observations["desired_goal"].numpy()
    assert np.array_equal(wished, batch.next_observations["desired_goal"].numpy())
    relabelled = wished[:, 0] > 0.0  # a fifth of n_sampled_goal=4 + 1 keeps (0, 0)
    assert relabelled.mean() == pytest.approx(0.8)
    elsewhere, n = relabelled & (wished[:, 0] != own[:, 0]), relabelled.sum()
    expected = 0.375 if share is None else share
    # of four episodes one is its own, and of ten steps the last is its episode's end, which it is with its own goal alone
    assert elsewhere.sum() / n == pytest.approx(expected * 3 / 4 * 9 / 10, abs=0.025)
    assert not elsewhere[own[:, 1] == 9].any()
    is_earlier = relabelled & ~elsewhere & (wished[:, 1] < own[:, 1])  # 36 of the 100 pairs of steps
    assert is_earlier.sum() / n == pytest.approx(expected / 4 * 0.36, abs=0.02)
    assert np.array_equal(batch.rewards.numpy()[relabelled, 0] > 0, (own == wished).all(1)[relabelled])
    reached = {(number, step) for number in (1, 2, 3, 4) for step in range(10)}
    assert {tuple(goal) for goal in wished[relabelled].tolist()} == reached


def test_random_goals_were_reached_in_all_environments_and_in_episodes_that_have_ended() -> None:
    """Two environments, one of which has an episode that runs; after the time limit of the others one may go on."""
    env = make_vec_env("GoalReacher-v5", n_envs=2)
    spaces = env.observation_space, env.action_space
    buffer = CombinedHerReplayBuffer(60, *spaces, env, n_envs=2, combined=False, random_goals=1.0)
    for step in range(15):
        goal = np.array([[1.0, step], [2.0, step]])
        row = {"observation": np.zeros((2, 6)), "achieved_goal": goal - [[0, 1]], "desired_goal": np.zeros((2, 2))}
        done = np.array([step == 9, step == 14])
        infos = [{"TimeLimit.truncated": bool(one)} for one in done]
        buffer.add(row, {**row, "achieved_goal": goal}, np.zeros((2, 2)), np.zeros(2), done, infos)
    batch = buffer.sample(2000)
    own, wished = batch.next_observations["achieved_goal"].numpy(), batch.observations["desired_goal"].numpy()
    ended = {(1.0, float(step)) for step in range(10)} | {(2.0, float(step)) for step in range(15)}
    assert {tuple(goal) for goal in wished[wished[:, 0] > 0.0].tolist()} == ended
    last = (own == [1.0, 9.0]).all(1) & (wished[:, 0] > 0.0)
    assert (wished[last] != own[last]).any()


@pytest.mark.slow
def test_actpc_does_not_fall_below_what_a_slow_arm_shows_of_fetch_reach() -> None:
    """A critic that has seen the arm's actions alone presses away from the goal: -31 after 6,000 steps. One that has seen
    goals of the same episode alone makes the arm slow: -7 in the mean of these episodes."""
    pytest.importorskip("gymnasium_robotics")
    env = make_env("FetchReach-v4", {})

    def slowly(observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.append(np.clip(8.0 * (observation["desired_goal"] - observation["achieved_goal"]), -1.0, 1.0), 0.0)

    shown = Demonstrations.record(slowly, env, n_episodes=40, only_successes=True)
    settings = {**preset("FetchReach-v4"), "demonstrations": shown, "guidance_kwargs": {"bc_updates": 2000}}
    model = ActPC(env=env, **settings, seed=0, device="cpu").learn(10_000)
    played = [episode["r"] for episode in model.ep_info_buffer]  # the last hundred: 5,000 steps under pressure
    assert len(played) == 100 and np.mean(played) > shown.episode_returns.mean()
    deployed, _ = evaluate_policy(model, model.get_env(), 20)
    learning, _ = evaluate_policy(model.actor_policy, model.get_env(), 20)
    assert deployed > shown.episode_returns.mean() - 1.5 and learning > shown.episode_returns.mean() - 0.5


@pytest.mark.slow
def test_her_solves_fetch_reach_within_its_20000_steps(tmp_path) -> None:
    """At least 90 % of 50 episodes, as every working HER does."""
    pytest.importorskip("gymnasium_robotics")
    config = Run(env="FetchReach-v4", algo="her", eval_episodes=50, progress=False, output=str(tmp_path / "run"))
    result = train_run(config, print)
    assert result["success"] >= 0.9


def test_hindsight_is_known_by_its_class_and_not_by_a_name() -> None:
    """A user's class of any name has one-step returns by default, as hindsight needs; others keep three."""
    shown = shipped_demonstrations("SparseReacher-v5")
    own, plain = type("Relabelled", (CombinedHerReplayBuffer,), {}), type("NoHerReplayBuffer", (CombinedDictReplayBuffer,), {})
    for kind, n_steps in ((own, 1), ("HerReplayBuffer", 1), (HerReplayBuffer, 1), (plain, 3)):
        kwargs = {"demonstrations": shown, "replay_buffer_class": kind, "buffer_size": 200, "device": "cpu"}
        assert ActPC("MultiInputPolicy", "GoalReacher-v5", **kwargs).n_steps == n_steps
