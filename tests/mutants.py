"""Plant one-line mistakes, one at a time, and see that the tests which are about them fail.

    python tests/mutants.py                        # all of them, two at a time
    python tests/mutants.py discount               # those whose name contains a text
    python tests/mutants.py --log mutants.log      # goes on where it was stopped: what is in the log is not tried again

Each mutant is planted in a copy of the package, where the named tests then run, in a process that is forked from one which has
imported torch and the like. It is killed when a test fails; one that lives shows a claim that no test makes. Exit code 1 when
one lives, when its tests did not run, or when the line that it changes is not there exactly once (which the normal tests check
too).
"""

from __future__ import annotations

import argparse
import compileall
import multiprocessing
import os
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("sb3_actpc", "tests", "hyperparams", "benchmarks", "examples", "pyproject.toml")
PRELOADED = ["torch", "stable_baselines3", "sb3_contrib", "gymnasium", "mujoco", "pandas", "scipy.stats", "pytest"]
SAID = "said.txt"  # what pytest printed, in the copy
TESTS_FAILED = 1  # pytest's exit code
TIMEOUT = 600  # seconds: a mutant may make something endless, which counts as a failed test


class Mutant(NamedTuple):
    """
    :param name: what is wrong then
    :param file: of the package
    :param old: text that occurs exactly once in it
    :param new: what takes its place
    :param tests: pytest's arguments: the tests that must kill it
    """

    name: str
    file: str
    old: str
    new: str
    tests: str


CIRCUIT, DYNAMICS, PLASTICITY = "ngc/circuit.py", "ngc/dynamics.py", "ngc/plasticity.py"
AGENT, POLICIES, FEATURES = (f"actpc/{name}.py" for name in ("actpc", "policies", "features"))
SIGNALS, SHOWN = "actpc/reward_signals.py", "actpc/demonstration_replay.py"
BUFFERS, SELF_IMITATION = "actpc/buffers.py", "actpc/self_imitation.py"
SIMULATORS, RESUMES = "checkpoints/simulators.py", "tests/checkpoints/test_exact_resume.py"
ENCODING, HELD = "checkpoints/encoding.py", "tests/checkpoints/test_environments.py"
CLONING, CLONES = "actpc/cloning.py", "tests/actpc/test_cloning.py"
ROOM, ROOMS = "actpc/room.py", "tests/actpc/test_room.py"
IMITATION = "actpc/imitation.py"
WITHIN, WITHINS = "actpc/within_episodes.py", "tests/actpc/test_within_episodes.py"
STRANGERS = "tests/actpc/test_strangers.py"
HELD_OUT, HELD_OUTS = "actpc/held_out.py", "tests/actpc/test_held_out.py"
LEARNS, STORES = "tests/actpc/test_agent.py", "tests/actpc/test_buffers.py"
COUPLED, SPARSE = "ngc/coupled.py", "envs/sparse_mujoco.py"
STATISTICS, R_STABILITY = "experiments/report/statistics.py", "experiments/report/r_stability.py"
SETTLING, LEARNING, SCHEDULED = (f"tests/ngc/test_{name}.py" for name in ("settling", "plasticity", "scheduled"))
HABIT, TRIALS = "tests/actpc/test_habit.py", "actpc/habit.py"
REGIONS, REGION = "tests/actpc/test_trust_region.py", "actpc/trust_region.py"
CLOSED, EQUATIONS = "tests/ngc/test_closed_forms.py", "tests/actpc/test_equations.py"
TASKS = "tests/envs/test_sparse_mujoco.py"
REPORTS = "tests/experiments/report/test_report.py"
PRESETS, TABLE = "experiments/runs/presets.py", "tests/experiments/comparison/test_table.py"
SCORES, STABLE = (f"tests/experiments/report/test_{name}.py" for name in ("statistics", "r_stability"))

