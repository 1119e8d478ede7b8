"""Checkpoints from which a killed run continues bit for bit as if it had not been killed.

A checkpoint is taken between an update and the next rollout, the one moment when everything that
training depends on is in few places: model, random generators, environments, logger, callbacks. The
file is a model file of SB3's with one more member, so ``CPO.load("checkpoint.zip")`` works on it.
"""

import copy
import os
import pickle
import random
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_guard.algorithms.common.reuse import Reuse, Rollout
from sb3_guard.common.files import replacing
from sb3_guard.common.monitor import KEPT
from sb3_guard.zoo.cli.usage import UsageError, explained
from sb3_guard.zoo.run.logger import RunLogger
from sb3_guard.zoo.run.make_envs import seed_rows
from sb3_guard.zoo.run.resumable import capture, restore

MEMBER = "run_state.pkl"
NORMALIZER = "vecnormalize.pkl"
REPLAY_BUFFER = "replay_buffer.pkl"
EARLIER = "earlier"  # folder in addition to the checkpoint: earlier rollouts, each written once
# Checkpoints take at most this share of the time: those with a replay buffer are large.
LARGEST_SHARE = 0.05
# The tensors with gSDE's noise, of all environments and of one each.
GSDE_NOISE = "exploration_mat", "exploration_matrices"
# Increased when the content changes, and the formats that can be continued.
FORMAT, FORMATS = 7, (5, 6, 7)


class Interrupted(Exception):
    """Training was asked to stop, and stopped with a checkpoint of where it was."""


def random_state() -> tuple[Any, Any, th.Tensor]:
    """The states of Python's, NumPy's and torch's global generators."""
    return random.getstate(), np.random.get_state(), th.get_rng_state()  # noqa: NPY002


def set_random_state(state: Mapping[str, Any]) -> None:
    """Put the generators of the process, and of its GPUs, where a checkpoint found them."""
    python, numpy, torch = state["generators"]
    random.setstate(python)
    np.random.set_state(numpy)  # noqa: NPY002
    th.set_rng_state(torch)
    if state["cuda"] and th.cuda.is_available():
        th.cuda.set_rng_state_all(state["cuda"])


def _exploration(model: BaseAlgorithm) -> StateDependentNoiseDistribution | None:
    """The distribution whose noise gSDE draws before callbacks hear of a rollout, if it is used."""
    actor = getattr(model.policy, "actor", None) or model.policy
    distribution = getattr(actor, "action_dist", None)
    return distribution if isinstance(distribution, StateDependentNoiseDistribution) else None


