"""Checkpoints from which a killed run continues bit for bit as if it had not been killed.

A checkpoint is taken between an update and the next rollout, the one moment when everything that
training depends on is in few places: model, random generators, environments, logger, callbacks. The
file is a model file of SB3's with one more member, so ``CPO.load("checkpoint.zip")`` works on it.
"""

import pickle
import random
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cloudpickle  # type: ignore[import-untyped]
import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize

from sb3_guard.common.evaluation import check_agent
from sb3_guard.common.files import replacing
from sb3_guard.common.monitor import find_monitor
from sb3_guard.vector import BatchVecEnv, layers, normalizer_of
from sb3_guard.zoo.cli.usage import UsageError, explained
from sb3_guard.zoo.run.logger import RunLogger
from sb3_guard.zoo.run.make_envs import seed_rows

MEMBER = "run_state.pkl"
NORMALIZER = "vecnormalize.pkl"
REPLAY_BUFFER = "replay_buffer.pkl"
# Checkpoints take at most this share of the time: replay buffers are large.
LARGEST_SHARE = 0.05
# The tensors with gSDE's noise, of all environments and of one each.
GSDE_NOISE = "exploration_mat", "exploration_matrices"
FORMAT = 11  # increased when the content changes: no other can be continued


# What a new environment brings itself and what need not be picklable.
_OWN = {"env", "venv", "class_attributes", "spec", "_cached_spec", "metadata", "render_mode"}


def _attributes(layer: Any) -> dict[str, Any]:
    return {key: value for key, value in vars(layer).items() if key not in _OWN}


class ResumableEnv(gym.Wrapper):
    """
    Give a single environment, with all its wrappers, ``state()`` and ``restore(state)``.

    An environment that has the two methods itself is asked; of any other, and of wrappers, the
    attributes are taken. It is the outermost wrapper, so that a vectorised environment reaches it
    by ``env_method`` even in another process.
    """

    @property
    def spec(self) -> Any:  # type: ignore[override]
        """Of what it wraps: a dataset is to know nothing of runs."""
        return self.env.spec

    def state(self) -> bytes | None:
        """Everything the next step depends on; None if it can't be pickled."""
        parts = [
            layer.state() if _tells(layer) else _attributes(layer) for layer in layers(self.env)
        ]
        try:
            return cloudpickle.dumps(parts)
        except Exception:
            # What can't be pickled says so in many ways; that it can't is all that matters here.
            return None

    def restore(self, state: bytes) -> None:
        """Go on from :meth:`state`; the environment has been reset before."""
        for layer, part in zip(layers(self.env), pickle.loads(state), strict=True):
            if _tells(layer):
                layer.restore(part)
            else:
                vars(layer).update(part)


def _tells(layer: Any) -> bool:
    return hasattr(type(layer), "state") and hasattr(type(layer), "restore")


def capture(env: VecEnv) -> list[Any]:
    """
    The state of a vectorised environment: of its wrappers from the outside in, then its own.

    :return: picklable parts; the last one is None if the environment itself can't tell its state
    """
    parts: list[Any] = []
    for layer in layers(env):
        if _tells(layer):
            parts.append(layer.state())
        elif isinstance(layer, VecEnvWrapper):
            parts.append(_attributes(layer))
        else:
            rows = not isinstance(layer, BatchVecEnv) and layer.has_attr("state")
            states = layer.env_method("state") if rows else [None]
            parts.append(None if None in states else states)
    return parts


def restore(env: VecEnv, parts: list[Any]) -> None:
    """
    Put an environment that was made the same way, and reset, into a captured state.

    :raises UsageError: it was made in another way, as by another version
    """
    for layer, part in zip(layers(env), parts, strict=True):
        if _tells(layer):
            with explained("the checkpoint belongs to another environment", ValueError):
                layer.restore(part)
        elif isinstance(layer, VecEnvWrapper):
            vars(layer).update(part)
        else:
            for index, state in enumerate(part or []):
                layer.env_method("restore", state, indices=index)


