"""LOGO: TRPO on the sparse reward, then a second trust-region step towards the demonstrations."""

import copy
from collections import deque
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import TRPO
from sb3_contrib.common.utils import conjugate_gradient_solver
from stable_baselines3.common.distributions import kl_divergence
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import GymEnv
from torch import nn

from sb3_actpc.demonstrations.mixin import LearnsFromDemonstrations
from sb3_actpc.utils.arguments import Count, Positive, Share, Weight, checked

ZERO_DELTA = 6e-7  # at or below this the guidance step is left out (the authors' code)
_NETS = ("discriminator", "guidance_value", "discriminator_optimizer", "guidance_value_optimizer")


class Guidance(NamedTuple):
    """What the guidance step needs of one iteration: N = n_steps x n_envs transitions, the first environment's first."""

    observations: th.Tensor  # (N, *obs_shape)
    actions: th.Tensor  # (N, A)
    log_probs: th.Tensor  # (N,), of the policy that acted
    advantages: th.Tensor  # (N,), of the discriminator's reward, mean 0 and standard deviation 1
    returns: th.Tensor  # (N,), targets of the guidance value net


class LOGO(LearnsFromDemonstrations, TRPO):
    """Learning online with guidance offline (Rengarajan et al., arXiv 2202.04628), on sb3-contrib's TRPO.

    Each iteration is TRPO's on the task's reward (policy improvement), then a trust-region step of size δ on the reward
    -log D(s, a) of a discriminator D that tells the agent's transitions (1) from the demonstrations (0): policy guidance. It
    uses no rewards of the demonstrations. After ``guidance_iterations``, δ shrinks whenever the agent's mean return of an
    iteration is above that of the last ten; near 0 guidance ends. Without demonstrations it is TRPO, number by number.

    Defaults are the authors' for Hopper but ``n_steps``: theirs is 20,000 and 1500 iterations, so that δ first shrinks after a
    million steps. With a small budget set ``n_steps`` and ``guidance_iterations`` so that it can shrink within it.

    Differences from the authors' code (github.com/DesikRengarajan/LOGO; written anew from the paper):

    1. Value nets are fitted by Adam on minibatches (sb3-contrib's), not by L-BFGS on the whole batch with an L2 penalty.
    2. The line search accepts any improvement within the trust region (sb3-contrib's), not a tenth of the predicted one.
    3. float32, not float64; observations are not normalised by running statistics.
    4. Where a time limit cuts an episode, the task's return bootstraps (SB3's), that of the guidance does not.

    :param args: policy, "MlpPolicy", and env, a task with Box observations and actions
    :param guidance_delta: δ at the start, mean Kullback-Leibler divergence of the guidance step
    :param guidance_iterations: iterations before δ can shrink
    :param guidance_decay: what δ is then multiplied by
    :param guidance_delta_min: smallest δ; at or below 6e-7 the step is left out
    :param discriminator_learning_rate: Adam's
    :param discriminator_updates: updates each iteration, each on all transitions of the iteration and all demonstrations
    :param discriminator_net_arch: hidden sizes of the discriminator and of the guidance value net
    :param options: keywords of :class:`~sb3_actpc.demonstrations.mixin.LearnsFromDemonstrations` (without demonstrations it
        is TRPO) and of sb3-contrib's TRPO; ``target_kl`` is the paper's ``high_kl``, and unless given ``cg_max_steps`` is 10,
        ``line_search_shrinking_factor`` 0.5
    :raises ValueError: for a keyword with a value that is not allowed, for demonstrations that do not fit the environment,
        and for other spaces
    """

    is_resumable: ClassVar[bool] = False  # its guidance keeps a state of its own

    @checked
    def __init__(
        self,
        *args: Any,
        guidance_delta: Weight = 0.01,
        guidance_iterations: Count = 50,
        guidance_decay: Share = 0.95,
        guidance_delta_min: Weight = 5e-7,
        discriminator_learning_rate: Weight = 3e-4,
        discriminator_updates: Positive = 1,
        discriminator_net_arch: list[int] | None = None,
        **options: Any,
    ) -> None:
        self.guidance_delta, self.guidance_iterations = guidance_delta, guidance_iterations
        self.guidance_decay, self.guidance_delta_min = guidance_decay, guidance_delta_min
        self.discriminator_learning_rate, self.discriminator_updates = discriminator_learning_rate, discriminator_updates
        self.discriminator_net_arch = discriminator_net_arch
        self.delta = guidance_delta
        self._iteration_returns: list[float] = []
        self._past_returns: deque[float] = deque(maxlen=10)
        super().__init__(*args, **{"cg_max_steps": 10, "line_search_shrinking_factor": 0.5, **options})

    def _setup_model(self) -> None:
        self._check_actions()
        super()._setup_model()
        self._demonstrated: th.Tensor | None = None
        if self.demonstrations is None:
            return
        if not (isinstance(self.observation_space, spaces.Box) and isinstance(self.action_space, spaces.Box)):
            raise ValueError(f"LOGO's discriminator needs Box spaces, found {self.observation_space} and {self.action_space}")
        n_observations, n_actions = (int(np.prod(space.shape)) for space in (self.observation_space, self.action_space))
        arch = [128, 128] if self.discriminator_net_arch is None else list(self.discriminator_net_arch)
        self.discriminator = nn.Sequential(*create_mlp(n_observations + n_actions, 1, arch, nn.Tanh)).to(self.device)
        self.guidance_value = nn.Sequential(*create_mlp(n_observations, 1, arch, nn.Tanh)).to(self.device)
        self.discriminator_optimizer = th.optim.Adam(self.discriminator.parameters(), lr=self.discriminator_learning_rate)
        self.guidance_value_optimizer = th.optim.Adam(self.guidance_value.parameters(), lr=self.lr_schedule(1.0))
        if self.env is not None:
            self._load_demonstrations()

    def _load_demonstrations(self) -> None:
        demonstrated = self._fitted_demonstrations()
        self._demonstrated = th.as_tensor(
            np.concatenate([demonstrated.observations, demonstrated.actions], axis=1), device=self.device
        )

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """As SB3's; an agent that was loaded without an environment gets its demonstrations now."""
        super().set_env(env, force_reset)
        if self.demonstrations is not None:
            self._load_demonstrations()

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        self._iteration_returns += [info["episode"]["r"] for info in infos if "episode" in info]

    def train(self) -> None:
        """One iteration: policy improvement (TRPO), then policy guidance, then the adaptation of δ."""
        guidance = None if self._demonstrated is None else self._prepare_guidance(self._demonstrated)
        super().train()
        if guidance is not None:
            if self.delta > ZERO_DELTA:
                self._guide(guidance)
            self._adapt_delta()
            self.logger.record("train/guidance_delta", self.delta)

    def _prepare_guidance(self, demonstrated: th.Tensor) -> Guidance:
        """Train the discriminator on the iteration's transitions and value them by it, before TRPO reorders its buffer."""
        buffer = self.rollout_buffer
        shape = (buffer.buffer_size * buffer.n_envs, -1)
        assert isinstance(self.action_space, spaces.Box)
        flat = [buffer.to_torch(buffer.swap_and_flatten(a)).float() for a in (buffer.observations, buffer.actions)]
        # the environment gets actions cut to its bounds, and so does the discriminator, or it would know the agent by them
        bounds = self.action_space.low, self.action_space.high
        low, high = (buffer.to_torch(bound.reshape(1, -1)).float() for bound in bounds)
        seen = th.cat([flat[0].reshape(shape), flat[1].reshape(shape).clamp(low, high)], dim=1)
        if self._vec_normalize_env is not None:  # the buffer's observations are normalised, as they were seen
            n = flat[0][0].numel()
            rows = demonstrated[:, :n].cpu().numpy().reshape(-1, *(self.observation_space.shape or ()))
            normalised = np.asarray(self._vec_normalize_env.normalize_obs(rows), dtype=np.float32).reshape(
                len(demonstrated), n
            )
            demonstrated = th.cat([th.as_tensor(normalised, device=self.device), demonstrated[:, n:]], dim=1)
        self._train_discriminator(seen, demonstrated)
        with th.no_grad():
            # -log D, with D the sigmoid of the output
            rewards = nn.functional.softplus(-self.discriminator(seen)).reshape(buffer.n_envs, -1).T
            values = self.guidance_value(flat[0].reshape(shape)).reshape(buffer.n_envs, -1).T
            last = th.as_tensor(np.asarray(self._last_obs), dtype=th.float32, device=self.device)
            last_values = self.guidance_value(last.reshape(buffer.n_envs, -1))[:, 0]
        judged = copy.copy(buffer)  # the same steps with the discriminator's rewards, for SB3's advantages
        judged.rewards, judged.values = rewards.cpu().numpy(), values.cpu().numpy()
        judged.advantages = np.zeros_like(judged.rewards)
        judged.compute_returns_and_advantage(last_values, np.asarray(self._last_episode_starts))
        advantages, returns = (buffer.to_torch(part.T.flatten()) for part in (judged.advantages, judged.returns))
        self.logger.record("train/guidance_reward", rewards.mean().item())
        return Guidance(
            observations=flat[0],
            actions=flat[1],
            log_probs=buffer.to_torch(buffer.swap_and_flatten(buffer.log_probs)).flatten(),
            advantages=(advantages - advantages.mean()) / (advantages.std() + 1e-8),
            returns=returns,
        )

    def _train_discriminator(self, seen: th.Tensor, demonstrated: th.Tensor) -> None:
        """Binary cross-entropy: 1 for the agent's transitions, 0 for the demonstrations."""
        for _ in range(self.discriminator_updates):
            mine, theirs = self.discriminator(seen), self.discriminator(demonstrated)
            loss = nn.functional.softplus(-mine).mean() + nn.functional.softplus(theirs).mean()
            self.discriminator_optimizer.zero_grad()
            loss.backward()
            self.discriminator_optimizer.step()
        accuracy = 0.5 * ((mine > 0).float().mean() + (theirs < 0).float().mean())
        self.logger.record("train/discriminator_loss", loss.item())
        self.logger.record("train/discriminator_accuracy", accuracy.item())

    def _guide(self, guidance: Guidance) -> None:
        """The second trust-region step and the fit of its value net."""
        success = self._trust_region_step(guidance, self.delta)
        self.logger.record("train/guidance_success", float(success))
        self._update_learning_rate(self.guidance_value_optimizer)
        observations = guidance.observations.reshape(len(guidance.returns), -1)
        for _ in range(self.n_critic_updates):
            for rows in th.randperm(len(observations)).split(self.batch_size):
                loss = nn.functional.mse_loss(self.guidance_value(observations[rows])[:, 0], guidance.returns[rows])
                self.guidance_value_optimizer.zero_grad()
                loss.backward()
                self.guidance_value_optimizer.step()
        self.logger.record("train/guidance_value_loss", loss.item())

    def _trust_region_step(self, guidance: Guidance, max_kl: float) -> bool:
        """Move the policy along the natural gradient, at most ``max_kl`` far; if no better one is found it stays: False."""
        with th.no_grad():
            old = copy.copy(self.policy.get_distribution(guidance.observations))
        objective, divergence = self._surrogate(guidance, old)
        parameters, gradient, grad_kl, shapes = self._compute_actor_grad(divergence, objective)
        product = partial(self.hessian_vector_product, parameters, grad_kl)
        direction = conjugate_gradient_solver(product, gradient, max_iter=self.cg_max_steps)
        step = direction * th.sqrt(2.0 * max_kl / th.dot(direction, product(direction, retain_graph=False)))
        steps = [part.view(shape) for part, shape in zip(step.split([p.numel() for p in parameters]), shapes, strict=True)]
        before = [parameter.detach().clone() for parameter in parameters]
        scale = 1.0
        for _ in range(self.line_search_max_iter):
            with th.no_grad():
                for parameter, start, change in zip(parameters, before, steps, strict=True):
                    parameter.copy_(start + scale * change)
                found, divergence = self._surrogate(guidance, old)
            if divergence < max_kl and found > objective:
                self.logger.record("train/guidance_kl", divergence.item())
                return True
            scale *= self.line_search_shrinking_factor
        with th.no_grad():
            for parameter, start in zip(parameters, before, strict=True):
                parameter.copy_(start)
        return False

    def _surrogate(self, guidance: Guidance, old: Any) -> tuple[th.Tensor, th.Tensor]:
        """Importance-weighted mean advantage, and the mean divergence from the distribution ``old``."""
        distribution = self.policy.get_distribution(guidance.observations)
        ratio = th.exp(distribution.log_prob(guidance.actions) - guidance.log_probs)
        return (guidance.advantages * ratio).mean(), kl_divergence(distribution, old).mean()

    def _adapt_delta(self) -> None:
        """Shrink δ when the agent did better than in the last ten iterations."""
        if self._iteration_returns:
            mean = float(np.mean(self._iteration_returns))
            improved = bool(self._past_returns) and mean > float(np.mean(self._past_returns))
            if improved and self._n_updates > self.guidance_iterations:
                self.delta = max(self.delta * self.guidance_decay, self.guidance_delta_min)
            self._past_returns.append(mean)
        self._iteration_returns = []

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_demonstrated", *_NETS]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return names if self.demonstrations is None else [*names, *_NETS], variables
