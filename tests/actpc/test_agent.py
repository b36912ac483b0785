"""The agent: every part of Algorithm 1 is wired, and does what the paper says it does."""

import dataclasses
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_actpc import ActPC, Demonstrations, MlpPolicy
from sb3_actpc.actpc import actpc as actpc_module
from sb3_actpc.actpc import base as base_module
from sb3_actpc.actpc.batches import Batch
from sb3_actpc.actpc.reward_signals import RewardWeights
from sb3_actpc.ngc import settle_coupled
from tests.actpc.agents import QUICK, differ, imitating, make, plain, weights_of
from tests.actpc.envs import CountingEnv, demonstrations

NO_MEMORY = {"self_imitation_size": 0}
NO_TIMEOUTS = {"replay_buffer_kwargs": {"handle_timeout_termination": False}}
WHOLE_NUMBERS = gym.spaces.Box(-2, 2, (2,), np.int64)
WITHOUT_WIDTH = gym.spaces.Box(np.array([-1, 2.0]), np.array([1, 2.0]), dtype=np.float32)
WITHOUT_BOUNDS = gym.spaces.Box(-np.finfo(np.float32).max, np.finfo(np.float32).max, (2,), np.float32)


def remembering(history):
    return {"net_arch": [16, 16], "memory_history": history}


def test_the_critic_target_is_the_weighted_sum_of_the_three_parts_plus_the_bootstrap():
    weights = {"task": 0.7, "epistemic": 0.5, "instrumental": 0.25}
    model = make(demonstrations=demonstrations(), reward_weights=weights, replay_buffer_kwargs={"combined": False})
    model.learn(60)
    np.random.seed(1)
    replayed = model.replay_buffer.sample(32)
    assert replayed.epistemic.abs().min() > 0 and replayed.instrumental.max() < 0 and replayed.rewards.max() > 0
    np.random.seed(1)
    batch = next(model.sample_batches(1, 32))
    parts = 0.7 * replayed.rewards + 0.5 * replayed.epistemic + 0.25 * replayed.instrumental
    assert th.allclose(batch.rewards, parts)
    next_inputs = th.cat([batch.next_features, model.actor_target.project(batch.next_features)], dim=1)
    bootstrap = model.gamma * (1 - batch.dones) * model.critic_target.project(next_inputs)
    assert th.allclose(model.critic_targets(batch), parts + bootstrap, atol=1e-6)
    assert batch.dones.max() == 1.0  # terminal transitions were in the batch: their targets are the reward alone


@pytest.mark.parametrize("name", ["epistemic", "instrumental", "task"])
def test_each_part_of_the_reward_reaches_the_critic_and_the_actor(name):
    """An earlier agent of this family computed the epistemic term and never used it."""
    learned = []
    for weight in (0.0, 2.0):
        weights = {"epistemic": 0.0, "instrumental": 0.0, "task": 0.0, name: weight}
        signals = {"normalizer": "max", "normalization": "stored", "prior_updates": 0}  # both runs draw the same numbers
        model = make(demonstrations=demonstrations(), signal_kwargs=signals, reward_weights=weights)
        model.learn(80)
        learned.append((weights_of(model.critic), weights_of(model.actor.circuit)))
    assert differ(learned[0][0], learned[1][0]) and differ(learned[0][1], learned[1][1])


def test_signals_are_the_summed_squared_errors_over_a_maximum_that_starts_at_one():
    model = make(demonstrations=demonstrations(), learning_starts=1000)
    model.learn(30)
    buffer, raws = model.replay_buffer, []
    for row in range(30):
        o, a, n = (th.as_tensor(x[row]) for x in (buffer.observations, buffer.actions, buffer.next_observations))
        generator = model.generator.settle(th.cat([o, a], dim=1), n)
        prior = model.prior.settle(o, n)
        raws.append([float(sum(e.square().sum() for e in s.errors)) for s in (generator, prior)])
    expected = np.array(raws) / np.maximum(1.0, np.maximum.accumulate(raws, axis=0))
    assert np.allclose(buffer.epistemic[:30, 0], expected[:, 0], rtol=1e-4)
    assert np.allclose(buffer.instrumental[:30, 0], -expected[:, 1], rtol=1e-4)


def test_the_unit_form_pays_one_more_than_the_penalty_for_every_transition():
    """1 - r = 1 + (-r): the same settled errors and the same normaliser, so the two differ by 1 everywhere."""
    paid = []
    for form in ("penalty", "unit"):
        weights = {"epistemic": 0.0, "task": 0.0}
        keywords = {"reward_weights": weights, "learning_starts": 1000, "signal_kwargs": {"instrumental_form": form}}
        model = make(demonstrations=demonstrations(), **keywords).learn(40)
        np.random.seed(1)
        paid.append(next(model.sample_batches(1, 32)).rewards)
    assert th.allclose(paid[0] + 1.0, paid[1], atol=1e-6) and -1 <= paid[0].min() < paid[0].max() <= 0


def test_signals_normalised_when_sampled_follow_the_maximum_that_was_seen_last():
    """Stored once, r = r̂ / max so far; sampled, r̂ / max of all: the latter ranks transitions by r̂ for as long as they live."""
    models = {}
    for normalization in ("stored", "sampled"):
        models[normalization] = make(
            demonstrations=demonstrations(),
            signal_kwargs={"normalizer": "max", "normalization": normalization},
            learning_starts=1000,
            reward_weights={"instrumental": 0.0, "task": 0.0},
        )
        models[normalization].learn(30)
    raw = models["sampled"].replay_buffer.epistemic[:30, 0]
    running = np.maximum.accumulate(np.maximum(raw, 1.0))
    assert running[0] < running[-1]  # else nothing tells them apart
    assert np.allclose(models["stored"].replay_buffer.epistemic[:30, 0], raw / running, rtol=1e-5)
    model = models["sampled"]
    for maximum in (running[-1], 10 * running[-1]):
        model.signals.epistemic.maximum = maximum
        np.random.seed(1)
        rows = np.concatenate([[29], np.random.randint(0, 30, size=31)])
        np.random.seed(1)
        assert np.allclose(next(model.sample_batches(1, 32)).rewards[:, 0].numpy(), raw[rows] / maximum, rtol=1e-5)


