"""Trained agents on the Hugging Face hub, in RL-Zoo's layout, with their costs on the card."""

import json
import shlex
import shutil
import tempfile
from collections.abc import Mapping
from contextlib import AbstractContextManager, closing, suppress
from pathlib import Path
from typing import Any

import yaml

from sb3_guard.algorithms.common.limits import limits_at
from sb3_guard.common.evaluation import evaluate_policy
from sb3_guard.zoo.agents import export
from sb3_guard.zoo.agents.film import filming
from sb3_guard.zoo.agents.flags import HubFlags
from sb3_guard.zoo.agents.playback import Agent, open_agent, summary
from sb3_guard.zoo.cli.usage import UsageError, explained, packages_flag
from sb3_guard.zoo.run.folder import RunFolder, claim, folder_name, read_data, require_writable
from sb3_guard.zoo.run.make_envs import full_id

# Said before an agent is downloaded.
TRUST = "agents are programs: load only from people you trust"
EPISODES = 10  # that the card tells of
TAGS = ("reinforcement-learning", "safe-reinforcement-learning", "stable-baselines3", "sb3-guard")
# Flags that name files of this machine
PATHS = ("log_folder", "tensorboard_log", "conf_file", "trained_agent")

CARD = """
# {name} on {env}

A **{name}** agent for **{env}**, trained with
[sb3_guard](https://arxiv.org/abs/2305.13681) for Stable-Baselines3.

| {episodes} episodes, {actions} actions | mean | std | 95 % interval of the mean |
|---|---|---|---|
{rows}

Cost is the undiscounted sum of `info["cost"]` over an episode{limit}.

## Play it

```bash
pip install .   # in a clone of sb3_guard's repository
sb3-guard hub load --repo-id {repo_id} --algo {algo} --env {env} -f logs
sb3-guard enjoy --algo {algo} --env {env} -f logs{packages}
```

## Train it again

```bash
{command}
```

```yaml
{hyperparams}```
"""


def model_name(algo: str, env_id: str) -> str:
    """RL-Zoo's name of a model on the hub: ``cpo-Goal_Point_8Hazards-v0``."""
    return f"{algo}-{folder_name(env_id)}"


def push(flags: HubFlags) -> int:
    """Evaluate an agent, write its card, film it, and upload all to the hub."""
    require_writable(Path(flags.to or tempfile.gettempdir()), "--to")
    agent = open_agent(flags, None if flags.no_video else "rgb_array")
    with closing(agent.env):
        name = flags.repo_name or model_name(flags.algo, agent.env_id)
        repo_id = f"{flags.organization}/{name}"
        folder = Path(flags.to or tempfile.mkdtemp(prefix="sb3_guard_hub_"))
        stage(agent, flags, repo_id, folder)
    print(f"Ready to upload: {folder}")
    if flags.dry_run:
        return 0
    from huggingface_hub import HfApi

    with _network(f"the upload of {folder} to {repo_id}"):
        api = HfApi()
        api.create_repo(repo_id, private=flags.private, exist_ok=True)
        url = api.upload_folder(
            repo_id=repo_id, folder_path=folder, commit_message=flags.commit_message
        )
    print(f"Uploaded: {url}")
    return 0


def stage(agent: Agent, flags: HubFlags, repo_id: str, folder: Path) -> None:
    """
    Write everything that goes to the hub into a folder.

    :param agent: the agent and its environment
    :param flags: of the command
    :param repo_id: ``organization/name``
    :param folder: made if it is not there; files of the same names are replaced
    :raises UsageError: the agent can't be filmed
    """
    folder.mkdir(parents=True, exist_ok=True)
    statistics = agent.normalizer if agent.normalizer.suffix == ".pkl" else Path("none")
    for source, name in {
        agent.path: f"{model_name(flags.algo, agent.env_id)}.zip",
        agent.run.params / "config.yml": "config.yml",
        agent.run.monitor: agent.run.monitor.name,
        statistics: "vec_normalize.pkl",
    }.items():
        if source.is_file():
            shutil.copyfile(source, folder / name)
    trained = agent.run.args()
    trained |= {name: Path(trained[name]).name for name in PATHS if trained.get(name)}
    (folder / "args.yml").write_text(yaml.safe_dump(trained), encoding="utf-8")
    (folder / "command.txt").write_text(command(agent.run), encoding="utf-8")
    how: dict[str, Any] = {"deterministic": not flags.stochastic, "seed": flags.seed}
    results = summary(evaluate_policy(agent.model, agent.env, flags.n_episodes or EPISODES, **how))
    if not flags.no_video:
        with filming(agent.env, agent.model, folder / "replay.mp4") as env:
            evaluate_policy(agent.model, env, 1, **how)
    try:
        export.write(agent, flags, folder / "policy.onnx", results)
    except UsageError as error:
        print(f"There is no policy.onnx: {error}")
    results["is_deterministic"] = not flags.stochastic
    (folder / "results.json").write_text(json.dumps(results, indent=2), encoding="utf-8")
    (folder / "README.md").write_text(card(agent, flags, repo_id, results), encoding="utf-8")


