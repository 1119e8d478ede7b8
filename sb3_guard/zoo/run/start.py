"""Runs that begin, runs of a grid that are brought to their end, and runs that are resumed."""

import dataclasses
import shlex
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_guard.zoo.cli.flags import START
from sb3_guard.zoo.cli.names import as_data, refuse_places, require_named
from sb3_guard.zoo.cli.usage import UsageError, explained, import_packages
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.checkpoint import read_checkpoint
from sb3_guard.zoo.run.experiment import Experiment
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder, identity, is_run, lock, plain, run_path
from sb3_guard.zoo.run.hyperparams import check, read_hyperparams
from sb3_guard.zoo.run.make_envs import full_id, source_of
from sb3_guard.zoo.run.training import Training


def prepare(flags: RunFlags) -> tuple[RunFlags, dict[str, Any]]:
    """
    What a new run is: all its flags and hyperparameters, as its folder will state them.

    :return: flags and hyperparameters, checked as far as that goes without making anything
    :raises UsageError: anything is wrong with them
    """
    flags = dataclasses.replace(flags)
    import_packages(flags.gym_packages)  # which may register algorithms, too
    cls = algorithm(flags.algo)
    source = source_of(flags.env)
    flags.env = str(source.env_id)
    if flags.seed < 0:
        flags.seed = int(np.random.default_rng().integers(2**31))
    overrides = dict(flags.hyperparams or {})
    if flags.n_timesteps > 0:
        overrides["n_timesteps"] = flags.n_timesteps
    values = check(
        flags.algo, cls, read_hyperparams(flags.algo, flags.env, flags.conf_file, overrides)
    )
    if getattr(cls, "constrained", False) and "cost_limit" not in values:
        raise UsageError(
            f"no cost limit is known for {flags.env}: give cost_limit, the highest cost of an "
            "episode that you accept, such as half of what an episode costs PPO "
            "(-params cost_limit:25)"
        )
    if flags.env_kwargs:
        values["env_kwargs"] = {**(values.get("env_kwargs") or {}), **flags.env_kwargs}
    # What wraps single environments needs single ones.
    native = source.batch is not None and values.get("env_wrapper") is None
    flags.vec_env = flags.vec_env or ("native" if native else "dummy")
    return flags, values


def start(flags: RunFlags) -> int:
    """
    Start a new run.

    :return: exit status
    :raises UsageError: anything is wrong with the flags; nothing has been written then
    """
    flags, values = prepare(flags)
    training = Training(Experiment(flags, values).try_out())
    try:
        folder = RunFolder.create(flags, values, shlex.join(sys.orig_argv))
    except UsageError:
        training.close()
        raise
    with lock(folder.path):
        return training.train(folder)


def path_of(flags: RunFlags) -> Path:
    """The folder of a run of a grid, whose number is its seed's."""
    return run_path(flags.log_folder, flags.algo, flags.env, flags.seed + 1)


def standing(flags: RunFlags, values: Mapping[str, Any]) -> str:
    """
    How far a run of a grid is: ``new``, ``done``, or to ``resume``.

    :param flags: as :func:`prepare` returns them
    :param values: its hyperparameters
    :raises UsageError: its folder holds another run, or is damaged
    """
    path = path_of(flags)
    if not is_run(path):
        return "new"
    folder = RunFolder(path)
    there = identity(folder.flags(), folder.hyperparams())
    if others := differences(there, identity(flags, values)):
        words = [f"{name}: {a} there, {b} here" for name, a, b in others[:3]]
        raise UsageError(
            f"{path} holds another run ({'; '.join(words)}); choose another folder with -f"
        )
    if folder.read_result() is not None:
        return "done"
    # Without a checkpoint nothing of it is worth keeping, and it restarts in its place.
    return "resume" if folder.checkpoint.exists() else "new"


def complete(
    flags: RunFlags, values: Mapping[str, Any], command: str, asked_to_stop: Callable[[], bool]
) -> int:
    """
    Bring a run of a grid to its end: start it, or continue it from where it was cut.

    :param flags: as :func:`prepare` returns them
    :param values: its hyperparameters
    :param command: the command line it is part of
    :param asked_to_stop: when it says so, training ends after the rollout under way
    :return: exit status, 0 if it is complete, now or already before
    :raises RunInUse: another process has the run
    :raises UsageError: it can't be trained, or the folder holds another run
    """
    import_packages(flags.gym_packages)
    path = path_of(flags)
    with explained(f"can't make folder {path}", OSError):
        path.mkdir(parents=True, exist_ok=True)
    with lock(path):
        state = standing(flags, values)
        if state == "done":
            return 0
        made = is_run(path)
        folder = RunFolder(path) if made else RunFolder.create(flags, values, command, path)
        quiet = dataclasses.replace(flags, progress=False, verbose=0)
        begun = folder if state == "resume" else None
        experiment = Experiment(quiet, values, begun).try_out()
        return Training(experiment).train(folder, asked_to_stop)


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """What differs between two runs: name and both values, ``unset`` for those that are absent."""

    def shown(value: Any) -> Any:
        return "unset" if value in ("", None) else value

    # As data: files of older runs have expressions as text.
    there, here = (
        plain({name: as_data(name, value) for name, value in run.items()}) for run in (there, here)
    )
    return [
        (name, shown(there.get(name)), shown(here.get(name)))
        for name in sorted({*there, *here})
        if there.get(name) != here.get(name)
    ]


def resume(given: RunFlags) -> int:
    """
    Continue a run in its folder.

    :param given: the flags given now; ``trained_agent`` is the run's folder or checkpoint
    :return: exit status
    :raises UsageError: the run can't be continued, or a flag contradicts what it is
    """
    folder = RunFolder(Path(given.trained_agent))
    with lock(folder.path):
        saved, values = folder.flags(), folder.hyperparams()
        require_named(folder.path, given, saved, "gym_packages")
        import_packages(given.gym_packages)
        state = read_checkpoint(folder.checkpoint)
        cls, done = algorithm(saved.algo), state["num_timesteps"]
        changed = {name: getattr(given, name) for name in {*given.given, "progress", "verbose"}}
        changed |= {name: getattr(saved, name) for name in ("trained_agent", "hyperparams")}
        if "env" in changed:
            changed["env"] = full_id(given.env)
        if 0 < given.n_timesteps < done:
            raise UsageError(
                f"-n {given.n_timesteps} is less than the {done} steps that {folder.path} has done"
            )
        if given.n_timesteps > 0:
            values["n_timesteps"] = given.n_timesteps
        overrides = given.hyperparams or {}
        refuse_places(folder.path, {n: v for n, v in values.items() if n not in overrides})
        values = check(saved.algo, cls, {**values, **overrides})
        flags = dataclasses.replace(saved, **changed)
        was = {**saved.values(START), **state["identity"], "n_timesteps": None}
        now = {**flags.values(START), **identity(flags, values), "n_timesteps": None}
        if Path(flags.log_folder).resolve() == folder.path.resolve().parents[1]:
            now["log_folder"] = was["log_folder"]  # the same folder in other words
        for name, old, new in differences(was, now):
            raise UsageError(
                f"{name} = {new} contradicts {old}, with which {folder.path} was trained; put it "
                "back or leave it out, or start a new run with it, without -i"
            )
        if folder.read_result() is not None and done >= values["n_timesteps"]:
            print(
                f"{folder.path} is finished: {done} of {values['n_timesteps']} steps; "
                "a larger -n continues it"
            )
            return 0
        return Training(Experiment(flags, values, folder).try_out()).train(folder)
