"""Share trained agents on the Hugging Face hub: ``sb3-guard hub push --algo cpo …``.

They have RL-Zoo's layout, and their costs on the card.
"""

import json
import shlex
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

from sb3_guard.common.evaluation import Evaluation, evaluate_policy
from sb3_guard.zoo.agents.film import filming
from sb3_guard.zoo.agents.flags import HubFlags as Flags
from sb3_guard.zoo.agents.playback import EPISODES, Agent, means, open_agent, summary
from sb3_guard.zoo.cli.flags import command
from sb3_guard.zoo.cli.usage import UsageError, explained, import_packages, packages_flag
from sb3_guard.zoo.run.folder import RunFolder, claim, folder_name, is_run, require_writable
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
{{ means }}
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


def model_name(algo: str, env_id: str) -> str:
    """RL-Zoo's name of a model on the hub: ``cpo-Goal_Point_8Hazards-v0``."""
    return f"{algo}-{folder_name(env_id)}"


def layout(run: Path, name: str) -> dict[str, Path]:
    """Files of a repository, by name there, and where a run's folder has them."""
    return {
        "0.monitor.csv": run / "0.monitor.csv",
        "config.yml": run / name / "config.yml",
        "command.txt": run / name / "command.txt",
        "vec_normalize.pkl": run / name / "vecnormalize.pkl",
        "args.yml": run / name / "args.yml",  # last: it makes the folder a run
    }


def push(flags: Flags) -> int:
    """Evaluate an agent, write its card, film it, and upload all to the hub."""
    require_writable(Path(flags.to or tempfile.gettempdir()), "--to")
    agent = open_agent(flags, None if flags.no_video else "rgb_array")
    flags.repo_name = flags.repo_name or model_name(flags.algo, agent.env_id)
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
    Write everything that goes to the hub into a folder.

    :param agent: the agent and its environment
    :param flags: of the command
    :param folder: made if it is not there; files of the same names are replaced
    :raises UsageError: the agent can't be filmed
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, source in layout(agent.run.path, agent.run.name).items():
        if source.is_file():
            shutil.copyfile(source, folder / name)
    shutil.copyfile(agent.path, folder / f"{model_name(flags.algo, agent.env_id)}.zip")
    normalizer = unwrap_vec_normalize(agent.env)
    if normalizer is not None:  # the model's, which may not be the run's last one
        normalizer.save(str(folder / "vec_normalize.pkl"))
    trained = agent.run.args()
    trained |= {name: Path(trained[name]).name for name in PATHS if trained.get(name)}
    (folder / "args.yml").write_text(yaml.safe_dump(trained), encoding="utf-8")
    (folder / "command.txt").write_text(command_of(agent), encoding="utf-8")
    how: dict[str, Any] = {"deterministic": not flags.stochastic, "seed": flags.seed}
    evaluation = evaluate_policy(agent.model, agent.env, flags.n_episodes or EPISODES, **how)
    if not flags.no_video:
        with filming(agent.env, agent.model, folder / "replay.mp4") as env:
            evaluate_policy(agent.model, env, 1, **how)
    results = summary(evaluation)
    results["is_deterministic"] = not flags.stochastic
    (folder / "results.json").write_text(json.dumps(results, indent=2), encoding="utf-8")
    card(agent, flags, evaluation).save(folder / "README.md")


def card(agent: Agent, flags: Flags, evaluation: Evaluation) -> ModelCard:
    """The model card: metadata that the hub reads, and a page that people read."""
    env, results = agent.env_id, summary(evaluation)
    scores = [
        EvalResult(
            task_type="reinforcement-learning", dataset_name=env, dataset_type=env,
            metric_type=kind, metric_value="{mean:.2f} +/- {std:.2f}".format(**results[key]),
        )
        for kind, key in (("mean_reward", "return"), ("mean_cost", "cost"))
    ]  # fmt: skip
    data = ModelCardData(
        library_name="stable-baselines3",
        tags=[env, *TAGS],
        model_name=type(agent.model).__name__,
        eval_results=scores,
    )
    return ModelCard.from_template(
        data,
        template_str=CARD,
        env=env,
        which=f"--algo {flags.algo} --env {env}",
        organization=flags.organization,
        repo=flags.repo_name,
        packages=packages_flag(agent.run.args().get("gym_packages") or []),
        actions="sampled" if flags.stochastic else "the most likely",
        means=means(evaluation),
        command=command_of(agent),
        hyperparams=yaml.safe_dump(agent.run.hyperparams()),
    )


def command_of(agent: Agent) -> str:
    """The command line of a run, with the names of files, but not where they lie here."""
    words = shlex.split(agent.run.flags().command())
    return shlex.join(Path(word).name if Path(word).is_absolute() else word for word in words)


def load(flags: Flags) -> int:
    """Download an agent into a new run folder, where ``enjoy`` and ``train -i`` find it."""
    import_packages(flags.gym_packages)
    if is_run(Path(flags.folder)):
        raise UsageError(f"--folder {flags.folder!r} is a run: name the folder that gets a new one")
    flags.env = str(source_of(flags.env).env_id)
    name = model_name(flags.algo, flags.env)
    repo_id = f"{flags.organization}/{flags.repo_name or name}"
    require_writable(Path(flags.folder), "--folder")
    print(TRUST)
    with _network(f"the download of {repo_id}"):
        downloaded = Path(huggingface_hub.snapshot_download(repo_id))
    run = install(downloaded, name, flags)
    print(f"Run folder: {run.path}")
    return 0


def install(downloaded: Path, name: str, flags: Flags) -> RunFolder:
    """
    Make a run folder of what was downloaded.

    :param downloaded: folder with the files that :func:`stage` writes
    :param name: name of the model
    :raises UsageError: the model or its settings are not there
    """
    files = {path.name for path in downloaded.iterdir() if path.is_file()}
    if absent := {f"{name}.zip", "config.yml", "args.yml"} - files:
        raise UsageError(
            f"the repository has no file {', '.join(sorted(absent))}, but "
            f"{', '.join(sorted(files)) or 'nothing'}; name the agent's own --algo and --env"
        )
    env = folder_name(flags.env)
    parent = Path(flags.folder) / flags.algo
    parent.mkdir(parents=True, exist_ok=True)
    path = claim(parent, env)
    (path / env).mkdir()
    shutil.copyfile(downloaded / f"{name}.zip", path / f"{env}.zip")
    for file, target in layout(path, env).items():
        if file in files:
            shutil.copyfile(downloaded / file, target)
    return RunFolder(path)


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
