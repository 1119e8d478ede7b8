"""Environments for the commands: found, made, and wrapped as a run's hyperparameters say."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize

from sb3_guard.checks import ContractError, WorldError
from sb3_guard.common.evaluation import check_normalizer
from sb3_guard.common.sources import Source, find
from sb3_guard.common.vec_env import make_vec_env
from sb3_guard.zoo.cli.usage import UsageError, explained, import_packages, interrupts_held
from sb3_guard.zoo.run.hyperparams import Setup
from sb3_guard.zoo.run.resumable import ResumableEnv

# What ends a training in a line: the message says all that a traceback would, and the remedy.
BAD_NUMBERS = (FloatingPointError, WorldError, ContractError)
# What constructors of environments and models raise when their arguments are wrong.
BAD_ARGUMENTS = (
    ValueError, TypeError, AssertionError, KeyError, ImportError, gym.error.Error, WorldError
)  # fmt: skip
# What a SubprocVecEnv raises when one of its processes has died.
PROCESS_DIED = (EOFError, ConnectionError)


def row_seeds(seed: int, rows: int, *key: int) -> list[int]:
    """
    Seeds for the rows of a run's environments, which no run of another seed shares.

    SB3 seeds row i with ``seed + i``, so that runs of seeds 0 and 1 play almost the same episodes;
    these are words of a child of NumPy's ``SeedSequence(seed)``.

    :param rows: how many; a longer list begins with a shorter one
    :param key: of the child: 0 for training, 1 for evaluation, and where training restarts the step
    """
    return np.random.SeedSequence(seed, spawn_key=key or (0,)).generate_state(rows).tolist()


def seed_rows(env: VecEnv, seed: int, *key: int) -> None:
    """Seed the next reset, see :func:`row_seeds`; a model seeds it, too, so this comes later."""
    env.unwrapped._seeds = list(row_seeds(seed, env.num_envs, *key))


def evaluation_seed(seed: int, *key: int) -> int:
    """
    The seed that a run of this seed evaluates with; row i plays ``evaluation_seed + i``.

    :param key: 1 for the episodes after training, which are not those that chose the best model
    """
    return row_seeds(seed, 1, 1, *key)[0] // 2


def source_of(env_id: str) -> Source:
    """
    The environments of ``--env``.

    :param env_id: an id, whose version may be left out
    :raises UsageError: it is unknown
    """
    if env_id.endswith((".yml", ".yaml")):
        raise UsageError(
            f"a run needs an environment with an id, and {env_id!r} is a file: give it one in a "
            'module of yours, sb3_guard.register("Mine-v0", '
            f"sb3_guard.Scenario.load({env_id!r})), then --gym-packages my_module --env Mine-v0"
        )
    with explained("--env", ValueError, gym.error.Error):
        source = find(env_id)
    module, colon, name = env_id.rpartition(":")
    if colon and module not in ("sb3_guard", "safety_gymnasium"):
        raise UsageError(f"--env {env_id}: write --gym-packages {module} --env {name}")
    return source


def full_id(env_id: str) -> str:
    """
    The id with its version.

    :raises UsageError: it is unknown
    """
    return str(source_of(env_id).env_id)


def make_envs(
    source: Source,
    setup: Setup,
    *,
    n_envs: int,
    seed: int | None,
    vec_env: str,
    env_kwargs: Mapping[str, Any],
    cost_keys: Sequence[str] = ("cost",),
    num_threads: int | None = None,
    packages: Sequence[str] = (),
    evaluation: bool = False,
    normalizer: VecNormalize | None = None,
    render_mode: str | None = None,
) -> VecEnv:
    """
    Make environments and wrap them: monitor, ``vec_env_wrapper``, VecNormalize, frame stack.

    :param source: where they come from, see :func:`source_of`
    :param setup: the run's hyperparameters
    :param n_envs: how many
    :param seed: the environments get seed, seed + 1, …
    :param vec_env: native, dummy or subproc; native is refused where it is not possible
    :param env_kwargs: arguments of the environment
    :param cost_keys: entries of info that are costs
    :param num_threads: threads of the native engine; None: its own choice
    :param packages: modules whose functions wrappers name, to be imported in each process
    :param evaluation: observations are normalised with given statistics, rewards not at all, and
        wrappers that are ``training_only`` and their ``training_arguments`` are left out
    :param normalizer: statistics to begin with; it is given the environment
    :param render_mode: as for :func:`gymnasium.make`
    :raises UsageError: the environment refuses an argument, or can't be made
    """

    def wrap(env: gym.Env) -> gym.Env:
        import_packages(packages)
        for cls, arguments in _wrappers(setup.env_wrapper, evaluation):
            env = cls(env, **arguments)
        return ResumableEnv(env)

    drawn = f" with render_mode={render_mode!r}" if render_mode else ""
    errors = (*BAD_ARGUMENTS, *PROCESS_DIED, MemoryError)
    with ExitStack() as made:
        with explained(f"can't make {source.env_id}{drawn}", *errors), interrupts_held():
            env = make_vec_env(
                source,
                n_envs,
                seed,
                vec_env=vec_env,
                env_kwargs=dict(env_kwargs),
                num_threads=num_threads,
                render_mode=render_mode,
                wrapper_class=wrap if vec_env != "native" or setup.env_wrapper else None,
                monitor_kwargs={"cost_keys": tuple(cost_keys), **setup.monitor_kwargs},
            )
            made.callback(env.close)
        with explained(f"can't wrap {source.env_id}", *BAD_ARGUMENTS):
            env = _wrap(env, setup, evaluation, normalizer)
        made.pop_all()
    return env


def _wrappers(
    wrappers: list[tuple[Any, dict[str, Any]]], evaluation: bool
) -> list[tuple[Any, dict[str, Any]]]:
    """Evaluation is without what ends episodes early, or changes rewards."""
    if not evaluation:
        return wrappers
    return [
        (cls, {k: v for k, v in given.items() if k not in getattr(cls, "training_arguments", ())})
        for cls, given in wrappers
        if not getattr(cls, "training_only", False)
    ]


def _wrap(env: VecEnv, setup: Setup, evaluation: bool, normalizer: VecNormalize | None) -> VecEnv:
    for cls, arguments in _wrappers(setup.vec_env_wrapper, evaluation):
        env = cls(env, **arguments)
    if normalizer is not None:
        check_normalizer(normalizer, env.observation_space)
        normalizer.set_venv(env)
        env = normalizer
    elif setup.normalize is not None:
        env = VecNormalize(env, **setup.normalize)
    if evaluation and isinstance(env, VecNormalize):
        env.training = False
        env.norm_reward = False
    if setup.frame_stack is not None:
        env = VecFrameStack(env, setup.frame_stack)
    # SB3 would transpose images itself, but training and evaluation are to be wrapped alike.
    return BaseAlgorithm._wrap_env(env, monitor_wrapper=False)
