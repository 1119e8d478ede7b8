"""Many environments with Gymnasium's vector interface, on one batch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
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
    """A control step of every row, after which finished rows have been reset.

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

    A row that ends is reset in the same step (``AutoresetMode.SAME_STEP``): its last observation
    and info are in ``infos["final_obs"]`` and ``infos["final_info"]``. ``infos["cost"]`` and
    ``infos["cost_<type>"]`` hold the costs of the step for every row.

    :param num_envs: number of environments N
    :param scenario: an id, a :class:`~sb3_guard.envs.scenario.Scenario`, its plain data or its
        YAML file
    :param max_episode_steps: control steps after which an episode is cut; None: as its id says,
        1,000 of a scenario
    :param num_threads: threads that step the physics; by default one per CPU, at most N. The
        results do not depend on it
    :param render_mode: ``"rgb_array"`` (one frame per row) or None
    :param flatten: False for a Dict observation with the components by name
    :param params: parameters of parts to change, such as ``hazards={"num": 4}``
    :raises ValueError: unknown names or bad values
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_modes": ["rgb_array"],
    }

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
        **params: Any,
    ) -> None:
        if max_episode_steps is None:
            steps = episode_steps(scenario) if isinstance(scenario, str) else EPISODE_STEPS
            max_episode_steps = steps
        fit("max_episode_steps", max_episode_steps, int, 1, ends="[)")
        self._simulate(
            scenario, params, num_envs, num_threads, render_mode, flatten, width, height, camera
        )
        self.engine.extras.check_limit(max_episode_steps)
        self.num_envs = self.engine.num_envs
        self.max_episode_steps = max_episode_steps
        self.single_observation_space = observation_space(self.engine, flatten)
        self.single_action_space = action_space(self.engine)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def begin(self, seeds: Sequence[int | None]) -> Array:
        """Begin an episode in every row; a seed renews a row's generator.

        :return: flat observations of every row, [N, D]
        """
        for row, seed in enumerate(seeds):
            if seed is not None:
                self.engine.seed(row, seeding.np_random(int(seed))[0])
        self.engine.reset(np.arange(self.num_envs))
        return self.engine.observe()

    def advance(self, actions: Array) -> Transition:
        """One control step of every row; rows that end are reset."""
        outcome = self.engine.step(actions)
        truncated = outcome.unplaced | (self.engine.steps >= self.max_episode_steps)
        done = outcome.terminated | truncated
        obs = outcome.obs
        images = final_images = self.look()
        if np.count_nonzero(done):
            self.engine.reset(np.flatnonzero(done))
            obs, images = self.engine.observe(), self.look()
        return Transition(obs, outcome, truncated, done, images, final_images)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every row.

        :param seed: row i gets seed + i; or one seed (or None) per row
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
        obs = self.begin(seeds)
        infos: dict[str, Any] = self.engine.drawn.info()
        everyone = np.ones(self.num_envs, dtype=bool)
        infos |= {f"_{name}": everyone for name in infos}
        return self.view(obs, self.look()), infos

    def step(self, actions: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Advance every row by one control step."""
        t = self.advance(actions)
        out = t.outcome
        everyone = np.ones(self.num_envs, dtype=bool)
        infos: dict[str, Any] = {"cost": out.cost, "_cost": everyone}
        for name, values in out.details.items():
            infos[name], infos[f"_{name}"] = values, everyone
        for name, rows in out.events.items():
            if rows.any():
                infos[name] = infos[f"_{name}"] = rows
        for name, rows in out.ended_by.items():
            for row in np.flatnonzero(rows).tolist():
                infos = self._add_info(infos, {"terminated_by": name}, row)
        if t.done.any():
            final = np.full(self.num_envs, None, dtype=object)
            details: dict[str, Any] = {}
            for row in np.flatnonzero(t.done).tolist():
                final[row] = self.view(out.obs, t.final_images, row)
                details = self._add_info(details, step_info(out, row), row)
            infos["final_obs"], infos["_final_obs"] = final, t.done
            infos["final_info"], infos["_final_info"] = details, t.done
        return self.view(t.obs, t.images), out.reward, out.terminated, t.truncated, infos

    def render(self) -> tuple[Array, ...] | None:
        """One frame per row, [height, width, 3] uint8; never advances physics."""
        if self.render_mode is None:
            return None
        return tuple(self.frame(row) for row in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Free the renderers and end the simulations: a step after it is an error."""
        self._free()
