"""One environment with Gymnasium's interface: the batch of one."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces

from sb3_guard.envs.components import Actuator, Component, actuators, components
from sb3_guard.envs.engine import Engine
from sb3_guard.envs.extras import EYE
from sb3_guard.envs.outcome import Outcome
from sb3_guard.envs.rendering import CAMERAS, Renderer
from sb3_guard.envs.robots.robot import PREFIX
from sb3_guard.envs.scenario import Scenario
from sb3_guard.envs.types import Array
from sb3_guard.fields import did_you_mean, fit

ROW = np.zeros(1, dtype=np.int32)


def as_scenario(
    scenario: str | Path | Mapping[str, Any] | Scenario, params: Mapping[str, Any] | None = None
) -> Scenario:
    """The scenario of an id, a YAML file or plain data, with parameters of its parts changed.

    :raises ValueError: it is none of these, or not a good one
    """
    if isinstance(scenario, Path):
        scenario = Scenario.load(scenario)
    elif isinstance(scenario, str):
        is_file = scenario.endswith((".yml", ".yaml"))
        scenario = Scenario.load(scenario) if is_file else Scenario.parse(scenario)
    elif isinstance(scenario, Mapping):
        scenario = Scenario.from_dict(scenario)
    elif not isinstance(scenario, Scenario):
        raise ValueError(
            f"scenario = {scenario!r} must be an id, a YAML file, a Scenario or its plain data"
        )
    return scenario.override(**params) if params else scenario


def observation_space(engine: Engine, flatten: bool) -> spaces.Box | spaces.Dict:
    """The space of one row's observation, with the true bounds of each component.

    :raises ValueError: an image cannot be part of a flat vector
    """
    camera = engine.extras.camera
    boxes: dict[str, spaces.Space[Any]] = {
        name: spaces.Box(c.low, c.high, (c.size,), np.float32)
        for name, c in engine.channels.items()
    }
    if not flatten:
        if camera is not None:
            boxes["camera"] = spaces.Box(0, 255, (camera[1], camera[0], 3), np.uint8)
        return spaces.Dict(boxes)
    if camera is not None:
        raise ValueError(f"observe.camera = {camera!r} needs flatten=False, a Dict observation")
    channels = engine.channels.values()
    low = np.concatenate([np.full(c.size, c.low, np.float32) for c in channels])
    high = np.concatenate([np.full(c.size, c.high, np.float32) for c in channels])
    return spaces.Box(low, high, dtype=np.float32)


def action_space(engine: Engine) -> spaces.Box:
    """Actions of one row, by default within [−1, 1]: the robot scales them to its actuators."""
    size = (engine.robot.action_size,)
    low, high = (np.broadcast_to(bound, size) for bound in engine.robot.action_range)
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def cameras(model: mujoco.MjModel) -> dict[str, str]:
    """The cameras that can be chosen: the renderer's names, by the names that users give.

    A camera of a robot's file has its name there, too, unless that is one of ours.
    """
    names = [model.camera(i).name for i in range(model.ncam)]
    chosen = {name: name for name in (*CAMERAS, *names) if name}
    return {name.removeprefix(PREFIX): name for name in names if name} | chosen


class Simulated:
    """What the lone environment and the vector environment share: an engine and ways to see it.

    An engine cannot be pickled or copied; its scenario and state make it again.
    """

    scenario: Scenario
    engine: Engine
    render_mode: str | None
    flatten: bool
    metadata: dict[str, Any]
    # None until first used, also after a refusal in the constructor: close() works then too.
    _renderer: Renderer | None = None
    _eye: Renderer | None = None  # the robot's own camera, if it is observed

    def _simulate(
        self,
        scenario: str | Path | Mapping[str, Any] | Scenario,
        params: Mapping[str, Any],
        num_envs: int,
        num_threads: int | None,
        render_mode: str | None,
        flatten: bool,
        width: int,
        height: int,
        camera: str | None,
    ) -> None:
        """Check the options and run the scenario.

        :raises ValueError: unknown names or bad values
        """
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            hint = did_you_mean(render_mode, modes)
            raise ValueError(f"unknown render_mode {render_mode!r}: {hint}")
        if not isinstance(flatten, bool):
            raise ValueError(f"flatten = {flatten!r} must be true or false")
        for name, value in (("width", width), ("height", height)):
            fit(name, value, int, 1, 10_000, "[]")
        self.scenario = as_scenario(scenario, params)
        self.render_mode, self.flatten = render_mode, flatten
        self._num_threads = num_threads
        self.engine = self.scenario.build(num_envs, num_threads)
        names, camera = cameras(self.engine.model), camera or self.engine.task.camera
        if not isinstance(camera, str) or camera not in names:
            raise ValueError(f"unknown camera {camera!r}: {did_you_mean(str(camera), names)}")
        self._window = (width, height, names[camera])
        self.metadata = {**self.metadata, "render_fps": round(1 / self.engine.control_step)}

    @property
    def observation_layout(self) -> dict[str, slice]:
        """Where each named component lies in the flat observation."""
        return self.engine.observation_layout

    @property
    def components(self) -> list[Component]:
        """What each number of the flat observation is: name, place, bounds and unit."""
        return list(components(self.engine))

    @property
    def actuators(self) -> list[Actuator]:
        """What each number of an action moves: name, range, and range of the actuator."""
        return list(actuators(self.engine))

    @property
    def most_costs(self) -> dict[str, float]:
        """The highest cost of a step, by entry of info; inf where nobody can say."""
        parts, alone = self.engine.constraints, self.scenario.cost == "any"
        most = {c.name: float(c.most_cost > 0) if alone else c.most_cost for c in parts}
        total = min(sum(most.values(), 0.0), 1.0 if alone else math.inf)
        return {"cost": total} | {f"cost_{n}": most[c.name] for c in parts for n in c.costs()}

    def look(self) -> Array | None:
        """What the robots' cameras see, [N, H, W, 3] uint8, or None if that is not observed."""
        camera = self.engine.extras.camera
        if camera is None:
            return None
        if self._eye is None:
            self._eye = Renderer(self.engine, *camera, EYE)
        return np.stack([self._eye.frame(row) for row in range(self.engine.num_envs)])

    def view(self, obs: Array, images: Array | None, row: int | None = None) -> Any:
        """Observations as the space has them: the flat array, or its components by name.

        :param obs: [N, D]
        :param images: [N, H, W, 3], or None
        :param row: one row instead of all
        """
        which = slice(None) if row is None else row
        if self.flatten:
            return obs[which]
        out = {n: obs[which, where] for n, where in self.engine.observation_layout.items()}
        if images is not None:
            out["camera"] = images[which]
        return out

    def frame(self, row: int) -> Array:
        """A picture of one row, [height, width, 3] uint8; never advances physics."""
        if self._renderer is None:
            self._renderer = Renderer(self.engine, *self._window)
        return self._renderer.frame(row)

    def _free(self) -> None:
        for renderer in (self._renderer, self._eye):
            if renderer is not None:
                renderer.close()
        self._renderer = self._eye = None
        if hasattr(self, "engine"):  # not after a refusal in the constructor
            self.engine.close()

    def state(self) -> dict[str, Any]:
        """Everything the coming steps depend on; :meth:`restore` continues from it bit for bit."""
        return self.engine.state()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state` of the same scenario and number of rows."""
        self.engine.restore(state)

    def __getstate__(self) -> dict[str, Any]:
        out = {k: v for k, v in self.__dict__.items() if k not in ("engine", "_renderer", "_eye")}
        return {**out, "state": self.state(), "rows": self.engine.num_envs}

    def __setstate__(self, out: dict[str, Any]) -> None:
        state, rows = out.pop("state"), out.pop("rows")
        self.__dict__.update(out)
        self._renderer = self._eye = None
        self.engine = self.scenario.build(rows, self._num_threads)
        self.restore(state)


def step_info(outcome: Outcome, row: int) -> dict[str, Any]:
    """The info of one row: its costs, and what happened if something did."""
    info: dict[str, Any] = {"cost": float(outcome.cost[row])}
    for name, values in outcome.details.items():
        info[name] = values[row].item()
    info |= {name: True for name, rows in outcome.events.items() if rows[row]}
    for name, rows in outcome.ended_by.items():
        if rows[row]:
            info["terminated_by"] = name
    return info


class GuardEnv(Simulated, gymnasium.Env[Any, Array]):
    """A safe-RL environment: a robot with a task among constraints.

    ``step`` returns the cost of the step as ``info["cost"]``, and per constraint type as
    ``info["cost_<type>"]``; ``info["goal_met"]`` is there, and True, only if the goal was reached;
    ``info["terminated_by"]`` names the part that ended the episode, if one did.
    Episodes are cut by the time limit of :func:`gymnasium.make`.

    :param scenario: an id, a :class:`~sb3_guard.envs.scenario.Scenario`, its plain data or its
        YAML file
    :param render_mode: ``"rgb_array"``, ``"human"`` or None
    :param flatten: False for a Dict observation with the components by name
    :param width: width of rendered frames, pixels
    :param height: height of rendered frames, pixels
    :param camera: ``"fixed"``, ``"track"``, ``"top"``, or a camera of the robot's file; None: the
        task's, which is fixed, or track where the robot runs far away
    :param params: parameters of parts to change, such as ``hazards={"num": 4}``
    :raises ValueError: unknown names or bad values
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        scenario: str | Path | Mapping[str, Any] | Scenario = "Goal_Point_8Hazards",
        render_mode: str | None = None,
        flatten: bool = True,
        width: int = 480,
        height: int = 480,
        camera: str | None = None,
        **params: Any,
    ) -> None:
        self._simulate(scenario, params, 1, None, render_mode, flatten, width, height, camera)
        self.observation_space = observation_space(self.engine, flatten)
        self.action_space = action_space(self.engine)
        self._so_far = np.zeros(2)  # return and cost of the episode, for a window

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; the same seed gives the same episodes, whatever else runs."""
        super().reset(seed=seed)
        if seed is not None or self.engine.rngs[0] is not self.np_random:
            self.engine.seed(0, self.np_random)
        self.engine.reset(ROW)
        self._so_far[:] = 0.0
        if self.render_mode == "human":
            self.render()
        info = {name: values[0].item() for name, values in self.engine.drawn.info().items()}
        return self.view(self.engine.observe(), self.look(), 0), info

    def step(self, action: Array) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance by one control step, of ten physics steps unless the robot says otherwise.

        :param action: [action size], clipped to the action space
        :raises ValueError: the action has the wrong shape or is not finite
        """
        action = np.asarray(action, dtype=float)
        if action.shape != self.action_space.shape:
            raise ValueError(f"action has shape {action.shape}, expected {self.action_space.shape}")
        outcome = self.engine.step(action[None])
        self._so_far += outcome.reward[0], outcome.cost[0]
        if self.render_mode == "human":
            self.render()
        return (
            self.view(outcome.obs, self.look(), 0),
            float(outcome.reward[0]),
            bool(outcome.terminated[0]),
            bool(outcome.unplaced[0]),
            step_info(outcome, 0),
        )

    def render(self) -> Array | None:
        """A frame, [height, width, 3] uint8, or a look at the window; never advances physics.

        In the window Space pauses, Tab opens MuJoCo's menus, F shows contact forces; closing it is
        a KeyboardInterrupt.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() needs a render_mode: gymnasium.make(id, render_mode='rgb_array')"
            )
            return None
        if self._renderer is None:
            self._renderer = Renderer(self.engine, *self._window, self.render_mode)
        total, cost = self._so_far
        return self._renderer.render(0, {"return": f"{total:.2f}", "cost": f"{cost:.2f}"})

    def close(self) -> None:
        """Free the renderers and end the simulation: a step after it is an error."""
        self._free()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state` of the same scenario."""
        super().restore(state)
        self.np_random = self.engine.rngs[0]
