"""Whether an agent's critic is worth following: its differences beside those of the returns that are really paid.

From states of own and demonstrated episodes, the first action is the actor's or is moved: along the critic's gradient with
respect to the action, against it, at random, or towards the action of the nearest demonstrated observation. The policy is
then played without noise. A critic that is worth following ranks the moved actions as the returns do.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from gymnasium.wrappers import TimeLimit

from sb3_actpc.checkpoints.encoding import Decoder, Encoder
from sb3_actpc.checkpoints.simulators import capture_env, env_layers, restore_env
from sb3_actpc.demonstrations import Demonstrations, resolve
from sb3_actpc.experiments.runs.evaluation import stacked
from sb3_actpc.utils.files import atomic_write

Values = Callable[[th.Tensor, th.Tensor], th.Tensor]
FILE = "examination.csv"  # in a run's folder
MOVES = ("along", "against", "demonstration", "random")
N_RANDOM = 3  # random moves from each state
N_EPISODES = 4  # own ones of each kind
N_TOGETHER = 12  # states that are rolled out side by side
GRADIENT_STEP = 0.01  # of the finite differences, in the scaled action
N_RESAMPLES = 200  # of the states, for the standard errors of the correlations
VELOCITY_CLIP = 10.0  # the Hopper and the Walker2d show their velocities clipped


@dataclass(frozen=True)
class Examination:
    """What was found, by groups: all states, those of each source, and the agent's own by thirds of ``distance``.

    The measures, for paid and for dense returns: ``rank_correlation``, Spearman's, of the critic's differences with the
    returns', moved against unmoved actions; ``<move>_wins``, share of states where the move pays more than none (1/2 where
    both pay the same), ``<move>_gain``, how much more; ``along_over_random``, share where the critic's move pays more than
    random ones; ``along_ties``. Then ``calibration_bias``, the critic's value of the unmoved action less the return realised
    (its own value of the state at the horizon included), ``calibration_correlation``, of the two; ``falls``, share of
    episodes that ended. A critic that says nothing has correlations of 0 and wins as often as random moves do.

    :param rows: one row for each action tried: ``state`` (its number), ``source`` (demonstrated, own or noisy), ``distance``
        (to the nearest demonstrated observation), ``move`` (policy for none), ``value`` (the critic's), ``paid`` and ``dense``
        (discounted returns), ``rest`` (the discounted value of where the horizon ended), ``fell`` (1 if the episode ended)
    :param table: one row for each group of states and measure: ``group``, ``measure``, ``states``, ``value``,
        ``standard_error``
    """

    rows: pd.DataFrame
    table: pd.DataFrame

    def __str__(self) -> str:
        table = self.table.assign(
            column=[f"{group} ({n})" for group, n in zip(self.table.group, self.table.states, strict=True)],
            cell=[f"{v:.2f} ±{e:.2f}" for v, e in zip(self.table.value, self.table.standard_error, strict=True)],
        )
        wide = table.pivot(index="measure", columns="column", values="cell")
        return wide.reindex(index=table.measure.unique(), columns=table.column.unique()).to_string(index_names=False)


@dataclass(frozen=True)
class _Start:
    """A state to start from: the environment as plain data, what the agent sees and remembers there."""

    captured: tuple[dict[str, Any], Decoder]
    observation: Any
    memory: tuple[np.ndarray, ...] | None
    source: str


def examine(
    model: Any,
    env_id: str,
    n_states: int = 60,
    horizon: int = 200,
    perturbation: float = 0.1,
    seed: int = 0,
    env_kwargs: Mapping[str, Any] | None = None,
    *,
    hold: int = 1,
    noise: float = 0.1,
    values: Values | None = None,
) -> Examination:
    """Compare a critic with returns. The agent, and the global random generators, are left as they are.

    A third of the states each are of demonstrated episodes (gymnasium's MuJoCo tasks alone), of the agent's own without
    noise, and of its own with it. A move is clipped where the action has its bounds, and goes no farther than to the
    demonstrated action. Paid returns know nothing of the agent's internal signals: a critic that does is biased by them.

    :param model: an :class:`~sb3_actpc.actpc.actpc.ActPC`, with its demonstrations where it has any
    :param horizon: steps from each of the ``n_states``
    :param perturbation: length of a move: root mean square over the dimensions of the scaled action, in (0, 2]
    :param seed: of episodes, noise and random moves
    :param hold: steps for which actions are moved, directions being found anew at each
    :param noise: standard deviation, in the scaled action, of the noise of the noisy episodes
    :param values: the critic: features (B, n_features) and scaled actions (B, A) to values (B,); by default that of the
        circuit which presses the actor
    :return: what was tried, and the table
    :raises ValueError: for a number out of its range, demonstrations that are missing, or an environment that cannot be set
        into the middle of an episode
    """
    for name, number, least in (("n_states", n_states, 1), ("horizon", horizon, 1), ("hold", hold, 1), ("noise", noise, 0)):
        if number < least:
            raise ValueError(f"{name}={number} must be at least {least}")
    if not 0.0 < perturbation <= 2.0:
        raise ValueError(f"perturbation={perturbation} must be above 0 and at most 2, the width of the scaled action")
    if model.demonstrations is not None and model.expert is None:
        raise ValueError(f"the agent's demonstrations are not at {model.demonstrations}: set agent.demonstrations")
    agent = _Agent(model, values, perturbation, horizon, hold)
    n_envs = max(N_EPISODES, min(N_TOGETHER, n_states) * len(agent.branches))
    with ExitStack() as stack:
        options = {"disable_env_checker": True, **(env_kwargs or {})}
        envs = [stack.enter_context(gym.make(env_id, **options)) for _ in range(n_envs)]
        rows = _try_all(agent, envs, _starts(agent, envs, n_states, noise, seed), seed)
    tables = [_measures(part, seed).assign(group=name, states=part.state.nunique()) for name, part in _groups(rows).items()]
    columns = ["group", "measure", "states", "value", "standard_error"]
    return Examination(rows, pd.concat(tables, ignore_index=True)[columns])


def examine_run(folder: Path, **options: Any) -> Examination:
    """Examine the agent of a run, with keywords of :func:`examine`, and write the table into its folder, as
    ``examination.csv``. The run's ``model.zip`` is unpickled: open only runs that you trust. ValueError when its agent is not
    an ActPC, or learned from ``VecNormalize``."""
    from sb3_actpc.actpc import ActPC
    from sb3_actpc.experiments.runs.environments import make_env
    from sb3_actpc.experiments.runs.run import load_run

    run, model = load_run(folder)
    if not isinstance(model, ActPC):
        raise ValueError(f"{folder} is not a run of ActPC without VecNormalize: only such an agent's critic can be examined")
    model.set_env(make_env(run.env, run.env_kwargs))
    examination = examine(model, run.env, env_kwargs=run.env_kwargs, **options)
    with atomic_write(folder / FILE, "w") as file:
        examination.table.to_csv(file, index=False)
    return examination


# ------------------------------------------------------------------ the agent


class _Agent:
    """The agent as it is examined; actions are scaled to [-1, 1]."""

    def __init__(self, model: Any, values: Values | None, perturbation: float, horizon: int, hold: int) -> None:
        self.model, self.values = model, values or self._first_critic
        self.perturbation, self.horizon, self.hold = perturbation, horizon, hold
        self.branches = ["policy", "along", "against", *["random"] * N_RANDOM]
        self.demonstrated = model.expert is not None
        if self.demonstrated:
            self.branches.insert(3, "demonstration")
            episodes = model.expert.episodes
            self._seen = self.features(episodes.observations)
            self._spread = self._seen.std(0).clamp_min(1e-4)
            self._done = th.as_tensor(episodes.actions, dtype=th.float32)

    def features(self, observations: Any) -> th.Tensor:
        """(B, n_features)."""
        return self.model.inputs.features(self.model.inputs.observations(observations))

    def act(self, observations: Any, memory: Any, begins: np.ndarray) -> tuple[th.Tensor, Any]:
        """The policy's scaled actions, (B, A), and its next recurrent state."""
        actions, memory = self.model.predict(observations, memory, begins, deterministic=True)
        return th.as_tensor(self.model.policy.scale_action(actions), dtype=th.float32).flatten(1), memory

    def unscaled(self, actions: th.Tensor) -> np.ndarray:
        """As the environment takes them."""
        shaped = actions.numpy().reshape(-1, *self.model.action_space.shape)
        return np.asarray(self.model.policy.unscale_action(shaped))

    def move(self, features: th.Tensor, actions: th.Tensor, branches: Sequence[str], randoms: th.Tensor) -> th.Tensor:
        """The actions, each moved as its branch says."""
        gradient = self.gradient(features, actions)
        wanted = {"along": gradient, "against": -gradient, "random": randoms}
        if self.demonstrated:
            wanted["demonstration"] = self._done[self.nearest(features)[1]] - actions
        still = th.zeros_like(actions)
        moves = th.stack([wanted.get(branch, still)[row] for row, branch in enumerate(branches)])
        lengths = moves.norm(dim=1, keepdim=True)
        steps = th.full_like(lengths, self.perturbation * actions.shape[1] ** 0.5)
        towards = th.tensor([branch == "demonstration" for branch in branches])[:, None]
        steps = th.where(towards, th.minimum(steps, lengths), steps)
        return (actions + steps * moves / lengths.clamp_min(1e-12)).clamp(-1.0, 1.0)

    def gradient(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Of the values with respect to the actions, by central differences, (B, A)."""
        steps = GRADIENT_STEP * th.eye(actions.shape[1])
        columns = [self.values(features, actions + step) - self.values(features, actions - step) for step in steps]
        return th.stack(columns, dim=1) / (2.0 * GRADIENT_STEP)

    def nearest(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Distance to the nearest demonstrated observation (root mean square over the features, in their standard deviations
        over the demonstrations) and its row, (B,) each."""
        distances = th.cdist(features / self._spread, self._seen / self._spread) / features.shape[1] ** 0.5
        nearest = distances.min(1)
        return nearest.values.cpu(), nearest.indices.cpu()

    def _first_critic(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return self.model.critic.first().project(th.cat([features, actions.to(features)], dim=1)).mean(1).cpu()


# ------------------------------------------------------------------ states


def _starts(agent: _Agent, envs: Sequence[gym.Env[Any, Any]], n_states: int, noise: float, seed: int) -> list[_Start]:
    starts = _demonstrated_states(agent.model, envs[0], n_states - 2 * (n_states // 3), seed) if agent.demonstrated else []
    n_own = (n_states - len(starts)) // 2
    starts += _visited_states(agent, envs[:N_EPISODES], n_states - len(starts) - n_own, 0.0, seed)
    return starts + _visited_states(agent, envs[:N_EPISODES], n_own, noise, seed + N_EPISODES)


def _visited_states(agent: _Agent, envs: Sequence[gym.Env[Any, Any]], n_states: int, noise: float, seed: int) -> list[_Start]:
    """States of the agent's own episodes, one in each environment, each step as likely as any other (a reservoir)."""
    rng, n_seen, source = np.random.default_rng(seed), 0, "noisy" if noise else "own"
    kept: list[_Start] = []
    observations = [env.reset(seed=seed + index)[0] for index, env in enumerate(envs)]
    memory, begins, playing = None, np.ones(len(envs), dtype=bool), np.full(len(envs), n_states > 0)
    while playing.any():
        actions, following = agent.act(stacked(observations), memory, begins)
        disturbance = th.as_tensor(noise * rng.standard_normal(actions.shape), dtype=th.float32)
        unscaled = agent.unscaled((actions + disturbance).clamp(-1.0, 1.0))
        for i in np.flatnonzero(playing):
            n_seen += 1
            place = len(kept) if len(kept) < n_states else int(rng.integers(n_seen))
            if place < n_states:
                remembered = None if memory is None else tuple(part[i].copy() for part in memory)
                kept[place : place + 1] = [_Start(_capture(envs[i]), observations[i], remembered, source)]
            observations[i], _, terminated, truncated, _ = envs[i].step(unscaled[i])
            playing[i] = not (terminated or truncated)
        memory, begins = following, np.zeros(len(envs), dtype=bool)
    return kept


def _demonstrated_states(model: Any, env: gym.Env[Any, Any], n_states: int, seed: int) -> list[_Start]:
    """States of demonstrated episodes; none where they cannot be rebuilt from what was recorded."""
    known = resolve(model.demonstrations).select(model.n_demonstrations, model.n_demonstration_transitions)
    task = known.env_id.rpartition(":")[2].removeprefix("Sparse").removeprefix("Goal")
    simulation: Any = env.unwrapped
    if f"Sparse{task}" not in gym.registry or not hasattr(simulation, "set_state"):
        return []
    if known.dense_rewards is None and not task.startswith("Reacher"):
        return []
    positions, velocities, rows = rebuilt_states(known, f"Sparse{task}")
    starts = []
    for row in np.random.default_rng(seed).choice(rows, size=min(n_states, len(rows)), replace=False):
        observation, _ = env.reset(seed=seed)
        if isinstance(observation, dict):
            return []
        origin = np.zeros(simulation.model.nq)
        if not task.startswith("Reacher"):
            origin[0] = simulation.data.qpos[0]  # what has been travelled counts from the place of the reset
        simulation.set_state(positions[row] + origin, velocities[row])
        starts.append(_Start(_capture(env), known.next_observations[row], None, "demonstrated"))
    return starts


def rebuilt_states(demonstrations: Demonstrations, sparse_id: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Generalised positions (N, nq), x counted from the episode's start, and velocities (N, nv) after each of N transitions
    of a gymnasium MuJoCo task; the rows after which the episode goes on and no velocity was clipped."""
    env = gym.make(sparse_id, disable_env_checker=True)
    simulation: Any = env.unwrapped
    positions, n_velocities = simulation.demonstrated_positions(demonstrations), simulation.model.nv
    env.close()
    seen = demonstrations.next_observations.astype(np.float64)
    velocities = seen[:, -n_velocities:]
    usable = np.ones(len(seen), dtype=bool)
    usable[[end - 1 for _, end in demonstrations.episode_bounds]] = False
    if "Reacher" in sparse_id:
        velocities = np.zeros((len(seen), n_velocities))  # the target stands still
        velocities[:, :2] = seen[:, 6:8]
    elif "Hopper" in sparse_id or "Walker2d" in sparse_id:
        usable &= np.all(np.abs(velocities) < VELOCITY_CLIP, axis=1)
    return positions, velocities, np.flatnonzero(usable)


def _capture(env: gym.Env[Any, Any]) -> tuple[dict[str, Any], Decoder]:
    encoder = Encoder()
    record = capture_env(env, encoder, "env")
    if "reason" in record:
        raise ValueError(f"the environment cannot be set into the middle of an episode: {record['reason']}")
    arrays = {name: array.copy() for name, array in encoder.arrays.items()}
    return record, Decoder(arrays, {name: tensor.clone() for name, tensor in encoder.tensors.items()})


# ------------------------------------------------------------------ trying actions


def _try_all(agent: _Agent, envs: Sequence[gym.Env[Any, Any]], starts: Sequence[_Start], seed: int) -> pd.DataFrame:
    """Every branch from every state; columns as in :class:`Examination`."""
    rng, frames = np.random.default_rng(seed), []
    distances = np.full(len(starts), np.nan)
    if agent.demonstrated:
        distances = agent.nearest(agent.features(stacked([start.observation for start in starts])))[0].numpy()
    for env in envs:
        env.reset(seed=seed)  # a wrapper refuses steps before
    for first in range(0, len(starts), N_TOGETHER):
        states = np.repeat(np.arange(first, min(first + N_TOGETHER, len(starts))), len(agent.branches))
        moves = agent.branches * (len(states) // len(agent.branches))
        group = [starts[state] for state in states]
        randoms = rng.standard_normal((len(states), int(np.prod(agent.model.action_space.shape))))
        frame = _roll_out(agent, envs, group, moves, th.as_tensor(randoms, dtype=th.float32))
        sources = [start.source for start in group]
        frames.append(frame.assign(state=states, source=sources, distance=distances[states], move=moves))
    return pd.concat(frames, ignore_index=True)


def _roll_out(
    agent: _Agent, envs: Sequence[gym.Env[Any, Any]], starts: Sequence[_Start], branches: Sequence[str], randoms: th.Tensor
) -> pd.DataFrame:
    """Side by side: the branch's actions for ``hold`` steps, then the policy's. A row each: value, paid, dense, rest, fell."""
    for env, start in zip(envs, starts, strict=False):
        restore_env(env, *start.captured)
        for layer in env_layers(env):
            if isinstance(layer, TimeLimit):
                layer._elapsed_steps = 0  # type: ignore[assignment]  # each state has its whole horizon before it
    gamma, n = agent.model.gamma, len(starts)
    observations = [start.observation for start in starts]
    memory, begins = _memories(starts)
    values, paid, dense, fell = np.zeros((4, n))
    rest = np.full(n, gamma**agent.horizon)
    playing = np.ones(n, dtype=bool)
    for t in range(agent.horizon):
        actions, memory = agent.act(stacked(observations), memory, begins)
        begins = np.zeros(n, dtype=bool)
        if t < agent.hold:
            features = agent.features(stacked(observations))
            actions = agent.move(features, actions, branches, randoms)
            values = values if t else agent.values(features, actions).double().numpy()
        unscaled = agent.unscaled(actions)
        for i in np.flatnonzero(playing):
            observations[i], reward, terminated, truncated, info = envs[i].step(unscaled[i])
            paid[i] += gamma**t * float(reward)
            dense[i] += gamma**t * float(info.get("dense_reward", reward))
            if terminated or truncated:
                playing[i], fell[i] = False, terminated
                rest[i] = 0.0 if terminated else gamma ** (t + 1)
        if not playing.any():
            break
    actions, _ = agent.act(stacked(observations), memory, begins)
    rest *= agent.values(agent.features(stacked(observations)), actions).double().numpy()
    return pd.DataFrame({"value": values, "paid": paid, "dense": dense, "rest": rest, "fell": fell})


def _memories(starts: Sequence[_Start]) -> tuple[tuple[np.ndarray, ...] | None, np.ndarray]:
    """The agent's recurrent states at the starts, and where they are to be emptied."""
    held = [start.memory for start in starts]
    template = next((memory for memory in held if memory is not None), ())  # stands in where one is to be emptied
    parts = [np.stack(rows) for rows in zip(*(template if memory is None else memory for memory in held), strict=True)]
    return tuple(parts) or None, np.array([memory is None for memory in held])


# ------------------------------------------------------------------ judging


def _groups(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """All states, those of each source, and the agent's own by thirds of their distance from the demonstrations."""
    found = {"all": rows} | {str(source): part for source, part in rows.groupby("source")}
    own = rows[rows.source != "demonstrated"]
    ranks = own.groupby("state").distance.first().dropna().rank(method="first", pct=True)
    if len(ranks) >= 3:
        thirds = own.state.map((3.0 * ranks).apply(np.ceil))
        found |= {name: own[thirds == third] for third, name in enumerate(("near", "middle", "far"), start=1)}
    return found


def _measures(rows: pd.DataFrame, seed: int) -> pd.DataFrame:
    """Columns measure, value and standard_error; the measures are those of :class:`Examination`."""
    rng = np.random.default_rng(seed)
    by_move = {str(move): part.groupby("state")[["paid", "dense"]].mean() for move, part in rows.groupby("move")}
    base = rows[rows.move == "policy"].set_index("state").sort_index()
    moved = rows[rows.move != "policy"].set_index("state")
    differences = moved[["value", "paid", "dense"]] - base.loc[moved.index, ["value", "paid", "dense"]].to_numpy()
    blocks = [part.to_numpy() for _, part in differences.groupby(level=0)]
    found = {f"rank_correlation_{name}": _correlation(blocks, column, rng) for column, name in ((1, "paid"), (2, "dense"))}
    for name in ("paid", "dense"):
        for move in MOVES:
            if move in by_move:
                found[f"{move}_wins_{name}"] = _mean(_wins(by_move[move][name], base[name]))
                found[f"{move}_gain_{name}"] = _mean(by_move[move][name] - base[name])
        found[f"along_over_random_{name}"] = _mean(_wins(by_move["along"][name], by_move["random"][name]))
        found[f"along_ties_{name}"] = _mean(_wins(by_move["along"][name], base[name]) == 0.5)
    realised = base.paid + base.rest
    found["predicted_return"], found["realised_return"] = _mean(base.value), _mean(realised)
    found["calibration_bias"] = _mean(base.value - realised)
    pairs = np.stack([base.value, realised], axis=1)
    found["calibration_correlation"] = _correlation(list(pairs[:, None]), 1, rng)
    found["falls"] = _mean(base.fell)
    return pd.DataFrame([(name, *pair) for name, pair in found.items()], columns=["measure", "value", "standard_error"])


def _mean(samples: Any) -> tuple[float, float]:
    """Mean and standard error; the latter is NaN for a single sample."""
    array = np.asarray(samples, dtype=np.float64)
    return float(array.mean()), float(array.std(ddof=1) / len(array) ** 0.5) if len(array) > 1 else float("nan")


def _wins(first: pd.Series, second: pd.Series) -> np.ndarray:
    """1 where the first is larger, 1/2 where both are the same but for rounding, 0 elsewhere."""
    ties = np.isclose(first, second, rtol=1e-9, atol=1e-9)
    return np.where(ties, 0.5, (first > second).astype(float))


def _correlation(blocks: list[np.ndarray], column: int, rng: np.random.Generator) -> tuple[float, float]:
    """Spearman's, of columns 0 and another of all blocks (one a state), and its standard error over states; or NaN."""

    def correlation(parts: list[np.ndarray]) -> float:
        return float(pd.DataFrame(np.concatenate(parts)[:, [0, column]]).corr("spearman", min_periods=3).to_numpy()[0, 1])

    n = len(blocks)
    resampled = [correlation([blocks[i] for i in rng.integers(n, size=n)]) for _ in range(N_RESAMPLES)]
    known = [value for value in resampled if not np.isnan(value)]
    return correlation(blocks), float(np.std(known)) if len(known) > 1 else float("nan")
