"""Where the environments of the commands come from, and how they are seeded."""

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard.common.sources import Source, find
from sb3_guard.errors import ContractError, WorldError
from sb3_guard.zoo.cli.usage import UsageError, explained

# What ends a training in a line: the message says all that a traceback would, and the remedy.
BAD_NUMBERS = (FloatingPointError, WorldError, ContractError)
# What constructors of environments and models raise when their arguments are wrong.
BAD_ARGUMENTS = (
    ValueError, TypeError, AssertionError, KeyError, ImportError, gym.error.Error, WorldError
)  # fmt: skip
# What is raised when a process of --vec-env subproc or gymnasium has died.
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
