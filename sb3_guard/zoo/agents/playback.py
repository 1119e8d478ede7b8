"""A trained agent found in its run folder, played, and filmed."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_guard.common.certificate import Certificate
from sb3_guard.common.delivery import MODEL
from sb3_guard.common.evaluation import evaluate_policy
from sb3_guard.ids import with_version
from sb3_guard.zoo.agents.dataset import recording
from sb3_guard.zoo.agents.film import filming, render
from sb3_guard.zoo.agents.flags import AgentFlags, EnjoyFlags
from sb3_guard.zoo.agents.pretrained import (
    PRETRAINED,
    certificates,
    find_pretrained,
    load_pretrained,
    weights,
)
from sb3_guard.zoo.cli.names import require_named
from sb3_guard.zoo.cli.usage import UsageError, explained, import_packages, packages_flag
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.checkpoint import load_model, read_normalizer
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder, folder_name, is_run, latest_run
from sb3_guard.zoo.run.hyperparams import check, merged
from sb3_guard.zoo.run.make_envs import BAD_NUMBERS, source_of
from sb3_guard.zoo.run.run import Run

EPISODES = 100  # as many as tell whether a limit is kept, in training's final ones, too
BATCH = 50  # environments of sb3_guard at once
VIDEO = {"width": 960, "height": 720}  # pixels, where the user has not said otherwise


def find_run(
    folder: str | Path, algo: str, env_id: str, number: int = 0, packages: Sequence[str] = ()
) -> RunFolder:
    """
    The folder of a run.

    :param folder: log folder
    :param env_id: without a version it is the latest one
    :param number: of the run; 0: the latest, -1: ``<folder>/<algo>`` itself, as in RL-Zoo
    :param packages: modules that the environment needs, for the command in the message
    :raises UsageError: there is none
    """
    parent, name = Path(folder) / algo, folder_name(with_version(env_id))
    number = number or latest_run(parent, name)
    if number:
        return RunFolder(parent if number < 0 else parent / f"{name}_{number}")
    algorithm(algo), source_of(env_id)  # a misspelled name has a message of its own
    raise UsageError(
        f"there is no run of {algo} on {env_id} in {str(folder)!r}; train one with: "
        f"sb3-guard train --algo {algo} --env {env_id} -f {folder}{packages_flag(packages)}"
    )


def only_algorithm(folder: str, env_id: str, default: str) -> str:
    """The algorithm that has runs of an environment; raises UsageError where several have."""
    name = folder_name(with_version(env_id))
    algos = sorted(path.name for path in Path(folder).glob("*") if latest_run(path, name))
    if len(algos) > 1:
        raise UsageError(f"{folder!r} has runs of {env_id} by {', '.join(algos)}: add --algo")
    return algos[0] if algos else default


def find_model(run: RunFolder, flags: AgentFlags) -> tuple[Path, Path]:
    """
    The model that the flags ask for, and where its observation statistics are, if it has any.

    Without a flag: the certified model, else the final one, or the checkpoint of a run that has not
    come to its end.

    :raises UsageError: the run has no such model
    """
    kept = {int(path.stem.split("_")[2]): path for path in run.path.glob("rl_model_*_steps.zip")}
    steps = flags.load_checkpoint
    if flags.load_last_checkpoint:
        steps = max(kept, default=None)
    if flags.load_best:
        model, statistics = run.path / "best_model.zip", run.path / "best_model_vecnormalize.pkl"
    elif steps is not None:
        if steps not in kept:
            allowed = ", ".join(map(str, sorted(kept))) or "none"
            raise UsageError(f"{run.path} kept no model at {steps} steps; allowed: {allowed}")
        model, statistics = kept[steps], run.path / f"rl_model_vecnormalize_{steps}_steps.pkl"
    elif all((run.path / name).is_file() for name in ("certificate.json", MODEL)) and not (
        flags.load_final or flags.load_last_checkpoint
    ):
        model = run.path / MODEL
        statistics = run.path / "certified_model_vecnormalize.pkl"
    elif run.model.is_file() and not flags.load_last_checkpoint:
        model, statistics = run.model, run.normalizer
    else:
        model = statistics = run.checkpoint
    if not model.is_file():
        fix = "the run has not reached that point"
        if flags.load_best and run.model.is_file():
            fix = "the run ended before an evaluation; --load-final takes its last model"
        raise UsageError(f"there is no {model}: {fix}")
    return model, statistics


@dataclass
class Agent:
    """
    A trained agent and an environment to play it in.

    :param run: where it comes from
    :param path: its model file
    :param env_id: full id of the environment
    :param stochastic: whether its actions are sampled
    """

    run: RunFolder
    path: Path
    env_id: str
    model: BaseAlgorithm
    env: VecEnv
    stochastic: bool

    @property
    def certificate(self) -> Certificate | None:
        """The certificate of this very agent, in this environment, with such actions."""
        there = self._filed()
        return None if there is None or self._foreign(there) else there

    @property
    def certified(self) -> str:
        """The certificate, or of what else the one beside the agent is; empty: there is none."""
        there = self._filed()
        if there is None:
            return ""
        foreign = self._foreign(there)
        return f"Its certificate is of {foreign}" if foreign else str(there)

    @property
    def certified_sampled(self) -> bool:
        """Whether the agent of a run is certified with sampled actions, in whatever environment."""
        there = None if PRETRAINED in self.path.parents else self._filed()
        ours = there is not None and self._foreign(there) != "another agent"
        return ours and there is not None and not there.deterministic

    def _filed(self) -> Certificate | None:
        """The certificate that lies beside the agent, whatever it is of."""
        if PRETRAINED in self.path.parents:
            return certificates(self.run)["stochastic" if self.stochastic else "deterministic"]
        file = self.path.with_name("certificate.json")
        if self.path.name != MODEL or not file.is_file():
            return None
        with explained(f"{file} is damaged"):
            return Certificate.from_json(file.read_text())

    def _foreign(self, certificate: Certificate) -> str:
        return certificate.foreign(self.model, self.env, not self.stochastic)


def open_agent(flags: AgentFlags, render_mode: str | None, n_envs: int = 1) -> Agent:
    """
    Load an agent and make an environment for it, wrapped as in training.

    :param flags: of the command
    :param render_mode: None, ``"human"``, or ``"rgb_array"``
    :param n_envs: environments of sb3_guard, which are one batch; of others there is one
    :raises UsageError: there is no such agent, or it does not fit the environment
    """
    import_packages(flags.gym_packages)
    if flags.pretrained:
        run = find_pretrained(flags.env, flags.algo if "algo" in flags.given else None)
        flags.algo = run.path.parent.name
    elif is_run(Path(flags.folder)):
        run = RunFolder(Path(flags.folder))
        with explained(f"{run.params / 'args.yml'} is damaged"):
            flags.algo, flags.env = (str(run.args()[name]) for name in ("algo", "env"))
    else:
        if "algo" not in flags.given:
            flags.algo = only_algorithm(flags.folder, flags.env, flags.algo)
        run = find_run(flags.folder, flags.algo, flags.env, flags.exp_id, flags.gym_packages)
    filed = RunFlags.read({"gym_packages": run.args().get("gym_packages")}, run.path)
    require_named(run.path, flags, filed, "gym_packages")
    hyperparams = {**run.hyperparams(), "callback": None}
    hyperparams = check(flags.algo, algorithm(flags.algo), hyperparams)
    named = {"algo": flags.algo, "env": flags.env, "gym_packages": flags.gym_packages}
    played = Run(RunFlags.of(named), hyperparams)
    env_id, ours = played.source.env_id, played.source.batch is not None
    if flags.num_threads > 0:
        th.set_num_threads(flags.num_threads)
    normalizer = None
    if flags.pretrained:
        path, model = weights(run), load_pretrained(env_id, flags.algo, device=flags.device)
    else:
        path, statistics = find_model(run, flags)
        model = load_model(played.algorithm, path, None, flags.device)
        normalizer = read_normalizer(statistics) if hyperparams.get("normalize") else None
    # A batch has no window, and no wrappers of single environments.
    native = ours and not hyperparams.get("env_wrapper") and render_mode != "human"
    size = VIDEO if ours and render_mode else {}
    env = played.make_envs(
        n_envs if native else 1,
        flags.seed,
        vec_env=played.source.stepped(wrapped=ours and not native),
        env_kwargs=size | merged(hyperparams.get("env_kwargs") or {}, flags.env_kwargs or {}),
        evaluation=True,
        normalizer=normalizer,
        render_mode=render_mode,
    )
    shipped = model.get_env()
    if shipped is not None:
        sync_envs_normalization(shipped, env)
        shipped.close()
    agent = Agent(run, path, env_id, model, env, stochastic=True)
    agent.stochastic = flags.stochastic or (not flags.deterministic and agent.certified_sampled)
    return agent


def play(flags: EnjoyFlags, render_mode: str | None) -> int:
    """
    Play an agent and print what it gets and what it costs.

    :param render_mode: None, ``"human"``, or ``"rgb_array"`` to record
    """
    alone = render_mode is not None or flags.n_timesteps is not None
    agent = open_agent(flags, render_mode, 1 if alone else min(flags.n_episodes or BATCH, BATCH))
    video = None
    if flags.record is not None:
        beside = agent.path.with_suffix(".mp4")
        own = f"{flags.algo}-{beside.name}"  # the package's folder is not the user's to write to
        video = Path(flags.record or (own if flags.pretrained else beside))
    episodes = flags.n_episodes
    if episodes is None and flags.n_timesteps is None:
        watched = 5 if render_mode == "human" else EPISODES
        episodes = 1 if flags.record is not None else watched
    result = agent.run.read_result() or {}
    if flags.verbose > 0:
        limit = result.get("trained_at")
        trained_at = "" if limit is None else f", trained at limit {limit:g}"
        sampled = ", sampled actions" if agent.stochastic else ""
        print(f"Playing {agent.path} on {agent.env_id}{trained_at}{sampled}")
        if agent.certified:
            print(agent.certified)
    shown: AbstractContextManager[Any] = nullcontext(None)
    if video is not None:
        shown = filming(agent.env, agent.model, video)
    elif render_mode == "human":
        shown = nullcontext(partial(render, agent.env))
    asked = episodes or flags.n_timesteps or 1
    recorded = recording(agent, flags, asked) if flags.dataset is not None else nullcontext()
    errors = (ValueError, *BAD_NUMBERS)  # SB3's, of observations of another shape
    playing = explained(f"can't play {agent.path}", *errors)
    with closing(agent.env), playing, shown as on_step, recorded:
        evaluation = evaluate_policy(
            agent.model,
            agent.env,
            n_eval_episodes=asked,
            deterministic=not agent.stochastic,
            seed=flags.seed,
            max_steps=flags.n_timesteps,
            on_step=on_step,
            on_episode=(lambda *ended: print(_episode(*ended))) if flags.verbose > 0 else None,
        )
    if len(evaluation):
        print(evaluation)
    else:
        print("No episode ended; play more steps with -n, or whole episodes with --n-episodes")
    if flags.verbose > 0:
        for cut in evaluation.unfinished:
            print(_episode(*cut), "so far: this episode did not end and is not counted")
    if video is not None and flags.verbose > 0:
        print(f"Video: {video}")
    return 0


def _episode(episode_return: float, cost: float, length: float) -> str:
    return f"  return {episode_return:9.3f}   cost {cost:9.3f}   {length:.0f} steps"
