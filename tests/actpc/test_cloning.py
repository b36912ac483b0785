"""The warm start: members that imitate, and the clone that they teach."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import ProgressBarCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_actpc import ActPC
from sb3_actpc.actpc import cloning as cloning_module
from sb3_actpc.actpc.cloning import BATCH_SIZE, TEACHING_NOISE, Cloning, taught
from sb3_actpc.actpc.imitation import Imitation
from sb3_actpc.ngc import NGCCircuit
from tests.actpc.agents import differ, imitating, weights_of
from tests.actpc.envs import CountingEnv


def make_circuit() -> NGCCircuit:
    circuit = NGCCircuit(2, 1, [8])
    circuit.optimizer = th.optim.Adam(circuit.parameter_groups(1e-3))  # of rates that the warm start sets
    return circuit


def sample(n: int) -> tuple[th.Tensor, th.Tensor, None]:
    """The first coordinate is what is imitated."""
    features = th.rand(n, 2) - 0.5
    return features, features[:, :1], None


class Sum(NGCCircuit):
    """A teacher whose action is a multiple of what it sees and remembers."""

    def __init__(self, factor: float) -> None:
        super().__init__(2, 1, [8])
        self.factor = factor

    def project(self, inputs: th.Tensor, memory: th.Tensor | None = None) -> th.Tensor:
        return self.factor * (inputs.sum(1, keepdim=True) + (0.0 if memory is None else memory))


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Small circuits learn with large rates."""
    monkeypatch.setattr(cloning_module, "RATES", (3e-2, 1e-3))
    th.manual_seed(0)


def test_alone_a_clone_imitates_what_is_shown():
    cloning = Cloning(make_circuit(), make_circuit, sample, 600)
    for update in range(len(cloning)):
        cloning.update(update)
    features, actions, _ = sample(500)
    assert len(cloning) == 600 and not cloning.teachers
    assert (cloning.clone.project(features, None) - actions).square().mean() < 0.01 * actions.var()


