"""A scenario says what an environment is: its robot, task and constraints with their parameters.

It is plain data: an id string, a dictionary, a YAML file and keyword arguments all become the same
:class:`Scenario`, and every environment is made from one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import yaml

from sb3_guard.envs import suites
from sb3_guard.envs.arena import Arena
from sb3_guard.envs.constraints.obstacles import Obstacles
from sb3_guard.envs.engine import Engine
from sb3_guard.envs.extras import Extras
from sb3_guard.envs.layout import Layout
from sb3_guard.envs.observation import Lidar
from sb3_guard.envs.part import Robot
from sb3_guard.envs.registry import CONSTRAINTS, KEYWORDS, OPTIONS, ROBOTS, TASKS
from sb3_guard.fields import did_you_mean, load_yaml, plain
from sb3_guard.ids import UnknownPart

Params = Mapping[str, Any]
COSTS = ("sum", "any")
_OWN_NAME = "a constraint under a name of its own states its type, such as {'type': 'hazards'}"


def _filled(data: Mapping[str, Any]) -> dict[str, Any]:
    """Without the keys that a YAML file leaves blank, at any depth: they keep their defaults."""
    return {
        key: _filled(value) if isinstance(value, Mapping) else value
        for key, value in data.items()
        if value is not None
    }


@dataclass(frozen=True)
class Scenario:
    """A robot, a task and constraints, each with parameters that differ from their defaults.

    None instead of any field is its default.

    :param robot: a name in :data:`~sb3_guard.envs.registry.ROBOTS`
    :param task: a name in :data:`~sb3_guard.envs.registry.TASKS`
    :param constraints: parameters by constraint, the constraint's name in lower case; a constraint
        under another name states its ``type``
    :param robot_params: parameters of the robot
    :param task_params: parameters of the task
    :param lidar: parameters of the pseudo-lidar
    :param layout: parameters of the layout
    :param observe: parameters of :class:`~sb3_guard.envs.extras.Extras`
    :param arena: parameters of the :class:`~sb3_guard.envs.arena.Arena`
    :param cost: ``"sum"`` of the constraints' costs, or ``"any"``: 1 if any constraint costs
        something, else 0, and so each of them
    :raises ValueError: an unknown name or a bad value, with what is allowed
    """

    robot: str = "Point"
    task: str = "Goal"
    constraints: Mapping[str, Params] = field(default_factory=dict)
    robot_params: Params = field(default_factory=dict)
    task_params: Params = field(default_factory=dict)
    lidar: Params = field(default_factory=dict)
    layout: Params = field(default_factory=dict)
    observe: Params = field(default_factory=dict)
    arena: Params = field(default_factory=dict)
    cost: str = "sum"

    def __post_init__(self) -> None:
        for f in fields(self):
            value = plain(getattr(self, f.name))
            if value is None:
                value = {} if f.default is MISSING else f.default
            object.__setattr__(self, f.name, value)
        for kind, name, known in (("robot", self.robot, ROBOTS), ("task", self.task, TASKS)):
            if not isinstance(name, str):
                raise ValueError(f"{kind} = {name!r} must be a name: {', '.join(known)}")
            if name not in known:
                raise UnknownPart(f"unknown {kind} {name!r}: {did_you_mean(name, known)}")
        if not isinstance(self.constraints, Mapping):
            raise ValueError(
                f"constraints = {self.constraints!r} must be a mapping of names to parameters, "
                "such as {'hazards': {'num': 8}}"
            )
        if self.cost not in COSTS:
            raise ValueError(f"cost = {self.cost!r}: {did_you_mean(self.cost, COSTS)}")
        self.parts()

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], label: str = "scenario") -> Scenario:
        """The scenario of plain data, with the fields of this class as keys.

        :param label: what an error message calls the data
        :raises ValueError: unknown keys or bad values
        """
        known = list(cls.__dataclass_fields__)
        for key in data:
            if key not in known:
                raise ValueError(f"{label} has no key {key!r}: {did_you_mean(key, known)}")
        return cls(**data)

    @classmethod
    def parse(cls, name: str) -> Scenario:
        """The scenario of an id such as ``Goal_Point_8Hazards-v0``; the version may be left out.

        :raises ValueError: it is in no environment, nor does it follow
            ``{Task}_{Robot}_{N}{Constraint}[_noconti]``
        """
        return cls(**suites.fields(name))

    @classmethod
    def load(cls, path: str | Path) -> Scenario:
        """The scenario in a YAML file with the fields of this class as keys.

        What is left blank has its default.

        :raises ValueError: the file is missing, is not YAML in UTF-8, or holds unknown keys or one
            key twice
        """
        try:
            data = load_yaml(Path(path).read_text(encoding="utf-8"))
        except (OSError, ValueError, yaml.YAMLError) as error:
            detail = " ".join(str(error).split())
            raise ValueError(f"cannot read scenario {str(path)!r}: {detail}") from None
        if not isinstance(data, dict):
            raise ValueError(
                f"scenario {str(path)!r} must be a mapping with keys such as robot and task, "
                f"found {'nothing' if data is None else repr(data)}"
            )
        constraints = data.get("constraints")
        if isinstance(constraints, dict):
            data["constraints"] = {k: {} if v is None else v for k, v in constraints.items()}
        return cls.from_dict(_filled(data), f"scenario {str(path)!r}")

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which ``Scenario(**data)`` makes this scenario again."""
        return {f.name: plain(getattr(self, f.name)) for f in fields(self)}

    def override(self, cost: str | None = None, **params: Params | None) -> Scenario:
        """This scenario with parameters of its parts changed or constraints added.

        ``override(hazards={"size": 0.2}, goal={"size": 0.3}, lidar={"bins": 32})``: a keyword is
        ``robot``, ``arena``, ``lidar``, ``layout``, ``observe``, the task's name in lower case, or
        a constraint's; None removes a constraint.

        :param cost: ``"sum"`` or ``"any"``; None: as it was
        :raises ValueError: an unknown keyword or parameter
        """
        changes: dict[str, Any] = {"constraints": dict(self.constraints), "cost": cost or self.cost}
        table = self._keywords()
        for key, value in params.items():
            if key not in table and not (isinstance(value, Mapping) and "type" in value):
                hint = did_you_mean(key, [*table, *OPTIONS])
                raise ValueError(f"unknown parameter {key!r}: {hint}; {_OWN_NAME}")
            if value is not None and not isinstance(value, Mapping):
                raise ValueError(f"{key} = {value!r} must be a mapping of parameters to values")
            name = table.get(key, "constraints")
            if name != "constraints":
                changes[name] = {**changes.get(name, getattr(self, name)), **(value or {})}
            elif value is None:
                changes[name].pop(key, None)
            else:
                changes[name][key] = {**changes[name].get(key, {}), **value}
        if self.observe.get("components") and "components" not in (params.get("observe") or {}):
            components = self._components(changes["constraints"])
            changes["observe"] = {**changes.get("observe", self.observe), "components": components}
        return replace(self, **changes)

    def _keywords(self) -> dict[str, str]:
        """The field that each keyword of :meth:`override` changes."""
        constraints = [*sorted(map(str.lower, CONSTRAINTS)), *self.constraints]
        own = {**KEYWORDS, self.task.lower(): "task_params"}
        return own | dict.fromkeys(constraints, "constraints")

    def _components(self, constraints: Mapping[str, Params]) -> list[str]:
        """What is observed with these constraints: not those that go, and the objects that come."""
        kinds = {name.lower(): cls for name, cls in CONSTRAINTS.items()}
        gone = {f"{name}_lidar" for name in self.constraints.keys() - constraints.keys()}
        kept = [name for name in self.observe["components"] if name not in gone]
        new = {name: of for name, of in constraints.items() if name not in self.constraints}
        types = {
            name: kinds.get(str(of.get("type", name)).lower(), object) for name, of in new.items()
        }
        return [*kept, *(f"{n}_lidar" for n, cls in types.items() if issubclass(cls, Obstacles))]

    def parts(self) -> dict[str, Any]:
        """New, unbound parts: the keyword arguments of an :class:`Engine`.

        :raises ValueError: an unknown name, a bad value, or a constraint's name that cannot be used
        """
        robot = ROBOTS[self.robot].from_params(self.robot_params, "robot")
        by_name = {name.lower(): cls for name, cls in CONSTRAINTS.items()}
        taken = (self.task.lower(), *KEYWORDS)
        constraints = []
        for name, params in self.constraints.items():
            used = name.lower() in taken or (name.lower() in by_name and name not in by_name)
            if not name.isidentifier() or not name.isascii() or used:
                raise ValueError(
                    f"constraint {name!r}: a name has letters, digits and underscores; types of "
                    f"constraints are in lower case, and {', '.join(taken)} mean other parts"
                )
            if not isinstance(params, Mapping):
                raise ValueError(f"constraint {name!r} = {params!r} must be a mapping")
            params = dict(params)
            named = "type" not in params
            kind = str(params.pop("type", name)).lower()
            if kind not in by_name:
                hint = did_you_mean(kind, by_name)
                if named:
                    raise UnknownPart(f"unknown constraint {name!r}: {hint}; {_OWN_NAME}")
                raise UnknownPart(f"{name}.type = {kind!r}: {hint}")
            if name in by_name and kind != name:
                raise ValueError(
                    f"constraint {name!r} cannot be of type {kind!r}: {name!r} is a type itself"
                )
            constraints.append(by_name[kind].from_params(_suited(robot, kind, params), name))
        task = self.task.lower()
        return {
            "robot": robot,
            "task": TASKS[self.task].from_params(_suited(robot, task, self.task_params), task),
            "constraints": constraints,
            "lidar": Lidar.from_params(self.lidar),
            "layout": Layout.from_params(self.layout),
            "extras": Extras.from_params(self.observe),
            "arena": Arena.from_params(_suited(robot, "arena", self.arena)),
            "cost": self.cost,
        }

    def build(self, num_envs: int = 1, num_threads: int | None = None) -> Engine:
        """Run ``num_envs`` simulations of this scenario."""
        return Engine(**self.parts(), num_envs=num_envs, num_threads=num_threads)


def _suited(robot: Robot, kind: str, params: Params) -> Params:
    """Parameters of a part, and those that suit the robot where none is stated."""
    defaults = robot.defaults.get(kind)
    if not defaults or not isinstance(params, Mapping):
        return params
    planar = params.get("space") == "planar"  # where there is no height
    usual = {key: v for key, v in defaults.items() if not (planar and key == "height")}
    return {**usual, **params}