MUTANTS = [
    # ------------------------------------------------------------------ circuits
    Mutant(
        "changes are subtracted",
        CIRCUIT,
        "th._foreach_neg(changes.tensors())",
        "changes.tensors()",
        f"{LEARNING} -k plain_sgd",
    ),
    Mutant(
        "error synapses change in the other direction",
        CIRCUIT,
        "parameter.grad = weights.grad[:, weights",
        "parameter.grad = -weights.grad[:, weights",
        f"{LEARNING} -k plain_sgd",
    ),
    Mutant(
        "error synapses learn at the weights' rate",
        CIRCUIT,
        "scale = self.feedback_rate",
        "scale = 1.0",
        f"{LEARNING} -k gamma_e",
    ),
    Mutant(
        "a graph's rates are constants",
        CIRCUIT,
        "rates.unbind() if th.compiler.is_compiling() else rates.tolist()",
        "rates.tolist()",
        "tests/actpc/test_compiled.py -k in_a_graph_rates",
    ),
    Mutant(
        "a critic that ranks states is taken for one that ranks actions",
        "actpc/calibration.py",
        "said - said.mean(), gained - gained.mean()",
        "said, gained",
        "tests/actpc/test_calibration.py -k ranks",
    ),
    Mutant(
        "after a time limit the last step is worth nothing",
        "actpc/calibration.py",
        "[0.0] * terminated, gamma)",
        "[0.0], gamma)",
        "tests/actpc/test_calibration.py -k time_limit",
    ),
    Mutant(
        "a critic that points downhill a little is trusted",
        "actpc/calibration.py",
        "if self.slope >= 0.0 or",
        "if self.slope >= -1.0 or",
        "tests/actpc/test_calibration.py -k p_value",
    ),
    Mutant(
        "what any noise costs is held against the critic",
        "actpc/actpc.py",
        "(noisy_value[env] - opposite_value[env]) / 2.0",
        "noisy_value[env] - meant[env]",
        "tests/actpc/test_calibration.py -k held_against",
    ),
    Mutant(
        "any negative slope is held against the critic",
        "actpc/calibration.py",
        "/ 2**0.5) / DOUBT)",
        "/ 2**0.5))",
        "tests/actpc/test_calibration.py -k p_value",
    ),
    Mutant(
        "an episode of long ago tells as much of the critic",
        "actpc/calibration.py",
        "exp(-len(said) / WINDOW)",
        "1.0",
        "tests/actpc/test_calibration.py -k long_ago",
    ),
    Mutant(
        "the region is as wide whatever the critic is worth",
        "actpc/trust_region.py",
        "self.radius * self.trust",
        "self.radius * 1.0",
        "tests/actpc/test_calibration.py -k as_wide",
    ),
    Mutant(
        "what the critic is worth does not reach the region",
        "actpc/actpc.py",
        "                self._follow_calibration()",
        "                pass",
        "tests/actpc/test_calibration.py -k reaches",
    ),
    Mutant(
        "the critic is asked of its actor's own actions",
        "actpc/actpc.py",
        "np.concatenate([self._meant, actions, opposite])",
        "np.concatenate([actions, self._meant, opposite])",
        "tests/actpc/test_calibration.py -k every_environment",
    ),
    Mutant(
        "the critic is tested by what the task pays alone",
        "actpc/actpc.py",
        "paid = self.alpha_ext * float(rewards[env])",
        "paid = float(rewards[env])",
        "tests/actpc/test_calibration.py -k every_environment",
    ),
    Mutant(
        "a time limit ends all for the critic's test",
        "actpc/actpc.py",
        'terminated=not infos[env].get("TimeLimit.truncated", False)',
        "terminated=True",
        "tests/actpc/test_calibration.py -k every_environment",
    ),
    Mutant(
        "an environment's critic is asked of another's state",
        "actpc/actpc.py",
        ".repeat(3, 1)  # type: ignore[arg-type]",
        ".repeat_interleave(3, 0)  # type: ignore[arg-type]",
        "tests/actpc/test_calibration.py -k every_environment",
    ),
    Mutant(
        "the old critic's test counts for the new one",
        "actpc/actpc.py",
        "            self.calibration = Calibration(self.n_envs)",
        "            self.calibration = self.calibration",
        "tests/actpc/test_calibration.py -k another_critic",
    ),
    Mutant(
        "ties of a learner that is held widen its region",
        "actpc/trust_region.py",
        "factor ** float(self.trust) if",
        "factor if",
        "tests/actpc/test_calibration.py -k outcomes_widen",
    ),
    Mutant(
        "a CUDA graph steps a loaded optimiser's old averages",
        "actpc/captured.py",
        "*_same(tensors), *[one.data_ptr() for one in state]",
        "*_same(tensors)",
        "tests/actpc/test_captured.py -k loaded",
    ),
    Mutant(
        "a CUDA graph takes two batches for one",
        "actpc/captured.py",
        "kind = (*shapes, *_same(tensors), ",
        "kind = (*shapes, ",
        "tests/actpc/test_captured.py -k every_kind",
    ),
    Mutant(
        "a CUDA graph keeps the settings that it was recorded with",
        "actpc/captured.py",
        "*_numbers(optimizers), *self.settings())",
        "*_numbers(optimizers))",
        "tests/actpc/test_captured.py -k setting_that",
    ),
    Mutant(
        "a CUDA graph records how an optimiser begins",
        "actpc/captured.py",
        "if not has_begun:",
        "if False:",
        "tests/actpc/test_captured.py -k every_kind",
    ),
    Mutant(
        "a CUDA graph keeps its learning rate",
        "actpc/captured.py",
        "if numbers != self.numbers:",
        "if not self.numbers:",
        "tests/actpc/test_captured.py -k 'reaches or equal'",
    ),
    Mutant(
        "a CUDA graph presses before the critic is warm",
        "actpc/compiled.py",
        "pressure if agent.is_pressing else None",
        "pressure",
        "tests/actpc/test_captured.py -k equal",
    ),
    Mutant(
        "a CUDA graph leaves the targets where they are",
        "actpc/compiled.py",
        "        self.agent._follow_circuits()",
        "        pass",
        "tests/actpc/test_captured.py -k equal",
    ),
    Mutant(
        "numbers of all kinds go to a GPU as one",
        "actpc/transfer.py",
        "kinds.setdefault(array.dtype, [])",
        "kinds.setdefault(0, [])",
        "tests/actpc/test_transfer.py",
    ),
    Mutant(
        "a tensor's rate is left out",
        "ngc/dynamics.py",
        "signal.sub_(error).mul_(rate)",
        "signal.sub_(error)",
        "tests/actpc/test_compiled.py -k in_a_graph_rates",
    ),
    Mutant("biases decay", CIRCUIT, "if parameter.dim() > 1]", "if parameter.dim() > 0]", f"{LEARNING} -k spares_the_biases"),
    Mutant(
        "one step of settling too many",
        CIRCUIT,
        "in range(1, self.n_settling_steps + 1):",
        "in range(1, self.n_settling_steps + 2):",
        f"{SETTLING} -k 'one_step or further'",
    ),
    Mutant(
        "a target of one row is one for all",
        "ngc/dynamics.py",
        "if target.shape != self.output.shape:",
        "if target.shape[-1:] != self.output.shape[-1:]:",
        f"{SETTLING} -k another_shape",
    ),
    Mutant(
        "a sweep asks for the same steps of both circuits",
        COUPLED,
        'for name in ("settling",) if is_swept else',
        'for name in ("settling", "n_settling_steps") if is_swept else',
        "tests/ngc/test_scheduled.py -k any_number_of_steps",
    ),
    Mutant(
        "two circuits may relax for different times",
        COUPLED,
        'for name in ("settling",) if is_swept else',
        'for name in ("settling",) if is_swept or True else',
        "tests/ngc/test_scheduled.py -k does_not_fit",
    ),
    Mutant(
        "projection without the last bias",
        CIRCUIT,
        "output = predict(x, self.synapses.weights[-1], biases[-1])",
        "output = predict(x, self.synapses.weights[-1], 0 * biases[-1])",
        f"{SETTLING} -k project",
    ),
    Mutant(
        "changes are sums over the batch",
        PLASTICITY,
        "inverse_batch = 1.0 / len(errors[0])",
        "inverse_batch = 1.0",
        f"{SETTLING} -k hebbian",
    ),
    Mutant(
        "the memory's weight is left out of its change",
        PLASTICITY,
        "memory_weight * (error.t() @ memory)",
        "(error.t() @ memory)",
        CLOSED,
    ),
    Mutant(
        "columns are stretched to the bound",
        PLASTICITY,
        "norms.clamp_min(bound)",
        "norms",
        CLOSED,
    ),
    Mutant(
        "steps near the soft bound are not shortened",
        PLASTICITY,
        "step.mul_((1.0 - old.abs() / bound).clamp_(0.0, 1.0))",
        "step.mul_(1.0)",
        CLOSED,
    ),
    Mutant(
        "the output's error has the other sign",
        DYNAMICS,
        "th.sub(self.target, self.output",
        "th.sub(self.output, self.target",
        f"{SETTLING} -k gradient",
    ),
    Mutant(
        "the leak pushes away from rest",
        DYNAMICS,
        "signal.sub_(self.latents[layer], alpha=settings.leak)",
        "signal.add_(self.latents[layer], alpha=settings.leak)",
        f"{SETTLING} -k 'one_step or rest'",
    ),
    Mutant(
        "no derivative on the way back",
        DYNAMICS,
        "if exact or not settings.derivative_free:",
        "if exact:",
        f"{SETTLING} -k 'one_step or derivative'",
    ),
    Mutant(
        "errors of the state dynamics have the other sign of the prediction",
        DYNAMICS,
        "settings.bfloat16, sign=-1.0)",
        "settings.bfloat16)",
        f"{SETTLING} -k 'one_step or fixed_point'",
    ),
    Mutant(
        "the sweep goes from the input up",
        DYNAMICS,
        "in range(self.n_hidden, 0, -1):",
        "in range(1, self.n_hidden + 1):",
        f"{SCHEDULED} -k equal_backprop",
    ),
    Mutant(
        "learned sweeps go back through the weights",
        "ngc/synapses.py",
        "if self.feedback and not tied:",
        "if self.feedback and tied:",
        f"{SCHEDULED} -k 'transposed or equation'",
    ),
    Mutant(
        "krylov settling without the states' answer",
        "ngc/krylov.py",
        "return answer.add_(drive)",
        "return drive.clone()",
        f"{SETTLING} -k krylov",
    ),
    Mutant(
        "krylov directions overlap",
        "ngc/krylov.py",
        "theirs, value=-1.0)",
        "theirs, value=-0.5)",
        f"{SETTLING} -k linear_circuit",
    ),
    Mutant(
        "noise is mirrored from the wrong side",
        PLASTICITY,
        "(noise @ weights.t()).t(), noise,",
        "noise.t()[: len(weights)], noise,",
        f"{LEARNING} -k mirrored",
    ),
    Mutant("energy without the half", DYNAMICS, "return 0.5 * th.stack", "return 1.0 * th.stack", CLOSED),
    Mutant(
        "the critic pushes the actor down",
        COUPLED,
        "scale / value.output.shape[1]",
        "-scale / value.output.shape[1]",
        f"{SCHEDULED} -k 'under_scheduled or raises'",
    ),
    Mutant(
        "the pair ignores the nudge",
        COUPLED,
        '== "scheduled" else nudge',
        '== "scheduled" else 1.0',
        f"{SCHEDULED} -k tends_to",
    ),
    Mutant("the nudge is not divided out", COUPLED, "error.div_(scale)", "error.div_(1.0)", f"{SCHEDULED} -k tends_to"),
    Mutant(
        "the memory's projection is transposed",
        "ngc/memory.py",
        "self.projection.t()",
        "self.projection",
        "tests/ngc/test_memory.py",
    ),
    Mutant(
        "rates beyond the stable range",
        "ngc/stability.py",
        "1.0 / (1.0 + w * e)",
        "4.0 / (1.0 + w * e)",
        CLOSED,
    ),
    # ------------------------------------------------------------------ agent
    Mutant(
        "the bootstrap is discounted twice",
        AGENT,
        "* batch.discounts * values",
        "* batch.discounts**2 * values",
        f"{LEARNS} -k critic_target",
    ),
    Mutant("terminal steps bootstrap", AGENT, "(1.0 - batch.dones) * batch", "batch", f"{LEARNS} -k critic_target"),
    Mutant("the largest of the critics bootstraps", AGENT, "reduce(th.minimum", "reduce(th.maximum", f"{LEARNS} -k smallest"),
    Mutant(
        "the epistemic signal is a punishment",
        SIGNALS,
        "epistemic = self.epistemic(",
        "epistemic = -self.epistemic(",
        f"{LEARNS} -k 'signals or part'",
    ),
    Mutant(
        "the instrumental signal is a reward",
        SIGNALS,
        "else -normalized",
        "else normalized",
        f"{LEARNS} -k 'signals or part'",
    ),
    Mutant(
        "the unit form pays for errors",
        SIGNALS,
        "return 1.0 - normalized",
        "return normalized",
        f"{LEARNS} -k unit_form",
    ),
    Mutant(
        "signals are stored as they are, and paid so",
        SIGNALS,
        "return self.paid if",
        "return STORED if",
        f"{LEARNS} -k normalised_when_sampled",
    ),
    Mutant(
        "the target actor never moves",
        AGENT,
        "_follow([self.actor_target, *self.critic_target], [self.actor.circuit, *self.critic], tau)",
        "_follow([*self.critic_target], [*self.critic], tau)",
        f"{LEARNS} -k target",
    ),
    Mutant(
        "hard copies every 2C",
        AGENT,
        "now // interval > (now - self.n_envs) // interval",
        "now // (2 * interval) > (now - self.n_envs) // (2 * interval)",
        f"{LEARNS} -k target",
    ),
    Mutant(
        "refresh never draws the agent's own episodes",
        IMITATION,
        "else [agent.expert.episodes, *own]",
        "else [agent.expert.episodes]",
        f"{LEARNS} -k 'refresh or own or imitat'",
    ),
    Mutant(
        "the generator learns o_t",
        AGENT,
        "dim=1), batch.next_features, batch.memory)",
        "dim=1), batch.features, batch.memory)",
        f"{LEARNS} -k 'generator or one_step'",
    ),
    Mutant(
        "the prior learns o_t",
        AGENT,
        "self.prior.settle(batch.features, batch.next_features",
        "self.prior.settle(batch.features, batch.features",
        f"{LEARNS} -k prior",
    ),
    Mutant(
        "the target actor lacks the warm start",
        AGENT,
        "_copy(self.actor.circuit, self.actor_target, self.actor.habit",
        "_copy(self.actor.circuit, self.actor.habit",
        f"{EQUATIONS} -k warm_start",
    ),
    Mutant(
        "an actor that was given is trained over",
        AGENT,
        "return bool(self.policy.has_imitated)",
        "return self.num_timesteps > 0",
        f"{CLONES} -k parameters",
    ),
    Mutant(
        "what a habit was paid is said of one that was given in its place",
        AGENT,
        "self.trials = self.trials.forgotten(self.n_envs, goes_on=True)",
        "pass",
        f"{CLONES} -k parameters",
    ),
    Mutant(
        "the lowest observation is both bounds",
        AGENT,
        "np.stack([space.low, space.high])",
        "np.stack([space.low, space.low])",
        f"{LEARNS} -k by_their_bounds",
    ),
    Mutant("the agent ignores the nudge", AGENT, "memory, self.policy.nudge)", "memory)", f"{LEARNS} -k nudge"),
    Mutant(
        "pressure from the first update on",
        AGENT,
        "return bool(self.actor_pressure) and self._n_updates > self.critic_warmup",
        "return bool(self.actor_pressure)",
        f"{LEARNS} -k warmup",
    ),
    Mutant("the weight of refresh is ignored", AGENT, "changes.scale_(refresh_weight)", "changes", f"{LEARNS} -k refresh"),
    Mutant(
        "the weight of the pressure is ignored",
        AGENT,
        "_pressure_weight(coupled, batch, actor_pressure)",
        "_pressure_weight(coupled, batch, 1.0)",
        EQUATIONS,
    ),
    Mutant(
        "the noise on the target's action is not bounded",
        AGENT,
        "* self.target_policy_noise).clamp(-bound, bound)",
        "* self.target_policy_noise)",
        f"{LEARNS} -k smoothing",
    ),
    Mutant(
        "the acting actor bootstraps",
        AGENT,
        "self.actor_target.project(",
        "self.actor.circuit.project(",
        f"{LEARNS} -k target",
    ),
    Mutant(
        "the learning critics bootstrap",
        AGENT,
        "for critic in self.critic_target)",
        "for critic in self.critic)",
        f"{LEARNS} -k 'target or smallest'",
    ),
    Mutant(
        "the next action remembers only m_t",
        AGENT,
        "batch.bootstrap_features, batch.next_memory",
        "batch.bootstrap_features, batch.memory",
        f"{EQUATIONS} -k bootstrapped",
    ),
    # ------------------------------------------------------------------ habit
    Mutant("quiet episodes are noisy", AGENT, 'role == "actor" for role', "True for role", f"{HABIT} -k quiet"),
    Mutant(
        "beside a schedule from zero the actor is not slower",
        POLICIES,
        "if self.habit and name",
        "if start and self.habit and name",
        f"{LEARNS} -k quarter",
    ),
    Mutant(
        "a stopped rollout is gone on with",
        AGENT,
        "if not rollout.continue_training:",
        "if False:",
        f"{LEARNS} -k callback_that",
    ),
    Mutant("random actions prove something", AGENT, "if is_random or env in", "if env in", f"{HABIT} -k random"),
    Mutant("an episode's rest is a whole one", AGENT, " or env in self.trials.skipped", "", f"{HABIT} -k 'random or counts'"),
    Mutant("the habit is not copied", AGENT, "_copy(circuit, self.actor.habit)", "pass", f"{HABIT} -k predict"),
    Mutant("no habit is kept", AGENT, "_copy(self.actor.habit, self.policy.former_habit)", "pass", f"{HABIT} -k recalled"),
    Mutant(
        "who is recalled does not act",
        AGENT,
        "(self.policy.former_habit, is_of",
        "(self.actor.habit, is_of",
        f"{HABIT} -k recalled",
    ),
    Mutant(
        "a recalled habit takes its clone for a learner",
        AGENT,
        'trials.is_by_clone if verdict == "recalled" else trials.is_clone',
        "False",
        f"{HABIT} -k 'recalled or begins'",
    ),
    Mutant("nobody is recalled", TRIALS, "if not self.former_returns or ", "if True or ", f"{HABIT} -k gives_way"),
    Mutant(
        "recalled at par", TRIALS, ">= fmean(self.former_returns)", "> fmean(self.former_returns)", f"{HABIT} -k gives_way"
    ),
    Mutant("recalled for ever", TRIALS, "self.former_returns, []", "self.former_returns, [1e9]", f"{HABIT} -k gives_way"),
    Mutant("the learning actor acts", POLICIES, "self.circuit if self.habit is None", "self.circuit if True", HABIT),
    Mutant("one proof is enough", TRIALS, "if n < N_PROOFS:", "if n < 1:", HABIT),
    Mutant("a tie is a proof", TRIALS, "gain >= max(smallest, (SURE", "gain >= max(0.0, (SURE", HABIT),
    Mutant("chance is a proof", TRIALS, "(SURE if has_time or is_coin else LIKELY) * error", "0.0", HABIT),
    Mutant("chance is a tie", TRIALS, "abs(gain) + SURE * error > smallest", "abs(gain) > smallest", f"{HABIT} -k chance"),
    Mutant(
        "a chance loss is held against a candidate", TRIALS, "LIKELY * error if has_time else 0.0", "0.0", f"{HABIT} -k chance"
    ),
    Mutant(
        "a sure loss waits for the end",
        TRIALS,
        "LIKELY * error if has_time else 0.0",
        "SURE * error if has_time else 0.0",
        f"{HABIT} -k chance",
    ),
    Mutant(
        "chance is held against a candidate",
        TRIALS,
        "gain + SURE * error < -GREAT_LOSS",
        "gain < -GREAT_LOSS",
        f"{HABIT} -k chance",
    ),
    Mutant(
        "a candidate plays on for ever",
        TRIALS,
        "has_time = is_early or",
        "has_time = True or",
        f"{HABIT} -k plays_on",
    ),
    Mutant(
        "candidates before anything is learned",
        TRIALS,
        "(not self.tests_habit and (self.has_learned or self.needs_clone()))",
        "not self.tests_habit",
        f"{HABIT} -k late",
    ),
    Mutant(
        "a clone whatever the habit is paid",
        TRIALS,
        "self.habit_return < self.imitated_return - shortfall * abs(self.imitated_return)",
        "True",
        f"{HABIT} -k clone",
    ),
    Mutant(
        "clones for a learner that is ahead",
        TRIALS,
        "self.n_rejected > self.is_ahead()",
        "self.n_rejected > 0",
        f"{HABIT} -k better",
    ),
    Mutant("a clone's noise is the last one's", TRIALS, "[] if self.is_by_clone else", "", f"{HABIT} -k not_count"),
    Mutant(
        "a learner that is ahead bars clones",
        TRIALS,
        "self.n_rejected > self.is_ahead()",
        "self.n_rejected and not self.is_ahead()",
        f"{HABIT} -k keeps",
    ),
    Mutant(
        "others' noisy episodes count",
        TRIALS,
        " and self.generations[env] == self.generation:  # else",
        ":  # else",
        f"{HABIT} -k began",
    ),
    Mutant(
        "a warm start that was saved goes on",
        AGENT,
        "self.n_cloning_updates = 0  # an agent",
        "pass  # an agent",
        f"{CLONES} -k saved",
    ),
    Mutant("two good episodes are proof", TRIALS, "not (self.is_clone or self.is_ahead())", "False", f"{HABIT} -k twice"),
    Mutant(
        "noise judges clones", TRIALS, "not (self.is_clone or self.is_ahead())", "not self.is_ahead()", f"{HABIT} -k twice"
    ),
    Mutant(
        "a decent beginning is not enough",
        TRIALS,
        "SHORTFALL if self.has_learned else GREAT_SHORTFALL",
        "SHORTFALL",
        f"{HABIT} -k half",
    ),
    Mutant("clones whatever was learned", TRIALS, "not self.n_clones or not is_due", "not self.n_clones", HABIT),
    Mutant(
        "a late clone is on trial against itself",
        TRIALS,
        "self.has_learned = self.has_learned and not self.is_by_clone",
        "pass",
        f"{HABIT} -k against_itself",
    ),
    Mutant(
        "the episodes that end first count first",
        TRIALS,
        "self.quiet.append(QuietEpisode(env, quiet))",
        "self.quiet.insert(0, QuietEpisode(env, quiet))",
        f"{HABIT} -k order",
    ),
    Mutant(
        "noise before a second beginning", TRIALS, "[self.generation] * self.n_envs", "[0] * self.n_envs", f"{HABIT} -k second"
    ),
    Mutant(
        "images are as recorded", "demonstrations/fitting.py", "if transposes is not None:", "if False:", f"{LEARNS} -k images"
    ),
    Mutant(
        "an action is what the environment makes of it",
        "demonstrations/recording.py",
        "shown = np.array(action).ravel()",
        "shown = np.asarray(action).ravel()",
        "tests/demonstrations/test_recording.py -k copies",
    ),
    Mutant(
        "without infos every end terminates",
        "demonstrations/recording.py",
        "was_cut = n_steps == limit if",
        "was_cut = False if",
        "tests/demonstrations/test_recording.py -k registered_time_limit",
    ),
    Mutant(
        "demonstrations are weighed by default",
        "envs/sparse_mujoco.py",
        "return min(velocities, key=lambda one: float(np.abs(one - observed).mean()))",
        "return velocities[0]",
        "tests/envs/test_sparse_mujoco.py -k reward_weighs",
    ),
    Mutant(
        "demonstrations are weighed as here",
        "envs/sparse_mujoco.py",
        "return min(velocities, key=lambda one: float(np.abs(one - observed).mean()))",
        "return velocities[1]",
        "tests/envs/test_sparse_mujoco.py -k reward_weighs",
    ),
    Mutant(
        "given rates travel with the synapses",
        CIRCUIT,
        "persistent=self._keep_rates",
        "persistent=True",
        "tests/ngc/test_settling.py -k another_way",
    ),
    Mutant(
        "adapted rates do not follow what is loaded",
        CIRCUIT,
        "if circuit._follows_loaded:",
        "if False:",
        "tests/ngc/test_settling.py -k another_way",
    ),
    Mutant(
        "demonstrations are paid by the task beneath a wrapper",
        "demonstrations/dataset.py",
        " or env.env_is_wrapped(gym.RewardWrapper, indices=[0])[0]",
        "",
        "tests/envs/test_sparse_mujoco.py -k wrapper_that_pays",
    ),
    Mutant(
        "a goal task takes another task's rows",
        "envs/goal_mujoco.py",
        'if recorded != own.replace("Goal", "Sparse", 1) or not fits:',
        "if recorded == own or not fits:",
        "tests/demonstrations/test_recording.py -k named_by_the_goal_task",
    ),
    Mutant(
        "LOGO's discriminator sees demonstrations as recorded",
        "baselines/logo.py",
        "if self._vec_normalize_env is not None:",
        "if False:",
        "tests/baselines/test_logo.py -k normalised",
    ),
    Mutant(
        "a running episode's rest proves the habit elsewhere",
        AGENT,
        "self.trials.forgotten(self.n_envs, goes_on=not force_reset)",
        "self.trials.forgotten(self.n_envs)",
        f"{HABIT} -k goes_on_in_another",
    ),
    Mutant(
        "a running episode's rest proves a loaded habit",
        AGENT,
        ".forgotten(self.n_envs, goes_on)",
        ".forgotten(self.n_envs)",
        f"{HABIT} -k goes_on_in_another",
    ),
    Mutant(
        "a resumed run compiles by what is left",
        AGENT,
        "compiled_update(self, self._total_timesteps)",
        "compiled_update(self, total_timesteps)",
        "tests/actpc/test_compiled.py -k resumed",
    ),
    Mutant(
        "loaded signals are the old ones",
        AGENT,
        "self.signals if self.signals.settings == signals.settings else signals",
        "self.signals",
        f"{LEARNS} -k loaded_agents",
    ),
    Mutant(
        "loaded signals have seen nothing",
        AGENT,
        "self.signals if self.signals.settings == signals.settings else signals",
        "signals",
        f"{LEARNS} -k loaded_agents",
    ),
    Mutant("early clones for ever", TRIALS, "else self.n_judged < EARLY_CLONES", "else True", f"{HABIT} -k half"),
    Mutant("noise between a candidate's first episodes", TRIALS, "is_quiet = begins or ", "is_quiet = ", f"{HABIT} -k turns"),
    Mutant("candidates play alone", TRIALS, " and len(self.candidate_returns) < N_PROOFS", "", f"{HABIT} -k turns"),
    Mutant(
        "a known habit is tested until something is learned",
        TRIALS,
        "or not _is_tried(self.habit_proofs, self.habit_steps)",
        "or not has_learned or not _is_tried(self.habit_proofs, self.habit_steps)",
        f"{HABIT} -k resized",
    ),
    Mutant("clones for ever", TRIALS, "not self.n_clones or ", "", f"{HABIT} -k clone"),
    Mutant(
        "clones after every learner",
        TRIALS,
        'verdict == "rejected" and not self.is_clone',
        "not self.is_clone",
        f"{HABIT} -k learner",
    ),
    Mutant(
        "the habit is not tested again",
        TRIALS,
        'self.tests_habit = verdict != "accepted"',
        "self.tests_habit = False",
        f"{HABIT} -k tested",
    ),
    Mutant(
        "a clone's verdict moves the radius",
        AGENT,
        "and trials.habit_return != 0.0 and not is_of_clone",
        "and trials.habit_return != 0.0",
        f"{HABIT} -k begins",
    ),
    Mutant(
        "an accepted clone does not learn",
        AGENT,
        "self._start_from(circuit)",
        "_copy(circuit, self.actor.habit)",
        f"{HABIT} -k begins",
    ),
    Mutant(
        "a clone is the old actor",
        AGENT,
        "self.imitation.clone_into(self.policy.make_actor(), ",
        "self.imitation.clone_into(self.actor.circuit, ",
        f"{HABIT} -k begins",
    ),
    Mutant(
        "what is imitated is paid alike",
        SELF_IMITATION,
        "if is_by_return(parts, weighting) else None",
        "if False else None",
        f"{HABIT} -k paid_as",
    ),
    Mutant(
        "a late clone is a candidate at once",
        AGENT,
        "max(self.critic_warmup, trials.begun_at)",
        "self.critic_warmup",
        f"{HABIT} -k long_enough",
    ),
    Mutant(
        "a clone's trial is broken off",
        TRIALS,
        "has_candidate = self.on_trial or ",
        "has_candidate = ",
        f"{HABIT} -k elsewhere_meanwhile",
    ),
    Mutant(
        "a costly habit needs clones",
        TRIALS,
        "shortfall * abs(self.imitated_return)",
        "shortfall * self.imitated_return",
        f"{HABIT} -k tenth",
    ),
    Mutant(
        "an episode of two habits counts",
        TRIALS,
        "(self.lengths[env] or env in self.skipped)",
        "env in self.skipped",
        f"{HABIT} -k another_habit",
    ),
    Mutant("own episodes keep old neighbours", AGENT, "memory.episodes.neighbours = None", "pass", f"{HABIT} -k anew"),
    Mutant("a given noise is ignored", IMITATION, "return float(asked_for) if", "return 1.0 if", f"{ROOMS} -k without_a_word"),
    Mutant(
        "clones imitate without noise", IMITATION, "now.sample(n, now.noise_of(number))", "now.sample(n)", f"{HABIT} -k noise"
    ),
    Mutant(
        "the learning actor is blurred",
        IMITATION,
        "n: int, noise: float = 0.0, parts",
        "n: int, noise: float = 0.5, parts",
        HABIT,
    ),
    Mutant(
        "one teacher for all", CLONING, "self.teachers.append(self.make_circuit())", "self.teachers.append(self.clone)", CLONES
    ),
    Mutant("clones keep their circuit's decay", CLONING, "memory)), self.weight_decay)", "memory)))", f"{CLONES} -k decay"),
    Mutant(
        "clones decay everywhere",
        IMITATION,
        "return ROOM_DECAY if self.guesses or",
        "return ROOM_DECAY if True or",
        f"{ROOMS} -k smaller_synapses",
    ),
    Mutant(
        "the decay of this once is ignored", CIRCUIT, " if weight_decay is None else weight_decay)", ")", f"{LEARNING} -k once"
    ),
    Mutant("teachers that are not asked", CLONING, "elif self.ensemble_size > 1:", "elif False:", CLONES),
    Mutant("teachers are asked where it was shown", CLONING, "+= TEACHING_NOISE * th", "+= 0.0 * th", CLONES),
    Mutant("the first teacher alone", CLONING, "for teacher in teachers]).mean(0)", "for teacher in teachers])[0]", CLONES),
    Mutant("teachers everywhere", CLONING, "actions[::2] = th", "actions[:] = th", CLONES),
    Mutant("one fall of the rates for all", CLONING, "(done / self.n_updates)", "(index / len(self))", CLONES),
    Mutant(
        "a stop forgets the teachers",
        AGENT,
        'self.cloning.restore_checkpoint_state(state["cloning"])',
        "pass",
        "tests/checkpoints/test_exact_resume.py -k pretraining",
    ),
    Mutant(
        "a simulator under the name env is no part of it",
        SIMULATORS,
        "else _SKIPPED_WITHIN",
        "else _SKIPPED",
        f"{RESUMES} -k cannot",
    ),
    Mutant(
        "the simulator in use is forgotten",
        ENCODING,
        "existing) if layer is None else layer",
        "existing) if layer is None else existing",
        f"{RESUMES} -k held",
    ),
    Mutant(
        "any simulator for any other",
        SIMULATORS,
        "layer if [kind] == stored[place : place + 1] else None for",
        "layer for",
        f"{RESUMES} -k cannot",
    ),
    Mutant(
        "examined in another simulator",
        SIMULATORS,
        "[mismatch] if mismatch else ",
        "",
        "tests/experiments/test_examination.py -k held",
    ),
    Mutant("the first member of all", ENCODING, "else kind[member]", "else existing", f"{HELD} -k members"),
    Mutant(
        "the first method of all",
        ENCODING,
        "return types.MethodType(function, layer)",
        "return existing",
        f"{HELD} -k methods",
    ),
    Mutant(
        "any function for any other",
        ENCODING,
        'node.get("name", name) == name:',
        "True:",
        f"{HELD} -k calls_for_code",
    ),
    Mutant("statistics lost", ENCODING, "gymnasium_utils.RunningMeanStd, ", "", f"{HELD} -k statistics"),
    Mutant(
        "one layer lost, all lost",
        SIMULATORS,
        'entry.get("lost", range(len(stored)))',
        "range(len(stored))",
        f"{HELD} -k beside",
    ),
    Mutant(
        "a counter that is none",
        ENCODING,
        'return Counter(self._pairs(node["counter"], existing))',
        'return self._pairs(node["counter"], existing)',
        f"{HELD} -k dictionaries",
    ),
    Mutant("held twice, made twice", ENCODING, "if id(value) in self._met:", "if False:", f"{HELD} -k twice"),
    Mutant("views become copies", ENCODING, "np.shares_memory(value, other)", "False", f"{HELD} -k memory"),
    Mutant("one generator for two", ENCODING, " or id(existing) in self._used", "", f"{HELD} -k generator"),
    Mutant(
        "a return from two episodes",
        "experiments/runs/episode_log.py",
        "self.dense_returns = [0.0] * len(self.dense_returns)",
        "pass",
        f"{HELD} -k lost_beginning",
    ),
    Mutant(
        "the argument of before",
        "checkpoints/state.py",
        "if made_with.get(name) == argument:",
        "if True:",
        "tests/checkpoints/test_callbacks.py",
    ),
    Mutant(
        "arguments do not change",
        "checkpoints/state.py",
        "if made_with.get(name, digest) != digest",
        "if False",
        "tests/checkpoints/test_callbacks.py",
    ),
    Mutant(
        "no more steps for a stopped run",
        "experiments/runs/run.py",
        "callbacks, more, is_held=True, changes=changes)\n        except",
        "callbacks, 0, is_held=True, changes=changes)\n        except",
        "tests/cli/test_choices.py -k stopped_run",
    ),
    Mutant(
        "the best agent is the last",
        "experiments/runs/run.py",
        '("target_return", "keep")',
        '("target_return",)',
        "tests/cli/test_choices.py -k kept_agent",
    ),
    Mutant("changes lie crosswise", "ngc/products.py", ".t().contiguous()", ".t()", "tests/ngc/test_products.py -k shape"),
    Mutant(
        "what names the episode is small anyhow",
        WITHIN,
        "        return as_it_is\n    for",
        "        pass\n    for",
        WITHINS,
    ),
    Mutant("noise whatever is held out", IMITATION, "between <= MOST_BLUR * without", "True", HELD_OUTS),
    Mutant("no noise where it costs anything", IMITATION, "between <= MOST_BLUR * without", "between <= without", HELD_OUTS),
    Mutant("asked at every step", IMITATION, "if self._noise_helps is None:", "if True:", f"{HELD_OUTS} -k imitate_between"),
    Mutant("all clones imitate one way", IMITATION, "is_open and number % 2", "False", f"{HELD_OUTS} -k other_way"),
    Mutant(
        "the other way where asked for",
        IMITATION,
        "self.agent.refresh.noise is None and self.guesses",
        "self.guesses",
        f"{HELD_OUTS} -k other_way",
    ),
    Mutant("the other way without room", IMITATION, " and self.guesses\n", "\n", f"{HELD_OUTS} -k other_way"),
    Mutant("clones are not counted", TRIALS, "self.n_tried + self.is_clone", "self.n_tried", f"{HELD_OUTS} -k in_turn"),
    Mutant("a clone that was not made counts", AGENT, "self.trials.n_clones + 1, self.trials.n_tried - 1", "0, 0", HELD_OUTS),
    Mutant("an answer that was not given", IMITATION, "self._noise_helps = helps", "self._noise_helps = True", HELD_OUTS),
    Mutant("the answer is not in a checkpoint", IMITATION, "self._noise_helps = state", "pass", f"{HELD_OUTS} -k checkpoint"),
    Mutant("asked before VecNormalize knows", IMITATION, " if number else None", "", f"{HELD_OUTS} -k vec_normalize"),
    Mutant("clones of the old demonstrations", IMITATION, "now = agent.imitation", "now = self", f"{HELD_OUTS} -k replaced"),
    Mutant("means lose their digits", WITHIN, "features.double()", "features", f"{WITHINS} -k long"),
    Mutant("held out and shown too", HELD_OUT, "shown.select(~is_held)", "shown", HELD_OUTS),
    Mutant("the mean error", HELD_OUT, ".mean(1).median()", ".mean(1).mean()", f"{HELD_OUTS} -k typical"),
    Mutant(
        "numbers are drawn from everybody's",
        HELD_OUT,
        "            np.random.set_state(before)",
        "            pass",
        HELD_OUTS,
    ),
    Mutant("asked with the decay of none", IMITATION, "weight_decay=self.decay", "weight_decay=None", HELD_OUTS),
    Mutant(
        "episodes begin where they began",
        SELF_IMITATION,
        "np.searchsorted(rows, self.starts[rows])",
        "self.starts[rows]",
        HELD_OUTS,
    ),
    Mutant("a goal is taken smaller", WITHIN, "weights < CONTEXT", "weights < 0.0", f"{WITHINS} -k never_changes"),
    Mutant("whatever is small keeps its size", WITHIN, "weights < CONTEXT", "weights < 0.5", f"{WITHINS} -k cue"),
    Mutant("no feature is asked for on its own", WITHIN, "< SMALL_SHARE", "< 0.0", f"{WITHINS} -k cue"),
    Mutant("any need will do", WITHIN, "(1.0 - SMALLEST_NEED) * ", "2.0 * ", f"{WITHINS} -k cue"),
    Mutant("every so manieth step", ROOM, "np.linspace(0, n - 1, min(n, most))", "np.arange(0, n, -(-n // most))", ROOMS),
    Mutant("neighbours of the step's own episode", ROOM, "np.where(own, -1, part.neighbours)", "part.neighbours", ROOMS),
    Mutant("change is absolute", POLICIES, "SMALLEST_CHANGE * features.abs().amax(0)", "1e-4 + 0.0 * features[0]", STRANGERS),
    Mutant("any deviation is change", POLICIES, ".clamp_min(SMALLEST_DEVIATION)", "", f"{STRANGERS} -k noise"),
    Mutant(
        "an extractor that is trained", POLICIES, "        features_extractor.eval()", "        pass", f"{STRANGERS} -k fixed"
    ),
    Mutant(
        "fused whatever is given",
        POLICIES,
        ' and not kwargs.keys() & {"foreach", "differentiable"}',
        "",
        f"{STRANGERS} -k adam",
    ),
    Mutant("VecNormalize knows nothing", AGENT, "            self._show_to_vec_normalize()", "", f"{STRANGERS} -k vec_norm"),
    Mutant("held statistics move", AGENT, " or not normalize.training", "", f"{STRANGERS} -k held"),
    Mutant(
        "the first step as it was seen", AGENT, "if self._last_original_obs is not None:", "if False:", f"{STRANGERS} -k first"
    ),
    Mutant("a rate of a file", AGENT, 'group["lr_scale"] = scale', "pass", f"{STRANGERS} -k outlasts"),
    Mutant("anybody's buffer", AGENT, "held == needed", "True", f"{STRANGERS} -k buffers"),
    Mutant("the file's memory", AGENT, "            loaded.history = self.memory_history\n", "", f"{STRANGERS} -k remembers"),
    Mutant("evaluations go on", AGENT, "self._steps_at_pause != self._steps_of_envs()", "False", f"{LEARNS} -k who_plays"),
    Mutant(
        "a loaded critic is new", AGENT, "not _init_setup_model  #", "False  #", "tests/actpc/test_calibration.py -k loaded"
    ),
    Mutant("hindsight waits in silence", AGENT, "if ENDLESS in", "if not", f"{LEARNS} -k hindsight_that_waits"),
    Mutant("features without end", WITHIN, "[:MOST_ALONE]", "", f"{WITHINS} -k wide"),
    Mutant("buffers that are refused stay", AGENT, "        self.replay_buffer = given", "", f"{STRANGERS} -k buffers"),
    Mutant(
        "loaded synapses aside", CIRCUIT, "    circuit._list_synapses()", "    pass", "tests/ngc/test_settling.py -k loaded"
    ),
    Mutant("any gain will do", WITHIN, "(1.0 - SMALLEST_GAIN) * ", "", f"{WITHINS} -k small_gain"),
    Mutant("absent neighbours answer", WITHIN, " * known)", ")", f"{WITHINS} -k each_step"),
    Mutant("episodes count alike", WITHIN, ".square().mean(0), exact", ".square().mean(0) * 0.9, exact", WITHINS),
    Mutant("the share of the variance", WITHIN, "(within / total).sqrt()", "(within / total)", WITHINS),
    Mutant("weights take the scales' place", POLICIES, "self.scale.mul_(weights)", "self.scale.copy_(weights)", WITHINS),
    Mutant(
        "features are weighed by default alone", AGENT, 'if self.observation_normalization == "episodes"', "if True", WITHINS
    ),
    Mutant("noise where there is no room", IMITATION, " and self.room.is_wide", "", f"{ROOMS} -k without_a_word"),
    Mutant("room in any unit", ROOM, "> self.step", "> 0.5", f"{ROOMS} -k without_a_word"),
    Mutant("noise of one size", ROOM, "size * way.abs() * th.randn_like(features)", "size * th.randn_like(features)", ROOMS),
    Mutant("noise as wide as the room", ROOM, "nan_to_num(0.0).clamp_max(1.0)", "nan_to_num(0.0).clamp(1.0, 1.0)", ROOMS),
    Mutant("noise wider than the room", ROOM, "nan_to_num(0.0).clamp_max(1.0)", "nan_to_num(0.0)", ROOMS),
    Mutant("other places, the same actions", ROOM, "actions + share * turn", "actions", ROOMS),
    Mutant("a neighbour's place is taken", ROOM, "features + share * way", "features + way", ROOMS),
    Mutant("the nearest alone", ROOM, "(np.random.random(len(neighbours)) * known)", "(0 * known)", f"{ROOMS} -k every_known"),
    Mutant(
        "an episode is its own neighbour twice", ROOM, "known = of_demonstrated[nearest]", "pass", f"{ROOMS} -k neighbours"
    ),
    Mutant("unpaid neighbours", ROOM, "np.flatnonzero(shown.weights > 0.0)", "np.arange(len(shown))", f"{ROOMS} -k never"),
    Mutant(
        "neighbours within an episode",
        ROOM,
        "lengths.masked_fill_(known[:, None] == of_demonstrated, th.inf)",
        "lengths.masked_fill_(lengths == 0.0, th.inf)",
        f"{ROOMS} -k neighbours",
    ),
    Mutant(
        "pressure begins with all its strength",
        REGION,
        "self.multiplier.fill_(FIRST_MULTIPLIER)",
        "self.multiplier.fill_(1.0)",
        f"{HABIT} -k begins",
    ),
    Mutant("candidates at once", AGENT, "pressed_since + CANDIDATE_AGE", "pressed_since", f"{HABIT} -k long_enough"),
    Mutant(
        "the spread of the habit does not count",
        TRIALS,
        "in (self.candidate_returns, self.habit_returns) if sample",
        "in (self.candidate_returns,) if sample",
        f"{HABIT} -k spread",
    ),
    Mutant(
        "a few successes prove a learner", TRIALS, "is_few = is_coin and is_early", "is_few = False", f"{HABIT} -k nothing"
    ),
    Mutant(
        "a likely success is enough in the end",
        TRIALS,
        "if has_time or is_coin else",
        "if has_time else",
        f"{HABIT} -k nothing",
    ),
    Mutant(
        "successes with noise hasten a learner", TRIALS, "is_doubtful = is_coin or", "is_doubtful =", f"{HABIT} -k nothing"
    ),
    Mutant(
        "clones are learners of all or nothing",
        TRIALS,
        "return not self.is_clone and self.habit_return",
        "return self.habit_return",
        f"{HABIT} -k nothing",
    ),
    Mutant("nothing is all", TRIALS, "self.habit_return > 0.0 and len(paid)", "len(paid)", f"{HABIT} -k nothing"),
    Mutant("no race", TRIALS, "has_time = is_early or (is_coin", "has_time = is_early or (False", f"{HABIT} -k race"),
    Mutant("a race for ever", TRIALS, "< MOST_PROOF_STEPS * RACING", "< MOST_PROOF_STEPS * 2 * RACING", f"{HABIT} -k race"),
    Mutant("who gains no more races on", TRIALS, "(is_coin and gain > 0.0 and", "(is_coin and", f"{HABIT} -k race"),
    Mutant(
        "the candidate races alone", TRIALS, "is_habits_turn = self.habit_is_due", "is_habits_turn = False", f"{HABIT} -k race"
    ),
    Mutant(
        "the habit races alone",
        TRIALS,
        'self.habit_is_due = role == "candidate"',
        "self.habit_is_due = True",
        f"{HABIT} -k race",
    ),
    Mutant(
        "all race",
        TRIALS,
        "return self.on_trial and has_played and self._is_coin()",
        "return self.on_trial and has_played",
        f"{HABIT} -k race",
    ),
    Mutant(
        "a race from the first episode on",
        TRIALS,
        "self.on_trial and has_played and",
        "self.on_trial and",
        f"{HABIT} -k race",
    ),
    Mutant(
        "a race after one long episode",
        TRIALS,
        "len(self.candidate_returns) >= N_PROOFS and self.candidate_steps",
        "self.candidate_steps",
        f"{HABIT} -k race",
    ),
    Mutant(
        "twenty episodes are asked in a race too",
        TRIALS,
        "is_few = is_coin and is_early",
        "is_few = is_coin and has_time",
        f"{HABIT} -k nothing",
    ),
    Mutant("too few successes are a tie", TRIALS, '"undecided" if is_coin else "tied"', '"tied"', f"{HABIT} -k nothing"),
    Mutant(
        "given synapses have no rivals",
        AGENT,
        "self.trials or Trials(1, n_clones=clones)",
        "self.trials or Trials(1)",
        f"{HABIT} -k given_synapses",
    ),
    Mutant(
        "steps of old actions", AGENT, 'self.bootstrap == "literal" and self.n_steps > 1', "False", f"{LEARNS} -k go_together"
    ),
    Mutant(
        "episodes of many environments",
        AGENT,
        "self.n_envs > 1 and isinstance(every, tuple)",
        "isinstance(every, int)",
        f"{LEARNS} -k go_together",
    ),
    Mutant("all dimensions spread alike", REGION, "residuals.square().mean(0)", "residuals.square().mean()", REGIONS),
    Mutant(
        "the deviation has no unit",
        REGION,
        "(actions - habit_actions) / self.unit",
        "(actions - habit_actions)",
        REGIONS,
    ),
    Mutant(
        "the pressure grows outside",
        REGION,
        "1.0 - self.deviation / allowed",
        "-1.0 + self.deviation / allowed",
        REGIONS,
    ),
    Mutant("clones that guess are sure", AGENT, "spread, self.imitation.guesses", "spread, False", f"{ROOMS} -k unless"),
    Mutant("twenty episodes say it all", TRIALS, "NOISY_RETURNS = 100, 2", "NOISY_RETURNS = 20, 2", f"{HABIT} -k unlucky"),
    Mutant("a small spread is as small a unit", REGION, "else SMALLEST_UNIT, 1.0)", "else 0.0, 1.0)", REGIONS),
    Mutant("lost states count as well", REGION, "(squares * weights).mean()", "squares.mean() * weights.mean()", REGIONS),
    Mutant("pressure goes as slowly as it comes", REGION, "FALL * unused", "RISE * unused", REGIONS),
    Mutant(
        "normalised twice",
        AGENT,
        "if not self.inputs.are_normalised:",
        "if True:",
        "tests/actpc/test_agent.py -k normalises",
    ),
    Mutant(
        "weights are constants of a graph",
        "actpc/compiled.py",
        "given.imitated, *given.weights)",
        "given.imitated, agent.refresh_weight, agent.actor_pressure)",
        "tests/actpc/test_compiled.py -k annealed",
    ),
    Mutant(
        "own episodes of another environment stay",
        AGENT,
        "self.replay_buffer.forget_own_episodes()",
        "self.replay_buffer.self_imitation",
        f"{LEARNS} -k forgets_the_own",
    ),
    Mutant(
        "the room stays as VecNormalize began",
        IMITATION,
        "            self._room = None",
        "            pass",
        f"{LEARNS} -k anew",
    ),
    Mutant(
        "a prior begins at a run's last rate",
        AGENT,
        'group["lr"] = self.lr_schedule(1.0) * group["lr_scale"]',
        'group["lr"] *= 1.0',
        f"{LEARNS} -k begins_later",
    ),
    Mutant(
        "clones of nothing are due",
        AGENT,
        "self.trials.n_clones = 0  # of nothing",
        "pass  # of nothing",
        f"{LEARNS} -k none_are_due",
    ),
    Mutant(
        "n_steps that is set later is not checked",
        BUFFERS,
        "_check_n_steps(n_steps, type(self), self.optimize_memory_usage)",
        "_check_n_steps(1, type(self), self.optimize_memory_usage)",
        f"{LEARNS} -k set_later",
    ),
    Mutant("updates made before do not count", AGENT, "self._n_updates + round(", "round(", f"{LEARNS} -k too_few"),
    Mutant(
        "a failed compilation ends the run",
        "actpc/compiled.py",
        "if agent.compile is True:",
        "if True:",
        "tests/actpc/test_compiled.py -k fails",
    ),
    Mutant(
        "an interrupted clone is on trial",
        AGENT,
        "self.trials, self._last_obs = self.trials.forgotten(self.n_envs), None",
        "pass",
        "tests/actpc/test_cloning.py -k interrupted",
    ),
    Mutant("the multiplier is let go", REGION, ".clamp_max_(self.largest)", "", REGIONS),
    Mutant("the multiplier goes to nothing", REGION, ".clamp_min_(MULTIPLIERS[0])", "", REGIONS),
    Mutant(
        "where clones guess as much pressure",
        REGION,
        "LARGEST_UNHELD if guesses and not holds else MULTIPLIERS[1]",
        "MULTIPLIERS[1]",
        REGIONS,
    ),
    Mutant("the habit holds, and the pressure is bounded", REGION, " and not holds else", " else", REGIONS),
    Mutant("a learner that is held has all the room", REGION, "if guesses and not holds:", "if guesses:", REGIONS),
    Mutant("a learner that guesses has no room", REGION, "HELD_UNIT if guesses else SMALLEST_UNIT", "SMALLEST_UNIT", REGIONS),
    Mutant("demonstrators are sure", REGION, "HELD_UNIT if guesses else SMALLEST_UNIT, 1.0", "HELD_UNIT, HELD_UNIT", REGIONS),
    Mutant("the radius in any unit", REGION, "float(self.unit.pow(-2).mean())", "44.44", REGIONS),
    Mutant(
        "rejections make the region of a learner that is held small",
        REGION,
        "clamp_(self.first_radius, max(self.first_radius, largest))",
        "clamp_(0.1, largest)",
        REGIONS,
    ),
    Mutant("verdicts resize a region that follows episodes", REGION, "if not self.holds:", "if True:", REGIONS),
    Mutant(
        "every region follows episodes",
        REGION,
        "if self.holds:\n            factor = ",
        "if True:\n            factor = ",
        REGIONS,
    ),
    Mutant(
        "a region follows what was before the pressure",
        AGENT,
        "and self._n_updates > self.critic_warmup:",
        "and True:",
        f"{HABIT} -k radius_follows",
    ),
    Mutant(
        "quiet episodes are followed",
        TRIALS,
        'if self.roles[env] != "actor" or self.gen',
        "if self.gen",
        f"{HABIT} -k of_before",
    ),
    Mutant(
        "another learner's episodes are followed",
        TRIALS,
        " or self.generations[env] != self.generation or",
        " or",
        f"{HABIT} -k of_before",
    ),
    Mutant("one episode moves the radius far", TRIALS, "max(-1.0, gain / unit)", "gain / unit", f"{HABIT} -k share_of_what"),
    Mutant("of nothing any episode is a loss", TRIALS, "-float(gain < 0.0)", "-1.0", f"{HABIT} -k share_of_what"),
    Mutant(
        "what is lost is a gain",
        TRIALS,
        "unit = max(abs(self.habit_return)",
        "unit = max(self.habit_return",
        f"{HABIT} -k share_of_what",
    ),
    Mutant(
        "where the habit is seldom paid a gain is too small",
        TRIALS,
        "max(self.habit_returns) - self.habit_return, gain)",
        "gain)",
        f"{HABIT} -k gains_in_the_mean",
    ),
    Mutant("the radius runs away", REGION, "max(self.first_radius, largest))", "RADII[1])", REGIONS),
    Mutant("a wide first radius is cut", REGION, "max(self.first_radius, largest))", "largest)", REGIONS),
    Mutant(
        "a clone begins with another's radius",
        REGION,
        "self.radius.fill_(self.first_radius)",
        "pass",
        f"{HABIT} -k first_radius",
    ),
    Mutant(
        "every clone begins with the first radius",
        REGION,
        "        if self.holds:\n            self.radius.fill_(",
        "        if True:\n            self.radius.fill_(",
        f"{HABIT} -k first_radius",
    ),
    Mutant(
        "a clone in a phase of imitation is not held",
        AGENT,
        "self.imitation.guesses, self.imitation.is_held",
        "self.imitation.guesses, self.imitation.is_taught",
        f"{HABIT} -k first_radius",
    ),
    Mutant("whether it holds is forgotten", REGION, "self.holds.fill_(float(holds))", "pass", f"{ROOMS} -k decided_once"),
    Mutant("the habit holds everywhere", IMITATION, "self.guesses and bool(", "bool(", f"{ROOMS} -k teaches"),
    Mutant(
        "what was never paid holds",
        IMITATION,
        "self.guesses and bool(agent.expert.episodes.returns.any())",
        "self.guesses",
        f"{ROOMS} -k teaches",
    ),
    Mutant(
        "whether it holds is decided anew",
        IMITATION,
        "region is None or agent.pretrained",
        "region is None",
        f"{ROOMS} -k decided_once",
    ),
    Mutant(
        "an actor that only imitates is taught",
        IMITATION,
        "return self.is_held and self._has_teacher",
        "return self.is_held",
        f"{ROOMS} -k decided_once",
    ),
    Mutant(
        "the habit holds imitation alone", IMITATION, "agent.actor_pressure and agent.ref", "agent.ref", f"{ROOMS} -k teaches"
    ),
    Mutant("a habit of nothing teaches", IMITATION, " and agent.actor_warm_start\n", "\n", f"{ROOMS} -k teaches"),
    Mutant(
        "nobody is taught",
        AGENT,
        "imitated = self._imitated(batch)",
        "imitated = self.imitation.sample(len(batch.features))",
        f"{ROOMS} -k is_learned",
    ),
    Mutant(
        "nobody is taught by a compiled update",
        "actpc/compiled.py",
        "agent._imitated(actor)",
        "agent.imitation.sample(len(actor.features))",
        f"{ROOMS} -k is_learned",
    ),
    Mutant(
        "the learner teaches itself",
        AGENT,
        "self.actor.habit.project(batch.features, batch.memory)\n        both",
        "self.actor.circuit.project(batch.features, batch.memory)\n        both",
        f"{ROOMS} -k teaches",
    ),
    Mutant("ties change nothing", REGION, '"tied": 2.0', '"tied": 1.0', REGIONS),
    Mutant(
        "unpaid ties widen",
        AGENT,
        "verdict is not None and trials.habit_return != 0.0",
        "verdict is not None",
        f"{HABIT} -k resized",
    ),
    Mutant(
        "old candidates count",
        TRIALS,
        'if one.role == "habit" and not is_other',
        'if one.role == "candidate" or not is_other',
        f"{HABIT} -k judged_meanwhile",
    ),
    Mutant("old habits count", TRIALS, " and not is_other]", "]", f"{HABIT} -k old_habit"),
    Mutant(
        "short episodes prove at once",
        TRIALS,
        "if not _is_tried(n, self.candidate_steps) and",
        "if False and",
        f"{HABIT} -k short",
    ),
    Mutant(
        "the critic sees nothing of the region",
        AGENT,
        "region.unit if region is not None and self._is_taught else self.policy.spread",
        "self.policy.spread",
        f"{ROOMS} -k as_wide",
    ),
    Mutant(
        "noise for nobody",
        AGENT,
        "region.unit if region is not None and self._is_taught else",
        "region.unit if region is not None else",
        f"{ROOMS} -k as_wide",
    ),
    Mutant(
        "the noise forgets the spread",
        AGENT,
        "widest.clamp_max(float(self.exploration_noise))",
        "th.full_like(widest, self.exploration_noise)",
        f"{HABIT} -k noise",
    ),
    Mutant("the warm start's rate stands", CLONING, " * (last / first) ** (done / self.n_updates)", "", f"{CLONES} -k rates"),
    Mutant("the delay is ignored", AGENT, "self._n_updates % self.policy_delay == 0", "True", f"{HABIT} -k once"),
    # ------------------------------------------------------------------ the batch
    Mutant(
        "half of the demonstrations' share",
        AGENT,
        "round(self.demonstration_fraction *",
        "round(0.5 * self.demonstration_fraction *",
        f"{LEARNS} -k share",
    ),
    Mutant(
        "a prior that nothing was shown rewards",
        AGENT,
        "0.0 if self.demonstrations is None else self.alpha_in",
        "self.alpha_in",
        f"{LEARNS} -k without_demonstrations",
    ),
    Mutant(
        "acting remembers o_t itself",
        POLICIES,
        "memory = self.memory(th.as_tensor(history, device=self.device))",
        "memory = self.memory(th.cat([th.as_tensor(history[:, 1:], device=self.device), features[:, None]], dim=1))",
        f"{LEARNS} -k memory",
    ),
    Mutant(
        "acting remembers the episode before",
        POLICIES,
        "history[np.asarray(episode_start, dtype=bool)] = 0.0",
        "history[np.asarray(episode_start, dtype=bool)] += 0.0",
        f"{LEARNS} -k memory",
    ),
    Mutant(
        "m_t+1 lacks o_t",
        FEATURES,
        "following = th.cat([past[:, 1:], features[:, None]], dim=1)",
        "following = past",
        f"{EQUATIONS} -k next_steps_memory",
    ),
    Mutant(
        "what was before the episode is remembered",
        FEATURES,
        ".view(*mask.shape, features.shape[1]) * mask[:, :, None]",
        ".view(*mask.shape, features.shape[1])",
        f"{LEARNS} -k memory",
    ),
    Mutant("the running maximum starts at 0", SIGNALS, "self.maximum = 1.0", "self.maximum = 1e-9", f"{LEARNS} -k maximum"),
    Mutant(
        "all layers' errors where the output's are asked for",
        SIGNALS,
        "else state.errors[-1:]",
        "else state.errors",
        f"{LEARNS} -k output_errors",
    ),
    Mutant(
        "the paper's maximum is the default: signals die",
        SIGNALS,
        '"saturating", "max"] = "quantile"',
        '"saturating", "max"] = "max"',
        EQUATIONS,
    ),
    Mutant(
        "the low quantile in the place of the high",
        SIGNALS,
        "(above - (1.0 - self.quantile))",
        "(above - self.quantile)",
        EQUATIONS,
    ),
    Mutant(
        "demonstrations' instrumental signals are rewards",
        SHOWN,
        "self.instrumental[rows] = instrumental(raw_in)",
        "self.instrumental[rows] = -instrumental(raw_in)",
        EQUATIONS,
    ),
    Mutant(
        "unseen falls count for nothing",
        TRIALS,
        "gain >= self._unseen_risk() * unit and not is_few",
        "not is_few",
        f"{HABIT} -k occasion",
    ),
    Mutant(
        "the habit's occasions are counted without end",
        TRIALS,
        "n_habit = min(len(self.habit_returns), ENOUGH_PROOFS)",
        "n_habit = len(self.habit_returns)",
        f"{HABIT} -k occasion",
    ),
    Mutant(
        "the habit has had no occasions",
        TRIALS,
        "- 1.0 / (n_habit + 2), 0.0)",
        "- 0.0 * n_habit, 0.0)",
        f"{HABIT} -k occasion",
    ),
    Mutant(
        "a policy of one's own has no keywords of its own",
        POLICIES,
        "{*constructor_keywords(policy_class)} -",
        "{*constructor_keywords(ActPCPolicy)} -",
        f"{LEARNS} -k keywords_of_its_own",
    ),
    # ------------------------------------------------------------------ buffers
    Mutant(
        "the newest transition is not in the batch",
        BUFFERS,
        "np.full(len(newest), self.newest)",
        "np.full(len(newest), self.newest - 1)",
        f"{STORES} -k newest",
    ),
    Mutant(
        "of many environments the same ones are always the newest",
        BUFFERS,
        "newest = np.random.permutation(self.n_envs)[: len(newest)]",
        "newest = np.arange(len(newest))",
        f"{STORES} -k newest",
    ),
    Mutant(
        "the memory reaches into the episode before",
        BUFFERS,
        "(self.dones[earlier, envs[:, None]] == 0)",
        "(self.dones[earlier - 1, envs[:, None]] == 0)",
        f"{STORES} {LEARNS} -k 'past or memory'",
    ),
    Mutant(
        "the first observation is forgotten",
        BUFFERS,
        "exists = steps_back <= age[:, None]",
        "exists = steps_back < age[:, None]",
        f"{STORES} {LEARNS} -k 'past or memory'",
    ),
    Mutant("returns run past the newest transition", BUFFERS, " | (window == self.newest)", "", f"{STORES} -k n_step"),
    Mutant(
        "a time limit is an end",
        BUFFERS,
        "self.dones[last, envs] * (1 - self.timeouts[last, envs])",
        "self.dones[last, envs]",
        STORES,
    ),
    Mutant(
        "returns of several steps are not discounted",
        BUFFERS,
        "* mask * self.gamma ** np.arange(self.n_steps, dtype=np.float32)).sum",
        "* mask).sum",
        f"{STORES} -k n_step",
    ),
    Mutant(
        "a ring's rows without their past are drawn",
        BUFFERS,
        "np.random.randint(skipped, self",
        "np.random.randint(0, self",
        f"{STORES} {LEARNS} -k 'past or memory'",
    ),
    Mutant(
        "hindsight has goals of the same episode alone",
        BUFFERS,
        "np.random.random(len(goals)) < self.random_goals",
        "np.random.random(len(goals)) > 2.0",
        "tests/baselines/test_her.py -k any_episode",
    ),
    Mutant(
        "a random goal is where an episode stood, not what it reached",
        BUFFERS,
        'self.next_observations["achieved_goal"][batch_indices[any_rows]',
        'self.observations["achieved_goal"][batch_indices[any_rows]',
        "tests/baselines/test_her.py -k any_episode",
    ),
    Mutant(
        "an episode's end ends it for other goals too",
        BUFFERS,
        "is_random = goes_on & (",
        "is_random = (",
        "tests/baselines/test_her.py -k any_episode",
    ),
    Mutant(
        "after a time limit there are no random goals",
        BUFFERS,
        " | (self.timeouts[rows] != 0)",
        "",
        "tests/baselines/test_her.py -k all_environments",
    ),
    Mutant(
        "an equally good episode does not enter",
        SELF_IMITATION,
        "or episode_return >= self.best_return",
        "or episode_return > self.best_return",
        f"{STORES} -k enters",
    ),
    Mutant(
        "short quiet episodes are few",
        TRIALS,
        'self.roles[env] == "actor" or self.quiet_due[env] > 0',
        'self.roles[env] == "actor"',
        f"{HABIT} -k as_many_steps",
    ),
    Mutant(
        "quiet steps are due for ever",
        TRIALS,
        "else self.quiet_due[env] - length",
        "else self.quiet_due[env]",
        f"{HABIT} -k as_many_steps",
    ),
    Mutant("own episodes below the best stay out", SELF_IMITATION, "self.takes_all or ", "", f"{STORES} -k enters"),
    Mutant(
        "own episodes count for nothing",
        IMITATION,
        "imitated_return(self.parts(), ",
        "imitated_return(self.parts()[:1], ",
        f"{HABIT} -k own_episodes_too",
    ),
    Mutant(
        "poor own episodes are imitated like good ones",
        AGENT,
        "memory.takes_all = is_weighted and",
        "memory.takes_all = is_weighted or",
        f"{HABIT} -k every_paid",
    ),
    Mutant("refresh squares returns", SELF_IMITATION, "** RETURN_EXPONENT", "** 2", f"{STORES} -k paid"),
    Mutant("lost returns weigh", SELF_IMITATION, "np.maximum(self.returns, 0.0)", "np.abs(self.returns)", f"{STORES} -k paid"),
    Mutant(
        "refresh ignores what was paid",
        IMITATION,
        "n, agent.memory_history, agent.refresh.weighting)",
        "n, agent.memory_history)",
        f"{LEARNS} -k paid",
    ),
    Mutant(
        "an unpaid episode enters",
        SELF_IMITATION,
        "episode_return > 0.0 and",
        "episode_return >= 0.0 and",
        f"{STORES} -k enters",
    ),
    Mutant(
        "imitation forgets an episode's first step",
        SELF_IMITATION,
        "(earlier >= self.starts[indices][:, None])",
        "(earlier > self.starts[indices][:, None])",
        f"{STORES} -k history",
    ),
    Mutant(
        "only the first part of the union is drawn",
        SELF_IMITATION,
        "np.random.randint(0, ends[-1], size=n)",
        "np.random.randint(0, ends[0], size=n)",
        f"{STORES} -k union",
    ),
    # ------------------------------------------------------------------ tasks
    Mutant(
        "displacement is measured from the origin",
        SPARSE,
        "is_far = bool(self.data.qpos[0] - self._start_x > self.distance)",
        "is_far = bool(self.data.qpos[0] > self.distance)",
        f"{TASKS} -k displacement",
    ),
    Mutant("the HalfCheetah's threshold", SPARSE, '"HalfCheetah": 20.0', '"HalfCheetah": 19.0', f"{TASKS} -k displacement"),
    Mutant(
        "the Reacher's threshold",
        SPARSE,
        "default_threshold: ClassVar[float] = 0.06",
        "default_threshold: ClassVar[float] = 0.07",
        f"{TASKS} -k 6_cm",
    ),
    Mutant(
        "motion backward is paid",
        SPARSE,
        'info["x_velocity"] > self',
        'abs(info["x_velocity"]) > self',
        f"{TASKS} -k 'forward or motion'",
    ),
    Mutant(
        "success is forgotten when the robot goes back",
        SPARSE,
        "self._has_passed = self._has_passed or is_far",
        "self._has_passed = is_far",
        f"{TASKS} -k 'displacement or success'",
    ),
    Mutant(
        "a fallen robot's last step is healthy",
        SPARSE,
        'healthy_reward * ~(demonstrations.terminations & demonstrations.env_id.endswith("v5"))',
        "healthy_reward * 1.0",
        f"{TASKS} -k demonstrat",
    ),
    Mutant(
        "the goal Reacher's fingertip is on the other side",
        "envs/goal_mujoco.py",
        "observation[..., _REACHER_DIFFERENCE] + target",
        "observation[..., _REACHER_DIFFERENCE] - target",
        "tests/baselines/test_her.py -k goal",
    ),
    # ------------------------------------------------------------------ statistics
    Mutant(
        "R-stability's window ends one episode late",
        R_STABILITY,
        "sliding_window_view(last, WINDOW)[:-1]",
        "sliding_window_view(last, WINDOW)[1:]",
        STABLE,
    ),
    Mutant("R-stability's best is of all episodes", R_STABILITY, "best = last[WINDOW:].max()", "best = last.max()", STABLE),
    Mutant("the final mean is the first", R_STABILITY, "np.mean(values[-WINDOW:])", "np.mean(values[:WINDOW])", STABLE),
    Mutant(
        "a fifth is trimmed, not a quarter",
        STATISTICS,
        "trim_mean(joined, 0.25,",
        "trim_mean(joined, 0.2,",
        SCORES,
    ),
    Mutant("ties lose", STATISTICS, "0.5 * (difference == 0)", "0.0 * (difference == 0)", SCORES),
    Mutant("a biased deviation over seeds", STATISTICS, "values.std(axis=0, ddof=1)", "values.std(axis=0)", SCORES),
    Mutant(
        "an interval of 90 %",
        STATISTICS,
        "np.quantile(values, [(1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0])",
        "np.quantile(values, [1.0 - CONFIDENCE, CONFIDENCE])",
        SCORES,
    ),
    Mutant(
        "profiles count runs below",
        STATISTICS,
        "(joined > threshold)",
        "(joined < threshold)",
        SCORES,
    ),
    Mutant(
        "a resumed run's best agent is written over",
        "experiments/runs/evaluation.py",
        "self.last_timesteps < 0 and not self.num_timesteps:",
        "self.last_timesteps < 0:",
        "tests/cli/test_cli.py -k resumed",
    ),
    Mutant(
        "a clone is evaluated as if it were untrained",
        "experiments/runs/evaluation.py",
        'elif not getattr(model, "actor_warm_start", 0):',
        "else:",
        "tests/baselines/test_bc.py -k evaluated",
    ),
    Mutant("a preset's noise stays", PRESETS, " or name in CAN_BE_NONE", "", f"{TABLE} -k left_out"),
    Mutant(
        "a goal task with a module has no demonstrations",
        "envs/__init__.py",
        "if name in GOAL_MUJOCO_IDS",
        "if env_id in GOAL_MUJOCO_IDS",
        TABLE,
    ),
    Mutant("the aim is no part of a run", "experiments/runs/schema.py", '"target_return",', "", f"{TABLE} -k follows"),
    Mutant(
        "a second number of steps hides the first",
        "experiments/report/results.py",
        "nunique().max() == 1",
        "nunique().max() > 1",
        f"{REPORTS} -k second_number",
    ),
    Mutant(
        "ablations beside another base",
        "experiments/report/ablations.py",
        "== known.loc[base, ALIKE]",
        "== known[ALIKE]",
        f"{REPORTS} -k second_number",
    ),
    Mutant(
        "a variant without a name is not its base's",
        "experiments/comparison/plan.py",
        "str(parse_variant(entry).name): entry for",
        'str(entry.get("name")): entry for',
        f"{TABLE} -k chosen",
    ),
    Mutant(
        "an export of an export forgets the settings",
        "experiments/report/export.py",
        "if kept_settings.is_file()",
        "if False",
        "tests/experiments/report/test_export.py -k export_of",
    ),
    Mutant(
        "references of two exports are two runs",
        "experiments/report/published.py",
        " | ~exported.duplicated()",
        " | True",
        "tests/experiments/report/test_published.py -k several_exports",
    ),
    Mutant(
        "a task with one kind of settings falls out",
        "experiments/report/build.py",
        "**by_label.get(variants[label], {}), ",
        "",
        f"{REPORTS} -k counts_with_each",
    ),
    Mutant("wrong settings are planned", PRESETS, "check_settings(algorithm, _parsed(settings))", "", f"{TABLE} -k planned"),
    Mutant(
        "wrong keywords of an environment are planned",
        "experiments/comparison/plan.py",
        "own_demonstrations or run.env_kwargs",
        "own_demonstrations",
        f"{TABLE} -k planned",
    ),
    Mutant(
        "seeds beyond the last are planned",
        "experiments/comparison/plan.py",
        "> MAX_SEED",
        "> 2 * MAX_SEED",
        f"{TABLE} -k planned",
    ),
    Mutant(
        "keys of an entry are planned for all",
        "experiments/comparison/plan.py",
        "(*OF_TASKS, *OF_VARIANTS))",
        "())",
        f"{TABLE} -k planned",
    ),
    Mutant(
        "a file's own variant is not known by its name",
        "experiments/comparison/plan.py",
        "own.get(name, name) for name",
        "name for name",
        "tests/experiments/comparison/test_table.py -k chosen",
    ),
]