def test_demonstrated_transitions_are_normalised_when_they_are_sampled_as_replayed_ones_are():
    """One batch, one normaliser: the maximum doubles, and both halves are paid half."""
    keywords = {"demonstration_fraction": 0.5, "reward_weights": {"instrumental": 0.0, "task": 0.0}}
    model = make(demonstrations=demonstrations(), signal_kwargs={"normalizer": "max"}, **keywords)
    model.learn(30)
    paid = []
    for maximum in (100.0, 200.0):
        model.signals.epistemic.maximum = maximum
        np.random.seed(1)
        paid.append(next(model.sample_batches(1, 32)).rewards[:, 0])
    assert (paid[0] > 0.0).all() and th.allclose(paid[1], paid[0] / 2.0)


@pytest.mark.parametrize("gradient_steps", [1, 4])
def test_demonstrated_transitions_are_scored_anew_as_the_generator_learns(gradient_steps, monkeypatch):
    monkeypatch.setattr(base_module, "RESCORING_INTERVAL", 30)
    model = make(demonstrations=demonstrations(), demonstration_fraction=0.5, gradient_steps=gradient_steps)
    scores = []
    for _ in range(3):
        model.learn(40, reset_num_timesteps=False)
        scores.append(model.expert.epistemic.copy())
    assert (scores[0] != scores[1]).any() and (scores[1] != scores[2]).any()


def test_the_minibatches_of_a_long_episode_are_drawn_in_parts():
    model = make()
    model.learn(40)
    batches = list(model.sample_batches(150, 16))
    assert len(batches) == 150 and {len(batch.features) for batch in batches} == {16}


def test_replayed_and_demonstrated_returns_have_one_discount_and_one_length():
    model = make(demonstrations=demonstrations(), demonstration_fraction=0.5, n_steps=3)
    model.learn(40)
    model.gamma = 0.5
    model.learn(40, reset_num_timesteps=False)
    discounts = set(next(model.sample_batches(1, 64)).discounts[:, 0].tolist())
    assert discounts <= {0.5, 0.25, 0.125} and 0.125 in discounts


def test_an_agent_with_own_rates_is_loaded_to_play_without_a_schedule(tmp_path):
    """As rl-zoo3 loads it; learning needs one."""
    model = make(policy_kwargs={"critic_kwargs": {"learning_rate": 1e-3}})
    model.save(tmp_path / "agent")
    nothing, shown = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0}, np.ones((2, 3), np.float32)
    loaded = ActPC.load(tmp_path / "agent", custom_objects=nothing)
    assert np.array_equal(loaded.predict(shown)[0], model.predict(shown)[0])
    loaded.set_env(model.env)
    with pytest.raises(ValueError, match=r"critic_kwargs has learning_rate=0\.001.*begin above"):
        loaded.learn(10)


def test_hindsight_pays_by_the_environment_that_was_set():
    env = BitFlippingEnv(n_bits=3, continuous=True)
    model = ActPC("MultiInputPolicy", env, replay_buffer_class="HerReplayBuffer", learning_starts=1)
    model.set_env(DummyVecEnv([lambda: BitFlippingEnv(n_bits=3, continuous=True)]))
    assert model.replay_buffer.env is model.env


# ---------------------------------------------------------------------- actor, critic, targets


@pytest.mark.parametrize("settling", ["iterative", "scheduled"])
def test_the_actor_update_changes_the_actor_and_leaves_the_critic_bit_identical(settling):
    model = make(settling=settling)
    model.learn(40)
    batch = next(model.sample_batches(1, 16))
    critic, actor = [v.clone() for v in model.critic.state_dict().values()], weights_of(model.actor.circuit)
    model.update_actor(batch)
    assert not differ(critic, list(model.critic.state_dict().values())) and differ(actor, weights_of(model.actor.circuit))


def step_of_actor(before_update=lambda model: None, **keywords):
    """What one update adds to the actor's synapses: by SGD with a rate of 1, the change itself; nothing was learned before.
    The agent and its batch, too."""
    policy_kwargs = {"net_arch": [16, 16], "optimizer_class": th.optim.SGD, **keywords.pop("policy_kwargs", {})}
    model = make(policy_kwargs=policy_kwargs, **{"learning_rate": 1.0, "learning_starts": 100, **keywords})
    model.learn(50)
    before_update(model)
    np.random.seed(3)
    batch, before = next(model.sample_batches(1, 16)), weights_of(model.actor.circuit)
    model.update_actor(batch)
    return [new - old for new, old in zip(weights_of(model.actor.circuit), before, strict=True)], model, batch


def test_the_refresh_change_is_added_with_its_weight_in_one_optimiser_step():
    """The step is pressure + weight * refresh: linear in the weight."""
    steps = [step_of_actor(demonstrations=demonstrations(), refresh_weight=weight)[0] for weight in (0.0, 1.0, 2.0)]
    for none, once, twice in zip(*steps, strict=True):
        assert th.allclose(twice - none, 2 * (once - none), atol=1e-5)


@pytest.mark.parametrize("shift", [5.0, 0.0])
def test_scaled_pressure_is_divided_by_the_mean_absolute_action_value_or_by_one_paid_step(shift):
    """Near 0, before any reward was seen, dividing by the value would blow the critic's noise up."""

    def shift_values(model):
        model.critic.synapses.biases[-1].add_(shift)

    steps = []
    for weight in (2.5, None):
        step, model, batch = step_of_actor(shift_values, critic_weight=weight, replay_buffer_kwargs=NO_MEMORY)
        steps.append(step)
    # the actor has moved since by some 1e-2
    inputs = th.cat([batch.features, model.actor_target.project(batch.features)], dim=1)
    value = model.critic.project(inputs).abs().mean()
    assert (value > 2.0) == (shift > 0.0)
    for unscaled, scaled in zip(*steps, strict=True):
        assert th.allclose(unscaled, scaled * value.clamp_min(1.0), rtol=1e-2, atol=1e-6)


