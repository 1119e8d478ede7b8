"""RL-Zoo's own training command with this package registered.

``python -m sb3_guard.zoo.rl_zoo3 train --algo cpo --env Goal_Point_8Hazards-v0`` takes all flags
of ``python -m rl_zoo3.train``. In RL-Zoo's table ``trpo`` stays sb3-contrib's and ours is
``guard_trpo``. ``--optimize`` is RL-Zoo's own search, by return alone, in the spaces of
:mod:`sb3_guard.zoo.spaces`; ``python -m sb3_guard.tune`` searches under a cost limit.
"""

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard.algorithms import ALGORITHMS
from sb3_guard.common.callbacks import CostEvalCallback
from sb3_guard.common.monitor import CostMonitor
from sb3_guard.zoo.hyperparams import entry, read_file, shipped_file
from sb3_guard.zoo.names import BASES, classes, evaluate
from sb3_guard.zoo.spaces import SPACES, rl_zoo_sampler, space_of
from sb3_guard.zoo.usage import KeyValues, UsageError, run

# Hyper-parameters that RL-Zoo evaluates where they are text, and the class it knows by a bare name.
TEXT = ("normalize", "policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs",
        "monitor_kwargs")  # fmt: skip
BUFFERS = {"HerReplayBuffer": HerReplayBuffer}


def key_in_rl_zoo(algo: str) -> str:
    """The key of one of our algorithms in RL-Zoo's table."""
    return "guard_trpo" if algo == "trpo" else algo


def register() -> None:
    """
    Add our algorithms and search spaces to RL-Zoo's tables; its environments are Gymnasium's, ours
    among them.
    """
    import rl_zoo3
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

    import sb3_guard  # noqa: F401  registers the environments

    for algo, cls in ALGORITHMS.items():
        rl_zoo3.ALGOS[key_in_rl_zoo(algo)] = cls
    for algo in {**ALGORITHMS, **SPACES}:
        path = shipped_file(algo)
        if space_of(algo):
            base = read_file(path)["default"] if path.is_file() else {}
            HYPERPARAMS_SAMPLER[key_in_rl_zoo(algo)] = rl_zoo_sampler(algo, base)


def make_vec_env(
    env_id: Any, n_envs: int = 1, monitor_dir: str | None = None, **kwargs: Any
) -> VecEnv:
    """SB3's ``make_vec_env``, whose environments are monitored for cost as well."""
    from stable_baselines3.common.env_util import make_vec_env as make

    monitor_kwargs = kwargs.pop("monitor_kwargs", None) or {}
    file = None if monitor_dir is None else f"{monitor_dir}/0.monitor.csv"
    with warnings.catch_warnings():
        # SB3 gives each environment a monitor of its own, which counts no costs.
        warnings.filterwarnings("ignore", message="The environment is already wrapped with a `Mon")
        # Of what EarlyTermination ends outside of that monitor, ours takes account.
        warnings.filterwarnings("ignore", message="EarlyTermination is around a Monitor")
        return CostMonitor(make(env_id, n_envs, **kwargs), file, **monitor_kwargs)


def typed(values: dict[str, Any]) -> dict[str, Any]:
    """
    Hyper-parameters whose text is read here: RL-Zoo's manager would call ``eval`` on it.

    :raises UsageError: a text is more than literals and classes of torch, or what is named as a
        wrapper or callback is none
    """
    read = dict(values)
    for name in TEXT:
        value = values.get(name)
        if isinstance(value, str):
            read[name] = BUFFERS.get(value) or evaluate(name, value)
    for name in BASES:
        classes(name, values.get(name))
    return read


def train(argv: Sequence[str]) -> int:
    """
    Run RL-Zoo's training command.

    :param argv: its arguments; our algorithms read our hyper-parameter files unless told otherwise
    :return: exit status
    """
    import rl_zoo3.exp_manager
    import rl_zoo3.train

    register()
    arguments = list(argv)
    ours = {key_in_rl_zoo(algo): algo for algo in ALGORITHMS}
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo")
    parser.add_argument("-conf", "--conf-file")
    given = parser.parse_known_args(arguments)[0]
    if given.algo in ours and given.conf_file is None:
        arguments += ["-conf", str(shipped_file(ours[given.algo]))]
    # RL-Zoo has no hooks for these two, and names them in this module.
    manager: Any = rl_zoo3.exp_manager
    manager.make_vec_env, manager.EvalCallback = make_vec_env, CostEvalCallback

    class TypedManager(rl_zoo3.exp_manager.ExperimentManager):
        def read_hyperparameters(self) -> Any:
            if not self.config.endswith((".yml", ".yaml")):
                return super().read_hyperparameters()
            # RL-Zoo looks for the id alone, or 'default'; our files have patterns too.
            given, env_id = self.config, self.env_name.gym_id
            with TemporaryDirectory() as folder:
                self.config = f"{folder}/{Path(given).name}"
                Path(self.config).write_text(
                    yaml.safe_dump({env_id: entry(read_file(given), env_id)})
                )
                found = super().read_hyperparameters()
            self.config = given
            return found

        def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
            return super()._preprocess_hyperparams(typed(hyperparams))

    command: Any = rl_zoo3.train
    command.StoreDict, command.ExperimentManager = KeyValues, TypedManager
    sys.argv = ["rl_zoo3.train", *arguments]
    rl_zoo3.train.train()
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command.

    :param argv: arguments, ``train`` first; None: those of the process
    :return: exit status
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] != ["train"]:
        raise UsageError(
            f"the command is python -m sb3_guard.zoo.rl_zoo3 train ..., not {arguments[:1]}; "
            "play agents with python -m sb3_guard.enjoy"
        )
    return train(arguments[1:])


if __name__ == "__main__":
    sys.exit(run(main))