def occurrences(mutant: Mutant) -> int:
    """
    :param mutant: one of ``MUTANTS``
    :return: how often the text that it changes is in the source
    """
    return (ROOT / "sb3_actpc" / mutant.file).read_text(encoding="utf-8").count(mutant.old)


def plant(mutant: Mutant, folder: Path) -> None:
    """
    :param mutant: one of ``MUTANTS``
    :param folder: empty; gets a copy of the package with the mutant in it, and of the tests
    """
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("results"))
        else:
            shutil.copy(ROOT / name, folder / name)
    file = folder / "sb3_actpc" / mutant.file
    file.write_text(file.read_text(encoding="utf-8").replace(mutant.old, mutant.new), encoding="utf-8")


def run_tests(folder: str, arguments: list[str]) -> None:
    """In a process of its own: end it with pytest's exit code.

    :param folder: the copy
    :param arguments: pytest's
    """
    os.chdir(folder)
    sys.dont_write_bytecode = True
    sys.path.insert(0, folder)
    for name in [name for name in sys.modules if name.partition(".")[0] in ("tests", "sb3_actpc")]:
        del sys.modules[name]
    os.environ["PYTHONPATH"] = folder  # for processes that the tests start
    with open(SAID, "w", encoding="utf-8") as said:
        os.dup2(said.fileno(), 1)
        os.dup2(said.fileno(), 2)
    import pytest

    sys.exit(int(pytest.main(["-q", "-x", "-p", "no:cacheprovider", *arguments])))


