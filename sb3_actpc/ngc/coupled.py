"""Two circuits that settle as one: the actor under the critic (paper, sections on the policy and motor-action circuits)."""

from dataclasses import dataclass

import torch as th

from sb3_actpc.ngc.circuit import NGCCircuit
from sb3_actpc.ngc.dynamics import SettledState, SettlingChain
from sb3_actpc.ngc.plasticity import HebbianChanges


@dataclass
class CoupledState:
    """
    :param actor: the actor's settled state; its output error is the perturbation d_a the critic asked for
    :param actions: the actor's projected actions, (B, A), fixed while settling
    :param action_values: the critic's projected values of them, (B, n_outputs), of an ensemble (M, B, n_outputs)
    """

    actor: SettledState
    actions: th.Tensor
    action_values: th.Tensor


def check_agreement(actor: NGCCircuit, critic: NGCCircuit) -> None:
    """:raises ValueError: for two circuits that cannot settle as one, as their schedules differ; a sweep takes no steps"""
    shared = ["settling"]
    if actor.settling == "iterative":
        shared += ["n_settling_steps", "dynamics"]
    for name in shared:
        if getattr(actor, name) != getattr(critic, name):
            raise ValueError(
                f"actor {name}={getattr(actor, name)!r} and critic {name}={getattr(critic, name)!r} must agree, as they "
                f"settle as one; give both circuits the same {name}"
            )


def settle_coupled(
    actor: NGCCircuit, critic: NGCCircuit, x: th.Tensor, memory: th.Tensor | None = None, nudge: float | None = None
) -> CoupledState:
    """
    Project actor and critic, hold the action, clamp the critic's output error to +1/A and settle both as one circuit.

    At every step the actor's output error is clamped to d_a = E_a e, the critic's perturbation of its action inputs. (The
    paper prints -1/A; with changes that are *added*, that sign would lower the action-values.) Neither circuit changes.

    The clamped error is applied as ``nudge`` / A and the actor's errors are divided by ``nudge`` afterwards: the smaller the
    nudge, the closer the actor's change comes to the deterministic policy gradient (tied feedback). The paper's is 1. In the
    limit the states stand still and only the error neurons settle: ``dynamics="krylov"`` is at rest after one sweep;
    ``dynamics="state"`` cannot be, as a small nudge drowns in the rounding of z - z̄.

    :param actor: observation (and memory) -> action
    :param critic: [observation, action] -> action-values; its last A inputs are the action. The actor follows the mean of an
        ensemble's members
    :param x: observations, (B, n_observation)
    :param memory: the actor's m_t, (B, n_memory), or None
    :param nudge: scale of the perturbation, in (0, 1]; None for an infinitesimal one, or 1 with ``dynamics="state"``
    :return: the actor's state, the actions and their values
    :raises ValueError: when the critic's error synapses do not reach the actor's outputs, or the schedules differ
    """
    n_actions = actor.sizes[-1]
    if critic.n_feedback_inputs != n_actions or critic.sizes[0] != x.shape[1] + n_actions:
        raise ValueError(
            f"the critic has n_inputs={critic.sizes[0]} and n_feedback_inputs={critic.n_feedback_inputs}; under this actor it "
            f"needs {x.shape[1] + n_actions} and {n_actions}"
        )
    check_agreement(actor, critic)
    motor = actor.chain(x, memory)
    value = critic.chain(th.cat([x, motor.output], dim=1))
    scale = 1.0 if nudge is None or actor.settling == "scheduled" else nudge
    value.clamp_output_drive(_mean_value_drive(value, scale))
    if actor.settling == "scheduled" or (actor.dynamics == "krylov" and nudge is None):
        _sweep_both(motor, value, critic.input_feedback())
    else:
        _settle_both(actor, critic, motor, value)
        for error in [*motor.errors, motor.output_error]:
            error.div_(scale)
        if motor.drive is not motor.output_error:
            motor.drive.div_(scale)
    return CoupledState(motor.state(), motor.output, value.output)


def policy_gradient(actor: NGCCircuit, critic: NGCCircuit, x: th.Tensor, memory: th.Tensor | None = None) -> HebbianChanges:
    """
    The deterministic policy gradient, by one backward sweep through W^T: what the coupled pair's change is compared with.

    :param actor: as for :func:`settle_coupled`, and so are the others
    :return: the ascent direction of the mean action-value, batch mean
    """
    motor = actor.chain(x, memory)
    value = critic.chain(th.cat([x, motor.output], dim=1))
    value.clamp_output_drive(_mean_value_drive(value))
    _sweep_both(motor, value, critic.input_feedback(tied=True), exact=True)
    return actor.hebbian_update(motor.state())


def _sweep_both(motor: SettlingChain, value: SettlingChain, to_action: th.Tensor, exact: bool = False) -> None:
    value.sweep(exact)
    _clamp_actor(motor, value, to_action)
    motor.sweep(exact)


def _settle_both(actor: NGCCircuit, critic: NGCCircuit, motor: SettlingChain, value: SettlingChain) -> None:
    value.start_settling()
    motor.start_settling()
    if actor.dynamics == "krylov":
        return _sweep_repeatedly(actor, critic, motor, value)
    value_rates = critic.rates.tolist()
    motor_rates = actor.rates.tolist()
    to_action = critic.input_feedback()
    for step in range(critic.n_settling_steps):
        if step >= value.n_hidden:  # only now has the critic's first layer an error to pass on
            _clamp_actor(motor, value, to_action)
            motor.integrate(motor_rates)
        value.integrate(value_rates)
        motor.predict(output=False)
        value.predict(output=False)
    _clamp_actor(motor, value, to_action)


def _sweep_repeatedly(actor: NGCCircuit, critic: NGCCircuit, motor: SettlingChain, value: SettlingChain) -> None:
    """Under a fixed error nothing answers at the output: only the slopes change as the states move, sweep by sweep."""
    to_action = critic.input_feedback()
    for _ in range(critic.n_settling_steps):
        before = motor.drive
        _sweep_both(motor, value, to_action)
        motor.n_steps += 1
        if float((motor.drive - before).norm()) <= actor.settling_tolerance * float(motor.drive.norm()) and motor.n_steps > 1:
            break
        for chain in (motor, value):
            chain.lowest_reached = 1
            chain.predict(output=False)


def _mean_value_drive(value: SettlingChain, scale: float = 1.0) -> th.Tensor:
    """The output error ``scale`` / A that raises the mean action-value, of an ensemble the mean over its members."""
    n_members = value.output.shape[0] if value.output.dim() == 3 else 1
    return value.drive_of(th.full_like(value.output, scale / (value.output.shape[-1] * n_members)))


def _clamp_actor(motor: SettlingChain, value: SettlingChain, to_action: th.Tensor) -> None:
    """The actor's output error becomes d_a = E_a e of the critic's first layer (of its output, without hidden layers)."""
    perturbation = (value.errors[0] if value.n_hidden else value.drive) @ to_action
    if perturbation.dim() == 3:  # every member adds its share of the mean
        perturbation = perturbation.sum(0)
    motor.output_error = perturbation
    motor.drive = motor.drive_of(perturbation)