def test_the_teachers_imitate_one_after_another_and_then_the_clone_does():
    """Each has its own first synapses, all learn from what is shown; the clone does not before they have."""
    cloning = Cloning(make_circuit(), make_circuit, sample, 400, 2)
    before, (features, actions, _) = weights_of(cloning.clone), sample(500)
    assert len(cloning) == 1200
    for update in range(800):
        assert len(cloning.teachers) == min(1 + (update - 1) // 400, 2) if update else not cloning.teachers
        cloning.update(update)
    assert not differ(before, weights_of(cloning.clone))
    teachers = [weights_of(teacher) for teacher in cloning.teachers]
    assert differ(*teachers)
    for update in range(800, 1200):
        cloning.update(update)
    for weights, teacher in zip(teachers, cloning.teachers, strict=True):
        assert not differ(weights, weights_of(teacher))
    for circuit in (*cloning.teachers, cloning.clone):
        assert (circuit.project(features, None) - actions).square().mean() < 0.01 * actions.var()


def test_beside_what_is_shown_the_clone_does_what_its_teachers_do_on_average(monkeypatch):
    """Shown along a line, where the action is 0; beside it the teachers' mean grows with the distance."""

    def on_a_line(n):
        return th.cat([th.rand(n, 1) - 0.5, th.zeros(n, 1)], dim=1), th.zeros(n, 1), None

    class Distance(Sum):
        def project(self, inputs, memory=None):
            return self.factor * inputs[:, 1:].abs()

    monkeypatch.setattr(cloning_module, "TEACHING_NOISE", 0.5)
    cloning = Cloning(make_circuit(), make_circuit, on_a_line, 600, 3)
    cloning.teachers = [Distance(-0.5), Distance(1.0), Distance(1.0)]
    for update in range(1800, 2400):
        cloning.update(update)
    for distance in (-0.6, -0.3, 0.3, 0.6):
        there = th.tensor([[0.2, distance]])
        assert cloning.clone.project(there, None).item() == pytest.approx(0.5 * abs(distance), abs=0.06)


def test_teachers_are_asked_around_every_other_step():
    """Their answer is to where they were asked, with the memory of that step; the other rows are as shown."""
    features, actions, memory = th.rand(20_000, 2), th.full((20_000, 1), 7.0), th.arange(20_000.0)[:, None]
    asked, answers = taught([Sum(1.0), Sum(2.0)], features, actions, memory)
    assert th.equal(asked[1::2], features[1::2]) and th.equal(answers[1::2], actions[1::2])
    assert bool((actions == 7.0).all())  # what was given is not changed
    moved = (asked - features)[::2]
    assert moved.std(0).tolist() == pytest.approx([TEACHING_NOISE] * 2, rel=0.05)
    assert moved.mean(0).tolist() == pytest.approx([0.0] * 2, abs=0.01)
    expected = 1.5 * (asked.sum(1, keepdim=True) + memory)
    assert th.allclose(answers[::2], expected[::2], rtol=1e-5)


def test_students_differ_less_beside_what_is_shown_than_clones_do(monkeypatch):
    """The mean of k independent members has a k-th of their variance, and its student is near it."""
    monkeypatch.setattr(cloning_module, "TEACHING_NOISE", 1.0)
    beside = 2.0 * th.randn(300, 2)

    def spread(ensemble_size: int) -> float:
        answers = []
        for _ in range(6):
            cloning = Cloning(make_circuit(), make_circuit, sample, 100, ensemble_size)
            for update in range(len(cloning)):
                cloning.update(update)
            answers.append(cloning.clone.project(beside, None))
        return float(th.stack(answers).var(0).mean())

    assert spread(6) < 0.5 * spread(1)


@pytest.mark.parametrize("ensemble_size", [1, 2])
def test_rates_fall_geometrically_for_every_circuit_and_leave_nothing_behind(ensemble_size, monkeypatch):
    seen, original = [], NGCCircuit.apply_changes

    def watched(circuit, changes, *given):
        seen.append((circuit, [group["lr"] for group in circuit.optimizer.param_groups]))
        original(circuit, changes, *given)

    monkeypatch.setattr(NGCCircuit, "apply_changes", watched)
    model = imitating(
        policy_kwargs={"circuit_kwargs": {"feedback_rate": 0.9}},
        actor_warm_start=10,
        learning_rate=8e-4,
        refresh_kwargs={"ensemble_size": ensemble_size},
    )
    monkeypatch.setattr(cloning_module, "RATES", (1e-3, 5e-5))
    model.pretrain()
    rates = [1e-3 * (5e-5 / 1e-3) ** (update / 10) for update in range(10)]
    stages = 1 if ensemble_size == 1 else ensemble_size + 1
    assert len(seen) == 10 * stages and len({id(circuit) for circuit, _ in seen}) == stages
    for index, (circuit, of_groups) in enumerate(seen):
        assert (circuit is model.actor.circuit) == (index // 10 == stages - 1)
        assert of_groups == pytest.approx([rates[index % 10], 0.9 * rates[index % 10]])
    assert not model.actor.circuit.optimizer.state and model.cloning is None
    model.learn(2)
    assert [group["lr"] for group in model.actor.circuit.optimizer.param_groups] == pytest.approx([2e-4, 0.9 * 2e-4])
    assert [group["lr"] for group in model.critic.first().optimizer.param_groups] == pytest.approx([8e-4, 0.9 * 8e-4])


@pytest.mark.parametrize("ensemble_size", [1, 2])
def test_the_decay_of_clones_is_their_teachers_too_and_nobodys_later(ensemble_size, monkeypatch):
    seen, original = [], NGCCircuit._decay_synapses

    def watched(circuit, weight_decay):
        seen.append((circuit, weight_decay))
        original(circuit, weight_decay)

    monkeypatch.setattr(NGCCircuit, "_decay_synapses", watched)
    model = imitating(actor_warm_start=5, refresh_kwargs={"ensemble_size": ensemble_size, "weight_decay": 3.0})
    model.pretrain()
    assert len({id(circuit) for circuit, _ in seen}) == (1 if ensemble_size == 1 else 3)
    assert {decay for _, decay in seen} == {3.0}
    seen.clear()
    model.learn(4)
    assert seen and {decay for _, decay in seen} == {circuit.weight_decay for circuit, _ in seen} == {0.1}


def test_further_clones_are_made_as_the_first_was(monkeypatch):
    made, original = [], Cloning.__init__

    def watched(self, *given):
        original(self, *given)
        made.append(self)

    monkeypatch.setattr(Cloning, "__init__", watched)
    model = imitating(refresh_kwargs={"ensemble_size": 4})
    model.pretrain()
    model.trials.on_trial = model.trials.is_clone = True
    model._make_candidate()
    assert [(cloning.ensemble_size, len(cloning)) for cloning in made] == [(4, 25), (4, 25)]
    assert made[0].clone is model.actor.circuit is not made[1].clone
    assert not differ(weights_of(made[1].clone), weights_of(model.policy.candidate))


def test_an_interrupted_clone_leaves_nobody_on_trial(monkeypatch):
    model = imitating()
    model.learn(30)
    model.trials.on_trial = model.trials.is_clone = True
    model.trials.habit_returns, model.trials.n_clones = [1.0], 3

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Cloning, "update", interrupted)
        with pytest.raises(KeyboardInterrupt):
            model._make_candidate()
    assert not model.trials.on_trial and model._last_obs is None
    model.learn(30, reset_num_timesteps=False)
    assert model.num_timesteps >= 60


def test_batches_are_of_one_size(monkeypatch):
    seen, original = [], Imitation.sample
    monkeypatch.setattr(Imitation, "sample", lambda self, n, noise=0.0: (seen.append(n), original(self, n, noise))[1])
    imitating().pretrain()
    assert seen == [BATCH_SIZE] * 20 and BATCH_SIZE == 256


class Stop(Exception):
    pass


def stopped_after(n_updates: int, **keywords) -> ActPC:
    """An agent whose warm start was interrupted."""

    def update(self, index):
        if index == n_updates:
            raise Stop
        original(self, index)

    original = Cloning.update
    model = imitating(**keywords)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Stop):
        patch.setattr(Cloning, "update", update)
        model.learn(9)
    assert model.n_cloning_updates == n_updates and not model.pretrained
    return model