def test_the_critic_term_has_the_nudge_that_was_asked_for():
    """A whole nudge moves the settled state, an infinitesimal one does not."""
    options = {"settling": "iterative", "replay_buffer_kwargs": NO_MEMORY, "critic_weight": 1.0}
    step, model, batch = step_of_actor(policy_kwargs={"nudge": 1.0}, **options)
    actor = model.actor_target  # as the actor was
    whole, smallest = (
        actor.hebbian_update(settle_coupled(actor, model.critic, batch.features, None, nudge).actor).tensors()
        for nudge in (1.0, None)
    )
    assert all(th.allclose(mine, wanted, atol=1e-6) for mine, wanted in zip(step, whole, strict=True))
    assert not all(th.allclose(a, b, rtol=1e-3, atol=1e-6) for a, b in zip(whole, smallest, strict=True))


def test_targets_of_actor_and_critic_move_by_tau():
    model = make(tau=0.25, learning_starts=1000)
    pairs = [(model.critic_target, model.critic), (model.actor_target, model.actor.circuit)]
    for _, circuit in pairs:
        for p in circuit.parameters():
            p.add_(1.0)
    before = [weights_of(target) for target, _ in pairs]
    model.update_targets()
    for olds, (target, circuit) in zip(before, pairs, strict=True):
        for old, new, source in zip(olds, weights_of(target), weights_of(circuit), strict=True):
            assert th.allclose(new, 0.75 * old + 0.25 * source, atol=1e-6)


def test_hard_targets_are_copied_every_c_transitions_and_rest_in_between():
    model = make(tau=1.0, target_update_interval=25)
    copied = []
    for step in range(1, 61):
        circuits, targets = weights_of(model.critic), weights_of(model.critic_target)
        model.learn(1, reset_num_timesteps=step == 1)
        if differ(targets, weights_of(model.critic_target)):
            copied.append(step)
            assert not differ(circuits, weights_of(model.critic_target))  # as it was before this step's update
    assert copied == [25, 50]


def test_the_smaller_value_of_two_critics_drawn_at_random_bootstraps():
    model = make(policy_kwargs={"net_arch": [16, 16], "n_critics": 3})
    model.learn(40)
    batch = next(model.sample_batches(1, 16))
    inputs = th.cat([batch.next_features, model.actor_target.project(batch.next_features)], dim=1)
    values = model.critic_target.project(inputs)
    pairs = th.stack([values[[0, 1]].amin(0), values[[0, 2]].amin(0), values[[1, 2]].amin(0)])
    possible = batch.rewards + (1 - batch.dones) * model.gamma * pairs
    for _ in range(10):
        found = model.critic_targets(batch)
        assert any(th.allclose(found, one) for one in possible)


def test_the_literal_bootstrap_values_the_action_taken():
    model = make(target_policy_noise=None)
    model.learn(40)
    batch = next(model.sample_batches(1, 16))
    values = model.critic_target.project(th.cat([batch.next_features, batch.actions], dim=1))
    expected = batch.rewards + (1 - batch.dones) * model.gamma * values
    assert th.allclose(model.critic_targets(batch), expected)


def test_target_smoothing_is_bounded_noise(monkeypatch):
    """Of 0.04, bounded by 2.5 standard deviations: with huge noise every action is moved by 0.1, up or down."""
    model = make().learn(40)
    batch = next(model.sample_batches(1, 16))
    quiet = model.critic_targets(batch)
    model.target_policy_noise = 0.04
    assert not th.allclose(quiet, model.critic_targets(batch))
    monkeypatch.setattr(th, "randn_like", lambda like: 1e6 * th.empty_like(like).normal_())
    next_actions = model.actor_target.project(batch.next_features)
    corners = [
        (next_actions + th.tensor(shift)).clamp(-1, 1) for shift in ([0.1, 0.1], [0.1, -0.1], [-0.1, 0.1], [-0.1, -0.1])
    ]
    possible = th.stack([model.critic_target.project(th.cat([batch.next_features, a], dim=1)) for a in corners])
    expected = batch.rewards + (1 - batch.dones) * model.gamma * possible
    assert th.isclose(expected, model.critic_targets(batch), atol=1e-5).any(0).all()


def test_generator_and_prior_learn_the_next_observation():
    """Here the next observation is minus this one."""
    data = demonstrations()
    data = dataclasses.replace(data, next_observations=-data.observations)
    model = make(demonstrations=data, signal_kwargs={"prior_updates": 300}, demonstration_fraction=0.9, learning_rate=2e-3)
    model.learn(300)
    o, actions = th.as_tensor(data.observations), th.as_tensor(model.expert.episodes.actions)
    for predicted in (model.prior.project(o), model.generator.project(th.cat([o, actions], dim=1))):
        assert (predicted + o).square().mean() < 0.3 * o.square().mean()


def test_refresh_imitates_the_agents_own_best_episodes_beside_the_demonstrations():
    errors = {}
    for with_own in (False, True):
        model = make(demonstrations=demonstrations(), critic_weight=0.0, learning_rate=2e-3)
        model.learn(15)
        lived, chosen = np.full((30, 3), 5.0), np.full((30, 2), 0.8)
        if with_own:
            model.replay_buffer.self_imitation.store(lived, chosen, 9.0)
        model.train(150, 16)
        errors[with_own] = float((model.actor.circuit.project(th.as_tensor(lived, dtype=th.float32)) - 0.8).abs().mean())
    assert errors[True] < 0.1 < 0.5 < errors[False]


def test_demonstrated_returns_reach_n_steps_ahead_and_end_with_the_episode():
    data = demonstrations(n_episodes=2, length=5)
    data = dataclasses.replace(data, rewards=np.arange(10.0), terminations=np.arange(10) == 9)
    model = make(demonstrations=data, n_steps=3)
    batch = model.expert.batch(
        np.array([0, 3, 9]), model.actor, None, RewardWeights(1.0, 1.0), 0.5, n_steps=3
    )  # no signals yet
    assert batch.rewards.ravel().tolist() == [0 + 0.5 * 1 + 0.25 * 2, 3 + 0.5 * 4, 9]
    assert batch.discounts.ravel().tolist() == [0.125, 0.25, 0.5]
    assert batch.dones.ravel().tolist() == [0, 0, 1]
    assert np.array_equal(batch.bootstrap_features, data.next_observations[[2, 4, 9]])
    assert np.array_equal(batch.next_features, data.next_observations[[0, 3, 9]])