class Checkpoints(BaseCallback):
    """
    Write ``checkpoint.zip`` at rollout boundaries.

    :param path: the file
    :param others: the run's other callbacks, whose counters and states belong to the checkpoint
    :param every: least time between two checkpoints, seconds; the first one is taken at once.
        0: one at every rollout; otherwise large ones are written less often
    :param log_interval: rollouts per logged row; checkpoints fall on logged rollouts, since SB3
        counts rollouts from the start of each ``learn``
    :param what: what makes the run the run it is, to be found unchanged when it is resumed
    """

    def __init__(
        self,
        path: Path,
        others: Sequence[BaseCallback],
        every: float = 10.0,
        log_interval: int = 1,
        what: Mapping[str, Any] | None = None,
    ):
        super().__init__()
        self.path = path
        self.others = list(others)
        self.every = every
        self.log_interval = max(log_interval, 1)
        self.what = dict(what or {})
        #: asked at each boundary whether to stop with a checkpoint, by a grid
        self.asked: Callable[[], bool] = lambda: False
        #: set from a signal handler: stop with a checkpoint at the next boundary
        self.stop = False
        self.rollouts = 0  # all of the run's
        self._elapsed = 0.0  # seconds of training before this process
        self._start = 0  # steps at which the run, not this process, began
        self._noise: ActionNoise | None = None  # as a checkpoint found it
        self._resumed: dict[str, Any] | None = None  # the checkpoint, until the next rollout starts
        self._last = -np.inf
        self._took = 0.0  # seconds to write the last one
        self._between = True
        self._warned = False

    def _on_training_start(self) -> None:
        # SB3 measures time and speed since `learn` was called; here they are the whole run's.
        self.model.start_time -= int(self._elapsed * 1e9)
        self.model._num_timesteps_at_start = self._start
        if self._noise is not None:
            self.model.action_noise = self._noise

    def _on_rollout_start(self) -> None:
        self._continue_rollout()
        pause = max(self.every, self._took / LARGEST_SHARE if self.every > 0 else 0.0)
        due = time.monotonic() - self._last >= pause
        self.stop |= self.asked()
        if self.stop or (due and self.rollouts % self.log_interval == 0):
            self.write(at_rollout=True)
        if self.stop:
            raise Interrupted
        self._between = False

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.rollouts += 1
        self._between = True

    def _on_training_end(self) -> None:
        # A callback may have stopped training within a rollout: then the last boundary stands.
        if self._between:
            self.write(at_rollout=False)

    def _continue_rollout(self) -> None:
        """In the first rollout of a resumed run, take the noise that gSDE drew for it before."""
        state, self._resumed = self._resumed or {}, None
        if state.get("noise") is not None:
            set_random_state(state)
            vars(_exploration(self.model)).update(state["noise"])

    def write(self, at_rollout: bool) -> None:
        """
        Write the checkpoint, replacing the one before in one step.

        :param at_rollout: whether a rollout starts, for which gSDE has drawn its noise
        """
        assert isinstance(self.logger, RunLogger)
        began = time.monotonic()
        environments = capture(self.training_env)
        earlier = _write_earlier(self.model, self.path.parent / EARLIER)
        if environments[-1] is None and not self._warned:
            self._warned = True
            print(
                "This environment can't save its state (it can't be pickled and has no state()): "
                "if the run is resumed, its episodes are restarted."
            )
        exploration = _exploration(self.model) if at_rollout else None
        state = {
            "format": FORMAT,
            "what": self.what,
            "num_timesteps": self.model.num_timesteps,
            "generators": random_state(),
            "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
            "noise": exploration
            and {name: vars(exploration)[name].detach() for name in GSDE_NOISE},
            # Off-policy algorithms fill their buffers with random actions from here.
            "action_space": self.model.action_space.np_random,
            "environments": environments,
            # Seeded again for each evaluation, but a wrapper may remember more than its episode.
            "evaluation": [capture(env) for env in self._evaluation_envs()],
            "callbacks": [
                (type(one).__name__, one.n_calls, one.state() if hasattr(one, "state") else None)
                for one in self.others
            ],
            "logger": self.logger.state(self.rollouts),
            "rollouts": self.rollouts,
            "elapsed": (time.time_ns() - self.model.start_time) / 1e9,
            "start": self.model._num_timesteps_at_start,
            "earlier": earlier,
        }
        with replacing(self.path) as file:
            self.model.save(file)
            with zipfile.ZipFile(file, "a") as archive:
                archive.writestr(MEMBER, pickle.dumps(state))
                normalizer = self.model.get_vec_normalize_env()
                if normalizer is not None:
                    # Once more, so that the agent can be played without the environment's state.
                    archive.writestr(NORMALIZER, pickle.dumps(normalizer))
                if isinstance(self.model, OffPolicyAlgorithm):
                    with archive.open(REPLAY_BUFFER, "w", force_zip64=True) as member:
                        pickle.dump(self.model.replay_buffer, member, pickle.HIGHEST_PROTOCOL)
        _keep_only(self.path.parent / EARLIER, earlier)
        self._last = time.monotonic()
        self._took = self._last - began

    def _evaluation_envs(self) -> list[VecEnv]:
        return [one.eval_env for one in self.others if isinstance(one, EvalCallback)]

    def restore(self, state: dict[str, Any], noise: ActionNoise | None) -> None:
        """
        Continue the counts of a checkpoint, here and in the other callbacks.

        :param noise: the loaded model's exploration noise, which `learn` resets
        """
        self._noise = copy.deepcopy(noise)
        self._resumed = state
        self.rollouts = state["rollouts"]
        self._elapsed = state["elapsed"]
        self._start = state["start"]
        for one, (_, n_calls, own) in zip(self.others, state["callbacks"], strict=True):
            one.n_calls = n_calls
            if own is not None:
                one.restore(own)  # type: ignore[attr-defined]
        for env, parts in zip(self._evaluation_envs(), state["evaluation"], strict=True):
            env.reset()
            restore(env, parts)


def _write_earlier(model: BaseAlgorithm, folder: Path) -> list[str]:
    """Write what is not yet there of the rollouts that an update uses in addition to its own.

    :return: the names of the files, the latest last
    """
    rollouts = model.earlier if isinstance(model, Reuse) else []
    for rollout in rollouts:
        folder.mkdir(exist_ok=True)
        path = folder / f"{rollout.number}.pkl"
        if not path.exists():
            with replacing(path) as file:
                pickle.dump(tuple(rollout), file, pickle.HIGHEST_PROTOCOL)
    return [f"{rollout.number}.pkl" for rollout in rollouts]


def _keep_only(folder: Path, names: Sequence[str]) -> None:
    for file in folder.glob("*"):
        if file.name not in names:
            file.unlink()


def _read_earlier(folder: Path, names: Sequence[str]) -> list[Rollout]:
    """
    :raises UsageError: a file is absent or damaged
    """
    with explained(f"can't read the earlier rollouts in {folder}"):
        return [Rollout(*pickle.loads((folder / name).read_bytes())) for name in names]


