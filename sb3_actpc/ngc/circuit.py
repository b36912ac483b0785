"""The neural generative coding (NGC) circuit: one stack of layers that predict, settle and learn by Hebbian changes."""

import copy
from collections.abc import Collection, Sequence
from math import inf
from numbers import Integral, Real
from typing import Any

import torch as th
from torch import nn

from sb3_actpc.ngc.activations import ACTIVATIONS, EPSILON, HIDDEN_ACTIVATIONS, NORMALIZATIONS, normalize
from sb3_actpc.ngc.dynamics import DYNAMICS, SettledState, SettlingChain, damped, largest_norm_, settling_rates
from sb3_actpc.ngc.krylov import settle_krylov
from sb3_actpc.ngc.plasticity import SYNAPTIC_SCALINGS, HebbianChanges, bound_columns_, hebbian_changes, mirrored, soft_bound_
from sb3_actpc.ngc.synapses import Synapses, affine

LARGEST_SIZE = 2**20  # of a layer, and of the number of steps


class NGCCircuit(nn.Module):
    """
    A neural generative coding circuit of any depth and width (Ororbia & Mali, arXiv 2209.09174, section 2.1).

    Layers are listed in forward order: ``weights[0]`` carries the clamped input to the first hidden layer, ``weights[-1]``
    predicts the clamped output (the paper counts from the output). The input is not passed through φ, hidden g is the
    identity. No parameter requires a gradient: learning goes through :meth:`settle`, :meth:`hebbian_update` and
    :meth:`apply_changes`.

    :param n_inputs: size of the input
    :param n_outputs: size of the output
    :param hidden: sizes of the hidden layers, first to last; may be empty
    :param activation: φ of the hidden layers: relu6 (paper), relu, leaky_relu, elu, tanh or identity
    :param output_activation: g of the output layer, same choices; with ``settling="scheduled"`` also "clamp", which cuts to
        [-1, 1] and keeps the errors there (:mod:`~sb3_actpc.ngc.activations`)
    :param settling: "iterative" (settle as ``dynamics`` says, then one change) or "scheduled" (each layer's change is
        taken when the error first reaches it, one ordered sweep; the zero-divergence schedule, Z-IL, of the predictive-coding
        literature; about K times cheaper). Scheduled with tied feedback is, numerically, the gradient of the output's loss;
        with learned error synapses it is where the error neurons rest under a fixed infinitesimal error (no W^T)
    :param n_settling_steps: K (paper: 10 to 25); with ``dynamics="krylov"`` the most steps
    :param settling_tolerance: "krylov" stops when this share of the output's equation is left (the others take all K steps)
    :param dynamics: how iterative settling comes to rest: "krylov" (minimal residuals, two to four steps:
        :mod:`~sb3_actpc.ngc.krylov`; to first order) or "state" (eq. 1 to the letter)
    :param settling_rate: β, a number in (0, 1], or "auto": kept inside the stable range as the synapses grow
    :param leak: γ of eq. 1; 0 by default
    :param feedback: "tied" (``feedback_scale`` W^T) or "learned" (own error synapses E: the paper's)
    :param feedback_scale: λ_e of tied error synapses
    :param feedback_start: how learned error synapses begin: "independent" of W (the paper; they take many thousand updates to
        align with W^T, and do so wholly only with a ``weight_decay``) or "mirrored": see :meth:`mirror_feedback`
    :param feedback_rate: γ_e, learning rate of E over that of W (the paper: below 1). At 1 both take the same steps, from any
        optimiser that works element by element, so that without ``synaptic_scaling`` the gap E - W^T never grows
    :param derivative_free: leave out φ' in the state update (appendix)
    :param synaptic_scaling: "none", "soft_bound" (none of W and E passes ±``weight_bound``) or "column_norm" (no column of W,
        and none of E^T, has a norm above ``weight_bound``); acts on the step after the optimiser
    :param weight_bound: the bound of ``synaptic_scaling``
    :param weight_decay: λ: before every change W, M and E shrink by 1 - ηλ (η the learning rate, as in AdamW); biases do not.
        E and W^T get changes in the same direction, so that what they were born with is what parts them; the decay forgets
        it in some 1/(ηλ) updates (Kolen & Pollack, 1994), and learned error synapses align
    :param normalization: "layer" normalizes the hidden latents of a layer before φ (:mod:`~sb3_actpc.ngc.activations`), in
        projection, sweep and settling alike; "none" for the paper's circuits
    :param n_members: M members of an ensemble, each with synapses of its own, which settle and change in the same products;
        0 for one circuit without a leading dimension
    :param n_memory: size of the working memory fed to every layer; 0 for none
    :param memory_weight: α_m
    :param n_feedback_inputs: error synapses also reach the last this-many inputs (the critic's action columns)
    :raises ValueError: when a keyword has a value that is not allowed, or conflicts with ``settling="scheduled"``
    """

    chain_class: type[SettlingChain] = SettlingChain  # how errors come back; a subclass of the circuit may have another
    rates: th.Tensor
    optimizer: th.optim.Optimizer  # of :meth:`parameter_groups`; the owner sets it so that the circuit learns

    def __init__(
        self,
        n_inputs: int,
        n_outputs: int,
        hidden: Sequence[int] = (256, 256),
        *,
        activation: str = "relu6",
        output_activation: str = "identity",
        settling: str = "iterative",
        n_settling_steps: int = 10,
        settling_tolerance: float = 0.3,
        dynamics: str = "krylov",
        settling_rate: float | str = "auto",
        leak: float = 0.0,
        feedback: str = "tied",  # the paper's is "learned"; see above
        feedback_scale: float = 1.0,
        feedback_start: str = "independent",
        feedback_rate: float = 1.0,  # the paper's is below 1
        derivative_free: bool = False,
        synaptic_scaling: str = "none",
        weight_bound: float = 1.0,
        weight_decay: float = 0.0,
        normalization: str = "none",
        n_members: int = 0,
        n_memory: int = 0,
        memory_weight: float = 1.0,
        n_feedback_inputs: int = 0,
    ) -> None:
        _check_settings(dict(locals()))
        super().__init__()
        self.sizes = [n_inputs, *hidden, n_outputs]
        self.activation = ACTIVATIONS[activation]
        self.output_activation = ACTIVATIONS[output_activation]
        self.settling = settling
        self.n_settling_steps = n_settling_steps
        self.settling_tolerance = settling_tolerance
        self.dynamics = dynamics
        self.leak = leak
        self.derivative_free = derivative_free
        self.feedback = feedback
        self.feedback_scale = feedback_scale
        self.feedback_rate = feedback_rate
        self.synaptic_scaling = synaptic_scaling
        self.weight_bound = weight_bound
        self.weight_decay = weight_decay
        self.normalization = normalization
        self.n_members = n_members
        self.n_memory = n_memory
        self.memory_weight = memory_weight
        self.n_feedback_inputs = n_feedback_inputs
        self._create_synapses()
        if feedback_start == "mirrored":
            self.mirror_feedback()
        self._create_rates(settling_rate)

    # ------------------------------------------------------------------ synapses

    def _create_synapses(self) -> None:
        pairs = list(zip(self.sizes[:-1], self.sizes[1:], strict=True))
        members = (self.n_members,) if self.n_members else ()
        self.weights = nn.ParameterList([_uniform((*members, n_out, n_in), n_in) for n_in, n_out in pairs])
        flat = (*members, 1) if self.n_members else ()
        self.biases = nn.ParameterList([_uniform((*flat, n_out), n_in) for n_in, n_out in pairs])
        self.memory_weights = nn.ParameterList(
            [_uniform((n_out, self.n_memory), self.n_memory) for _, n_out in pairs] if self.n_memory else []
        )
        # E^T in the layout of W: (n_out, n_in), so that errors @ E^T is one product without a transposition
        sources = [self.n_feedback_inputs, *self.sizes[1:-1]]
        self.feedback_weights = nn.ParameterList(
            [_uniform((*members, n_out, source), n_in) for source, (n_in, n_out) in zip(sources, pairs, strict=True) if source]
            if self.feedback == "learned"
            else []
        )
        for parameter in self.parameters():
            parameter.requires_grad_(False)
        self._list_synapses()

    def _list_synapses(self) -> None:
        # the same parameters as plain lists: indexing a ParameterList costs more than a small product
        self.synapses = Synapses(*map(list, (self.weights, self.biases, self.memory_weights, self.feedback_weights)))

    def _create_rates(self, settling_rate: float | str) -> None:
        moves_by_rates = self.settling == "iterative" and self.dynamics != "krylov"
        self._keep_rates = moves_by_rates and settling_rate == "auto" and self.n_hidden > 0
        self.register_load_state_dict_post_hook(_follow_loaded)
        # others are the constructor's, and do not travel with the synapses
        self.register_buffer("rates", th.zeros(max(1, self.n_hidden)), persistent=self._keep_rates)  # β, first layer first
        if self._keep_rates:
            for name, matrix in self._coupling_matrices():
                start = th.ones(*matrix.shape[:-2], matrix.shape[-1])
                self.register_buffer(name, th.nn.functional.normalize(start, dim=-1))
            self.update_settling_rates(n_iterations=30)
        elif settling_rate != "auto":
            self.rates.fill_(float(settling_rate))

    def mirror_feedback(self) -> None:
        """
        Let learned error synapses copy the weights' action from noise: E = sum of ξ (W ξ)^T over orthonormal noise ξ.

        Weight mirroring (Akrout et al., "Deep learning without weight transport", NeurIPS 2019): Hebbian, each synapse sees
        the two neurons it joins and no weight is read across. Then E is W^T up to rounding. Does nothing with tied feedback.
        """
        above = self.synapses.weights[len(self.synapses.weights) - len(self.synapses.feedback) :]
        for feedback, weights in zip(self.synapses.feedback, above, strict=True):
            source = weights[..., weights.shape[-1] - feedback.shape[-1] :]
            if self.n_members:
                feedback.copy_(th.stack([mirrored(member) for member in source]))
            else:
                feedback.copy_(mirrored(source))

    @property
    def n_hidden(self) -> int:
        """Number of hidden layers."""
        return len(self.sizes) - 2

    def input_feedback(self, tied: bool = False) -> th.Tensor:
        """
        E^T of the input's last ``n_feedback_inputs`` columns, (n_first, n_feedback_inputs); of an ensemble with M in front.

        :param tied: the weights themselves, whatever the circuit uses
        """
        matrix = self.synapses.feedback_matrix(0, self.feedback_scale, tied)
        return matrix[..., matrix.shape[-1] - self.n_feedback_inputs :]

    # ------------------------------------------------------------------ inference

    def project(self, x: th.Tensor, memory: th.Tensor | None = None, members: th.Tensor | None = None) -> th.Tensor:
        """
        Ancestral projection f_proj: one feed-forward pass, no settling (paper, eq. for projection).

        :param x: (B, n_inputs)
        :param memory: m_t, (B, n_memory), for a circuit with a working memory
        :param members: of an ensemble, the indices of those that are asked; None for all
        :return: (B, n_outputs), of an ensemble (M, B, n_outputs)
        :raises ValueError: for an input that is no such tensor, for a memory that is missing, not wanted or of the wrong size
        """
        x = self._as_input(x)
        biases = self.synapses.layer_biases(memory, self.memory_weight)
        layers = self.synapses.weights
        if members is not None:
            x = x[: len(members)]
            biases = [bias[members] for bias in biases]
            layers = [weights[members] for weights in layers]
        for weights, bias in zip(layers[:-1], biases[:-1], strict=True):
            latents = affine(bias, x, weights)
            if self.normalization == "layer":
                latents = th.layer_norm(latents, latents.shape[-1:], None, None, EPSILON)
            x = self.activation.apply(latents, latents)
        output = affine(biases[-1], x, layers[-1])
        return self.output_activation.apply(output, output)

    def settle(self, x: th.Tensor, target: th.Tensor, memory: th.Tensor | None = None) -> SettledState:
        """
        Clamp input and output and let the hidden layers settle from the projected state (f_inf). No synapse changes.

        :param x: (B, n_inputs)
        :param target: (B, n_outputs); of an ensemble, for all members or (M, B, n_outputs)
        :param memory: m_t, (B, n_memory), for a circuit with a working memory
        :return: latents, activations and errors of every layer
        :raises ValueError: as :meth:`project`, and for a target of another shape than the outputs'
        """
        return self.settle_chain(self.chain(x, memory), target)

    def settle_chain(self, chain: SettlingChain, target: th.Tensor) -> SettledState:
        """:meth:`settle` for a :meth:`chain` that is projected already; ``target`` may depend on its output."""
        if self.n_members and target.dim() == 2:
            target = target.expand(self.n_members, -1, -1)
        chain.clamp_output(target)
        if self.settling == "scheduled":
            chain.sweep()
            return chain.state()
        chain.start_settling()
        if not self.n_hidden:
            return chain.state()
        if self.dynamics == "krylov":
            chain.n_steps = settle_krylov(chain, self.n_settling_steps, self.settling_tolerance)
            return chain.state()
        rates = self.rates.tolist()
        for chain.n_steps in range(1, self.n_settling_steps + 1):
            chain.integrate(rates)
            chain.predict()
        return chain.state()

    def chain(self, x: th.Tensor, memory: th.Tensor | None = None) -> SettlingChain:
        """The projected chain of this circuit's layers, to be clamped and settled; see :meth:`settle` for the shapes."""
        return self.chain_class(self, self._as_input(x), memory)

    def _as_input(self, x: th.Tensor) -> th.Tensor:
        """``x``, checked; of an ensemble the same for every member, (M, B, n_inputs)."""
        n = self.sizes[0]
        dtype = self.synapses.weights[0].dtype
        if not isinstance(x, th.Tensor) or x.dim() != 2 or x.shape[1] != n or x.dtype != dtype:
            found = f"a {x.dtype} tensor {tuple(x.shape)}" if isinstance(x, th.Tensor) else f"a {type(x).__name__}"
            raise ValueError(f"this circuit takes inputs of shape (B, {n}), a {dtype} tensor, but was given {found}")
        return x.expand(self.n_members, -1, -1) if self.n_members else x

    def residual(self, state: SettledState) -> th.Tensor:
        """
        How far from rest the hidden layers still are: RMS of eq. 1's right-hand side over RMS of the feedback in it, 0-d.

        1 at the projected start of a circuit with one hidden layer, 0 at a fixed point.
        """
        moves = []
        drives = []
        for layer in range(1, self.n_hidden + 1):
            latents = state.latents[layer]
            signal = state.postsynaptic[layer] @ self.synapses.feedback_matrix(layer, self.feedback_scale)
            if not self.derivative_free:
                normalized = normalize(latents) if self.normalization == "layer" else None
                signal = damped(self.activation, signal, latents, state.activations[layer], normalized)
            drives.append(signal.square().sum())
            moves.append((signal - state.errors[layer - 1] - self.leak * latents).square().sum())
        if not moves:
            return th.zeros(())
        return (th.stack(moves).sum() / th.stack(drives).sum().clamp_min(1e-30)).sqrt()

    # ------------------------------------------------------------------ learning

    def hebbian_update(self, state: SettledState) -> HebbianChanges:
        """
        The changes *to be added* that the settled ``state`` asks for: e φ(z)^T and its like, means over the batch.

        Nothing is changed yet: :meth:`apply_changes` does that, and gives the error synapses those of the weights.
        """
        return hebbian_changes(state.postsynaptic, state.activations, state.memory, self.memory_weight)

    def parameter_groups(self, learning_rate: float) -> list[dict[str, Any]]:
        """
        Parameter groups for a ``torch.optim`` optimiser. The error synapses' rate is γ_e times the weights': an adaptive
        optimiser cancels a constant factor on the change itself. ``lr_scale`` tells a scheduler that ratio. With γ_e = 1
        there is one group, which an optimiser steps faster than two.
        """
        forward = [*self.synapses.weights, *self.synapses.biases, *self.synapses.memory]
        groups: list[dict[str, Any]] = [{"params": forward, "lr": learning_rate, "lr_scale": 1.0}]
        if self.feedback_rate == 1.0:
            forward += self.synapses.feedback
        elif len(self.synapses.feedback):
            scale = self.feedback_rate
            groups.append({"params": self.synapses.feedback, "lr": learning_rate * scale, "lr_scale": scale})
        return groups

    def apply_changes(self, changes: HebbianChanges) -> None:
        """
        Hand the changes to the circuit's ``optimizer``, which its owner has set (see :meth:`parameter_groups`), bound the step
        it takes, and keep the settling rates stable.

        The one place where a change becomes a gradient to ascend.

        :param changes: of this circuit's synapses
        :raises ValueError: for a circuit without an optimiser
        """
        if not hasattr(self, "optimizer"):
            raise ValueError("no optimizer: set circuit.optimizer = torch.optim.Adam(circuit.parameter_groups(1e-3)) first")
        # W, M and E decay; biases do not
        biases = set(map(id, self.synapses.biases))
        for group in self.optimizer.param_groups:
            matrices = [parameter for parameter in group["params"] if id(parameter) not in biases]
            if matrices and self.weight_decay:
                th._foreach_mul_(matrices, max(0.0, 1.0 - group["lr"] * self.weight_decay))
        bounded = [*self.synapses.weights, *self.synapses.feedback]
        old = [parameter.clone() for parameter in bounded] if self.synaptic_scaling == "soft_bound" else []
        # The optimizer ascends where it can, as torch's own: no product for the sign
        ascends = "maximize" in self.optimizer.defaults
        if ascends:
            for group in self.optimizer.param_groups:
                group["maximize"] = True
        targets = [*self.synapses.weights, *self.synapses.biases, *self.synapses.memory]
        given = changes.tensors() if ascends else th._foreach_neg(changes.tensors())
        for parameter, gradient in zip(targets, given, strict=True):
            parameter.grad = gradient
        # E^T is stored in the layout of W, so that its change is ΔW itself
        above = self.synapses.weights[0 if self.n_feedback_inputs else 1 :]
        for parameter, weights in zip(self.synapses.feedback, above, strict=self.feedback == "learned"):
            assert weights.grad is not None
            parameter.grad = weights.grad[..., weights.shape[-1] - parameter.shape[-1] :].contiguous()
        self.optimizer.step()
        self._bound_step(bounded, old)
        if self._keep_rates:
            self.update_settling_rates()

    def _bound_step(self, synapses: list[th.Tensor], old: list[th.Tensor]) -> None:
        """Bounds act on the step that was taken from the ``old`` synapses."""
        for new, before in zip(synapses, old, strict=False):
            soft_bound_(new, before, self.weight_bound)
        if self.synaptic_scaling == "column_norm":
            for new in synapses:
                bound_columns_(new, self.weight_bound)

    def projection_copy(self) -> "NGCCircuit":
        """An equal circuit that only projects: a target circuit or a deployed policy. It has no learned error synapses."""
        twin = copy.deepcopy(self)
        twin.feedback = "tied"
        twin.feedback_weights = nn.ParameterList()
        twin._list_synapses()
        return twin

    def move_towards(self, other: "NGCCircuit", share: float) -> None:
        """
        Move the synapses by ``share`` (0 to 1) of the way towards those of an equal circuit (Polyak averaging).

        :param other: the circuit; where this one is a :meth:`projection_copy`, its error synapses are left out
        :param share: 1 copies them
        """
        mine: list[th.Tensor] = []
        theirs: list[th.Tensor] = []
        for own, others in zip(self.synapses, other.synapses, strict=True):
            if own:
                mine += own
                theirs += others
        th._foreach_lerp_(mine, theirs, share)

    # ------------------------------------------------------------------ stability

    def _coupling_matrices(self) -> list[tuple[str, th.Tensor]]:
        """The matrices between hidden layers and output, with the names of their power-iteration vectors."""
        named = [(f"singular_vector_{layer}", self.synapses.weights[layer]) for layer in range(1, self.n_hidden + 1)]
        if self.feedback == "learned":
            learned = self.synapses.feedback[-self.n_hidden :]
            named += [(f"feedback_singular_vector_{layer}", matrix) for layer, matrix in enumerate(learned, start=1)]
        return named

    def update_settling_rates(self, n_iterations: int = 1) -> None:
        """
        Follow the spectral norms of the synapses by power iteration and set the rates that are stable for them.

        Only of a circuit that moves by them: ``settling="iterative"``, ``dynamics="state"``, ``settling_rate="auto"``.

        :param n_iterations: of each matrix's singular vector
        """
        norms = th.stack([largest_norm_(m, getattr(self, name), n_iterations) for name, m in self._coupling_matrices()])
        forward = norms[: self.n_hidden].tolist()
        feedback = norms[self.n_hidden :].tolist() or [self.feedback_scale * norm for norm in forward]
        self.rates.copy_(th.tensor(settling_rates(forward, feedback)))


