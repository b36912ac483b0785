"""SAC with demonstrations in the way of RLPD: what a practitioner would try first today."""

from typing import Any, ClassVar

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, create_mlp
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

from sb3_actpc.baselines.demonstrated import DemonstratedAlgorithm


class LayerNormCritic(ContinuousCritic):
    """SB3's critics with layer normalisation before every activation."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.n_drawn: int | None = None  # of the critics, how many answer; None for all
        net_arch, activation = kwargs["net_arch"], kwargs.get("activation_fn", nn.ReLU)
        n_inputs = kwargs["features_dim"] + get_action_dim(self.action_space)
        for index in range(self.n_critics):
            layers = create_mlp(n_inputs, 1, net_arch, activation, post_linear_modules=[nn.LayerNorm])
            self.q_networks[index] = nn.Sequential(*layers)
            self.add_module(f"qf{index}", self.q_networks[index])

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """Action-values (B, 1) of every critic, or of ``n_drawn`` drawn ones."""
        values = super().forward(obs, actions)
        if self.n_drawn is None:
            return values
        return tuple(values[index] for index in th.randperm(len(values))[: self.n_drawn])


class LayerNormSACPolicy(SACPolicy):
    """SB3's SAC policy with :class:`LayerNormCritic`.

    :param n_critics: how many critics
    :param n_target_critics: how many drawn target critics give the smallest value that bootstraps (REDQ, arXiv 2101.05982)
    :raises ValueError: when more are to be drawn than there are
    """

    def __init__(self, *args: Any, n_critics: int = 10, n_target_critics: int = 2, **kwargs: Any) -> None:
        if not 1 <= n_target_critics <= n_critics:
            raise ValueError(f"n_target_critics={n_target_critics!r} must be between 1 and n_critics={n_critics}")
        self.n_target_critics = n_target_critics
        super().__init__(*args, **{**kwargs, "n_critics": n_critics})

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.critic_target.n_drawn = self.n_target_critics  # type: ignore[assignment]

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> LayerNormCritic:
        """As SB3's."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return LayerNormCritic(**kwargs).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "n_target_critics": self.n_target_critics}


class LayerNormMultiInputPolicy(LayerNormSACPolicy):
    """The same for Dict observations."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"features_extractor_class": CombinedExtractor, **kwargs})


class RLPD(DemonstratedAlgorithm, SAC):
    """SAC in the way of RLPD (Ball et al., arXiv 2302.02948): half of every batch from the demonstrations, layer-normalised
    critics, an ensemble of which two bootstrap, several updates a step. The learning itself is Stable-Baselines3's SAC.

    Defaults are those published (10 critics, 20 updates a step, 5000 random steps before learning).

    Differences from RLPD's code (github.com/ikostrikov/rlpd):

    1. The actor and the temperature are updated with every update of the critic; there once for all 20.
    2. The actor climbs the smallest of all critics' values, as in SB3; there their mean.

    :param args: policy, "MlpPolicy" or "MultiInputPolicy", and env; ``policy_kwargs`` takes ``n_critics`` and
        ``n_target_critics``
    :param options: keywords of :class:`~sb3_actpc.baselines.demonstrated.DemonstratedAlgorithm` and of SB3's SAC
    :raises ValueError: for a keyword with a value that is not allowed, for demonstrations that do not fit the environment
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": LayerNormSACPolicy,
        "MultiInputPolicy": LayerNormMultiInputPolicy,
    }

    def __init__(self, *args: Any, learning_starts: int = 5000, gradient_steps: int = 20, **options: Any) -> None:
        super().__init__(*args, learning_starts=learning_starts, gradient_steps=gradient_steps, **options)