class Interrupted(Exception):
    """Training was asked to stop, and stopped with a checkpoint of where it was."""


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
    :param identity: what makes the run the run it is, to be found unchanged when it is resumed
    :param asked_to_stop: asked at each boundary whether to stop with a checkpoint
    """

    def __init__(
        self,
        path: Path,
        others: Sequence[BaseCallback],
        identity: Mapping[str, Any],
        every: float = 10.0,
        log_interval: int = 1,
        asked_to_stop: Callable[[], bool] = lambda: False,
    ):
        super().__init__()
        self.path = path
        self.others = list(others)
        self.identity = dict(identity)
        self.every = every
        self.log_interval = max(log_interval, 1)
        self.asked_to_stop = asked_to_stop
        self.rollouts = 0  # all of the run's
        self._resumed: dict[str, Any] = {}  # the checkpoint of a run that is continued
        self._last = -np.inf
        self._took = 0.0  # seconds to write the last one
        self._between = True

    def _on_training_start(self) -> None:
        if self._resumed:
            # SB3 measures time and speed since `learn` was called; here they are the whole run's.
            self.model.start_time -= int(self._resumed["elapsed"] * 1e9)
            self.model._num_timesteps_at_start = self._resumed["start"]
            self.model.action_noise = self._resumed["action_noise"]  # which `learn` has reset
        if capture(self.training_env)[-1] is None:
            print(
                "This environment can't save its state (it can't be pickled and has no state()): "
                "if the run is resumed, its episodes are restarted."
            )

    def _on_rollout_start(self) -> None:
        if self._resumed.get("noise") is not None:
            # gSDE has drawn the noise of this rollout anew, but the checkpoint came after that.
            set_random_state(self._resumed)
            vars(_exploration(self.model)).update(self._resumed["noise"])
        self._resumed = {}
        pause = max(self.every, self._took / LARGEST_SHARE if self.every > 0 else 0.0)
        due = time.monotonic() - self._last >= pause
        stop = self.asked_to_stop()
        if stop or (due and self.rollouts % self.log_interval == 0):
            self.write(at_rollout=True)
        if stop:
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

    def write(self, at_rollout: bool) -> None:
        """
        Write the checkpoint, replacing the one before in one step.

        :param at_rollout: whether a rollout starts, for which gSDE has drawn its noise
        """
        assert isinstance(self.logger, RunLogger)
        began = time.monotonic()
        exploration = _exploration(self.model) if at_rollout else None
        state = {
            "format": FORMAT,
            "identity": self.identity,
            "num_timesteps": self.model.num_timesteps,
            "generators": (random.getstate(), np.random.get_state(), th.get_rng_state()),  # noqa: NPY002
            "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
            "noise": exploration
            and {name: vars(exploration)[name].detach() for name in GSDE_NOISE},
            # Off-policy algorithms fill their buffers with random actions from here.
            "action_space": self.model.action_space.np_random,
            "environments": capture(self.training_env),
            # Seeded again for each evaluation, but a wrapper may remember more than its episode.
            "evaluation": [capture(env) for env in self._evaluation_envs()],
            "callbacks": [
                (callback.n_calls, callback.state() if hasattr(callback, "state") else None)
                for callback in self.others
            ],
            "logger": self.logger.state(self.rollouts),
            "rollouts": self.rollouts,
            "episodes": find_monitor(self.training_env).episode_count,
            "elapsed": (time.time_ns() - self.model.start_time) / 1e9,
            "start": self.model._num_timesteps_at_start,
            "action_noise": self.model.action_noise,
        }
        with replacing(self.path) as file:
            self.model.save(file)
            with zipfile.ZipFile(file, "a") as archive:
                archive.writestr(MEMBER, pickle.dumps(state))
                normalizer = normalizer_of(self.training_env)
                if normalizer is not None:
                    # Once more, so that the agent can be played without the environment's state.
                    archive.writestr(NORMALIZER, pickle.dumps(normalizer))
                if isinstance(self.model, OffPolicyAlgorithm):
                    with archive.open(REPLAY_BUFFER, "w", force_zip64=True) as member:
                        pickle.dump(self.model.replay_buffer, member, pickle.HIGHEST_PROTOCOL)
        self._last = time.monotonic()
        self._took = self._last - began

    def _evaluation_envs(self) -> list[VecEnv]:
        return [other.eval_env for other in self.others if isinstance(other, EvalCallback)]

    def restore(self, model: BaseAlgorithm, state: dict[str, Any]) -> None:
        """
        Put everything where the checkpoint found it; the last thing before ``learn``.

        :param model: as loaded from the same checkpoint, with its environment
        :param state: as :func:`read_checkpoint` returns it
        """
        self._resumed = state
        self.rollouts = state["rollouts"]
        for callback, (n_calls, own) in zip(self.others, state["callbacks"], strict=True):
            callback.n_calls = n_calls
            if own is not None:
                callback.restore(own)  # type: ignore[attr-defined]
        for evaluation, parts in zip(self._evaluation_envs(), state["evaluation"], strict=True):
            evaluation.reset()
            restore(evaluation, parts)
        env = model.get_env()
        assert env is not None
        env.reset()
        restore(env, state["environments"])
        if state["environments"][-1] is None:
            # `learn` begins new episodes when there is no observation to go on from; not the first
            # ones of the run again.
            model.set_env(env)
            seed_rows(env, model.seed or 0, 0, state["num_timesteps"])
        set_random_state(state)
        generator = state["action_space"].bit_generator
        model.action_space.np_random.bit_generator.state = generator.state


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
    with explained(f"{path} is damaged or no checkpoint"), zipfile.ZipFile(path) as archive:
        state: dict[str, Any] = pickle.loads(archive.read(MEMBER))
        version = state["format"]
    if version != FORMAT:
        raise UsageError(
            f"{path} has format {version}; this version continues format {FORMAT} only"
        )
    return state


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
    (`force_reset=False`), which fits only once `Checkpoints.restore` has put the environment back.

    :param env: environment to continue training in; None: to predict only
    :raises UsageError: the file is damaged, of another algorithm, or does not fit the environment
    """
    fix = (
        "if it is another algorithm's, sb3_guard.warm_start(model, file) takes over its networks "
        "in Python"
    )
    with explained(f"can't load {path} as {algorithm.__name__}", fix=fix):
        model = algorithm.load(path, env=env, device=device, force_reset=False, **changes)
        if env is not None and isinstance(model, OffPolicyAlgorithm):
            with zipfile.ZipFile(path) as archive:
                if REPLAY_BUFFER in archive.namelist():
                    with archive.open(REPLAY_BUFFER) as member:
                        model.replay_buffer = pickle.load(member)
    if env is not None:
        with explained(f"can't train {path} on", ValueError):
            check_agent(model, env)
    return model
