"""Played episodes as a dataset for offline learning, with their costs.

A dataset is Minari's, or one HDF5 file in the layout of DSRL, which OSRL reads. Episodes are
written as they end, so that memory holds only those under way.
"""

import copy
import importlib.util
import json
import os
import pickle
import shlex
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_guard.common.monitor import cost_keys_of, find_monitor, total_cost
from sb3_guard.costs import number
from sb3_guard.judging import Limits
from sb3_guard.vector import each
from sb3_guard.zoo.agents.flags import EnjoyFlags
from sb3_guard.zoo.cli.usage import UsageError, explained, interrupts

#: A whole episode of T steps in Minari's words: ``observations`` [T + 1, ...], or a dictionary of
#: such, ``actions`` [T, ...], ``rewards``, ``terminations``, ``truncations`` [T], and ``infos``, of
#: ``"cost"`` and each cost key that was reported, [T + 1]: 0 at the reset, then those of the steps.
Episode = dict[str, Any]
DSRL = ".hdf5"  # how the name of a file ends; other names are Minari's


class Recorder(VecEnvWrapper):
    """
    Collect the episodes that :func:`~sb3_guard.common.evaluation.evaluate_policy` counts.

    It belongs directly around the environments: what is recorded is neither normalised nor stacked.

    :param n_episodes: how many will be counted
    :param cost_keys: entries of info that are costs
    :param write: called with the episodes that a step ended
    :param stop: once it has an entry, the next step raises KeyboardInterrupt, after its write
    """

    def __init__(
        self,
        venv: VecEnv,
        n_episodes: int,
        cost_keys: tuple[str, ...],
        write: Callable[[list[Episode]], None],
        stop: list[int],
    ) -> None:
        super().__init__(venv)
        self.cost_keys, self.write, self.stop = cost_keys, write, stop
        self.asked = n_episodes  # that are still to be begun
        self.playing = np.zeros(venv.num_envs, dtype=bool)
        self.actions = np.zeros(0)
        self.first: list[Any] = []  # observation of each row's episode under way
        self.steps: list[list[tuple[Any, ...]]] = []  # and its steps

    def reset(self) -> VecEnvObs:
        obs = self.venv.reset()
        self.playing = np.arange(self.num_envs) < self.asked
        self.asked = max(self.asked - self.num_envs, 0)
        self.first = [_row(obs, row) for row in range(self.num_envs)]
        self.steps = [[] for _ in self.first]
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions.copy()
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        ended = []
        for row in np.flatnonzero(self.playing).tolist():
            info, done = infos[row], bool(dones[row])
            truncated = done and info.get("TimeLimit.truncated", False)
            named = {key: number(info[key], key) for key in self.cost_keys if key in info}
            costs = {"cost": total_cost(info, self.cost_keys), **named}
            after = copy.deepcopy(info["terminal_observation"]) if done else _row(obs, row)
            step = after, self.actions[row], rewards[row], done and not truncated, truncated, costs
            self.steps[row].append(step)
            if done:
                ended.append(_episode(self.first[row], self.steps[row]))
                self.playing[row] = False
        if ended:
            self.write(ended)
        if self.stop:
            raise KeyboardInterrupt
        return obs, rewards, dones, infos


def _row(obs: Any, row: int) -> Any:
    """A copy of one row of a batch of observations."""
    return each(lambda values: np.copy(values[row]), obs)


def _episode(first: Any, steps: list[tuple[Any, ...]]) -> Episode:
    after, actions, rewards, terminations, truncations, costs = zip(*steps, strict=True)
    keys = dict.fromkeys(key for step in costs for key in step)
    return {
        "observations": each(lambda *seen: np.stack(seen), first, *after),
        "actions": np.stack(actions),
        "rewards": np.array(rewards),
        "terminations": np.array(terminations),
        "truncations": np.array(truncations),
        "infos": {key: np.array([0.0, *(step.get(key, 0.0) for step in costs)]) for key in keys},
    }


def take_room(file: Path, size: int) -> None:
    """
    Lengthen a file by so many bytes, into which HDF5 writes; it cuts off what it does not need.

    On a full disk HDF5 would leave a damaged file, and crash when the process ends.

    :raises OSError: there is no room; the file is as it was
    """
    folder = next(folder for folder in file.parents if folder.is_dir())
    with open(file, "r+b", 0) if file.exists() else TemporaryFile(buffering=0, dir=folder) as room:
        end = room.seek(0, os.SEEK_END)
        try:
            while (left := end + size - room.tell()) > 0:
                room.write(bytes(left))
        except OSError:
            room.truncate(end)
            raise