def test_with_n_step_returns_generator_and_prior_still_predict_one_step():
    """Their surprise is measured one step on; trained n steps on, they would be surprised by everything."""
    model = make(demonstrations=demonstrations(), n_steps=3, demonstration_fraction=0.5)
    model.learn(40)
    buffer, size = model.replay_buffer, model.replay_buffer.pos
    pairs = zip(
        [*buffer.observations[:size, 0], *model.demonstrations.observations],
        [*buffer.next_observations[:size, 0], *model.demonstrations.next_observations],
        strict=True,
    )
    following = {tuple(before.tolist()): tuple(after.tolist()) for before, after in pairs}
    batch = next(model.sample_batches(1, 64))
    one_step_on = [following[tuple(row)] for row in batch.features.tolist()]
    assert [tuple(row) for row in batch.next_features.tolist()] == one_step_on
    assert differ([batch.next_features], [batch.bootstrap_features])
    model.reward_weights["epistemic"] = 0.0  # nobody predicts: the gathering is left out
    batch = next(model.sample_batches(1, 64))
    assert not differ([batch.next_features], [batch.bootstrap_features])


def test_demonstrations_fill_their_share_of_the_largest_batch_and_a_fair_one_of_a_smaller_circuits():
    data = demonstrations()
    sizes = {"critic_kwargs": {"batch_size": 64}, "generator_kwargs": {"batch_size": 32}}
    model = make(demonstrations=data, demonstration_fraction=0.5, policy_kwargs={"net_arch": [16, 16], **sizes})
    model.learn(40)
    rows = {tuple(row) for row in data.observations.tolist()}
    newest = tuple(model.replay_buffer.observations[model.replay_buffer.newest, 0].tolist())
    shares = []
    for _ in range(50):
        batch = next(model.sample_batches(1, 16))
        is_shown = [tuple(row) in rows for row in batch.features.tolist()]
        assert len(is_shown) == 64 and sum(is_shown) == 32 and tuple(batch.features[0].tolist()) == newest
        shares.append(np.mean(is_shown[:16]))
    assert np.mean(shares) == pytest.approx(0.5, abs=0.07)


@pytest.mark.parametrize(("norm_obs", "fitted"), [(True, False), (False, True)])
def test_what_vec_normalize_normalises_is_not_normalised_again(norm_obs, fitted):
    """It begins with a mean of 0: what the demonstrations look like to it then says nothing of later."""
    env = VecNormalize(DummyVecEnv([CountingEnv]), norm_obs=norm_obs)
    model = imitating(env)
    assert model.observation_normalization == "demonstrations"
    shown = demonstrations().observations
    features = model.actor.features(th.as_tensor(env.normalize_obs(shown))).numpy()
    assert np.allclose(features.mean(0), 0.0, atol=1e-4) == fitted
    assert np.allclose(features, env.normalize_obs(shown), atol=1e-5) != fitted


def test_observations_are_normalised_by_the_demonstrations_and_do_not_drift():
    data = demonstrations()
    model = make(demonstrations=data, observation_normalization="demonstrations")
    features = model.actor.features(th.as_tensor(data.observations))
    assert th.allclose(features.mean(0), th.zeros(3), atol=1e-5)
    assert th.allclose(features.std(0, correction=0), th.ones(3), atol=1e-4)
    model.set_env(model.env)  # fits again, to what is not normalised
    assert th.equal(features, model.actor.features(th.as_tensor(data.observations)))
    model.learn(60)
    assert th.equal(features, model.actor.features(th.as_tensor(data.observations)))


def test_observations_are_normalised_by_their_bounds():
    """Position in [-1.2, 0.6], velocity in [-0.07, 0.07]."""
    model = ActPC("MlpPolicy", "MountainCarContinuous-v0", **plain(observation_normalization="bounds"))
    seen = th.tensor([[-1.2, 0.07], [-0.3, 0.0], [0.15, -0.035]])
    for _ in range(2):
        assert th.allclose(model.actor.features(seen), th.tensor([[-1.0, 1.0], [0.0, 0.0], [0.5, -0.5]]), atol=1e-6)
        model.set_env(model.env)


# ---------------------------------------------------------------------- working memory


@pytest.mark.parametrize("dict_observations", [False, True])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_rebuilt_memory_equals_the_one_at_collection_across_episode_ends_and_ring_wrap(n_envs, dict_observations, monkeypatch):
    lengths = [(5 + i, 9, 3, 12) for i in range(n_envs)]
    env = DummyVecEnv([lambda n=n: CountingEnv(lengths=n, dict_observations=dict_observations) for n in lengths])
    policy = "MultiInputPolicy" if dict_observations else "MlpPolicy"
    model = ActPC(policy, env, **plain(learning_starts=1000, buffer_size=30 * n_envs, policy_kwargs=remembering(4)))
    seen, roll_out = [], type(model.actor).roll_out

    def recording(self, observations, state, episode_start, circuits):
        past = np.zeros((n_envs, 4, self.features_extractor.features_dim), np.float32) if state is None else state[0].copy()
        past[np.asarray(episode_start, dtype=bool)] = 0.0
        seen.append(self.memory(th.as_tensor(past)))
        return roll_out(self, observations, state, episode_start, circuits)

    monkeypatch.setattr(type(model.actor), "roll_out", recording)
    steps = 77  # wraps a ring of 30 rows twice
    model.learn(steps * n_envs)
    buffer, envs = model.replay_buffer, np.arange(n_envs)
    assert buffer.full and len(seen) == steps
    for age in range(30 - 4):  # the oldest rows have lost their predecessors
        row = (buffer.newest - age) % 30
        samples = buffer.gather(np.full(n_envs, row), envs)
        batch = Batch.of(samples, samples.rewards, model.actor)
        assert th.allclose(batch.memory, seen[steps - 1 - age], atol=1e-5)
        if age:  # the next step's, where the episode went on
            goes_on = buffer.dones[row] == 0
            assert th.allclose(batch.next_memory[goes_on], seen[steps - age][goes_on], atol=1e-5)
    if n_envs == 1:  # every observation is another: the oldest are never sampled
        stored = buffer.observations["a"] if dict_observations else buffer.observations
        lost = {tuple(stored[(buffer.pos + k) % 30, 0]) for k in range(4)}
        drawn = [buffer.sample(16).observations for _ in range(50)]
        drawn = {tuple(row) for one in drawn for row in (one["a"] if dict_observations else one).numpy()}
        assert not drawn & lost and len(drawn) == 26


