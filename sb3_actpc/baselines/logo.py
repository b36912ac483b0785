"""LOGO: TRPO on the sparse reward, then a second trust-region step towards the demonstrations."""

import copy
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import TRPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import GymEnv
from torch import nn

from sb3_actpc.demonstrations import Demonstrations
from sb3_actpc.demonstrations.mixin import LearnsFromDemonstrations
from sb3_actpc.utils.arguments import Count, Share, Weight, checked

ZERO_DELTA = 6e-7  # at or below this the guidance step is left out (the authors' code)
_NETS = ("discriminator", "discriminator_optimizer", "guidance_policy", "guidance_policy.optimizer")
_GUIDANCE_LOGS = ("value_loss", "kl_divergence_loss", "is_line_search_success")


class LOGO(LearnsFromDemonstrations, TRPO):
    """Learning online with guidance offline (Rengarajan et al., arXiv 2202.04628), on sb3-contrib's TRPO.

    Each iteration is TRPO's on the task's reward (policy improvement), then a trust-region step of size δ on the reward
    -log D(s, a) of a discriminator D that tells the agent's transitions (1) from the demonstrations (0): policy guidance. It
    uses no rewards of the demonstrations. After ``guidance_iterations``, δ shrinks whenever the agent's mean return of an
    iteration is above that of the last ten; near 0 guidance ends. Without demonstrations it is TRPO, number by number.

    Defaults are the authors' for Hopper but ``n_steps`` (20,000). With a small budget set ``n_steps`` and
    ``guidance_iterations`` so that δ can shrink within it.

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
    :param discriminator_learning_rate: Adam's, of one update each iteration on all its transitions and all demonstrations
    :param discriminator_net_arch: hidden sizes of the discriminator; the guidance's value net has those of the policy's
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
        discriminator_net_arch: list[int] | None = None,
        **options: Any,
    ) -> None:
        self.guidance_delta, self.guidance_iterations = guidance_delta, guidance_iterations
        self.guidance_decay, self.guidance_delta_min = guidance_decay, guidance_delta_min
        self.discriminator_learning_rate = discriminator_learning_rate
        self.discriminator_net_arch = discriminator_net_arch
        self.delta = guidance_delta
        self._iteration_returns: list[float] = []
        self._past_returns: list[float] = []
        super().__init__(*args, **{"cg_max_steps": 10, "line_search_shrinking_factor": 0.5, **options})

    def _setup_model(self) -> None:
        self._check_actions()
        super()._setup_model()
        self._demonstrated: Demonstrations | None = None
        if self.demonstrations is None:
            return
        if not (isinstance(self.observation_space, spaces.Box) and isinstance(self.action_space, spaces.Box)):
            raise ValueError(f"LOGO's discriminator needs Box spaces, found {self.observation_space} and {self.action_space}")
        n_inputs = sum(int(np.prod(space.shape)) for space in (self.observation_space, self.action_space))
        arch = [128, 128] if self.discriminator_net_arch is None else list(self.discriminator_net_arch)
        self.discriminator = nn.Sequential(*create_mlp(n_inputs, 1, arch, nn.Tanh)).to(self.device)
        self.discriminator_optimizer = th.optim.Adam(self.discriminator.parameters(), lr=self.discriminator_learning_rate)
        # the same actor beside a value net of its own: TRPO's update of it is the guidance step
        own = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs)
        own.mlp_extractor.policy_net = self.policy.mlp_extractor.policy_net  # type: ignore[union-attr]
        own.action_net, own.log_std = self.policy.action_net, self.policy.log_std
        self.guidance_policy: Any = own.to(self.device)
        if self.env is not None:
            self._demonstrated = self._fitted_demonstrations()

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """As SB3's; an agent that was loaded without an environment gets its demonstrations now."""
        super().set_env(env, force_reset)
        if self.demonstrations is not None:
            self._demonstrated = self._fitted_demonstrations()

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        returns = [info["episode"]["r"] for info in infos if "episode" in info]
        is_guided = self.demonstrations is not None and self.delta > ZERO_DELTA
        if is_guided and dones is not None and dones.any() and not returns:
            raise ValueError(
                "LOGO's δ follows the returns of episodes: make SB3's Monitor (or VecMonitor) the outermost wrapper"
            )
        self._iteration_returns += returns

    def train(self) -> None:
        """One iteration: policy improvement (TRPO), then policy guidance, then the adaptation of δ."""
        if self._demonstrated is None:
            super().train()
            return
        judged = self._judge(self._demonstrated)
        super().train()
        if self.delta > ZERO_DELTA:
            self._guide(judged)
        self._adapt_delta()
        self.logger.record("train/guidance_delta", self.delta)

    def _judge(self, shown: Demonstrations) -> RolloutBuffer:
        """Train the discriminator on the iteration's transitions: the same, rewarded by it, before TRPO reorders them."""
        judged = copy.copy(self.rollout_buffer)
        shape = -1, *judged.obs_shape
        assert isinstance(self.action_space, spaces.Box) and isinstance(judged.observations, np.ndarray)
        # the environment gets actions cut to its bounds, and so does the discriminator, or it would know the agent by them
        actions = judged.actions.clip(self.action_space.low.ravel(), self.action_space.high.ravel())
        seen, rows = judged.observations.reshape(shape), shown.observations.reshape(shape)
        if self._vec_normalize_env is not None:  # the buffer's observations are normalised, as they were seen
            rows = np.asarray(self._vec_normalize_env.normalize_obs(rows))
        own = th.cat([self._flat(seen), self._flat(actions.reshape(len(seen), -1))], dim=1)
        self._train_discriminator(own, th.cat([self._flat(rows), self._flat(shown.actions)], dim=1))
        with th.no_grad():
            rewards = nn.functional.softplus(-self.discriminator(own))  # -log D, with D the sigmoid of the output
            last = judged.to_torch(np.asarray(self._last_obs))
            values, last_values = map(self.guidance_policy.predict_values, (judged.to_torch(seen), last))
        judged.rewards = rewards.cpu().numpy().reshape(judged.rewards.shape)
        judged.values = values.cpu().numpy().reshape(judged.rewards.shape)
        judged.advantages = np.zeros_like(judged.rewards)
        judged.compute_returns_and_advantage(last_values, np.asarray(self._last_episode_starts))
        self.logger.record("train/guidance_reward", rewards.mean().item())
        return judged

    def _flat(self, rows: np.ndarray) -> th.Tensor:
        return th.as_tensor(rows.reshape(len(rows), -1), dtype=th.float32, device=self.device)

    def _train_discriminator(self, own: th.Tensor, demonstrated: th.Tensor) -> None:
        """Binary cross-entropy: 1 for the agent's transitions, 0 for the demonstrations."""
        mine, theirs = self.discriminator(own), self.discriminator(demonstrated)
        loss = nn.functional.softplus(-mine).mean() + nn.functional.softplus(theirs).mean()
        self.discriminator_optimizer.zero_grad()
        loss.backward()
        self.discriminator_optimizer.step()
        accuracy = 0.5 * ((mine > 0).float().mean() + (theirs < 0).float().mean())
        self.logger.record("train/discriminator_loss", loss.item())
        self.logger.record("train/discriminator_accuracy", accuracy.item())

    def _guide(self, judged: RolloutBuffer) -> None:
        """TRPO's update of the actor in a trust region of size δ, and of the guidance's value net, on the judged rollout."""
        changed = {"policy": self.guidance_policy, "rollout_buffer": judged, "target_kl": self.delta}
        changed["_logger"] = Logger(None, [])
        kept = {name: getattr(self, name) for name in (*changed, "_n_updates")}
        vars(self).update(changed)
        super().train()
        logs = self.logger.name_to_value
        vars(self).update(kept)
        for name in _GUIDANCE_LOGS:
            self.logger.record(f"train/guidance_{name}", logs[f"train/{name}"])

    def _adapt_delta(self) -> None:
        """Shrink δ when the agent did better than in the last ten iterations."""
        if not self._iteration_returns:
            return
        mean, past = float(np.mean(self._iteration_returns)), self._past_returns[-10:]
        if past and mean > float(np.mean(past)) and self._n_updates > self.guidance_iterations:
            self.delta = max(self.delta * self.guidance_decay, self.guidance_delta_min)
        self._past_returns.append(mean)
        self._iteration_returns = []

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_demonstrated", *_NETS[:3]]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return names if self.demonstrations is None else [*names, *_NETS], variables

    def set_parameters(self, load_path_or_dict: Any, *args: Any, **options: Any) -> None:
        """As SB3's; an agent that is loaded without demonstrations, to be played, has no networks that learn from them."""
        if self.demonstrations is None and isinstance(load_path_or_dict, dict):
            load_path_or_dict = {name: state for name, state in load_path_or_dict.items() if name not in _NETS}
        super().set_parameters(load_path_or_dict, *args, **options)
