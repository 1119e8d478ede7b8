"""Prepare an agent for the Hugging Face hub: ``sb3-guard hub --algo cpo … -o agent``.

What is written is a run folder, as RL-Zoo lays it out, with a card that tells return and costs; the
hub's own command uploads it (``hf upload me/my_agent agent``) and downloads it.
"""

import dataclasses
import shutil
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from huggingface_hub import EvalResult, ModelCard, ModelCardData
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_guard.common.evaluation import Evaluation, evaluate_policy
from sb3_guard.zoo.agents.film import filming
from sb3_guard.zoo.agents.flags import HubFlags as Flags
from sb3_guard.zoo.agents.playback import EPISODES, Agent, open_agent
from sb3_guard.zoo.cli.flags import command
from sb3_guard.zoo.cli.usage import UsageError, packages_flag
from sb3_guard.zoo.run.folder import RunFolder

TAGS = ("reinforcement-learning", "safe-reinforcement-learning", "stable-baselines3", "sb3-guard")
# Flags that name files of this machine
PATHS = ("log_folder", "tensorboard_log", "conf_file", "trained_agent")

CARD = """---
{{ card_data }}
---
# {{ model_name }} on {{ env }}

A **{{ model_name }}** agent for **{{ env }}**, trained with
[sb3_guard](https://arxiv.org/abs/2305.13681) for Stable-Baselines3. With {{ actions }} actions:

```
{{ evaluation }}
```

Cost is the undiscounted sum of `info["cost"]` over an episode.

## Play it

An agent is a program: load only those of people you trust. `NAME` is the name of this repository.

```bash
pip install .   # in a clone of sb3_guard's repository
hf download NAME --local-dir {{ folder }}
sb3-guard enjoy -f {{ folder }}{{ packages }}
```

## Train it again

```bash
{{ command }}
```

```yaml
{{ hyperparams }}```
"""


def stage(agent: Agent, flags: Flags) -> None:
    """
    Write everything that goes to the hub into a folder.

    :param agent: the agent and its environment
    :param flags: of the command
    :raises UsageError: the folder can't be written to, or the agent can't be filmed
    """
    folder, trained = Path(flags.output), agent.run.flags()
    # names of files, but not where they lie here
    files: dict[str, Any] = {n: Path(getattr(trained, n) or "").name for n in PATHS}
    trained = dataclasses.replace(trained, **{n: file for n, file in files.items() if file})
    run = RunFolder.create(trained, agent.run.hyperparams(), trained.command(), folder)
    shutil.copyfile(agent.path, run.model)
    if agent.run.monitor.is_file():
        shutil.copyfile(agent.run.monitor, run.monitor)
    normalizer = unwrap_vec_normalize(agent.env)
    if normalizer is not None:  # the model's, which may not be the run's last one
        normalizer.save(str(run.normalizer))
    for path in agent.run.path.glob("certifi*") if agent.certificate else ():
        shutil.copyfile(path, folder / path.name)
    how: dict[str, Any] = {"deterministic": not flags.stochastic, "seed": flags.seed}
    evaluation = evaluate_policy(agent.model, agent.env, flags.n_episodes or EPISODES, **how)
    if not flags.no_video:
        with filming(agent.env, agent.model, folder / "replay.mp4") as film:
            evaluate_policy(agent.model, agent.env, 1, on_step=film, **how)
    card(agent, run, flags, evaluation).save(folder / "README.md")


def card(agent: Agent, run: RunFolder, flags: Flags, evaluation: Evaluation) -> ModelCard:
    """The model card: metadata that the hub reads, and a page that people read."""
    data = ModelCardData(
        library_name="stable-baselines3",
        tags=[agent.env_id, *TAGS],
        model_name=type(agent.model).__name__,
        eval_results=[
            EvalResult(
                "reinforcement-learning",
                dataset_type=agent.env_id,
                dataset_name=agent.env_id,
                metric_type=kind,
                metric_value=f"{np.mean(values):.2f} +/- {np.std(values):.2f}",
            )
            for kind, values in (
                ("mean_reward", evaluation.returns),
                ("mean_cost", evaluation.costs),
            )
        ],
    )
    trained = run.flags()
    return ModelCard.from_template(
        data,
        template_str=CARD,
        model_name=data.model_name,
        env=agent.env_id,
        folder=f"logs/{flags.algo}/{run.name}_1",
        packages=packages_flag(trained.gym_packages),
        actions="sampled" if flags.stochastic else "the most likely",
        evaluation=f"{evaluation}\n{agent.certificate or ''}".rstrip(),
        command=trained.command(),
        hyperparams=yaml.safe_dump(run.hyperparams()),
    )


def hub(flags: Flags) -> int:
    """Evaluate an agent, film it, and write it with its card."""
    if flags.pretrained:
        raise UsageError("hub takes agents of your runs, not those of --pretrained")
    agent = open_agent(flags, None if flags.no_video else "rgb_array")
    with closing(agent.env):
        stage(agent, flags)
    name = f"{flags.algo}-{agent.run.name}"
    print(f"Upload it to a repository of yours: hf upload YOU/{name} {flags.output}")
    return 0


main = command(Flags, hub)

if __name__ == "__main__":
    sys.exit(main())
