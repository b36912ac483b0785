"""The compiled update: the same numbers as the eager one, and only where it is earned."""

import math
import warnings

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import configure

from sb3_actpc.actpc import actpc as actpc_module
from sb3_actpc.actpc import compiled as compiled_module
from sb3_actpc.actpc.compiled import ENOUGH_UPDATES, CompiledUpdate, compiled_update
from tests.actpc.agents import EQUATION_1, LEARNED, make, with_all_parts
from tests.actpc.envs import demonstrations

LENGTH = len(demonstrations().rewards) / demonstrations().n_episodes


@pytest.mark.parametrize("device", [None, pytest.param("cpu", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("settling", "circuits", "nudge"),
    [("scheduled", LEARNED, None), ("iterative", EQUATION_1, 1.0), ("iterative", EQUATION_1, 0.1)],
)
def test_compiled_updates_equal_eager_ones(settling, circuits, nudge, device, monkeypatch):
    """Fast: what would be compiled, as it stands."""
    if device is None:
        monkeypatch.setattr(compiled_module.th, "compile", lambda function, **_: function)
    weights = []
    for compiled in (False, True):
        th.manual_seed(0)
        np.random.seed(0)
        model = with_all_parts(settling, circuits, nudge, compile=compiled, device="cpu")
        model.learn(60)
        start = {name: value.clone() for name, value in model.policy.state_dict().items()}
        assert (model._compiled is not None) == compiled
        th.manual_seed(1)
        np.random.seed(1)
        model.train(5, 32)
        weights.append(model.policy.state_dict())
        assert any((value - start[name]).abs().max() > 1e-3 for name, value in weights[-1].items())
    for name, eager in weights[0].items():
        assert th.allclose(eager, weights[1][name], atol=1e-5), name


@pytest.mark.parametrize(("settling", "circuits"), [("scheduled", LEARNED), ("iterative", EQUATION_1)])
def test_auto_compiles_from_enough_updates_on(settling, circuits):
    model = with_all_parts(settling, circuits, compile="auto")
    assert compiled_update(model, ENOUGH_UPDATES - 1) is None
    assert compiled_update(model, ENOUGH_UPDATES) is not None
    model.compile = False
    assert compiled_update(model, ENOUGH_UPDATES) is None


def test_a_resumed_run_compiles_as_the_whole_run_would(monkeypatch):
    """Else the two would differ by rounding."""
    asked = []
    monkeypatch.setattr(actpc_module, "compiled_update", lambda agent, steps: asked.append(steps))
    model = with_all_parts()
    model.learn(60)
    model.learn(40, reset_num_timesteps=False)
    assert asked == [60, 100]


@pytest.mark.parametrize(
    ("keywords", "per_step"),
    [
        ({"gradient_steps": 4}, 4.0),
        ({"gradient_steps": 2, "train_freq": 4}, 0.5),
        ({"gradient_steps": -1, "train_freq": 4}, 1.0),
        ({"gradient_steps": -1, "train_freq": (1, "episode")}, 1.0),
        ({"gradient_steps": 3, "train_freq": (2, "episode")}, 1.5 / LENGTH),
        ({"gradient_steps": 1, "n_envs": 2}, 0.5),
    ],
)
def test_auto_counts_the_updates_that_a_run_will_make(keywords, per_step):
    model = with_all_parts(compile="auto", **keywords)
    enough = math.ceil(ENOUGH_UPDATES / per_step)
    assert compiled_update(model, enough - 1) is None and compiled_update(model, enough) is not None


@pytest.mark.parametrize(
    ("keywords", "why"),
    [
        ({"replay_buffer_kwargs": {"self_imitation_size": 0}}, "nothing is imitated .no demonstrations=, and no paid episode"),
        ({"refresh_weight": 0.0}, "refresh_weight=0"),
        ({"actor_pressure": 0.0, "critic_warmup": 5}, "actor_pressure=0"),
    ],
)
def test_updates_that_were_to_be_compiled_and_cannot_be_are_named_once(keywords, why, monkeypatch):
    """ "auto" compiles where it can."""
    monkeypatch.setattr(CompiledUpdate, "__call__", lambda self, *parts: pytest.fail("it was compiled"))
    with pytest.warns(UserWarning, match=f"compile=True: updates run eagerly while {why}") as said:
        make(compile=True, alpha_in=0.0, **keywords).learn(60)
    assert len([one for one in said if "eagerly" in str(one.message)]) == 1
    monkeypatch.setattr(compiled_module, "ENOUGH_UPDATES", 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        make(compile="auto", alpha_in=0.0, **keywords).learn(60)


def test_weights_that_are_annealed_ask_for_no_other_graph(monkeypatch):
    real, graphs = th.compile, []

    def counted(graph, inputs):
        graphs.append(graph)
        return graph.forward

    monkeypatch.setattr(
        compiled_module.th, "compile", lambda function, **keywords: real(function, backend=counted, **keywords)
    )
    model = with_all_parts(compile=True)
    model.learn(60)
    n_graphs = len(graphs)
    assert n_graphs > 0
    for weight in (0.9, 0.8, 0.7):
        model.refresh_weight = model.actor_pressure = weight
        model.learn(4, reset_num_timesteps=False)
    assert len(graphs) == n_graphs


def test_agents_of_many_sizes_have_their_graphs_in_one_process():
    from torch._dynamo import config

    CompiledUpdate(with_all_parts())
    assert config.recompile_limit >= 64


def test_without_a_compiler_updates_stay_eager(monkeypatch):
    monkeypatch.setattr("sb3_actpc.actpc.compiled._has_compiler", lambda: False)
    model, said = with_all_parts(compile=True), []
    model.set_logger(configure(None, []))
    monkeypatch.setattr(model.logger, "info", said.append)
    assert compiled_update(model, 1) is None and len(said) == 1 and "no C++ compiler" in said[0]


def test_where_compiling_fails_auto_goes_on_eagerly_and_an_order_raises(monkeypatch):
    def failing(self, given):
        raise RuntimeError("no Python.h")

    monkeypatch.setattr(CompiledUpdate, "_all_changes", failing)
    monkeypatch.setattr(compiled_module.th, "compile", lambda function, **_: function)
    monkeypatch.setattr(compiled_module, "ENOUGH_UPDATES", 1)
    with pytest.raises(RuntimeError, match=r"Python\.h"):
        with_all_parts(compile=True).learn(60)
    model = with_all_parts(compile="auto")
    with pytest.warns(UserWarning, match=r"compiling them failed \(RuntimeError\)") as said:
        model.learn(60)
    assert len([one for one in said if "compiling" in str(one.message)]) == 1
    eager = with_all_parts(compile=False)
    eager.learn(60)
    assert model._compiled is None and model._n_updates == eager._n_updates


def test_in_a_graph_rates_are_tensors_that_move_with_the_synapses(monkeypatch):
    """As numbers they would be constants of the graph."""
    circuit = with_all_parts("iterative", EQUATION_1).critic[0]
    numbers = circuit.layer_rates()
    monkeypatch.setattr(th.compiler, "is_compiling", lambda: True)
    tensors = circuit.layer_rates()
    assert numbers == [rate.item() for rate in tensors] and all(isinstance(rate, float) for rate in numbers)
    x, target = th.randn(4, circuit.sizes[0]), th.randn(4, circuit.sizes[-1])
    by_tensors = circuit.settle(x, target)
    circuit.rates.mul_(0.5)
    assert [rate.item() for rate in tensors] == [0.5 * rate for rate in numbers]
    circuit.rates.mul_(2.0)
    monkeypatch.undo()
    for ours, theirs in zip(by_tensors.errors, circuit.settle(x, target).errors, strict=True):
        assert th.allclose(ours, theirs, atol=1e-6)


def test_circuits_that_stop_at_a_tolerance_are_not_compiled():
    with pytest.raises(ValueError, match="compile=True needs settling='scheduled'"):
        compiled_update(make(settling="iterative", compile=True), 1)
    with pytest.raises(ValueError, match="compile='fast'"):
        make(compile="fast")
