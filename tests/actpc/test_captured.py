"""The update as a CUDA graph: what it reads, when it is recorded anew; on a GPU the numbers themselves."""

import copy
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th

from sb3_actpc.actpc import actpc as actpc_module
from sb3_actpc.actpc import captured as captured_module
from sb3_actpc.actpc.captured import MOST_KINDS, N_WARM_UP, CapturedUpdate
from sb3_actpc.actpc.compiled import CompiledUpdate, compiled_update
from sb3_actpc.actpc.transfer import map_nested
from tests.actpc.agents import EQUATION_1, PARTS, make, with_all_parts

DEVICE = "cuda" if th.cuda.is_available() else "cpu"


@pytest.fixture
def recorded(monkeypatch):
    """Without a GPU: what would be replayed is run, on what the graph would read. All the recorded."""
    found = []

    def record(self, given, optimizers, state):
        copies = {id(tensor): th.empty_like(tensor) for tensor in captured_module._tensors(given)}
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        rates, replaced = [th.zeros(()) for _ in groups], map_nested(lambda tensor: copies[id(tensor)], given)

        def replay():
            with captured_module._with_rates(groups, rates):
                self.update(replaced)

        found.append(replaced)
        return captured_module._Recorded(SimpleNamespace(replay=replay), list(copies.values()), groups, rates, state)

    if DEVICE == "cpu":
        monkeypatch.setattr(CapturedUpdate, "_record", record)
        monkeypatch.setattr(
            actpc_module, "compiled_update", lambda agent, _: CompiledUpdate(agent, captures=True) if agent.compile else None
        )
    return found


def trained(model, n=8):
    th.manual_seed(1)
    np.random.seed(1)
    for _ in range(n):
        model.train(1, 32)
    return {name: value.cpu().clone() for name, value in model.policy.state_dict().items()}


def made(**keywords):
    th.manual_seed(0)
    np.random.seed(0)
    model = with_all_parts(device=DEVICE, **keywords)
    model.learn(60)
    return model


@pytest.mark.parametrize(
    "keywords",
    [
        {},
        {"policy_delay": 2},  # two kinds of updates
        {"critic_warmup": 64},  # the pressure begins among those that are compared
        {"actor_pressure": 0.0, "critic_warmup": 5},
        {"learning_rate": lambda left: 1e-3 * (1.0 + left)},
        {"target_update_interval": 5},
        {"habit": True},
        {"habit": True, "refresh_kwargs": {"habit": True}},
    ],
)
def test_captured_updates_equal_eager_ones(keywords, recorded):
    weights = []
    for compile in (False, "auto"):
        model = made(compile=compile, **keywords)
        assert bool(model._compiled) == (compile == "auto")
        start = {name: value.cpu().clone() for name, value in model.policy.state_dict().items()}
        weights.append(trained(model))
        assert any((value - start[name]).abs().max() > 1e-3 for name, value in weights[-1].items())
    for name, eager in weights[0].items():
        assert th.allclose(eager, weights[1][name], atol=1e-6), name


def test_a_rate_that_changes_reaches_the_graph(recorded):
    model = made(compile="auto")
    trained(model)
    before = {name: value.clone() for name, value in model.policy.state_dict().items() if "weights" in name}
    model.lr_schedule = lambda left: 0.0
    assert model._compiled._captured._recorded
    moved = trained(model, 2)
    for name, value in before.items():
        if name.startswith(("actor.circuit", "critic.0")):
            assert th.equal(value.cpu(), moved[name]), name


def test_a_loaded_optimiser_is_recorded_anew(recorded):
    """Its averages lie elsewhere: the old graph would go on with the old ones."""
    model, eager = made(compile="auto"), made(compile=False)
    for each in (model, eager):
        trained(each)
        each.set_parameters(copy.deepcopy(each.get_parameters()))
    n = len(model._compiled._captured._recorded)
    ours, theirs = trained(model), trained(eager)
    assert len(model._compiled._captured._recorded) == n + 1
    assert all(th.allclose(value, ours[name], atol=1e-6) for name, value in theirs.items())


@pytest.mark.parametrize(
    ("name", "value"), [("tau", 0.5), ("scale_pressure", False), ("target_update_interval", 100), ("refresh_weight", 0.9)]
)
def test_a_setting_that_changes_is_followed(name, value, recorded):
    """By another graph, or, as the weights are, by what the graph reads."""
    model, eager = made(compile="auto"), made(compile=False)
    for each in (model, eager):
        trained(each)
        setattr(each, name, value)
    n = len(model._compiled._captured._recorded)
    ours, theirs = trained(model), trained(eager)
    assert len(model._compiled._captured._recorded) == n + (name != "refresh_weight")
    assert all(th.allclose(value, ours[name], atol=1e-6) for name, value in theirs.items())


@pytest.mark.skipif(DEVICE == "cuda", reason="nothing here has kernels to record")
def test_an_update_is_recorded_after_its_warm_up_and_for_every_kind(recorded):
    said, parameter = [], th.nn.Parameter(th.zeros(1), requires_grad=False)
    optimizer = th.optim.Adam([parameter], fused=True)
    update = CapturedUpdate(lambda given: said.append(given), lambda given: [optimizer], tuple)
    x, y = th.ones(3), th.zeros(2)
    for _ in range(N_WARM_UP + 3):  # an optimiser that has not begun yet
        update.prepared(((x, x), None, y))()
    assert not recorded
    parameter.grad = th.ones(1)
    optimizer.step()
    for n in range(1, N_WARM_UP + 3):
        update.prepared(((x, x), None, y))()
        assert len(recorded) == max(0, min(1, n - N_WARM_UP))
    assert said[0][0][0] is x and said[-1][0][0] is not x and said[-1][0][0].tolist() == [1, 1, 1]
    assert said[-1][0][0] is said[-1][0][1] and said[-1][1] is None and said[-1][2].tolist() == [0, 0]
    for other in (((x, x.clone()), None, y), ((y, y), None, y), ((x, x), y, None)):
        before = len(recorded)
        for _ in range(N_WARM_UP + 1):
            update.prepared(other)()
        assert len(recorded) == before + 1
    before = len(recorded)
    optimizer.param_groups[0]["betas"] = 0.8, 0.9
    for _ in range(N_WARM_UP + 1):
        update.prepared(((x, x), None, y))()
    assert len(recorded) == before + 1
    for size in range(3, 3 + 2 * MOST_KINDS):
        for _ in range(N_WARM_UP + 1):
            update.prepared((th.ones(size),))()
    assert len(update._recorded) <= MOST_KINDS


def test_on_a_cpu_nothing_is_captured_and_on_a_gpu_what_neither_waits_nor_is_told_not_to():
    assert compiled_update(with_all_parts(compile="auto"), 1) is None

    def captured(model):
        object.__setattr__(model, "device", th.device("cuda"))
        return compiled_update(model, 1)

    found = captured(with_all_parts(compile="auto"))
    assert isinstance(found._captured, CapturedUpdate) and found.captures
    assert captured(with_all_parts(compile=False)) is None
    for others in (
        partial(with_all_parts, "iterative", EQUATION_1, 1.0),
        partial(make, policy_kwargs={"optimizer_class": th.optim.SGD}, **PARTS),
        partial(make, policy_kwargs={"optimizer_class": th.optim.SGD, "optimizer_kwargs": {"fused": True}}, **PARTS),
    ):
        assert captured(others(compile="auto")) is None
        with pytest.raises(ValueError, match="compile=True on a GPU needs settling='scheduled'"):
            captured(others(compile=True))