def outcome(mutant: Mutant) -> str:
    """
    :param mutant: one of ``MUTANTS``
    :return: "killed", or what is wrong
    """
    if occurrences(mutant) != 1:
        return f"NOT PLANTED: {mutant.old!r} is {occurrences(mutant)} times in {mutant.file}"
    with tempfile.TemporaryDirectory() as folder:
        plant(mutant, Path(folder))
        process = multiprocessing.get_context("forkserver").Process(target=run_tests, args=(folder, shlex.split(mutant.tests)))
        process.start()
        process.join(TIMEOUT)
        if process.is_alive():
            process.kill()
            return "killed"
        if process.exitcode == TESTS_FAILED:
            return "killed"
        said = (Path(folder) / SAID).read_text(encoding="utf-8").strip().splitlines()
    return "LIVES" if process.exitcode == 0 else f"NOT TESTED: {said[-1:]}"


def outcomes(mutants: list[Mutant], jobs: int) -> Iterator[tuple[Mutant, str, float]]:
    """
    :param mutants: to try
    :param jobs: how many at a time
    :return: each with its :func:`outcome` and the seconds that it took, in their order
    """

    def timed(mutant: Mutant) -> tuple[Mutant, str, float]:
        started = time.monotonic()
        return mutant, outcome(mutant), time.monotonic() - started

    os.environ["OMP_NUM_THREADS"] = "1"
    compileall.compile_dir(ROOT / "sb3_actpc", quiet=1)  # once, not in every copy
    multiprocessing.get_context("forkserver").set_forkserver_preload(PRELOADED)
    with ThreadPoolExecutor(jobs) as workers:
        yield from workers.map(timed, mutants)


def main() -> int:
    """:return: exit code"""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", nargs="?", default="", help="of the names of those to try (default: all)")
    parser.add_argument("--jobs", type=int, default=2, help="mutants at a time (default: %(default)s)")
    parser.add_argument("--log", type=Path, help="file of those killed, which are not tried again")
    args = parser.parse_args()
    started, alive = time.monotonic(), []
    done = args.log.read_text(encoding="utf-8").splitlines() if args.log and args.log.is_file() else []
    chosen = [mutant for mutant in MUTANTS if args.part in mutant.name and mutant.name not in done]
    for mutant, result, seconds in outcomes(chosen, args.jobs):
        print(f"{time.monotonic() - started:6.0f} s  {mutant.name}: {result} ({seconds:.0f} s)", flush=True)
        if result != "killed":
            alive.append(mutant.name)
        elif args.log:
            with open(args.log, "a", encoding="utf-8") as log:
                log.write(f"{mutant.name}\n")
    print(f"{len(chosen) - len(alive)} of {len(chosen)} mutants killed")
    for name in alive:
        print(f"not killed: {name}")
    return 1 if alive or not (chosen or done) else 0


if __name__ == "__main__":
    sys.exit(main())
