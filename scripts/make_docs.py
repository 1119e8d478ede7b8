"""Write the reference pages from the code: ``python scripts/make_docs.py``.

Robots, tasks and constraints have a page a kind: pictures, docstrings, the parameters with defaults
and limits, what is added to the observation. Further pages list the parameters that belong to no
part, the files in ``examples/`` and the flags of the commands.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import importlib
import inspect
import itertools
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sb3_guard.cli import COMMANDS, module_of
from sb3_guard.envs import GuardVectorEnv
from sb3_guard.envs.arena import Arena
from sb3_guard.envs.extras import Extras
from sb3_guard.envs.layout import Layout
from sb3_guard.envs.observation import Lidar
from sb3_guard.envs.parameters import Parameters
from sb3_guard.envs.part import Part
from sb3_guard.envs.registry import CONSTRAINTS, ROBOTS, TASKS, guard
from sb3_guard.envs.robots.from_file import ATTRIBUTES
from sb3_guard.list import KINDS, summary
from sb3_guard.zoo.cli.flags import Command
from sb3_guard.zoo.cli.markdown import escaped, table

ROOT = Path(__file__).parents[1]
# Robots that tell the sizes of an observation apart: in the plane, in space, with several lidars.
BLOCK = re.compile(r"(<!-- robots -->\n).*?(<!-- end -->)", re.DOTALL)
SIZED = ("Point", "Drone", "Arm3", "Arm6")
GROUPS: dict[str, dict[str, type[Part]]] = {
    "robot": guard(ROBOTS),
    "task": guard(TASKS),
    "constraint": guard(CONSTRAINTS),
}
CAPTIONS = {
    "robot": "Each in `Goal_<Robot>_8Hazards`. The ring of beads is its lidar: the more opaque a "
    "bead, the closer the object in that direction. The dart on the floor shows where the robot "
    "faces. Point is the package's TRPO-USL agent; the others are TRPO after 500,000 steps, "
    "with noise.",
    "task": "Each with Point among eight hazards: in Goal the package's TRPO-USL agent, elsewhere "
    "TRPO, which ignores cost, after 500,000 steps.",
    "constraint": "Each with Point and the task Goal: the package's TRPO-USL agent among hazards, "
    "CPO among ghosts, elsewhere TRPO, which ignores cost, after 200,000 steps. While a robot "
    "incurs a cost, it and the border of the arena turn red.",
}
LOOKS = {
    "constraint_ghosts_spatial": "Ghosts in the air: `Goal_Drone_8Ghosts`",
    "constraint_ghosts_solid": "Solid ghosts: `ghosts={'solid': True}`",
    "task_chase_solid": "Solid targets: `chase={'solid': True}`",
    "task_push_box": "A box to push: `push={'object': 'box'}`",
}
FILES = {
    "file_go1": "[Go1](robot_files.md#trained) walks to goals; leaning costs",
    "file_yam": "[YAM](robot_files.md#trained) reaches for goals; fast joints cost",
}
ABOUT = {
    "task": "What a robot is rewarded for. Any task can be combined with any robot and any "
    "[constraints](constraints.md); it is the first word of an id, as in `Push_Ant_8Hazards-v0`.",
    "constraint": "What incurs a cost. Any number of constraints can be combined with any "
    "[task](tasks.md) and any [robot](robots.md): the first is named in the id, "
    "`Goal_Ant_8Ghosts-v0`, others are arguments, `vases={'num': 4}`. Each reports its own cost as "
    "`info['cost_<name>']`, and `info['cost']` is their sum.",
}


#: What belongs to no part, by its argument of ``gymnasium.make``.
OF_NO_PART: dict[str, tuple[type[Parameters], str]] = {
    "lidar": (Lidar, "The pseudo-lidar that detects constraints and targets:"),
    "observe": (Extras, "Observations that belong to no part:"),
    "layout": (Layout, "Where things are:"),
    "arena": (Arena, "The place and its physics:"),
}


def key_of(field: Any) -> tuple[str, str, str]:
    """Name, default and meaning of a parameter."""
    return field.name, str(field.default), field.metadata.get("doc", "")


def parameters(part: type[Parameters]) -> str:
    """A row per parameter: name, default, what it is and what is allowed."""
    return parameter_table(dataclasses.fields(part))  # type: ignore[arg-type]


def parameter_table(fields: Iterable[Any], of: Iterable[str] = ()) -> str:
    """A row per parameter: name, default, what it is, what is allowed, and which parts have it."""
    rows = []
    for field in fields:
        meaning = field.metadata.get("doc", "")
        limits = []
        for key, sign in (("above", "> "), ("low", "≥ "), ("high", "≤ ")):
            if field.metadata.get(key) is not None:
                limits.append(f"{sign}{field.metadata[key]:g}")
        if field.metadata.get("choices"):
            limits.append(", ".join(map(str, field.metadata["choices"])))
        if field.metadata.get("drawn"):
            limits.append("may be [drawn](customizing.md#domain-randomisation)")
        rows.append([f"`{field.name}`", f"`{field.default}`", meaning, "; ".join(limits)])
    header = ["parameter", "default", "what it is", "allowed"]
    if of:
        header.append("of")
        rows = [[*row, parts] for row, parts in zip(rows, of, strict=True)]
    return table(header, rows)


def parameters_of_environments() -> str:
    """The page of the parameters that belong to no part, and of those that can be drawn."""
    parts = [
        "# Parameters",
        "[Robots](robots.md), [tasks](tasks.md) and [constraints](constraints.md) list their own. "
        "[Change an environment](customizing.md) shows how to set them.",
    ]
    for name, (kind, about) in OF_NO_PART.items():
        parts += [f"## `{name}={{...}}`", about, parameters(kind)]
    drawn: dict[tuple[str, str], list[str]] = {}
    for kinds in GROUPS.values():
        for name, part in kinds.items():
            for field in dataclasses.fields(part):  # type: ignore[arg-type]
                if field.metadata.get("drawn"):
                    drawn.setdefault((field.name, field.metadata["doc"]), []).append(name)
    robots = ", ".join(GROUPS["robot"])
    rows = [[f"`{name}`", ", ".join(of).replace(robots, "all robots"), doc]
            for (name, doc), of in drawn.items()]  # fmt: skip
    parts += ["## Drawn anew in each episode", table(["parameter", "of", "what it is"], rows)]
    rows = [[f"`{name}`", escaped(default), escaped(meaning)]
            for name, (default, meaning, _) in ATTRIBUTES.items()]  # fmt: skip
    parts += ["## `register_robot`", "Further arguments: what the file of the robot does not say."]
    parts += [table(["argument", "default", "what it is"], rows)]
    return "\n\n".join(parts) + "\n"


def perceived(kind: str) -> str:
    """What each task or constraint adds to the observation of some robots."""
    rows: dict[tuple[str, str], list[str]] = {}
    for name, robot in itertools.product(GROUPS[kind], SIZED):
        task, constraint = (name, "Hazards") if kind == "task" else ("Goal", name)
        engine = GuardVectorEnv(1, f"{task}_{robot}_8{constraint}").engine
        part = engine.task if kind == "task" else engine.constraints[0]
        for what, channel in engine.observer.channels_of(part).items():
            bounds = f"[{channel.low:g}, {channel.high:g}]"
            row = rows.setdefault((name, what), [name, f"`{what}`", bounds, channel.unit])
            row.append(str(channel.size))
    return table([kind, "observation", "bounds", "unit", *SIZED], list(rows.values()))


def overview(kind: str, names: Iterable[str]) -> str:
    """The page of all tasks or all constraints."""
    listed = KINDS[f"{kind}s"]()
    for name in names:
        listed = re.sub(rf"^\| {name} +\|", f"| [{name}](#{name.lower()}) |", listed, flags=re.M)
    return "\n\n".join([f"# {kind.title()}s", ABOUT[kind], listed, sections(kind)]) + "\n"


def sections(kind: str) -> str:
    """A section per part of a kind, after the parameters that at least two have alike."""
    fields: dict[Any, dict[str, Any]] = {}
    for name, part in GROUPS[kind].items():
        for field in dataclasses.fields(part):  # type: ignore[arg-type]
            fields.setdefault(key_of(field), {})[name] = field
    common = {key: alike for key, alike in fields.items() if len(alike) >= 2}
    every = {*GROUPS[kind]}
    of = ["all" if {*alike} == every else ", ".join(alike) for alike in common.values()]
    shared = parameter_table([next(iter(alike.values())) for alike in common.values()], of)
    texts = [f"Parameters that several {kind}s have:", shared]
    if kind != "robot":
        texts += ["Added to the observation, with the size for some robots:", perceived(kind)]
    for name, part in GROUPS[kind].items():
        own = [f for f in dataclasses.fields(part) if key_of(f) not in common]  # type: ignore[arg-type]
        about = inspect.cleandoc(part.__doc__ or "").replace("``", "`")
        texts += [f"## {name}", pictures(kind, name), about]
        if own:
            texts += [f"Set with `{part.name or name.lower()}={{...}}`:", parameter_table(own)]
    return "\n\n".join(texts)


def robots() -> str:
    """The page of the robots, whose sections are made."""
    text = (ROOT / "docs" / "robots.md").read_text()
    return BLOCK.sub(lambda m: f"{m[1]}\n{sections('robot')}\n\n{m[2]}", text)


def thumbnails(kind: str) -> str:
    """A picture and a caption of each part of a kind, three beside each other."""
    cells: list[tuple[str, str]] = []
    for name, part in GROUPS[kind].items():
        about = re.sub(r" \([A-Z][^()]*\d{4}[^()]*\)", "", summary(part)).replace("``", "`")
        caption = f"[**{name}**]({kind}s.md#{name.lower()})<br>{about}"
        stem = f"{kind}_{name.lower()}"
        cells.append((f"![{name}](images/{stem}.webp)", caption))
    rows: list[list[str]] = []
    for k in range(0, len(cells), 3):
        three = [*cells[k : k + 3], ("", ""), ("", "")][:3]
        rows += [[image for image, _ in three], [caption for _, caption in three]]
    return table(rows[0], rows[1:])


def gallery() -> str:
    """The page that shows everything."""
    parts = [
        "# Gallery",
        "![TRPO, which ignores cost, and SAC-Lagrangian in the same place](images/trained.gif)",
        "Two of the package's agents in the same place: TRPO ignores cost, SAC-Lagrangian keeps a "
        "limit. "
        "`sb3-guard show Goal_Ant_8Ghosts --window` opens any environment in MuJoCo's viewer, and "
        "`sb3-guard enjoy --pretrained --env Goal_Point_8Hazards --record` films an agent. "
        "The pictures are made by `python scripts/render_gallery.py`.",
    ]
    parts.append("![Robots, tasks and constraints](images/poster.png)")
    for kind in GROUPS:
        parts += [f"## {kind.title()}s", CAPTIONS[kind], thumbnails(kind)]
    films = [f"![{one}](images/{one}.webp)" for one in FILES]
    parts += ["## Robots of other packages", "CPO, with limits of the robot itself."]
    parts.append(table(films, [[*FILES.values()]]))
    parts += ["## Other looks", table([f"![{one}](images/{one}.png)" for one in LOOKS],
                                      [[caption for caption in LOOKS.values()]])]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def pictures(kind: str, name: str) -> str:
    """The pictures of a part: as it is by default, and the others that the gallery has of it."""
    stem = f"{kind}_{name.lower()}"
    lines = [f"![{name}](images/{stem}.png)"]
    for file in sorted((ROOT / "docs" / "images").glob(f"{stem}_*.png")):
        lines.append(f"![{name}, {file.stem.rpartition('_')[2]}](images/{file.name})")
    return "\n".join(lines)


def examples() -> str:
    """The page of the files in ``examples/``: what each says of itself, and the file."""
    parts = [
        "# Examples",
        "Each is a file in `examples/` that runs as it is. There is also a "
        "[notebook](../examples/quickstart.ipynb).",
    ]
    for file in sorted((ROOT / "examples").glob("*.py")):
        says = (ast.get_docstring(ast.parse(file.read_text())) or "").splitlines()[0]
        code = f"```{{literalinclude}} ../examples/{file.name}\n:language: python\n```"
        parts += [f"## {says}", f"[{file.name}](../examples/{file.name})", code]
    return "\n\n".join(parts) + "\n"


def flags_of(command: type[Command]) -> dict[str, list[tuple[str, str, str]]]:
    """The flags of a command by the headings of its help: names, values, meaning."""
    headings: dict[str, list[tuple[str, str, str]]] = {}
    for group in command.parser()._action_groups:
        for action in group._group_actions:
            if action.help == argparse.SUPPRESS or action.dest == "help":
                continue
            names = ", ".join(f"`{name}`" for name in action.option_strings) or f"`{action.dest}`"
            values = action.metavar or (action.choices and " ".join(map(str, action.choices))) or ""
            values = f"`{values}`" if values and action.nargs != 0 else ""
            meaning = escaped(str(action.help).replace("%%", "%"))
            headings.setdefault(str(group.title), []).append((names, values, meaning))
    return headings


def command_line() -> str:
    """The page of the commands and their flags."""
    commands = {name: importlib.import_module(module_of(name)).Flags for name in COMMANDS}
    headings = {name: flags_of(flags) for name, flags in commands.items()}
    every = [row for of in headings.values() for rows in of.values() for row in rows]
    common = [row for row in dict.fromkeys(every) if every.count(row) >= 3]
    parts = [
        "# Command line",
        "`sb3-guard <command>` and `python -m sb3_guard.<command>` are the same (`export`: "
        "`sb3_guard.export_agent`). `--help` prints all flags of a command, "
        "and a misspelled flag or value is an error that names the nearest one or all. "
        "Flags that take KEY:VALUE take Python literals: `-params n_envs:10 normalize:True`.",
        table(
            ["command", "what it does"],
            [[f"[`{name}`](#{name})", text] for name, text in COMMANDS.items()],
        ),
        "## Flags of several commands",
        table(["flag", "value", "meaning"], common),
    ]
    for name, flags in commands.items():
        says = " ".join(flags.parser().description.split())
        examples = inspect.cleandoc(flags.examples).partition("\n")[2]
        examples = inspect.cleandoc(examples.partition("\n\n")[0])
        examples = re.sub(r" {3,}(?=\w)", "  # ", examples)
        parts += [f"## {name}", says, f"```bash\n{examples}\n```"]
        rows = [row for of in headings[name].values() for row in of]
        if own := [row for row in rows if row not in common]:
            parts.append(table(["flag", "value", "meaning"], own))
        if shared := [row[0].split(", ")[-1] for row in rows if row in common]:
            parts.append(f"[Of several commands](#flags-of-several-commands): {', '.join(shared)}.")
    return "\n\n".join(parts) + "\n"


def pages() -> dict[str, str]:
    """Every page by its path below docs/."""
    overviews = {f"{kind}s.md": overview(kind, GROUPS[kind]) for kind in ABOUT}
    others = (robots, gallery, examples, command_line)
    rest = {f"{page.__name__}.md": page() for page in others}
    return {**overviews, **rest, "parameters.md": parameters_of_environments()}


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