@pytest.mark.parametrize("n_done", [2, 7, 12, 17])
def test_an_agent_saved_within_the_warm_start_begins_it_again(n_done, tmp_path):
    model = stopped_after(n_done)
    model.save(tmp_path / "model")
    again = ActPC.load(tmp_path / "model", env=DummyVecEnv([CountingEnv]))
    seen, update = [], Cloning.update
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Cloning, "update", lambda self, index: (seen.append(index), update(self, index)))
        again.pretrain()
    assert seen == list(range(20)) and again.pretrained and again.n_cloning_updates == 20


@pytest.mark.parametrize("n_done", [2, 7, 12, 17])
@pytest.mark.parametrize("others", [{"refresh_kwargs": {"ensemble_size": 1}}, {"actor_warm_start": 3}])
def test_a_clone_in_the_making_keeps_the_sizes_that_it_was_begun_with(n_done, others):
    """Whatever the agent that a checkpoint is restored into was made with."""
    model = stopped_after(n_done)
    other = imitating(**others)
    other.restore_checkpoint_state(model.checkpoint_state())
    assert len(other.cloning) == 20 and len(other.cloning.teachers) == len(model.cloning.teachers)
    other.pretrain()
    assert other.n_cloning_updates == 20


def test_a_clone_in_the_making_keeps_the_decay_that_it_was_begun_with():
    model, other = stopped_after(7, refresh_kwargs={"ensemble_size": 3, "weight_decay": 0.7}), imitating()
    other.restore_checkpoint_state(model.checkpoint_state())
    assert other.cloning.weight_decay == 0.7


def test_parameters_that_have_imitated_are_not_trained_over():
    """SB3's own way to hand an actor on: before, the warm start of the agent that took them trained another in its place."""
    model = imitating()
    model.pretrain()
    other = imitating(seed=1)
    other.set_parameters(model.get_parameters())
    other.pretrain()
    for mine, theirs in zip(model.actor.circuit.state_dict().values(), other.actor.circuit.state_dict().values(), strict=True):
        assert th.equal(mine, theirs)
    other.trials.habit_returns = [500.0]
    other.set_parameters(model.get_parameters())
    assert not other.trials.habit_returns  # of another habit
    untrained = imitating()
    untrained.set_parameters(imitating(seed=1).get_parameters())
    assert not untrained.pretrained


def test_without_a_warm_start_there_is_nothing_to_measure():
    model = imitating(actor_warm_start=0)
    model.pretrain()
    assert model.pretrained and model.imitation._room is None


def test_settings_are_checked():
    for size in (0, -1, 1.5, np.nan):
        with pytest.raises(ValueError, match="ensemble_size"):
            imitating(refresh_kwargs={"ensemble_size": size})


@pytest.mark.parametrize("asked", ["argument", "callback", None])
def test_a_progress_bar_shows_the_clones_too(asked, capsys):
    bar, model = ProgressBarCallback(), imitating()
    model.learn(2, callback=bar if asked == "callback" else None, progress_bar=asked == "argument")
    assert ("pre-training" in capsys.readouterr().err) == (asked is not None)
    model.trials.on_trial = model.trials.is_clone = True
    model._make_candidate()
    assert ("another clone" in capsys.readouterr().err) == (asked is not None)


@pytest.mark.parametrize("steps", [-5, "abc", None, np.nan])
def test_a_number_of_steps_is_refused_before_the_warm_start(steps):
    model = imitating()
    with pytest.raises(ValueError, match="total_timesteps="):
        model.learn(steps)
    assert not model.pretrained
