"""Many environments with Gymnasium's vector interface, on one batch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from sb3_guard.envs.gym_env import (
    Simulated,
    action_space,
    observation_space,
    step_info,
)
from sb3_guard.envs.outcome import Outcome
from sb3_guard.envs.scenario import Scenario
from sb3_guard.envs.suites import EPISODE_STEPS, episode_steps
from sb3_guard.envs.types import Array
from sb3_guard.fields import fit


@dataclass
class Transition:
    """A control step of every row.

    :param obs: the next observation, [N, D]: of the new episode where one began
    :param outcome: what the step brought, with the observation before the new episode
    :param truncated: cut by the time limit or for want of a next goal, [N] bool
    :param done: terminated or truncated, [N] bool
    :param images: what the robots' cameras see next, [N, H, W, 3], if they are observed
    :param final_images: the same before any new episode
    """

    obs: Array
    outcome: Outcome
    truncated: Array
    done: Array
    images: Array | None = None
    final_images: Array | None = None


class GuardVectorEnv(Simulated, gymnasium.vector.VectorEnv[Any, Any, Array]):
    """N environments stepped together; row i equals a single one with seed + i, bit for bit.

    A row that ends is reset in the same step: its last observation and info are in
    ``infos["final_obs"]`` and ``infos["final_info"]``. In the other modes of Gymnasium the next
    step resets it, whatever its action, or the caller does, by
    ``reset(options={"reset_mask": rows})``. The episodes are the same. ``infos["cost"]`` and
    ``infos["cost_<type>"]`` hold the costs of the step for every row that took it.

    :param num_envs: number of environments N
    :param scenario: an id, a :class:`~sb3_guard.envs.scenario.Scenario`, its plain data or its
        YAML file
    :param max_episode_steps: control steps after which an episode is cut; None: as its id says,
        1,000 of a scenario
    :param num_threads: threads that step the physics; by default one per CPU, at most N. The
        results do not depend on it
    :param render_mode: ``"rgb_array"`` (one frame per row) or None
    :param flatten: False for a Dict observation with the components by name
    :param autoreset_mode: when a row that has ended is reset: ``"SameStep"``, ``"NextStep"`` or
        ``"Disabled"``, or Gymnasium's ``AutoresetMode``
    :param params: parameters of parts to change, such as ``hazards={"num": 4}``
    :raises ValueError: unknown names or bad values
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_modes": ["rgb_array"],
    }
    #: what steps it for Stable-Baselines3
    vec_entry_point = "sb3_guard.common.native:GuardVecEnv"

    def __init__(
        self,
        num_envs: int = 1,
        scenario: str | Path | Mapping[str, Any] | Scenario = "Goal_Point_8Hazards",
        max_episode_steps: int | None = None,
        num_threads: int | None = None,
        render_mode: str | None = None,
        flatten: bool = True,
        width: int = 480,
        height: int = 480,
        camera: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        **params: Any,
    ) -> None:
        name = getattr(autoreset_mode, "value", autoreset_mode)
        name = fit("autoreset_mode", name, choices=[mode.value for mode in AutoresetMode])
        self.metadata = {**self.metadata, "autoreset_mode": AutoresetMode(name)}
        if max_episode_steps is None:
            steps = episode_steps(scenario) if isinstance(scenario, str) else EPISODE_STEPS
            max_episode_steps = steps
        fit("max_episode_steps", max_episode_steps, int, 1, ends="[)")
        self._simulate(
            scenario, params, num_envs, num_threads, render_mode, flatten, width, height, camera
        )
        self.engine.extras.check_limit(max_episode_steps)
        self.num_envs = self.engine.num_envs
        self._ended = np.zeros(self.num_envs, dtype=bool)  # and not reset yet
        self.max_episode_steps = max_episode_steps
        self.single_observation_space = observation_space(self.engine, flatten)
        self.single_action_space = action_space(self.engine)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def begin(self, seeds: Sequence[int | None], rows: Array | None = None) -> Array:
        """Begin an episode in every row; a seed renews a row's generator.

        :param seeds: one per row, or None
        :param rows: which rows, [N] bool, instead of all
        :return: flat observations of every row, [N, D]
        """
        ids = np.arange(self.num_envs) if rows is None else np.flatnonzero(rows)
        for row in ids.tolist():
            seed = seeds[row]
            if seed is not None:
                self.engine.seed(row, seeding.np_random(int(seed))[0])
        self.engine.reset(ids)
        self._ended[ids] = False
        return self.engine.observe()

    def advance(self, actions: Array) -> Transition:
        """One control step of every row; rows that end are reset."""
        t = self._control_step(actions)
        if np.count_nonzero(t.done):
            self.engine.reset(np.flatnonzero(t.done))
            t.obs, t.images = self.engine.observe(), self.look()
        return t

    def _control_step(self, actions: Array, resting: Array | None = None) -> Transition:
        """One control step of every row.

        :param resting: rows, [N] bool, that begin an episode in place of it
        """
        rows = [] if resting is None else np.flatnonzero(resting).tolist()
        # The batch steps these rows, too, and nobody is to know: their numbers are drawn again.
        generators = [self.engine.rngs[row].bit_generator for row in rows]
        before = [generator.state for generator in generators]
        outcome = self.engine.step(actions)
        if rows:
            for generator, state in zip(generators, before, strict=True):
                generator.state = state
            self.engine.reset(np.array(rows))
            outcome.forget(rows)
            outcome.obs, outcome.drawn = self.engine.observe(), self.engine.drawn.info()
        truncated = outcome.unplaced | (self.engine.steps >= self.max_episode_steps)
        done, images = outcome.terminated | truncated, self.look()
        return Transition(outcome.obs, outcome, truncated, done, images, images)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every row.

        :param seed: row i gets seed + i; or one seed (or None) per row
        :param options: ``{"reset_mask": rows}``, [N] bool, begins episodes in these rows alone
        """
        seeds: Sequence[int | None]
        if seed is None:
            seeds = [None] * self.num_envs
        elif isinstance(seed, (int, np.integer)):
            seeds = [int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
            if len(seeds) != self.num_envs:
                raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments")
        everyone = np.ones(self.num_envs, dtype=bool)
        rows = np.asarray((options or {}).get("reset_mask", everyone))
        if rows.dtype != bool or rows.shape != everyone.shape:
            raise ValueError(f"reset_mask = {rows.tolist()} must be {self.num_envs} truth values")
        obs = self.begin(seeds, rows)
        infos: dict[str, Any] = self.engine.drawn.info()
        infos |= {f"_{name}": rows for name in infos}
        return self.view(obs, self.look()), infos

    def step(self, actions: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Advance every row by one control step.

        :raises gymnasium.error.ResetNeeded: an episode has ended, and ``autoreset_mode`` leaves its
            reset to the caller
        """
        mode, resting = self.metadata["autoreset_mode"], self._ended
        if mode is AutoresetMode.SAME_STEP:
            t = self.advance(actions)
        elif mode is AutoresetMode.DISABLED and resting.any():
            raise ResetNeeded(
                f"the episodes of rows {np.flatnonzero(resting).tolist()} have ended: call "
                "reset(options={'reset_mask': rows}) before step()"
            )
        else:
            t = self._control_step(actions, resting)
            self._ended = t.done
        out, obs = t.outcome, self.view(t.obs, t.images)
        return obs, out.reward, out.terminated, t.truncated, self._gather(t, ~resting)

    def _gather(self, t: Transition, acted: Array) -> dict[str, Any]:
        """What a step brought to the rows that took it, [N] bool, with Gymnasium's masks."""
        out, everyone = t.outcome, np.ones(self.num_envs, dtype=bool)
        infos: dict[str, Any] = {}
        for name, values in {"cost": out.cost, **out.costs}.items():
            infos[name], infos[f"_{name}"] = values, acted
        for name, values in out.drawn.items():
            infos[name], infos[f"_{name}"] = values, everyone
        for name, rows in out.events.items():
            if rows.any():
                infos[name] = infos[f"_{name}"] = rows
        for name, rows in out.ended_by.items():
            for row in np.flatnonzero(rows).tolist():
                infos = self._add_info(infos, {"terminated_by": name}, row)
        if self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP and t.done.any():
            final = np.full(self.num_envs, None, dtype=object)
            details: dict[str, Any] = {}
            for row in np.flatnonzero(t.done).tolist():
                final[row] = self.view(out.obs, t.final_images, row)
                details = self._add_info(details, step_info(out, row), row)
            infos["final_obs"], infos["_final_obs"] = final, t.done
            infos["final_info"], infos["_final_info"] = details, t.done
        return infos

    def state(self) -> dict[str, Any]:
        return {**super().state(), "ended": self._ended.copy()}

    def restore(self, state: Mapping[str, Any]) -> None:
        super().restore(state)
        self._ended = np.array(state["ended"])

    def render(self) -> tuple[Array, ...] | None:
        """One frame per row, [height, width, 3] uint8; never advances physics."""
        if self.render_mode is None:
            return None
        return tuple(self.frame(row) for row in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Free the renderers and end the simulations: a step after it is an error."""
        self._free()
