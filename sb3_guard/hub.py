"""Share trained agents on the Hugging Face hub: ``sb3-guard hub push --algo cpo …``.

A repository is a run folder, as RL-Zoo lays it out, with a card that tells return and costs.
"""

import dataclasses
import json
import shutil
import sys
import tempfile
from contextlib import AbstractContextManager, closing
from pathlib import Path
from typing import Any

import huggingface_hub
import yaml
from huggingface_hub import EvalResult, ModelCard, ModelCardData
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_guard.common.evaluation import evaluate_policy
from sb3_guard.zoo.agents.film import filming
from sb3_guard.zoo.agents.flags import HubFlags as Flags
from sb3_guard.zoo.agents.playback import EPISODES, Agent, open_agent, summary
from sb3_guard.zoo.cli.flags import command
from sb3_guard.zoo.cli.usage import UsageError, explained, import_packages, packages_flag
from sb3_guard.zoo.run.folder import RunFolder, claim, folder_name, is_run
from sb3_guard.zoo.run.make_envs import source_of

# Said before an agent is downloaded.
TRUST = "agents are programs: load only from people you trust"
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

```bash
pip install .   # in a clone of sb3_guard's repository
sb3-guard hub load {{ which }} -orga {{ organization }} -name {{ repo }} -f logs{{ packages }}
sb3-guard enjoy {{ which }} -f logs{{ packages }}
```

## Train it again

```bash
{{ command }}
```

```yaml
{{ hyperparams }}```
"""


def push(flags: Flags) -> int:
    """Evaluate an agent, write its card, film it, and upload all to the hub."""
    agent = open_agent(flags, None if flags.no_video else "rgb_array")
    flags.repo_name = flags.repo_name or f"{flags.algo}-{agent.run.name}"
    folder = Path(flags.to or tempfile.mkdtemp(prefix="sb3_guard_hub_"))
    with closing(agent.env):
        stage(agent, flags, folder)
    print(f"Ready to upload: {folder}")
    if flags.to:
        return 0
    repo_id = f"{flags.organization}/{flags.repo_name}"
    with _network(f"the upload of {folder} to {repo_id}"):
        api = huggingface_hub.HfApi()
        api.create_repo(repo_id, private=flags.private, exist_ok=True)
        url = api.upload_folder(
            repo_id=repo_id, folder_path=folder, commit_message=flags.commit_message
        )
    print(f"Uploaded: {url}")
    return 0


def stage(agent: Agent, flags: Flags, folder: Path) -> None:
    """
    Write everything that goes to the hub into a folder: a run folder with a card.

    :param agent: the agent and its environment
    :param flags: of the command
    :param folder: made if it is not there; files of the same names are replaced
    :raises UsageError: the folder can't be written to, or the agent can't be filmed
    """
    trained = agent.run.flags()
    # names of files, but not where they lie here
    files: dict[str, Any] = {n: Path(getattr(trained, n) or "").name for n in PATHS}
    trained = dataclasses.replace(trained, **{n: file for n, file in files.items() if file})
    command, hyperparams = trained.command(), agent.run.hyperparams()
    run = RunFolder.create(trained, hyperparams, command, folder)
    shutil.copyfile(agent.path, run.model)
    if agent.run.monitor.is_file():
        shutil.copyfile(agent.run.monitor, run.monitor)
    normalizer = unwrap_vec_normalize(agent.env)
    if normalizer is not None:  # the model's, which may not be the run's last one
        normalizer.save(str(run.normalizer))
    certificate = agent.certificate
    for path in agent.run.path.glob("certifi*") if certificate else ():
        shutil.copyfile(path, folder / path.name)
    how: dict[str, Any] = {"deterministic": not flags.stochastic, "seed": flags.seed}
    evaluation = evaluate_policy(agent.model, agent.env, flags.n_episodes or EPISODES, **how)
    if not flags.no_video:
        with filming(agent.env, agent.model, folder / "replay.mp4") as film:
            evaluate_policy(agent.model, agent.env, 1, on_step=film, **how)
    results = summary(evaluation)
    results["is_deterministic"] = not flags.stochastic
    (folder / "results.json").write_text(json.dumps(results, indent=2), encoding="utf-8")
    data = ModelCardData(
        library_name="stable-baselines3",
        tags=[agent.env_id, *TAGS],
        model_name=type(agent.model).__name__,
        eval_results=[
            EvalResult(
                task_type="reinforcement-learning",
                dataset_name=agent.env_id,
                dataset_type=agent.env_id,
                metric_type=kind,
                metric_value="{mean:.2f} +/- {std:.2f}".format(**results[key]),
            )
            for kind, key in (("mean_reward", "return"), ("mean_cost", "cost"))
        ],
    )
    card = ModelCard.from_template(
        data,
        template_str=CARD,
        env=agent.env_id,
        which=f"--algo {flags.algo} --env {agent.env_id}",
        organization=flags.organization,
        repo=flags.repo_name,
        packages=packages_flag(trained.gym_packages),
        actions="sampled" if flags.stochastic else "the most likely",
        evaluation=f"{evaluation}\n{certificate or ''}".rstrip(),
        command=command,
        hyperparams=yaml.safe_dump(hyperparams),
    )
    card.save(folder / "README.md")


def load(flags: Flags) -> int:
    """Download an agent into a new run folder, where ``enjoy`` and ``train -i`` find it."""
    import_packages(flags.gym_packages)
    if is_run(Path(flags.folder)):
        raise UsageError(f"--folder {flags.folder!r} is a run: name the folder that gets a new one")
    env = folder_name(str(source_of(flags.env).env_id))
    repo_id = f"{flags.organization}/{flags.repo_name or f'{flags.algo}-{env}'}"
    print(TRUST)
    with _network(f"the download of {repo_id}"):
        downloaded = Path(huggingface_hub.snapshot_download(repo_id))
    run = RunFolder(downloaded)
    there = run.args().get("algo"), run.name
    if there != (flags.algo, env):
        raise UsageError(
            "the repository has an agent of {} on {}; name its own --algo and --env".format(*there)
        )
    parent = Path(flags.folder) / flags.algo
    with explained(f"can't write to {parent}", OSError):
        parent.mkdir(parents=True, exist_ok=True)
        path = claim(parent, env)
        shutil.copytree(downloaded, path, dirs_exist_ok=True)
    print(f"Run folder: {path}")
    return 0


def _network(what: str) -> AbstractContextManager[None]:
    """Say in one line what the network, the hub or the lack of a login made impossible."""
    # Its client raises what it likes.
    text = f"{what} failed: the hub can't be reached, or needs a login (hf auth login)"
    return explained(text, fix="then run the command again")


def hub(flags: Flags) -> int:
    """Upload an agent, or download one."""
    if flags.pretrained:
        raise UsageError("hub takes agents of your runs, not those of --pretrained")
    return push(flags) if flags.direction == "push" else load(flags)


main = command(Flags, hub)

if __name__ == "__main__":
    sys.exit(main())