def card(agent: Agent, flags: HubFlags, repo_id: str, results: Mapping[str, Any]) -> str:
    """The model card: metadata that the hub reads, and a page that people read."""
    from huggingface_hub import EvalResult, ModelCardData

    name = type(agent.model).__name__
    data = ModelCardData(
        library_name="stable-baselines3",
        tags=[agent.env_id, *TAGS],
        model_name=name,
        eval_results=[
            EvalResult(
                task_type="reinforcement-learning",
                task_name="reinforcement-learning",
                dataset_name=agent.env_id,
                dataset_type=agent.env_id,
                metric_type=kind,
                metric_name=kind,
                metric_value=f"{results[key]['mean']:.2f} +/- {results[key]['std']:.2f}",
            )
            for kind, key in (("mean_reward", "return"), ("mean_cost", "cost"))
        ],
    )
    rows = []
    for key, one in results.items():
        if not isinstance(one, dict):
            continue
        interval = "–" if one["low"] is None else f"{one['low']:.2f} to {one['high']:.2f}"
        spread = "–" if one["low"] is None else f"{one['std']:.2f}"
        rows.append(f"| {key} | {one['mean']:.2f} | {spread} | {interval} |")
    limit = limits_at(getattr(agent.model, "cost_limit", None), 0.0)
    constrained = getattr(agent.model, "constrained", False) and limit is not None
    worst = " on the worst step" if "worst" in results else ""
    page = CARD.format(
        name=name,
        env=agent.env_id,
        algo=flags.algo,
        packages=packages_flag(agent.run.args().get("gym_packages") or []),
        repo_id=repo_id,
        episodes=results["episodes"],
        actions="sampled" if flags.stochastic else "most likely",
        rows="\n".join(rows),
        limit=f"; the agent was trained under a limit of {limit}{worst}" if constrained else "",
        command=command(agent.run),
        hyperparams=yaml.safe_dump(agent.run.hyperparams()),
    )
    return f"---\n{data.to_yaml()}\n---\n{page}"


def command(run: RunFolder) -> str:
    """The command line of a run, with the names of files, but not where they lie here."""
    words = []
    with suppress(OSError, ValueError):  # absent, or a quotation mark that nothing closes
        words = shlex.split((run.params / "command.txt").read_text(encoding="utf-8"))
    # The interpreter's own path and flags are this machine's: what follows is the command.
    if "-m" in words:
        words = ["python", *words[words.index("-m") :]]
    else:
        starts = [k for k, word in enumerate(words) if Path(word).stem == "sb3-guard"]
        words = ["sb3-guard", *words[starts[0] + 1 :]] if starts else words
    return shlex.join(Path(word).name if Path(word).is_absolute() else word for word in words)


def load(flags: HubFlags) -> int:
    """Download an agent into a new run folder, where ``enjoy`` and ``train -i`` find it."""
    try:
        flags.env = full_id(flags.env)
    except UsageError:
        # The environment may be unknown to this process: the repository says which it is.
        if not (flags.repo_id or flags.gym_packages):
            raise
    name = model_name(flags.algo, flags.env)
    repo_id = flags.repo_id or f"{flags.organization}/{flags.repo_name or name}"
    require_writable(Path(flags.folder), "--folder")
    from huggingface_hub import snapshot_download

    print(TRUST)
    with _network(f"the download of {repo_id}"):
        downloaded = Path(snapshot_download(repo_id))
    run = install(downloaded, name, flags)
    print(f"Run folder: {run.path}")
    return 0


def install(downloaded: Path, name: str, flags: HubFlags) -> RunFolder:
    """
    Make a run folder of what was downloaded.

    :param downloaded: folder with the files that :func:`stage` writes
    :param name: name of the model
    :raises UsageError: the model or its settings are not there, or they are another agent's
    """
    model = downloaded / f"{name}.zip"
    own = "name the agent's own --algo and --env"
    for needed in (model, downloaded / "config.yml", downloaded / "args.yml"):
        if not needed.is_file():
            found = ", ".join(sorted(one.name for one in downloaded.iterdir())) or "nothing"
            raise UsageError(f"the repository has no {needed.name}, but {found}; {own}")
    env = folder_name(flags.env)
    trained = read_data(downloaded / "args.yml")
    if (trained.get("algo"), folder_name(str(trained.get("env")))) != (flags.algo, env):
        raise UsageError(
            f"the repository's agent is {trained.get('algo')} on {trained.get('env')} by its "
            f"args.yml, not {flags.algo} on {flags.env}; {own}"
        )
    parent = Path(flags.folder) / flags.algo
    parent.mkdir(parents=True, exist_ok=True)
    path = claim(parent, env)
    (path / env).mkdir()
    shutil.copyfile(model, path / f"{env}.zip")
    for file, target in {
        "0.monitor.csv": path / "0.monitor.csv",
        "config.yml": path / env / "config.yml",
        "command.txt": path / env / "command.txt",
        "vec_normalize.pkl": path / env / "vecnormalize.pkl",
        "args.yml": path / env / "args.yml",  # last: it makes the folder a run
    }.items():
        if (downloaded / file).is_file():
            shutil.copyfile(downloaded / file, target)
    return RunFolder(path)


def _network(what: str) -> AbstractContextManager[None]:
    """Say in one line what the network, the hub or the lack of a login made impossible."""
    # Its client raises what it likes.
    text = f"{what} failed: the hub can't be reached, or needs a login (hf auth login)"
    return explained(text, fix="then run the command again")
