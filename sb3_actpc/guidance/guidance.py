"""The default guidance: BC pre-training, critic warm-up, return-weighted imitation and the deployment gate, as hooks."""

import warnings
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

import numpy as np

from sb3_actpc.guidance.base import ActorGuidance, GuidanceContext
from sb3_actpc.guidance.behavior_cloning import clone_behavior
from sb3_actpc.guidance.policy_selection import PolicySelection
from sb3_actpc.ngc import NGCCircuit
from sb3_actpc.utils.arguments import Count, Share, Weight, check_value
from sb3_actpc.utils.checks import Settings


@dataclass(frozen=True)
class GuidanceConfig:
    """
    Every constant of the default guidance; ``guidance_kwargs`` sets them.

    :param bc_updates: BC updates of the actor before learning
    :param input_noise: standard deviation of Gaussian noise on the normalized observations of imitated steps, in BC and later.
        It helps where observations are redundant (robosuite: 0.3) and harms where actions depend on small differences
        (Hopper, insertion)
    :param critic_warmup: updates before the critic term reaches the actor: the critic first learns from the BC policy's own
        episodes (WSRL, arXiv 2412.07762, warms up on 5,000 such steps)
    :param q_filter: after the warm-up, imitate less where the critics value the actor's own action more (Nair et al., arXiv
        1709.10089, do not imitate there)
    :param filter_residual: such steps keep the weight filter_residual / residual, at most 1. The residual is BC's error as a
        share of the variance of demonstrated actions: errors count by their precision, as in predictive coding (Whittington
        and Bogacz, Neural Computation 2017). 0 for no weight
    :param weighting: "returns" draws imitated steps by their episode's return to the power of four (reward-weighted
        regression, Peters and Schaal 2007), "uniform" as the paper does
    :param gate: whether the deployed policy changes only after a test; else the actor explores and is deployed
    :param evaluation_share: share of environment steps in evaluation episodes above which none begins
    :param averaging_rate: step of the actor's moving average per update of the actor, with the gate
    :param challenger_interval: updates after the warm-up, and after each copy, before the average may be copied
    :raises ValueError: for a value out of range
    """

    bc_updates: Count = 3000
    input_noise: Weight = 0.0
    critic_warmup: Count = 6000
    q_filter: bool = True
    filter_residual: Share = 0.01
    weighting: Literal["returns", "uniform"] = "returns"
    gate: bool = True
    evaluation_share: Share = 0.25
    averaging_rate: Share = 0.002
    challenger_interval: Count = 4000

    def __post_init__(self) -> None:
        for field in fields(self):
            check_value(f"guidance_kwargs[{field.name!r}]", getattr(self, field.name), field.type)
        if self.gate and not self.evaluation_share:
            raise ValueError(
                f"guidance_kwargs['evaluation_share']={self.evaluation_share!r} must be above 0, or no policy is promoted; "
                "gate=False deploys the actor without evaluation"
            )


