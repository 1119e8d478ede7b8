"""Write a page for every robot, task and constraint from its code: ``python scripts/make_docs.py``.

The pages hold what the code says of itself: the docstring, the place in the paper's taxonomy, the
parameters with defaults and limits, and for robots the tables of actions and observations.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
from pathlib import Path

from sb3_guard.envs import GuardVectorEnv
from sb3_guard.envs.engine import FRAME_SKIP
from sb3_guard.envs.objects import Movers
from sb3_guard.envs.part import Part
from sb3_guard.envs.registry import CONSTRAINTS, ROBOTS, TASKS
from sb3_guard.list import yes
from sb3_guard.show import action_table, observation_table
from sb3_guard.zoo.tables import table


def parameters(part: type[Part]) -> str:
    """A row per parameter: name, default, what it is and what is allowed."""
    rows = []
    for field in dataclasses.fields(part):  # type: ignore[arg-type]
        limits = []
        for key, sign in (("above", "> "), ("low", "≥ "), ("high", "≤ ")):
            if field.metadata.get(key) is not None:
                limits.append(f"{sign}{field.metadata[key]:g}")
        if field.metadata.get("choices"):
            limits.append(", ".join(map(str, field.metadata["choices"])))
        meaning = field.metadata.get("doc", "")
        rows.append([f"`{field.name}`", f"`{field.default}`", meaning, "; ".join(limits)])
    return table(["parameter", "default", "what it is", "allowed"], rows)


def taxonomy(part: type[Part]) -> str:
    """The paper's columns for this part, in one line."""
    names = ("interactive", "contact", "targets", "trespassable", "movable", "workspace", "spaces")
    values = []
    for name in names:
        value = getattr(part, name, None)
        if value is None or callable(value) or (name == "spaces" and hasattr(part, "workspace")):
            continue
        if isinstance(value, bool):
            value = yes(part, name)
        values.append(f"{name}: {', '.join(value) if isinstance(value, tuple) else value}")
    return " · ".join(values)


def speeds(part: type[Movers]) -> str:
    """What the default speed is by the second, which depends on the robot's time step."""
    robots: dict[float, list[str]] = {}
    for name, robot in ROBOTS.items():
        second = part().speed / (FRAME_SKIP * robot.timestep)
        robots.setdefault(second, []).append(name)
    each = "; ".join(f"{', '.join(robots[v])} {v:.3g}" for v in sorted(robots, reverse=True))
    return f"A `speed` of {part().speed:g} m per control step is, in m/s, with {each}."


def page(kind: str, name: str, part: type[Part]) -> str:
    """The page of one part."""
    text = inspect.cleandoc(part.__doc__ or "").replace("``", "`")
    parts = [
        f"# {name}",
        f"![{name}](../images/{kind}_{name.lower()}.png)",
        text,
        taxonomy(part),
        f"Parameters, set with `{part.name or name.lower()}={{...}}`:",
        parameters(part),
    ]
    if issubclass(part, Movers):
        parts.append(speeds(part))
    if kind == "robot":
        env = GuardVectorEnv(1, f"Goal_{name}_8Hazards")
        parts += [action_table(env), f"In `Goal_{name}_8Hazards`:", observation_table(env)]
    return "\n\n".join(parts) + "\n"


def pages() -> dict[str, str]:
    """Every page by its path below docs/."""
    kinds = {"robot": ROBOTS, "task": TASKS, "constraint": CONSTRAINTS}
    return {
        f"{kind}s/{name.lower()}.md": page(kind, name, part)
        for kind, parts in kinds.items()
        for name, part in parts.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("docs"))
    args = parser.parse_args()
    for path, text in pages().items():
        file = args.output / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        print(file)


if __name__ == "__main__":
    main()