def read_checkpoint(path: Path) -> dict[str, Any]:
    """
    The run's state in a checkpoint, without the model.

    :raises UsageError: the file is absent, damaged, not a checkpoint, or of another version
    """
    if not path.is_file():
        raise UsageError(
            f"there is no {path}: the run was stopped before its first rollout; "
            "start it again without -i"
        )
    with explained(f"{path} is damaged and can't be read"), zipfile.ZipFile(path) as archive:
        members = archive.namelist()
        state = pickle.loads(archive.read(MEMBER)) if MEMBER in members else None
    if not isinstance(state, dict) or "format" not in state:
        # The end of a cut file may look like one of the archives inside it.
        whole = state is None and "data" in members
        raise UsageError(f"{path} is {'a model, not a checkpoint' if whole else 'damaged'}")
    version = state["format"]
    if version not in FORMATS:
        raise UsageError(
            f"{path} has format {version}; this version continues formats "
            f"{' and '.join(map(str, FORMATS))} only"
        )
    return state


def cut_logs(folder: Path, state: Mapping[str, Any]) -> None:
    """
    Drop what a run wrote to its csv files after a checkpoint.

    :param folder: the run folder
    :param state: as :func:`read_checkpoint` returns it
    :raises UsageError: they can't be written
    """
    logger = state["logger"]
    (monitor,) = (part for part in state["environments"] if {*KEPT} <= {*(part or ())})
    with explained(f"can't write to {folder}", OSError):
        table = folder / "progress.csv"
        header, *rows = table.read_bytes().split(b"\n") if table.is_file() else [b""]
        later = header.count(b",") + 1 - len(logger["columns"])
        if rows and later > 0:
            # Each column that came after the checkpoint put a comma behind every row before it.
            with replacing(table) as file:
                header = header.rsplit(b",", later)[0]
                file.write(b"\n".join([header, *(row[:-later] for row in rows)]))
        for path, written in ((table, logger), (folder / "0.monitor.csv", monitor)):
            # Checkpoints of format 5 have the table itself.
            length = written["length"] if "length" in written else len(written["table"].encode())
            if path.is_file() and path.stat().st_size > length:
                os.truncate(path, length)


def is_checkpoint(path: Path) -> bool:
    """Whether a file is a checkpoint rather than a plain model."""
    try:
        with zipfile.ZipFile(path) as archive:
            return MEMBER in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def read_normalizer(path: Path) -> VecNormalize:
    """
    Observation statistics from a pickle or a checkpoint, to be given an environment.

    :raises UsageError: the file is absent or damaged, or there are none in it
    """
    with explained(f"can't read the observation statistics of the agent from {path}"):
        if path.suffix == ".zip":
            with zipfile.ZipFile(path) as archive:
                return pickle.loads(archive.read(NORMALIZER))
        return pickle.loads(path.read_bytes())


def load_model(
    algorithm: type[BaseAlgorithm], path: Path, env: VecEnv | None, device: str, **changes: Any
) -> BaseAlgorithm:
    """
    The model in a model file or checkpoint, as it was.

    Loading alone does not touch the environment: the model continues from its last observation
    (`force_reset=False`), which fits only once `restore_run` has put the environment back.

    :param env: environment to continue training in; None: to predict only
    :raises UsageError: the file is damaged, of another algorithm, or does not fit the environment
    """
    with explained(f"can't load {path} as {algorithm.__name__}"):
        model = algorithm.load(path, env=env, device=device, force_reset=False, **changes)
        if env is not None and isinstance(model, OffPolicyAlgorithm):
            with zipfile.ZipFile(path) as archive:
                if REPLAY_BUFFER in archive.namelist():
                    with archive.open(REPLAY_BUFFER) as member:
                        model.replay_buffer = pickle.load(member)
        return model


def restore_run(model: BaseAlgorithm, state: dict[str, Any], folder: Path) -> None:
    """
    Put environments and generators where the checkpoint found them; the last thing before `learn`.

    :param model: as loaded from the same checkpoint, with its environment
    :param folder: the run's
    :raises UsageError: a file that the checkpoint names is absent or damaged
    """
    if isinstance(model, Reuse):
        names = state.get("earlier", ())
        model.earlier = _read_earlier(folder / EARLIER, names)
        _keep_only(folder / EARLIER, names)
    env = model.get_env()
    assert env is not None
    env.reset()
    restore(env, state["environments"])
    if state["environments"][-1] is None:
        # `learn` begins new episodes when there is no observation to go on from; not the first
        # ones of the run again.
        model._last_obs = None
        seed_rows(env, model.seed or 0, 0, state["num_timesteps"])
    set_random_state(state)
    model.action_space._np_random = state["action_space"]
