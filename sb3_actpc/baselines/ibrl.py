"""IBRL: a frozen BC policy proposes actions to a TD3 agent, when it acts and when it bootstraps."""

from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_actpc.baselines.bc import BC, BCPolicy
from sb3_actpc.baselines.td3 import TD3Demo
from sb3_actpc.utils.arguments import Positive, checked

N_TARGET_CRITICS = 2  # drawn to bootstrap (REDQ, arXiv 2101.05982)


class IBRLPolicy(TD3Policy):
    """SB3's TD3 policy with layer-normalized critics and the frozen BC policy, ``bc``.

    :param n_critics: number of critics
    :param exploration_noise: standard deviation of Gaussian noise on the actor's proposal, in units of [-1, 1], while learning
    """

    follows_bc: th.Tensor

    def __init__(self, *args: Any, n_critics: int = 5, exploration_noise: float = 0.1, **options: Any) -> None:
        self.exploration_noise = exploration_noise
        super().__init__(*args, **{**options, "n_critics": n_critics})
        self.register_buffer("follows_bc", th.tensor(False))  # the actor proposes nothing yet
        self.bc = BCPolicy(self.observation_space, self.action_space).requires_grad_(False)

    def make_critic(self, features_extractor: Any = None) -> ContinuousCritic:
        """SB3's critics with a layer normalization after each hidden layer."""
        critic = super().make_critic(features_extractor)
        n_inputs = critic.q_networks[0][0].in_features  # type: ignore[index]
        hidden: Any = self.critic_kwargs["net_arch"]
        for index in range(len(critic.q_networks)):
            modules = create_mlp(n_inputs, 1, hidden, self.activation_fn, post_linear_modules=[nn.LayerNorm])
            critic.q_networks[index] = nn.Sequential(*modules)
            critic.add_module(f"qf{index}", critic.q_networks[index])
        return critic.to(self.device)

    def bc_actions(self, observations: th.Tensor) -> th.Tensor:
        """Proposals of the BC policy in [-1, 1], (B, A)."""
        return self.bc._predict(observations, deterministic=True)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        proposed = self.bc_actions(observation)
        if self.follows_bc:
            return proposed
        actions = self.actor(observation)
        if not deterministic:
            actions = (actions + self.exploration_noise * th.randn_like(actions)).clamp(-1, 1)
        both = th.stack([actions, proposed])
        # both actions are valued by the same critics: all of them, so that the choice is no matter of chance
        values = th.stack([th.cat(self.critic_target(observation, one), dim=1).amin(dim=1) for one in both])
        return th.where((values[1] > values[0])[:, None], proposed, actions)


class IBRL(TD3Demo):
    """Imitation-bootstrapped reinforcement learning (Hu et al., arXiv 2311.02198) on TD3.

    The first ``learn`` trains a BC policy on the demonstrations, which then stays as it is. At each step the agent takes the
    actor's action or that of the BC policy, whichever the target critics value more. Targets bootstrap from the better of
    the two in the next state. Until ``learning_starts`` the BC policy acts.

    Differences from the authors' code (github.com/hengyuan-hu/ibrl, its settings for state observations):

    1. Half of every batch is demonstrated; there the replay buffer starts with the demonstrations. ``hyperparams/ibrl.yml``
       normalizes observations by them.
    2. The actor has no dropout (there 0.5). Layers, rates and target steps are ``hyperparams/ibrl.yml``'s; there three hidden
       layers of 1024, 1e-4 and 0.01.
    3. The better of two actions is taken; there one is drawn with probabilities softmax(10 Q).
    4. The choice when acting uses the smallest value of all target critics, not of two drawn ones.
    5. The actor's loss is of its action without noise (there with that of the targets).
    6. The BC policy acts for the first ``learning_starts`` steps, which count (there for 40 episodes, which do not).

    :param args: policy, "MlpPolicy", and env; ``policy_kwargs`` are those of :class:`IBRLPolicy`
    :param gradient_steps: critic updates per environment step, and per actor update unless ``policy_delay`` is given
    :param options: keywords of :class:`~sb3_actpc.baselines.TD3Demo`, of which ``bc_steps`` (of
        :class:`~sb3_actpc.baselines.BC`) is 2500 and ``target_policy_noise``, on the actor's proposal for the next state, 0.1,
        clipped to 0.3, unless given; exploration noise is ``policy_kwargs``' own
    :raises ValueError: without demonstrations, and as there
    """

    policy: IBRLPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": IBRLPolicy, "MultiInputPolicy": IBRLPolicy}

    @checked
    def __init__(self, *args: Any, gradient_steps: Positive = 5, **options: Any) -> None:
        theirs = {"target_policy_noise": 0.1, "target_noise_clip": 0.3}
        options = {"bc_steps": 2500, "policy_delay": gradient_steps, **theirs, **options}
        super().__init__(*args, gradient_steps=gradient_steps, **options)

    def _setup_model(self) -> None:
        if self.env is not None and self.demonstrations is None:
            raise ValueError("demonstrations=None: IBRL needs demonstrations for its BC policy, pass a file")
        if not isinstance(self.observation_space, spaces.Box):
            raise ValueError(
                f"IBRL takes Box observations, found {self.observation_space}: use FlattenObservation of gymnasium"
            )
        super()._setup_model()

    def _clone_actor(self) -> None:
        """Train the BC policy, not the actor."""
        shown = "demonstrations", "n_demonstrations", "seed", "device"
        same = {name: getattr(self, name) for name in shown}
        model = BC("MlpPolicy", self.env, learning_rate=lambda left: 1e-3 * left, batch_size=64, **same)
        model.learn(self.bc_steps, log_interval=None)
        self.policy.bc.load_state_dict(model.policy.state_dict())
        self.policy.follows_bc.fill_(True)

    def _sample_action(self, learning_starts: int, *args: Any, **options: Any) -> Any:
        self.policy.follows_bc.fill_(self.num_timesteps < learning_starts)
        return super()._sample_action(0, *args, **options)

    def _next_values(self, batch: Any, next_actions: th.Tensor) -> th.Tensor:
        """Of the actor's and the BC policy's actions the better one's value, (B, 1): two drawn critics choose the action, two
        drawn anew value it, each pair by its smaller value."""
        actions = th.cat([next_actions, self.policy.bc_actions(batch.next_observations)])
        values = th.stack(self.critic_target(th.cat([batch.next_observations] * 2), actions))
        choosing, valuing = (
            values[th.randperm(len(values), device=values.device)[:N_TARGET_CRITICS]].amin(dim=0).view(2, -1, 1)
            for _ in range(2)
        )
        return valuing.gather(0, choosing.argmax(dim=0, keepdim=True))[0]

    def _actor_values(self, observations: Any, actions: th.Tensor) -> th.Tensor:
        """The smallest value of all critics."""
        return th.cat(self.critic(observations, actions), dim=1).amin(dim=1, keepdim=True)

    def _update_critic(self, batch: Any) -> None:
        """The target critics follow every update."""
        super()._update_critic(batch)
        self._follow("critic")

    def _update_targets(self) -> None:
        self._follow("actor")
