"""A model in Python as the commands make it: environment, normalisation and hyperparameters."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_guard.common.monitor import find_monitor
from sb3_guard.common.sources import find
from sb3_guard.fields import is_data
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.hyperparams import annotations
from sb3_guard.zoo.run.run import Run

if TYPE_CHECKING:
    from sb3_guard.envs.scenario import Scenario

# Hyperparameters of a run that are none of its model, and what takes them.
ELSEWHERE = {
    "callback": "model.learn", "n_timesteps": "model.learn", "selection_limit": "CostEvalCallback"
}  # fmt: skip


def make_model(
    algo: str,
    env_id: "str | Path | Mapping[str, Any] | Scenario | Callable[..., gym.Env]",
    *,
    conf: str | Path | None = None,
    seed: int | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    vec_env: str | None = None,
    device: str = "auto",
    num_threads: int | None = None,
    monitor_path: str | None = None,
    tensorboard_log: str | None = None,
    verbose: int = 0,
    **hyperparams: Any,
) -> BaseAlgorithm:
    """The model that ``sb3-guard train`` trains, with its environments, ready to ``learn``.

    ::

        model = make_model("cpo", "SafetyPointGoal1-v0", cost_limit=25, seed=0)
        model.learn(1_000_000)

    gives the same weights as ``sb3-guard train --algo cpo --env SafetyPointGoal1-v0 --seed 0 -n 1e6
    -params cost_limit:25``. ``model.get_env()`` has the environments, normalised where the
    hyperparameters say so.

    :param algo: what ``--algo`` takes: an algorithm of this package, or one of RL-Zoo as a baseline
    :param env_id: an environment, whose version may be left out; a scenario, its plain data or its
        YAML file; or a class or function that makes one
    :param conf: hyperparameters: ``"paper"``, an algorithm or a file; None for the defaults in
        ``hyperparams/<algo>.yml``, or in that of the nearest base which has one
    :param seed: of networks and environments; None for a random one
    :param env_kwargs: parameters of the environment, such as ``{"hazards": {"num": 4}}``
    :param vec_env: ``"native"``, ``"dummy"``, ``"subproc"`` or ``"gymnasium"``; None chooses
    :param device: torch device
    :param num_threads: threads of torch and of the simulations; None for their own choice
    :param monitor_path: csv file for the episode statistics
    :param tensorboard_log: folder for TensorBoard's events
    :param verbose: 1 logs to the terminal, as in Stable-Baselines3
    :param hyperparams: what is not to be as in the file: arguments of the algorithm, which may also
        be objects that a file can't hold, and ``n_envs``, ``normalize``, ``frame_stack``,
        ``env_wrapper``, ``vec_env_wrapper``
    :return: the model, not yet trained
    :raises ValueError: a name or value is not allowed; the message says what is
    :raises TypeError: ``env_id`` is an environment, not what makes one
    """
    for argument in ELSEWHERE.keys() & hyperparams:
        raise ValueError(f"make_model takes no {argument!r}; give it to {ELSEWHERE[argument]}")
    named = isinstance(env_id, str) and not env_id.endswith((".yml", ".yaml"))
    source = None if named else find(env_id)
    try:
        flags = RunFlags.read(
            {
                "algo": algo,
                "env": source.env_id if source else env_id,
                "seed": seed,
                "conf_file": None if conf is None else str(conf),
                "env_kwargs": env_kwargs,
                "vec_env": vec_env,
                "device": device,
                "num_threads": num_threads,
                "eval_freq": -1,
                "verbose": int(verbose > 0),
            },
            "make_model",
        )
        names = annotations(algorithm(algo))
        # What a file can't hold is not checked as data; the constructor looks at it.
        objects = {n: v for n, v in hyperparams.items() if n in names and not is_data(v)}
        flags.hyperparams = {n: v for n, v in hyperparams.items() if n not in objects}
        run = Run.check(flags, source)
        run.arguments.update(objects)
        model = run.make_model()
    except UsageError as error:
        raise ValueError(str(error)) from error
    if monitor_path is not None:
        env = model.get_env()
        assert env is not None
        find_monitor(env).log_to(monitor_path)
    model.verbose, model.tensorboard_log = verbose, tensorboard_log
    return model