def _follow_loaded(circuit: NGCCircuit, _: Any) -> None:
    circuit._list_synapses()  # ``assign=True`` puts others in their place


def _uniform(shape: tuple[int, ...], fan_in: int) -> nn.Parameter:
    """U(-1/sqrt(fan_in), 1/sqrt(fan_in)), as ``torch.nn.Linear`` starts, without a gradient."""
    bound = fan_in**-0.5
    return nn.Parameter(th.empty(shape).uniform_(-bound, bound), requires_grad=False)


# ------------------------------------------------------------------ checks of the constructor's keywords

_CHOICES: dict[str, Collection[str]] = {
    "activation": HIDDEN_ACTIVATIONS,
    "output_activation": ACTIVATIONS,
    "settling": ("iterative", "scheduled"),
    "dynamics": DYNAMICS,
    "feedback": ("learned", "tied"),
    "feedback_start": ("independent", "mirrored"),
    "synaptic_scaling": SYNAPTIC_SCALINGS,
    "normalization": NORMALIZATIONS,
}
_SMALLEST = {"n_inputs": 1, "n_outputs": 1, "n_settling_steps": 1, "n_memory": 0, "n_feedback_inputs": 0, "n_members": 0}
_RATES = ("leak", "settling_tolerance", "feedback_rate", "weight_bound", "weight_decay", "feedback_scale", "memory_weight")
# what scheduled settling implies; krylov dynamics imply the first two
_IMPLIED = {"leak": 0.0, "settling_rate": "auto", "feedback_scale": 1.0, "derivative_free": False}