def test_a_state_of_another_number_of_environments_is_named():
    model = make(policy_kwargs=remembering(3))
    _, state = model.predict(np.ones((2, 3), np.float32), episode_start=np.ones(2, bool))
    with pytest.raises(ValueError, match=r"state is of 2 environments, the observations are of 3"):
        model.predict(np.ones((3, 3), np.float32), state, np.zeros(3, bool))


def test_evaluate_policy_carries_the_memory_of_what_came_before_in_the_episode():
    """The action is that of o_t and of the H observations before it in its episode, o_t not among them."""
    history = 3
    model = make(policy_kwargs=remembering(history))
    seen, acted, begins = [], [], [True]

    def record(scope, _):
        seen.append(scope["observations"][0].copy())
        acted.append(scope["actions"][0].copy())
        begins.append(bool(scope["dones"][0]))  # the next one

    evaluate_policy(model, DummyVecEnv([CountingEnv]), n_eval_episodes=3, callback=record, warn=False)
    assert sum(begins[:-1]) == 3 and len(seen) == 5 + 9 + 3
    for step, action in enumerate(acted):
        start = max(index for index in range(step + 1) if begins[index])
        past = np.zeros((history, 3), np.float32)
        lived = seen[max(start, step - history) : step]
        past[history - len(lived) :] = np.reshape(lived, (-1, 3))
        expected = model.actor.circuit.project(th.as_tensor(seen[step])[None], model.actor.memory(th.as_tensor(past)[None]))
        assert np.allclose(model.policy.scale_action(action), expected[0], atol=1e-5)


# ---------------------------------------------------------------------- safety


@pytest.mark.parametrize("settling", ["iterative", "scheduled"])
def test_learning_never_backpropagates(settling, monkeypatch):
    def refuse(*args, **keywords):
        raise AssertionError("autograd was used")

    for owner, name in ((th.Tensor, "backward"), (th.autograd, "backward"), (th.autograd, "grad")):
        monkeypatch.setattr(owner, name, refuse)
    signals = {"reward_weights": {"epistemic": 0.1, "instrumental": 0.1}, "signal_kwargs": {"prior_updates": 5}}
    model = imitating(settling=settling, policy_kwargs={"memory_history": 7}, **signals)
    before = weights_of(model.policy)
    model.learn(60)
    assert differ(before, weights_of(model.policy))
    assert not any(p.requires_grad for p in model.policy.parameters())


@pytest.mark.parametrize("circuit", ["actor", "critic", "generator", "prior"])
def test_a_synapse_that_is_not_finite_is_named_with_its_circuit_and_step(circuit):
    model = make(demonstrations=demonstrations())
    model.learn(40)
    model.policy.circuits()[circuit].weights[0][0, 0] = float("nan")
    with pytest.raises(ValueError, match=rf"{circuit}: synapses are not finite at step 40"):
        model.train(100, 16)


