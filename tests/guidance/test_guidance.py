"""The default guidance as an agent lives it: BC first, warm-up, gate, self-imitation; and hooks of one's own."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_actpc import ActPC
from sb3_actpc.guidance import ActorGuidance, BehaviorGuidance, GuidanceConfig, GuidanceContext
from sb3_actpc.ngc import NGCCircuit
from tests.actpc.agents import QUICK, differ, imitating, make, weights_of
from tests.actpc.envs import CountingEnv, demonstrations


def test_bc_imitates_before_any_step_and_starts_target_and_deployed_policy():
    data = demonstrations()
    errors = {}
    for n_updates in (0, 400):
        model = imitating(learning_starts=50, guidance_kwargs={"bc_updates": n_updates})
        model.learn(1)
        features = model.actor.features(th.as_tensor(data.observations))
        actions = model.actor.circuit.project(features)
        errors[n_updates] = float((actions - th.as_tensor(data.actions / 2)).square().mean())
        for circuit in (model.actor_target, model.actor.deployed):
            assert not differ(weights_of(circuit), weights_of(model.actor.circuit)) or n_updates == 0
    assert errors[400] < 0.5 * errors[0]


def test_the_critic_term_waits_for_the_end_of_the_warm_up():
    settings = {"bc_updates": 1, "critic_warmup": 20}
    model = imitating(guidance_kwargs=settings, refresh_weight=0.0, gradient_steps=1, policy_delay=1)
    model.learn(1)
    before = weights_of(model.actor.circuit)
    model.train(19, 16)
    assert not differ(before, weights_of(model.actor.circuit))
    model.train(1, 16)
    assert differ(before, weights_of(model.actor.circuit))


@pytest.mark.parametrize("n_critics", [1, 2, 5])
def test_the_q_filter_imitates_unless_all_critics_value_the_own_action_more(n_critics):
    model = imitating(policy_kwargs={"n_critics": n_critics, "net_arch": [8]})
    model.learn(5)
    rng = np.random.default_rng(0)
    features = th.as_tensor(rng.normal(size=(64, 3)), dtype=th.float32)
    actions = th.as_tensor(rng.uniform(-1, 1, size=(64, *model.action_space.shape)), dtype=th.float32)
    own = model.actor.circuit.project(features)
    kept = model.q_filter(features, actions, own)
    is_imitated = (kept == actions).all(1)
    assert th.equal(kept[~is_imitated], own[~is_imitated])
    for row in range(len(features)):
        gains = [
            model.critic.project(th.cat([features[row], action[row]])[None]).reshape(n_critics, -1).mean(1)
            for action in (actions, own)
        ]
        assert bool(is_imitated[row]) == bool((gains[0] > gains[1]).any())
    assert 0 < int(is_imitated.sum()) < len(features)


@pytest.mark.parametrize(("q_filter", "imitates"), [(True, False), (False, True)])
def test_what_the_filter_takes_away_is_not_imitated_after_the_warm_up(q_filter, imitates):
    """A filter that leaves nothing, next to a critic term that weighs next to nothing."""
    settings = {"bc_updates": 1, "critic_warmup": 20, "q_filter": q_filter}
    plain = {"net_arch": [8], "optimizer_class": th.optim.SGD, "circuit_kwargs": {"weight_decay": 0.0}}
    model = imitating(
        guidance_kwargs=settings, gradient_steps=1, policy_delay=1, critic_weight=1e-9, learning_rate=0.1, policy_kwargs=plain
    )
    model.learn(1)
    model.q_filter = lambda features, actions, own, weight: own
    model.train(20, 16)
    before = weights_of(model.actor.circuit)
    model.train(1, 16)
    moved = max(float((a - b).abs().max()) for a, b in zip(before, weights_of(model.actor.circuit), strict=True))
    assert (moved > 1e-5) == imitates


@pytest.mark.parametrize(("residual", "expected"), [(0.005, 1.0), (0.04, 0.25), (0.0, 1.0), (None, 0.0)])
def test_filtered_steps_count_by_the_precision_of_their_actions(residual, expected):
    guidance = BehaviorGuidance(GuidanceConfig(critic_warmup=10, filter_residual=0.01))
    guidance.bc_residual = residual
    assert guidance.filtered_weight(10) == 1.0
    assert guidance.filtered_weight(11) == pytest.approx(expected)
    copy = BehaviorGuidance(guidance.config)
    copy.load_state_dict(guidance.state_dict())
    assert copy.filtered_weight(11) == guidance.filtered_weight(11)
    unfiltered = BehaviorGuidance(GuidanceConfig(critic_warmup=10, q_filter=False))
    assert unfiltered.filtered_weight(11) == 1.0
    plain = BehaviorGuidance(GuidanceConfig(critic_warmup=10, filter_residual=0.0))
    plain.bc_residual = residual
    assert plain.filtered_weight(11) == 0.0


@pytest.mark.parametrize(("worst", "stored"), [(0.0, [1.0, 3.0, 1.0]), (-1.0, [1.0, 3.0])])
def test_with_negative_demonstrated_returns_only_the_best_own_episodes_are_imitated(worst, stored):
    """Steps are then drawn uniformly, and mediocre episodes would outnumber the demonstrations."""
    data = demonstrations()
    rewards = np.where(np.arange(60) == 19, worst, data.rewards)
    env = DummyVecEnv([lambda: CountingEnv(lengths=(5,), returns=(1.0, 3.0, 1.0, 0.0))])
    model = imitating(env, demonstrations=dataclasses.replace(data, rewards=rewards), guidance_kwargs={"bc_updates": 5})
    model.learn(20)
    assert model.replay_buffer.self_imitation.returns == stored


@pytest.mark.parametrize(("failure", "success"), [(0.0, 1.0), (-1.0, 0.0), (-0.1, 10.0)])
def test_the_rewards_of_failure_and_success_do_not_change_what_is_imitated(failure, success):
    """The first demonstrated episode succeeds in twelve of its steps, the second in four, the last never."""
    data = demonstrations()
    paid = np.isin(np.arange(60), [*range(8, 20), *range(36, 40)])
    rewards = np.where(paid, success, failure)

    def pay(reward):
        return failure + (success - failure) * reward

    def own():
        return gym.wrappers.TransformReward(CountingEnv(lengths=(5,), returns=(1.0, 0.0)), pay)

    model = imitating(
        DummyVecEnv([own]), demonstrations=dataclasses.replace(data, rewards=rewards), guidance_kwargs={"bc_updates": 5}
    )
    model.learn(20)
    assert (f"returns counted from {failure:g} per step" in model.describe()) == (failure < 0.0)
    memory = model.replay_buffer.self_imitation
    assert memory.lengths == [5, 5] and memory.returns == pytest.approx([success - failure] * 2)
    weights = np.repeat([12.0**4, 4.0**4, 0.0, 1.0], [20, 20, 20, 10])
    drawn = model.sample_imitated(20_000)[1].numpy()
    rows = np.concatenate([data.actions / 2, memory.episodes.actions])
    counts = (np.abs(drawn[:, None] - rows) < 1e-6).all(2).sum(0)
    assert counts / 20_000 == pytest.approx(weights / weights.sum(), abs=0.01)


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_bc_measures_how_much_of_the_demonstrated_actions_it_leaves_unexplained(noise, scale):
    """Actions that are a function of the observations, plus noise: its share of the variance, whatever their scale."""
    rng = np.random.default_rng(0)
    data = demonstrations(n_episodes=40)
    clean = 0.5 * scale * np.tanh(data.observations[:, :2])
    actions = clean + rng.normal(scale=noise * scale, size=clean.shape).clip(-0.5 * scale, 0.5 * scale)
    guidance = BehaviorGuidance(GuidanceConfig(bc_updates=1000))
    demonstrated = dataclasses.replace(data, actions=2 * actions)  # the actions' limits are -2 and 2
    model = imitating(demonstrations=demonstrated, guidance=guidance, guidance_kwargs=None)
    model.learn(1)
    expected = np.square(actions - clean).mean() / actions.var(0).mean()
    assert guidance.bc_residual == pytest.approx(expected, rel=0.3, abs=0.1)


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("settings", [{"bc_updates": 1000}, {"bc_updates": 0}], ids=["BC", "imitation while learning"])
def test_noise_on_the_inputs_flattens_the_policy_as_theory_says(noise, settings):
    """Of standard normal x, seen with Gaussian noise, the best prediction of c x is c (x + noise) / (1 + its variance)."""
    rng = np.random.default_rng(0)
    data = demonstrations(n_episodes=40)
    observations = rng.normal(size=data.observations.shape).astype(np.float32)
    demonstrated = dataclasses.replace(data, observations=observations, actions=0.4 * observations[:, :2])
    guidance_kwargs = {**settings, "input_noise": noise}
    model = imitating(demonstrations=demonstrated, guidance_kwargs=guidance_kwargs, critic_weight=0.0, learning_rate=1e-3)
    model.learn(1)
    if not settings["bc_updates"]:
        model.train(2000, 64)
    actions = model.actor.circuit.project(model.actor.features(th.as_tensor(observations))).numpy()
    assert ("input noise of 1," in model.describe()) == (noise == 1.0)
    slope = (actions * observations[:, :2]).sum() / np.square(observations[:, :2]).sum()  # of actions in [-1, 1], not [-2, 2]
    assert slope == pytest.approx(0.2 / (1 + noise**2), rel=0.15)


def test_a_filter_of_some_weight_pulls_part_of_the_way():
    model = imitating()
    model.learn(10)
    features, actions, _ = model.sample_imitated(64)
    none, half, whole = (model.q_filter(features, actions, -actions, weight) for weight in (0.0, 0.5, 1.0))
    assert th.allclose(half, (none + actions) / 2, atol=1e-6)
    assert th.allclose(whole, actions, atol=1e-6)
    assert not th.equal(none, actions)


@pytest.mark.parametrize(("weighting", "share"), [("returns", 0.0), ("uniform", 0.5)])
def test_steps_are_imitated_by_the_return_of_their_episode(weighting, share):
    """Of two demonstrations one has a return; half of the steps are of the other."""
    data = demonstrations(n_episodes=2)
    data = dataclasses.replace(data, rewards=data.rewards * (np.arange(len(data)) < 20))
    model = imitating(demonstrations=data, guidance_kwargs={"weighting": weighting}, observation_normalization="none")
    first_length = int(data.episode_bounds[0, 1])
    features = model.sample_imitated(2000)[0]
    of_second = th.as_tensor(data.observations[first_length:])
    drawn = (features[:, None] == of_second[None]).all(2).any(1).float().mean()
    assert abs(float(drawn) - share) < 0.1


def gated(n_envs: int = 1) -> tuple[BehaviorGuidance, GuidanceContext]:
    """A gate whose circuits all differ."""
    actor, deployed, average, challenger, previous = (NGCCircuit(2, 1, [4]) for _ in range(5))
    circuits = {"deployed": deployed, "average": average, "challenger": challenger, "previous": previous}
    context = GuidanceContext(actor, [], n_envs, np.ones(n_envs, dtype=bool), None, circuits)
    guidance = BehaviorGuidance(GuidanceConfig(critic_warmup=0, challenger_interval=0))
    guidance.on_training_start(context, is_pretrained=True)
    return guidance, context


def test_the_average_explores_with_noise_and_evaluation_episodes_have_none():
    guidance, context = gated(3)
    guidance.selection.roles = ["average", "incumbent", "challenger"]
    circuits = context.selection_circuits
    expected = [circuits["average"], circuits["deployed"], circuits["challenger"]]
    assert all(mine is theirs for mine, theirs in zip(guidance.acting_circuits(context), expected, strict=True))
    assert [guidance.explores(env) for env in range(3)] == [True, False, False]


def test_a_confirmed_challenger_is_deployed():
    guidance, context = gated()
    guidance.selection.incumbent_returns = [1.0, 1.1]
    guidance.selection.exploration_returns = [9.0] * 4
    guidance.selection.worst = 0.0
    names = list(context.selection_circuits)
    before = {name: weights_of(context.selection_circuits[name]) for name in names}
    for n_updates in (8, 12):  # the average's exploration episode ends, then the evaluation episode of its copy
        guidance.on_step(context, np.array([9.0]), np.array([True]), n_updates)
    after = {name: weights_of(context.selection_circuits[name]) for name in names}
    assert guidance.selection.n_promoted == 1
    assert not differ(after["deployed"], before["average"])
    assert not differ(after["previous"], before["deployed"])
    assert differ(before["average"], before["deployed"])
    assert guidance.state_dict()["copied_at"] in (8, 12)


def test_evaluations_beside_the_deployed_policy_are_of_what_the_gate_may_deploy():
    class Own(ActorGuidance):
        has_gate = True

    model = make(demonstrations=demonstrations(), guidance=Own(), learning_starts=5).learn(30)
    assert not differ(weights_of(model.actor_policy.circuit), weights_of(model.actor.circuit))


def test_random_steps_and_the_rest_of_their_episode_count_for_nobody():
    """Every step is rewarded, every episode has ten; random steps end within the second."""

    class EveryStep(CountingEnv):
        def step(self, action):
            observation, _, *ends = super().step(action)
            return observation, 1.0, *ends

    model = imitating(
        DummyVecEnv([lambda: EveryStep(lengths=(10,))]),
        learning_starts=15,
        guidance_kwargs={"critic_warmup": 0, "challenger_interval": 0, "bc_updates": 1},
    )
    counted = []
    for n_steps in (25, 20, 20):
        model.learn(n_steps, reset_num_timesteps=False)
        selection = model.actor_guidance.selection
        counted.append({*selection.incumbent_returns, *selection.exploration_returns, *selection.challenger_returns})
    assert counted == [set(), {10.0}, {10.0}]


@pytest.mark.parametrize("gate", [True, False])
def test_the_actor_policy_is_the_moving_average_and_without_a_gate_the_actor(gate):
    model = imitating(guidance_kwargs={"bc_updates": 5, "critic_warmup": 10, "averaging_rate": 0.5, "gate": gate})
    model.learn(60)
    observations = np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32)
    with th.no_grad():
        features = model.actor.features(model.actor.obs_to_tensor(observations)[0])
        learned = model.policy.unscale_action(model.actor.circuit.project(features).numpy())
        deployed = model.policy.unscale_action(model.actor.acting.project(features).numpy())
        average = learned
        if gate:
            average = model.policy.unscale_action(model.policy.selection["average"].project(features).numpy())
    assert np.allclose(model.actor_policy.predict(observations)[0], average, atol=1e-6)
    assert np.allclose(average, learned, atol=0.2)
    assert np.allclose(average, learned, atol=1e-6) == (not gate)
    assert np.allclose(model.predict(observations)[0], deployed, atol=1e-6)
    assert np.allclose(deployed, average, atol=1e-6) == (not gate)  # nothing was promoted
    assert (model.actor.deployed is not None) == gate  # the view took nothing away


def test_guidance_none_has_no_deployed_policy_and_no_bc():
    keywords = {**QUICK, "guidance_kwargs": None}
    model = ActPC("MlpPolicy", CountingEnv(), demonstrations=demonstrations(), guidance="none", **keywords)
    before = weights_of(model.actor.circuit)
    model.pretrain()
    assert model.actor.deployed is None
    assert not differ(before, weights_of(model.actor.circuit))


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"bc_updates": -1}, r"guidance_kwargs\['bc_updates'\]=-1 must be at least 0"),
        ({"evaluation_share": 2.0}, r"guidance_kwargs\['evaluation_share'\]=2.0 must be between 0 and 1"),
        ({"weighting": "best"}, r"'weighting'\]='best' is unknown; choose one of .'returns', 'uniform'."),
        ({"gate": 1}, r"'gate'\]=1 must be True or False"),
        ({"critic_warmup": True}, r"'critic_warmup'\]=True must be a number"),
        ({"warmup": 1}, "guidance_kwargs=.*'warmup'"),
    ],
)
def test_wrong_guidance_keywords_are_named(wrong, named):
    with pytest.raises(ValueError, match=named):
        imitating(guidance_kwargs=wrong)


@pytest.mark.parametrize("is_loaded", [False, True])
def test_demonstrations_that_come_later_warn_of_what_stays(is_loaded, tmp_path):
    model = make(learning_starts=5)
    if is_loaded:
        model.save(tmp_path / "agent")
        model = ActPC.load(tmp_path / "agent", env=CountingEnv(), demonstrations=demonstrations())
    model.demonstrations = demonstrations()
    with pytest.warns(UserWarning, match="demonstrations were set after the agent was made without"):
        model.learn(10)


def test_without_demonstrations_there_is_no_bc_of_own_episodes():
    settings = {"guidance_kwargs": {"bc_updates": 500}, "replay_buffer_kwargs": {"self_imitation_size": 100}}
    model = make(guidance="default", learning_starts=0, **settings)
    model.learn(80)
    assert model.imitated_episodes()
    before = weights_of(model.actor.circuit)
    model.pretrain()
    assert not differ(before, weights_of(model.actor.circuit))


def test_bc_of_a_trained_agent_begins_with_a_gate_without_returns():
    model = make(guidance="default", guidance_kwargs={"bc_updates": 5}, learning_starts=0)
    model.learn(80)
    assert model.actor_guidance.selection.steps > 0
    model.demonstrations = demonstrations()
    model.learn(1, reset_num_timesteps=False)
    assert model.actor_guidance.selection.steps <= 1