def _check_settings(given: dict[str, Any]) -> None:
    """:raises ValueError: for a keyword with a value that is not allowed, or for two that do not go together"""
    for name, allowed in _CHOICES.items():
        if not isinstance(given[name], str) or given[name] not in allowed:
            raise ValueError(f"{name}={given[name]!r} is unknown; choose one of {sorted(allowed)}")
    if not isinstance(given["hidden"], Sequence) or isinstance(given["hidden"], str):
        raise ValueError(f"hidden={given['hidden']!r} must be a list of layer sizes")
    sizes = [(name, given[name], smallest) for name, smallest in _SMALLEST.items()]
    sizes += [(f"hidden[{layer}]", size, 1) for layer, size in enumerate(given["hidden"])]
    for name, value, smallest in sizes:
        if not isinstance(value, Integral) or not smallest <= int(value) <= LARGEST_SIZE:
            raise ValueError(f"{name}={value!r} must be a whole number from {smallest} to {LARGEST_SIZE}")
    for name in _RATES:
        if not isinstance(given[name], Real) or not 0.0 <= given[name] < inf:
            raise ValueError(f"{name}={given[name]!r} must be a finite number that is not negative")
    rate = given["settling_rate"]
    if not (isinstance(rate, str) and rate == "auto") and not (isinstance(rate, Real) and 0.0 < float(rate) <= 1.0):
        raise ValueError(f"settling_rate={rate!r} must be 'auto' or a number in (0, 1]")
    if not isinstance(given["derivative_free"], bool):
        raise ValueError(f"derivative_free={given['derivative_free']!r} must be True or False")
    _check_agreement(given)


def _check_agreement(given: dict[str, Any]) -> None:
    def refuse(one: str, other: str, why: str) -> None:
        raise ValueError(f"{one}={given[one]!r} does not go with {other}={given[other]!r}: {why}")

    if given["n_members"] and given["n_memory"]:
        refuse("n_members", "n_memory", "an ensemble has no memory")
    if given["n_feedback_inputs"] > given["n_inputs"]:
        refuse("n_feedback_inputs", "n_inputs", "it can be at most as large")
    if given["synaptic_scaling"] != "none" and not given["weight_bound"]:
        refuse("weight_bound", "synaptic_scaling", "it must be above 0")
    is_scheduled = given["settling"] == "scheduled"
    if given["output_activation"] == "clamp" and not is_scheduled:
        refuse("output_activation", "settling", "use settling='scheduled' or output_activation='tanh'")
    for name, implied in _IMPLIED.items():
        if given[name] == implied:
            continue
        if is_scheduled:
            refuse(name, "settling", f"leave {name} out or use settling='iterative'")
        if given["dynamics"] == "krylov" and name in ("leak", "settling_rate"):
            refuse(name, "dynamics", "it needs dynamics='state'")