class Images(gym.Env):
    """Every pixel says where it is and what was done before."""

    observation_space = gym.spaces.Box(0, 255, (36, 40, 3), np.uint8)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def observe(self):
        return (np.arange(36 * 40 * 3).reshape(36, 40, 3) % 251 + self.n).astype(np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n = 0
        return self.observe(), {}

    def step(self, action):
        self.n += 1
        return self.observe(), 1.0, self.n == 4, False, {}


def test_images_are_imitated_as_the_circuits_see_them():
    """Recorded with channels last, as the environment shows them; SB3 puts the channels first."""
    shown = Demonstrations.record(lambda _: np.zeros(1, np.float32), Images(), n_episodes=2)
    model = ActPC("CnnPolicy", Images(), demonstrations=shown, **{**QUICK, "policy_kwargs": {"net_arch": [8]}})
    env = model.get_env()
    first = env.reset()
    second = env.step(np.zeros((1, 1)))[0]
    expert = model.expert.episodes.observations
    assert first.shape == (1, 3, 36, 40) and np.array_equal(expert[0], first[0]) and np.array_equal(expert[1], second[0])
    model.learn(5)
    assert model.is_pretrained


def test_a_loaded_agents_signals_are_those_asked_for(tmp_path):
    model = make(demonstrations=demonstrations(), signal_kwargs={"normalizer": "max"}, learning_starts=1)
    model.learn(30)
    model.save(tmp_path / "agent")
    same, other = ActPC.load(tmp_path / "agent"), ActPC.load(tmp_path / "agent", signal_kwargs={"normalizer": "quantile"})
    assert same.signals.checkpoint_state() == model.signals.checkpoint_state()
    assert type(other.signals.epistemic) is not type(model.signals.epistemic)


# ---------------------------------------------------------------------- saving, determinism


@pytest.mark.parametrize(
    "keywords", [{"settling": "iterative"}, {"n_envs": 1}, {"policy_kwargs": {**remembering(7), "n_critics": 2}}]
)
def test_save_and_load_predict_the_same_and_training_goes_on(keywords, tmp_path):
    model = make(demonstrations=demonstrations(), **keywords).learn(40)
    model.save(tmp_path / "agent")
    model.save_replay_buffer(tmp_path / "replay")
    loaded = ActPC.load(tmp_path / "agent", env=DummyVecEnv([CountingEnv]))
    obs = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    state = model.predict(obs, episode_start=np.ones(5))[1]
    assert np.array_equal(model.predict(obs, state)[0], loaded.predict(obs, state)[0])
    assert loaded.reward_weights == model.reward_weights and loaded.is_pretrained
    loaded.load_replay_buffer(tmp_path / "replay")
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.num_timesteps == 60 and loaded._n_updates > model._n_updates


@pytest.mark.parametrize("own", [{}, {"actor_kwargs": {"learning_rate": 1e-3}, "prior_kwargs": {"learning_rate": 1e-5}}])
def test_a_saved_policy_acts_as_the_agent_does(own, tmp_path):
    """Whatever its circuits' learning rates were: it does not learn."""
    model = imitating(policy_kwargs=own).learn(20)
    model.policy.save(tmp_path / "policy.pt")
    seen = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    assert np.array_equal(MlpPolicy.load(tmp_path / "policy.pt").predict(seen)[0], model.predict(seen)[0])


@pytest.mark.parametrize(
    ("shown", "own", "is_other"),
    [
        ([0.0, 1.0], [0.0, 1.0], False),
        ([0.0, 1.0], [0.0, 100.0], True),
        ([0.0, 100.0], [0.0, 0.0], False),  # no reward yet
        ([-0.1] * 99 + [100.0], [-0.1] * 100, False),  # a beginner earns no prize
        ([-1000.0] + [-10.0] * 99, [-10.0] * 100, False),  # the same mean, a larger maximum
        ([-1000.0, 500.0], [-10.0, 5.0], True),
    ],
)
def test_demonstrated_rewards_of_another_scale_are_named_once(shown, own, is_other):
    data = demonstrations()
    model = make(demonstrations=dataclasses.replace(data, rewards=np.resize(shown, len(data))))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.expert.check_scale(np.resize(own, (499, 1)))
        assert not caught
        model.expert.check_scale(np.resize(own, (500, 1)))
        model.expert.check_scale(np.resize(own, (500, 1)))
    assert [("times the environment's" in str(one.message)) for one in caught] == [True] * is_other


def test_demonstrated_rewards_are_compared_while_the_agent_learns():
    data = demonstrations()
    model = make(demonstrations=dataclasses.replace(data, rewards=100 * data.rewards), learning_starts=600)
    with pytest.warns(UserWarning, match="the rewards in the demonstrations are .* times the environment's"):
        model.learn(540)


def test_demonstrations_that_are_set_later_are_checked_and_used(tmp_path):
    demonstrations().save(tmp_path / "demos.npz")
    model = make(demonstrations=tmp_path / "demos.npz").learn(20)
    prior = weights_of(model.prior)
    model.demonstrations = demonstrations(n_episodes=2)
    model.learn(10, reset_num_timesteps=False)
    assert len(model.expert) == 40 and not differ(prior, weights_of(model.prior))
    model.demonstrations = dataclasses.replace(demonstrations(), actions=np.zeros((60, 5), np.float32))
    with pytest.raises(ValueError, match="actions"):
        model.learn(10)


def test_learning_rates_of_circuits_and_error_synapses_follow_the_schedule():
    circuits = {"circuit_kwargs": {"feedback": "learned", "feedback_rate": 0.9}, "actor_kwargs": {"learning_rate": 5e-3}}
    model = make(learning_rate=lambda left: 1e-3 * left, settling="iterative", policy_kwargs=circuits)
    model.learn(30)
    model._current_progress_remaining = 0.5
    model.train(1, 16)
    actor, critic = ([g["lr"] for g in c.optimizer.param_groups] for c in list(model.policy.circuits().values())[:2])
    assert actor == pytest.approx([2.5e-3, 0.9 * 2.5e-3]) and critic == pytest.approx([0.5e-3, 0.45e-3])


def test_a_circuit_with_a_rate_of_zero_stands_still_beside_any_schedule():
    for schedule in (1e-3, lambda left: 1e-3 * (1.0 - left)):
        model = make(learning_rate=schedule, policy_kwargs={"critic_kwargs": {"learning_rate": 0.0}})
        critic, actor = weights_of(model.critic), weights_of(model.actor.circuit)
        model.learn(40)
        assert not differ(critic, weights_of(model.critic)) and differ(actor, weights_of(model.actor.circuit))


@pytest.mark.parametrize("n_envs", [1, 2])
def test_hindsight_relabels_goals_and_rewards_of_drawn_transitions_but_neither_signals_nor_the_newest(n_envs):
    env = DummyVecEnv([lambda: BitFlippingEnv(n_bits=6, continuous=True) for _ in range(n_envs)])
    model = ActPC("MultiInputPolicy", env, **plain(replay_buffer_class=HerReplayBuffer, learning_starts=40))
    model.learn(120)
    buffer = model.replay_buffer
    batch = buffer.sample(200)
    places = {tuple(buffer.actions[row, env]): (row, env) for row in range(buffer.pos) for env in range(n_envs)}
    rows, envs = np.array([places[tuple(action)] for action in batch.actions.numpy()]).T
    raw = buffer.gather(rows, envs)
    changed = (batch.observations["desired_goal"] != raw.observations["desired_goal"]).any(dim=1)
    assert not changed[:n_envs].any() and 0.5 < changed.float().mean() < 0.9
    assert th.equal(batch.epistemic, raw.epistemic)
    achieved = (batch.next_observations["achieved_goal"] == batch.next_observations["desired_goal"]).all(dim=1)
    assert th.equal(batch.rewards.squeeze(1), achieved.float() - 1.0)  # BitFlipping: 0 at the goal, else -1


def test_hindsight_relabels_the_same_share_of_every_minibatch():
    env = BitFlippingEnv(n_bits=6, continuous=True)
    model = ActPC("MultiInputPolicy", env, **plain(replay_buffer_class=HerReplayBuffer, learning_starts=40))
    model.learn(120)
    for stored in (model.replay_buffer.observations, model.replay_buffer.next_observations):
        stored["desired_goal"][:] = 2.0  # a goal that is never achieved
    for batch in model.sample_batches(4, 200):
        keeps_goal = (batch.features == 2.0).any(dim=1).float().mean()
        assert 0.1 < keeps_goal < 0.35


def test_hindsight_learns_from_the_first_episode_that_has_ended():
    env = BitFlippingEnv(n_bits=6, continuous=True, max_steps=6)
    model = ActPC("MultiInputPolicy", env, **plain(replay_buffer_class=HerReplayBuffer, learning_starts=0, seed=1))
    model.learn(5)
    assert model._n_updates == 0
    model.learn(15, reset_num_timesteps=False)
    assert 0 < model._n_updates <= 15


def test_hindsight_that_waits_for_an_episode_to_end_says_so(monkeypatch):
    monkeypatch.setattr(actpc_module, "ENDLESS", 30)
    env = BitFlippingEnv(n_bits=6, continuous=True, max_steps=1000)
    model = ActPC("MultiInputPolicy", env, **plain(replay_buffer_class=HerReplayBuffer, learning_starts=0))
    with pytest.warns(UserWarning, match="an episode has gone on for 30 steps") as said:
        model.learn(70)
    assert len([one for one in said if "gone on" in str(one.message)]) == 1 and model._n_updates == 0


@pytest.mark.parametrize("n_steps", [1, 3])
def test_the_memory_of_the_bootstrapped_step_is_the_one_that_the_same_step_has_as_a_first(n_steps):
    """m_{t+n} of row t is m_t of row t + n, in the replay buffer and in the demonstrations."""
    data = demonstrations()
    model = make(policy_kwargs=remembering(4), n_steps=n_steps, demonstrations=data, demonstration_fraction=0.5)
    model.learn(60)
    buffer, rows = model.replay_buffer, np.arange(40)
    samples = buffer.gather(rows, np.zeros(len(rows), int))
    batch = Batch.of(samples, samples.rewards, model.actor)
    goes_on = np.array([not buffer.dones[row : row + n_steps].any() for row in rows[:-n_steps]])
    assert goes_on.any() and batch.memory.abs().sum() > 0
    assert th.allclose(batch.next_memory[:-n_steps][goes_on], batch.memory[n_steps:][goes_on], atol=1e-6)
    rows = np.arange(len(model.expert))
    shown = model.expert.batch(rows, model.actor, None, model.used_weights, model.gamma, n_steps)
    goes_on = rows + n_steps < model.expert.ends
    assert goes_on.any()
    assert th.allclose(shown.next_memory[goes_on], shown.memory[rows[goes_on] + n_steps], atol=1e-6)


def test_a_second_learn_cuts_the_episode_it_interrupts():
    model = make(policy_kwargs=remembering(3), learning_starts=1000)
    model.learn(7)  # stops in the second episode, two steps in
    assert model.replay_buffer.dones[6, 0] == 0
    model.learn(2)  # resets the environment
    assert model.replay_buffer.dones[6, 0] == 1 and model.replay_buffer.timeouts[6, 0] == 1
    samples = model.replay_buffer.gather(np.array([7, 8]), np.zeros(2, int))
    assert samples.history_mask.tolist() == [[0, 0, 0], [0, 0, 1]]


def test_vec_normalize_relabels_the_task_reward_alone():
    env = VecNormalize(DummyVecEnv([CountingEnv]))
    model = make(env, demonstrations=demonstrations(), demonstration_fraction=0.25, policy_kwargs=remembering(7))
    with pytest.warns(UserWarning, match="statistics drift"):
        model.learn(60)
    np.random.seed(0)
    raw = model.replay_buffer.sample(32)
    np.random.seed(0)
    normalised = model.replay_buffer.sample(32, env=env)
    assert th.equal(raw.epistemic, normalised.epistemic) and th.equal(raw.instrumental, normalised.instrumental)
    assert not th.equal(raw.rewards, normalised.rewards)


# ---------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("keywords", "named"),
    [
        ({"signal_kwargs": {"normalizer": "mean"}}, "signal_kwargs=.*: normalizer='mean'"),
        ({"signal_kwargs": {"normaliser": "max"}}, "signal_kwargs.*has no keyword 'normaliser'"),
        ({"target_update_interval": 0}, "target_update_interval=0"),
        ({"demonstration_fraction": 1.5}, "demonstration_fraction=1.5"),
        ({"refresh_weight": -1.0}, "refresh_weight=-1.0"),
        ({"reward_weights": {"epistemic": -1.0}}, r"reward_weights\['epistemic'\]=-1.0 must be at least 0"),
        ({"reward_weights": {"task": "1"}}, r"reward_weights\['task'\]='1' must be a finite number"),
        ({"reward_weights": {"alpha_ep": 1.0}}, "'alpha_ep': choose from .'task', 'epistemic', 'instrumental'"),
        ({"action_noise": -0.1}, "action_noise=-0.1 must be at least 0"),
        ({"action_noise": "0.1"}, "action_noise='0.1' must be None, a standard deviation, or one of SB3's"),
        ({"n_demonstrations": (3, "steps")}, "must be a whole number .* or .number, 'episodes' or 'transitions'"),
        ({"policy_kwargs": {"activation_fn": th.nn.ReLU}}, "has no keyword 'activation_fn'"),
        ({"policy_kwargs": {"sleepiness": 0.5}}, "ActPCPolicy has no keyword 'sleepiness'"),
        ({"policy_kwargs": {"n_critics": 0}}, "n_critics=0"),
        ({"policy_kwargs": {"nudge": 0.0}}, "nudge=0.0"),
        ({"policy_kwargs": {"optimizer_kwargs": {"lr": 1.0}}}, "optimizer_kwargs has lr=1.0: use learning_rate="),
        ({"policy_kwargs": {"circuit_kwargs": {"settling": "iterative"}}}, "give settling= to the agent"),
        ({"policy_kwargs": {"actor_kwargs": {"settling": "iterative"}}}, "critic settling='scheduled' must agree"),
        ({"policy_kwargs": {"actor_kwargs": {"output_activation": "relu"}}}, "choose one of .'tanh', 'clamp'"),
        ({"policy_kwargs": {"critic_kwargs": {"output_activation": "tanh"}}}, "critic_kwargs: a circuit has no keywords"),
        ({"policy_kwargs": {"net_arch": {"vf": [8]}}}, "unknown keys"),
        ({"policy_kwargs": {"circuit_kwargs": {"activation": "gelu"}}}, "activation='gelu'"),
        ({"policy_kwargs": {"circuit_kwargs": {"n_steps": 3}}}, "a circuit has no keywords"),
        ({"policy_kwargs": {"critic_kwargs": {"hidden": [8]}}}, "critic_kwargs: a circuit has no keywords"),
        ({"policy_kwargs": {"optimizer_class": th.optim.LBFGS}}, "asks for a loss"),
        ({"policy_kwargs": {"critic_kwargs": {"learning_rate": 1.0}}, "learning_rate": lambda left: 1 - left}, "begin above"),
        ({"demonstration_fraction": 0.5}, "demonstration_fraction: give demonstrations="),
        ({"n_demonstrations": 3}, "n_demonstrations: give demonstrations="),
        ({"replay_buffer_kwargs": {"combine": True}}, "replay_buffer_kwargs=.*'combine'"),
        ({"replay_buffer_kwargs": {"n_steps": 2}}, "replay_buffer_kwargs=.*'n_steps'"),
        ({"settling": "fast"}, "settling='fast'"),
        ({"target_policy_noise": None, "n_steps": 3}, "n_steps=3 does not work with target_policy_noise=None.*use 1"),
        ({"optimize_memory_usage": True, **NO_TIMEOUTS}, "optimize_memory_usage=False or a weight of 0"),
        (
            {"reward_weights": {"epistemic": 0.0}, "optimize_memory_usage": True, "n_steps": 3, **NO_TIMEOUTS},
            "n_steps=3 does not work",
        ),
        ({"observation_normalization": "bounds"}, "needs a flat Box whose bounds are below"),
        ({"device": "xpu"}, "device='xpu' must be 'auto' or a torch device of this machine"),
        ({"guidance_kwargs": {"gat": True}}, "guidance_kwargs=.*'gat'"),
        ({"guidance": "best"}, "guidance='best' must be None, 'default', 'none' or an ActorGuidance"),
        ({"learning_rat": 0.1}, "ActPC has no keyword 'learning_rat' .did you mean 'learning_rate'"),  # a TypeError
        ({"alpha_ep": 1.0}, "ActPC has no keyword 'alpha_ep'; choose from .*reward_weights"),
    ],
)
def test_a_wrong_keyword_is_named(keywords, named):
    with pytest.raises((ValueError, TypeError), match=named):
        make(**keywords)


