"""Prepare an agent for the Hugging Face hub: ``sb3-guard hub logs/cpo/Goal_Point_8Hazards-v0_1``.

What is written is a run folder, as RL-Zoo lays it out, with a card that tells return and costs; the
hub's own command uploads it (``hf upload me/my_agent agent``) and downloads it.
"""

import shutil
import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from sb3_guard.judging import Mean
from sb3_guard.zoo.agents.flags import AgentFlags
from sb3_guard.zoo.agents.playback import open_agent
from sb3_guard.zoo.cli.flags import Command, command, flag
from sb3_guard.zoo.cli.usage import UsageError, packages_flag
from sb3_guard.zoo.run.folder import PLAYED, RunFolder
from sb3_guard.zoo.run.progress import summary

# Flags that name files of this machine
PATHS = ("log_folder", "tensorboard_log", "conf_file", "trained_agent")
CARD = """---
library_name: stable-baselines3
tags: [{env}, reinforcement-learning, safe-reinforcement-learning, stable-baselines3, sb3-guard]
---
# {label} on {env}

An agent of [sb3_guard](https://arxiv.org/abs/2305.13681) for Stable-Baselines3:

```
{figures}
```

Cost is the undiscounted sum of `info["cost"]` over an episode. An agent is a program: load only
those of people you trust. `NAME` is the name of this repository.

```bash
pip install .   # in a clone of sb3_guard's repository
hf download NAME --local-dir {folder}
sb3-guard enjoy -f {folder}{packages}
{command}   # trains it again
```
"""


@dataclass
class Flags(Command):
    """
    Write an agent and its model card into a folder that is ready for the Hugging Face hub.

    The command hf uploads and downloads it. Downloaded agents are programs: load only from people
    you trust.

    :param run: folder of a finished run
    :param output: folder to write to (default: agent)
    :param gym_packages: modules that the training imported, of a run with a certificate
    """

    prog: ClassVar[str] = "sb3-guard hub"
    examples: ClassVar[str] = """examples:
  sb3-guard hub logs/cpo/Goal_Point_8Hazards-v0_1 -o agent
  hf upload me/cpo-Goal_Point_8Hazards-v0 agent
  hf download me/cpo-Goal_Point_8Hazards-v0 --local-dir logs/cpo/Goal_Point_8Hazards-v0_1
"""
    run: str = flag(default="", positional=True, metavar="RUN")
    output: str = flag("-o", default="agent", metavar="DIR")
    gym_packages: list[str] = flag(default=[], metavar="MODULE")


def uploaded(run: RunFolder) -> list[Path]:
    """The files of a run that are given away; raises UsageError for a link that leaves the run."""
    paths = [run.params / name for name in ("args.yml", "config.yml", "command.txt")]
    paths += [run.model, run.normalizer, run.monitor, run.path / "certificate.json"]
    for name in ("best_model", "certified_model"):
        paths += [run.path / f"{name}.zip", run.path / f"{name}_vecnormalize.pkl"]
    for path in paths:
        if not path.resolve().is_relative_to(run.path.resolve()):
            raise UsageError(f"{path} is a link that leaves the run folder; replace it by the file")
    return [path for path in paths if path.is_file()]


def empty(folder: Path) -> None:
    """Remove the agent that was written there before; raises UsageError if anything else is."""
    there = {path for top in folder.glob("[!.]*") for path in (top, *top.glob("*"))}
    if (card := folder / "README.md").is_file() and b"sb3_guard" in card.read_bytes():
        before = RunFolder(folder)
        there -= {card, before.params, *uploaded(before)}
    if there:
        raise UsageError(f"{folder} holds files of others, {min(there)}; name an empty one with -o")
    for path in folder.glob("[!.]*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def hub(flags: Flags) -> int:
    """Write the run's models, their certificate, and a card."""
    run, folder = RunFolder(Path(flags.run)), Path(flags.output)
    files = uploaded(run)
    result, trained, hyperparams = run.checked_result(), run.flags(), run.hyperparams()
    for name in PATHS:  # files have names, but not where they lie here
        setattr(trained, name, getattr(trained, name) and Path(getattr(trained, name)).name)
    at = "" if result["cost_limit"] is None else f" at cost limit {result['cost_limit']}"
    figures = [f"{result['n_timesteps']:,} steps{at}, last epoch: {summary(result)}"]
    for actions, played in result["final"].items():
        numbers = (Mean.of(np.array(played[name], float)) for name in ("returns", "costs"))
        figures.append("{}: return {}, cost {}".format(PLAYED[actions], *numbers))
    if (file := run.path / "certificate.json").is_file():
        if not (run.path / "certified_model.zip").is_file():
            raise UsageError(f"{file} is of no certified_model.zip: move it elsewhere")
        named = {"folder": str(run.path), "gym_packages": flags.gym_packages}
        agent = open_agent(AgentFlags.of(named), None)
        with closing(agent.env):
            figures.append(agent.certified)
    empty(folder)
    RunFolder.create(trained, hyperparams, trained.command(), folder)
    for path in files:
        if not (copied := folder / path.relative_to(run.path)).exists():  # settings are written
            shutil.copyfile(path, copied)
    card = CARD.format(
        env=trained.env,
        label=result["label"] or trained.algo,
        figures="\n".join(figures),
        folder=f"logs/{trained.algo}/{run.name}_1",
        packages=packages_flag(trained.gym_packages),
        command=trained.command(),
    )
    (folder / "README.md").write_text(card, encoding="utf-8")
    print(f"Upload it to a repository of yours: hf upload YOU/{trained.algo}-{run.name} {folder}")
    return 0


main = command(Flags, hub)

if __name__ == "__main__":
    sys.exit(main())