class BehaviorGuidance(ActorGuidance):
    """
    :param config: its constants
    """

    stores: Literal["positive", "best"] = "positive"

    def __init__(self, config: GuidanceConfig) -> None:
        self.config = config
        self.weighting = config.weighting
        self.input_noise = config.input_noise
        self.has_gate = config.gate
        self.selection: PolicySelection | None = None
        self.copied_at = config.critic_warmup  # update of the last copy of the average
        self.bc_residual = None

    def on_training_start(self, context: GuidanceContext, is_pretrained: bool) -> None:
        """BC pre-training, once."""
        imitates = not is_pretrained and context.sample is not None and self.config.bc_updates > 0
        # Returns of another policy, or of parts of episodes, say nothing of this one
        if self.has_gate and (self.selection is None or self.selection.n_envs != context.n_envs or imitates):
            self.selection = PolicySelection(context.n_envs, self.config.evaluation_share)
        if not imitates or context.sample is None:
            return
        self.bc_residual = clone_behavior(context.actor, context.sample, self.config.bc_updates, self.input_noise)
        copies = [*context.targets, *(context.selection_circuits or {}).values()]
        for circuit in copies:
            circuit.move_towards(context.actor, 1.0)

    def acting_circuits(self, context: GuidanceContext) -> list[NGCCircuit]:
        """The actor's average explores; incumbent and challenger play their evaluation episodes."""
        if self.selection is None or context.selection_circuits is None:
            return [context.actor] * context.n_envs
        circuits = context.selection_circuits
        return [circuits["deployed" if role == "incumbent" else role] for role in self.selection.roles]

    def explores(self, env: int) -> bool:
        """Only episodes of the average have noise."""
        return self.selection is None or self.selection.roles[env] == "average"

    def candidate(self, context: GuidanceContext) -> NGCCircuit:
        """The actor's moving average; without a gate the actor."""
        return context.actor if context.selection_circuits is None else context.selection_circuits["average"]

    def on_step(self, context: GuidanceContext, rewards: np.ndarray, dones: np.ndarray, n_updates: int) -> None:
        """Evaluation episodes end, policies are promoted, rejected or rolled back, the next episodes begin."""
        selection = self.selection
        circuits = context.selection_circuits
        if selection is None or circuits is None:
            return
        for env in range(context.n_envs):
            selection.step(env, float(rewards[env]), bool(context.episode_starts[env]))
            if not dones[env]:
                continue
            decision = selection.end_episode(env, self._actor_differs(n_updates))
            if decision == "promoted":
                circuits["previous"].move_towards(circuits["deployed"], 1.0)
                circuits["deployed"].move_towards(circuits["challenger"], 1.0)
            elif decision == "rolled back":
                circuits["deployed"].move_towards(circuits["previous"], 1.0)
            if selection.begin_episode(env, self._actor_differs(n_updates)):
                circuits["challenger"].move_towards(circuits["average"], 1.0)
                self.copied_at = n_updates

    def _actor_differs(self, n_updates: int) -> bool:
        """Whether the actor has learned long enough since the last copy."""
        return n_updates > self.copied_at + self.config.challenger_interval

    def on_reset(self) -> None:
        """Cut episodes have no return."""
        if self.selection is not None:
            self.selection.reset()

    def forget_returns(self) -> None:
        """The gate starts anew with the next ``learn``."""
        self.selection = None

    def critic_weight(self, n_updates: int) -> float:
        """0 during the warm-up, then 1."""
        return float(n_updates > self.config.critic_warmup)

    def filtered_weight(self, n_updates: int) -> float:
        """1 during the warm-up of the critic, then by the precision of the demonstrated actions."""
        if not self.config.q_filter or n_updates <= self.config.critic_warmup:
            return 1.0
        if self.bc_residual is None:
            return 0.0
        largest = self.config.filter_residual
        return largest / max(self.bc_residual, largest) if largest else 0.0

    def after_update(self, context: GuidanceContext) -> None:
        """The actor's moving average."""
        if context.selection_circuits is not None:
            context.selection_circuits["average"].move_towards(context.actor, self.config.averaging_rate)

    def logs(self) -> dict[str, float]:
        """BC's residual, the decisions of the gate, and the incumbent's mean return."""
        values = {} if self.bc_residual is None else {"bc_residual": self.bc_residual}
        if self.selection is None:
            return values
        values["policies_promoted"] = float(self.selection.n_promoted)
        values["policies_rejected"] = float(self.selection.n_rejected)
        values["policies_rolled_back"] = float(self.selection.n_rolled_back)
        if self.selection.incumbent_returns:
            values["deployed_return"] = float(np.mean(self.selection.incumbent_returns))
        return values

    def describe(self) -> str:
        """One line."""
        gate = "deployment gate on" if self.has_gate else "no deployment gate"
        config = self.config
        noise = f" with input noise of {config.input_noise:g}" if config.input_noise else ""
        return f"guidance: {config.bc_updates} BC updates{noise}, {config.critic_warmup} updates of critic warm-up, {gate}"

    def state_dict(self) -> dict[str, Any]:
        """The gate's fields, and the residual of BC."""
        return {
            "selection": None if self.selection is None else asdict(self.selection),
            "copied_at": self.copied_at,
            "bc_residual": self.bc_residual,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As stored."""
        stored = state["selection"]
        self.selection = None if stored is None else PolicySelection(**{**stored, "share": self.config.evaluation_share})
        self.copied_at = state["copied_at"]
        self.bc_residual = state["bc_residual"]


def make_guidance(given: ActorGuidance | str, settings: Settings | None) -> ActorGuidance:
    """
    :param given: "default", "none" or the guidance itself
    :param settings: keywords of :class:`GuidanceConfig`, for "default"
    :raises ValueError: for another name, or keywords that the guidance has not
    """
    if given not in ("default", "none") and not isinstance(given, ActorGuidance):
        raise ValueError(f"guidance={given!r} must be None, 'default', 'none' or an ActorGuidance")
    settings = settings or {}
    known = [field.name for field in fields(GuidanceConfig)]
    unknown = sorted({*settings} - {*known})
    if unknown:
        raise ValueError(f"guidance_kwargs={settings!r} has unknown keys {unknown}: choose from {known}")
    config = GuidanceConfig(**settings)
    if settings and given != "default":
        warnings.warn(f"guidance_kwargs={settings!r} have no effect without guidance='default'", stacklevel=4)
    if isinstance(given, ActorGuidance):
        return given
    return BehaviorGuidance(config) if given == "default" else ActorGuidance()