@pytest.mark.parametrize(
    ("policy", "observations", "actions", "named"),
    [
        ("MlpPolicy", (3,), WHOLE_NUMBERS, r"int64\) must have a floating dtype: wrap the environment"),
        ("MlpPolicy", (3,), WITHOUT_WIDTH, "dimension 1 has low == "),
        ("MlpPolicy", (3,), WITHOUT_BOUNDS, "must have finite bounds"),
        ("MlpPolicy", (36, 36, 3), None, "ActPCPolicy does not take .*: use 'CnnPolicy'"),
        ("MlpPolicy", {}, None, "MultiInputPolicy"),
        (MlpPolicy, {}, None, "ActPCPolicy does not take .*: use 'MultiInputPolicy'"),
        ("MultiInputPolicy", (3,), None, "MultiInputPolicy does not take .*: use 'MlpPolicy'"),
        ("MultiInputPolicy", (36, 36, 3), None, "MultiInputPolicy does not take .*: use 'CnnPolicy'"),
    ],
)
def test_spaces_that_do_not_fit_are_named(policy, observations, actions, named):
    env = CountingEnv(dict_observations=observations == {})
    env.action_space = actions or env.action_space
    if observations:
        env.observation_space = gym.spaces.Box(0, 255, observations, np.uint8 if len(observations) > 1 else np.float32)
    with pytest.raises(ValueError, match=named):
        ActPC(policy, env)