class MinariDataset:
    """
    A dataset of Minari's, in its folder of datasets; it is made with its first episodes.

    :param name: its id, such as ``point/cpo-v0``
    :param venv: the environments that are recorded
    :param about: entries of its metadata
    :raises UsageError: the name is not one of Minari's, or is taken
    """

    def __init__(self, name: str, venv: VecEnv, about: dict[str, Any]) -> None:
        from minari.dataset.minari_dataset import parse_dataset_id
        from minari.storage import get_dataset_path

        try:
            parse_dataset_id(name)
        except (ValueError, TypeError):
            raise UsageError(
                f"--dataset {name!r}: must be an id of Minari's, such as point/cpo-v0, or a file "
                f"in DSRL's layout, such as cpo{DSRL}"
            ) from None
        self.name, self.venv, self.about = name, venv, about
        self.place = get_dataset_path(name)
        self.dataset: Any = None
        if self.place.exists():
            raise UsageError(f"--dataset {name} exists; remove the folder {self.place}")
        self.spec, spec = None, venv.get_attr("spec")[0]
        with suppress(Exception):  # what can't be made again from data says so in many ways
            spec.to_json()
            gymnasium.make(spec).close()
            self.spec = spec

    def write(self, episodes: list[Episode]) -> None:
        """Append episodes."""
        import minari
        from minari.data_collector import EpisodeBuffer

        size = 2 * len(pickle.dumps(episodes)) + 2**16 * len(episodes)  # with HDF5's records
        take_room(self.place / "data" / "main_data.hdf5", size)
        buffers = [EpisodeBuffer(**episode) for episode in episodes]
        if self.dataset is not None:
            self.dataset.update_dataset_from_buffer(buffers)
            return
        with warnings.catch_warnings():  # of an author and others that nobody has named
            warnings.simplefilter("ignore")
            self.dataset = minari.create_dataset_from_buffers(
                self.name,
                buffers,
                env=self.spec,
                observation_space=self.venv.observation_space,
                action_space=self.venv.action_space,
                jpeg_encoding=False,
            )
        self.dataset.storage.update_metadata(self.about)


class DSRLFile:
    """
    One HDF5 file in the layout of DSRL (Liu et al. 2023, arXiv 2306.09303): N steps in a row.

    ``observations``, ``next_observations``, ``actions``, ``rewards`` and ``costs`` are float32,
    ``terminals`` and ``timeouts`` bool.

    :param path: the file, which must not exist
    :param venv: the environments that are recorded
    :param about: becomes the file's attribute ``metadata``, as JSON
    :raises UsageError: the file exists, or observations are not arrays
    """

    def __init__(self, path: str, venv: VecEnv, about: dict[str, Any]) -> None:
        self.place, self.about = Path(path), about
        if self.place.exists():
            raise UsageError(f"--dataset {path} exists; remove it, or name another file")
        if not isinstance(venv.observation_space, spaces.Box):
            kind = type(venv.observation_space).__name__
            raise UsageError(f"--dataset {path}: DSRL's layout has no {kind} observations")

    def write(self, episodes: list[Episode]) -> None:
        """Append episodes."""
        import h5py

        parts = [
            {
                "observations": np.float32(episode["observations"][:-1]),
                "next_observations": np.float32(episode["observations"][1:]),
                "actions": np.float32(episode["actions"]),
                "rewards": np.float32(episode["rewards"]),
                "costs": np.float32(episode["infos"]["cost"][1:]),
                "terminals": episode["terminations"],
                "timeouts": episode["truncations"],
            }
            for episode in episodes
        ]
        joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        self.place.parent.mkdir(parents=True, exist_ok=True)
        take_room(self.place, 2**18 + sum(new.nbytes + new.nbytes // 4 for new in joined.values()))
        with h5py.File(self.place, "a") as file:
            file.attrs["metadata"] = json.dumps(self.about)
            for key, new in joined.items():
                if key in file:
                    file[key].resize(len(file[key]) + len(new), axis=0)
                    file[key][-len(new) :] = new
                else:
                    rows, shape = max(2**14 // new[0].nbytes, 1), new.shape[1:]
                    kwargs = {"maxshape": (None, *shape), "chunks": (rows, *shape)}
                    file.create_dataset(key, data=new, **kwargs)


@contextmanager
def recording(agent: Any, flags: EnjoyFlags, n_episodes: int) -> Iterator[None]:
    """
    Write the episodes that are counted while the block plays them.

    Ctrl-C and SIGTERM end the block with KeyboardInterrupt between two steps; the dataset has the
    episodes that ended before.

    :param agent: the :class:`~sb3_guard.zoo.agents.playback.Agent`, whose environments are recorded
    :param n_episodes: how many will be counted
    :raises UsageError: the dataset can't be made
    """
    name, written = flags.dataset or "", 0
    for package in ("h5py",) if name.endswith(DSRL) else ("minari", "h5py"):
        if importlib.util.find_spec(package) is None:
            raise UsageError(f"--dataset needs {package}: pip install 'sb3-guard[datasets]'")
    model, monitor, certificate = agent.model, find_monitor(agent.env), agent.certificate
    keys = cost_keys_of(model, agent.env)
    limits = Limits.of(model, keys)
    about = {
        "algorithm_name": flags.algo,
        "actions": "sampled" if agent.stochastic else "most likely",
        "cost_limits": dict(zip(limits.names, limits.values.tolist(), strict=True))
        if limits
        else {},
        "certificate": certificate and json.loads(certificate.to_json()),
        "command": shlex.join(["sb3-guard", "enjoy", *flags.words(flags.names())]),
    }
    kind = DSRLFile if name.endswith(DSRL) else MinariDataset
    dataset = kind(name, monitor.venv, about)

    def write(episodes: list[Episode]) -> None:
        nonlocal written
        fix = f"it has {written or 'no'} whole episodes"
        with explained(f"can't write --dataset {name}", OSError, fix=fix):
            dataset.write(episodes)
        written += len(episodes)

    try:
        with interrupts(lambda _: None) as stop:
            monitor.venv = Recorder(monitor.venv, n_episodes, keys, write, stop)
            yield
    finally:
        if flags.verbose > 0:
            where = f"{written} episodes in {dataset.place}" if written else "no episode ended"
            print(f"Dataset: {where}")