@pytest.mark.parametrize("field", ["observations", "rewards", "last observations"])
def test_an_environment_that_is_not_finite_is_named_with_its_step(field):
    class Broken(CountingEnv):
        def step(self, action):
            obs, reward, terminated, *rest = super().step(action)
            if field == "last observations":
                obs = obs * np.nan if terminated else obs
            elif self.episode == 2:
                obs, reward = (obs * np.nan, reward) if field == "observations" else (obs, np.inf)
            return obs, reward, terminated, *rest

    step = 5 if field == "last observations" else 15
    with pytest.raises(ValueError, match=rf"environment: {field.split()[-1]} are not finite at step {step}"):
        make(DummyVecEnv([Broken])).learn(100)


# ---------------------------------------------------------------------- demonstrations that come and go


def test_the_prior_learns_from_the_demonstrations_and_then_stands_still():
    """Where it has no role, it does not learn, and it learns once."""
    model = make(demonstrations=demonstrations(), signal_kwargs={"prior_updates": 50}, reward_weights={"instrumental": 0.0})
    untrained = weights_of(model.prior)
    model.learn(20)
    assert not differ(untrained, weights_of(model.prior))
    model.reward_weights = {"instrumental": 1.0}
    model.learn(20)
    trained = weights_of(model.prior)
    model.learn(20)
    assert differ(untrained, trained) and not differ(trained, weights_of(model.prior))


def test_a_batch_may_be_of_demonstrations_alone():
    model = imitating(demonstration_fraction=1.0, policy_kwargs={"memory_history": 2})
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # no means of nothing
        model.learn(60)
    assert np.isfinite(list(model.diagnostics.values.values())).all()


def test_what_has_no_effect_without_demonstrations_is_named():
    with pytest.warns(UserWarning, match="'instrumental'.=1 has no effect without demonstrations="):
        make().learn(5)
    with pytest.warns(UserWarning, match=r"guidance_kwargs=.*have no effect without guidance"):
        make(guidance_kwargs={"gate": False})


def test_an_actor_with_nothing_to_learn_from_is_named() -> None:
    """Without critic term, demonstrations and self-imitation nothing would change."""
    with pytest.warns(UserWarning, match="critic_weight=0 without demonstrations"):
        ActPC("MlpPolicy", "Pendulum-v1", critic_weight=0.0)


class Counter(gym.Env):
    """Its observation is a whole number of Python's, its episodes have three steps."""

    observation_space, action_space = gym.spaces.Discrete(4), gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self.count, {}

    def step(self, action):
        self.count += 1
        return self.count, 0.0, self.count == 3, False, {}


def test_observations_may_be_numbers_of_python():
    assert ActPC("MlpPolicy", Counter(), learning_starts=2, policy_kwargs={"net_arch": [8]}).learn(10).num_timesteps == 10


def test_a_prior_that_would_learn_nothing_is_refused():
    with pytest.raises(ValueError, match=r"reward_weights\['instrumental'\]=1: .*start value, which is 0: begin above"):
        make(
            demonstrations=demonstrations(), reward_weights={"instrumental": 1.0}, learning_rate=lambda left: 1e-3 * (1 - left)
        )
