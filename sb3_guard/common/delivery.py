"""A training that ends with a certified agent: candidates, and a certificate."""

import math
import os
import pickle
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.td3.policies import TD3Policy

from sb3_guard.common.callbacks import CostEvalCallback
from sb3_guard.common.certificate import Certificate, certify, refuse_training_only
from sb3_guard.common.evaluation import Evaluation, evaluate_policy, sync_normalization
from sb3_guard.common.files import replacing
from sb3_guard.common.monitor import cost_keys_of
from sb3_guard.fields import fit
from sb3_guard.judging import EPISODES, LEAST, TRIES, Limits
from sb3_guard.vector import moments_of, normalizer_of

HELP = (
    "a training with more steps (-n), more episodes (--certify), a lower cost_limit than you need, "
    "or SAC-Lagrangian may help"
)
CERTIFICATE = "certificate.json"
MODEL, NORMALIZER = "certified_model.zip", "certified_model_vecnormalize.pkl"
CANDIDATES = 8  # files, at most
FORMAT = "sb3_guard candidate"
FINAL_EPISODES = 100  # of the last policy, with each kind of actions
EVALUATIONS = 10  # of a training, where no frequency is given


def play_final(
    model: Any, env: VecEnv, episodes: int, seed: int, verbose: bool
) -> dict[bool, Evaluation]:
    """Episodes of the last policy, by whether they are of its most likely actions."""
    played = {}
    for deterministic, actions in ((False, "sampled"), (True, "most likely")):
        played[deterministic] = evaluate_policy(model, env, episodes, deterministic, seed=seed)
        if verbose and len(played[deterministic]):
            print(f"Final policy, {actions} actions, {played[deterministic]}")
    return played


class Candidate(NamedTuple):
    """A policy that an evaluation has played, with one kind of actions.

    :param content: its weights, the statistics of observations, and its steps
    :param deterministic: whether it was played with its most likely actions
    :param mean_return: of these episodes
    :param costs: what the limits bound, of each episode, [E, m]
    """

    content: dict[str, Any]
    deterministic: bool
    mean_return: float
    costs: np.ndarray

    def rank(self, limits: Limits, caution: float) -> tuple[bool, float]:
        """The greater, the sooner it is tried: safe ones by return, then those nearest to it."""
        excess = float(np.max(limits.excess(self.costs, caution)))
        return (True, self.mean_return) if excess <= 0.0 else (False, -excess)


class DeliveryCallback(CostEvalCallback):
    """
    Evaluate the agent regularly, and end the training with one that is certified.

    The policies that evaluations play from the middle of the training on are *candidates*, and so
    is the last one. Each has been played with its most likely actions and with sampled ones. Of
    those whose mean cost plus its standard error is within the limit, the one of highest return is
    certified by fresh episodes (:func:`~sb3_guard.certify`); if it is refused, others follow, whose
    cost plus two and then three standard errors is within it. The three tries share the error. The
    certified agent is written as ``certified_model.zip``, with
    ``certified_model_vecnormalize.pkl`` where observations are normalised, and
    ``certificate.json``; these are of the last training that ended in this folder. The model itself
    keeps its last weights.

    A training that was cut and continues keeps the candidates that it has, and ends alike; one that
    begins takes those of another away.

    :param eval_env: environment to play in, wrapped as the training environment is, but for
        wrappers that are for training only
    :param folder: where the files are written; the current one unless it is given
    :param cost_limit: d, one number or one per cost; None: the model's own at the end
    :param certificate_env: another environment like ``eval_env`` for the last policy's episodes and
        the certificate's; None: ``eval_env``
    :param n_episodes: episodes of a certificate, at least 100
    :param final_seed: of the last policy's episodes; None: drawn from ``seed``
    :param deterministic: certify the most likely actions, or sampled ones; None: either, if the
        agent can be exported with sampled ones
    :param eval_freq: evaluate every this many calls; None: ten times in the training
    :param kwargs: further arguments of :class:`CostEvalCallback`
    """

    def __init__(
        self,
        eval_env: VecEnv,
        folder: str | os.PathLike[str] = ".",
        cost_limit: float | Sequence[float] | None = None,
        *,
        certificate_env: VecEnv | None = None,
        n_episodes: int = EPISODES,
        final_seed: int | None = None,
        eval_freq: int | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(eval_env, eval_freq=eval_freq or 0, **kwargs)
        fit("n_episodes", n_episodes, int, LEAST, ends="[)")
        self.certificate_env = self.eval_env if certificate_env is None else certificate_env
        self.folder, self.cost_limit = Path(folder), cost_limit
        self.n_episodes = n_episodes
        child = np.random.SeedSequence(self.seed, spawn_key=(3,)).generate_state(1)[0] >> 1
        self.final_seed = int(child) if final_seed is None else final_seed
        self.evenly = eval_freq is None
        #: of the agent that was delivered; None: none was
        self.certificate: Certificate | None = None
        #: episodes of the last policy, by whether they are of its most likely actions
        self.final: dict[bool, Evaluation] = {}

    def _init_callback(self) -> None:
        """
        :raises ValueError: the limit is not finite, or does not fit the costs, or ``eval_env`` is
            not normalised as the training is, has other actions, or a wrapper that is for training
            only
        :raises OSError: the folder can't be written, or ``certificate.json`` is of something else
        """
        if not self._certified_limits():
            raise ValueError("the agent has no cost limit of its own: give cost_limit")
        super()._init_callback()
        if (file := self.folder / CERTIFICATE).exists() and not (self.folder / MODEL).exists():
            raise FileExistsError(f"{file} would be replaced; move it, or choose another folder")
        for env in (self.eval_env, self.certificate_env):
            refuse_training_only(env)
            sync_normalization(self.training_env, env)
        self._candidates.mkdir(parents=True, exist_ok=True)

    def _certified_limits(self) -> Limits:
        keys = cost_keys_of(self.model, self.eval_env)
        return Limits.of(self.model, keys, self.cost_limit)

    @property
    def _candidates(self) -> Path:
        return self.folder / "candidates"

    def kinds(self) -> list[bool]:
        """The kinds of actions that are played: whether the most likely ones."""
        # Sampled actions of Discrete spaces can't be exported, the noise of gSDE is not saved, and
        # TD3 samples none.
        policy, noisy = self.model.policy, getattr(self.model, "use_sde", False)
        box = isinstance(self.model.action_space, spaces.Box)
        sampled = box and not noisy and not isinstance(policy, TD3Policy)
        return super().kinds() if sampled or not self.both else [True]

    # Candidates

    def _on_training_start(self) -> None:
        self.certificate, self.final = None, {}
        if self.evenly:
            steps = self.model._total_timesteps / EVALUATIONS
            self.eval_freq = max(round(steps / self.training_env.num_envs), 1)
        for file, content in self._read():
            if content["num_timesteps"] > self.num_timesteps:
                file.unlink()  # of another training

    def _read(self) -> list[tuple[Path, dict[str, Any]]]:
        """The candidates that are there, and their files; others are left alone."""
        there = []
        for file in sorted(self._candidates.glob("*.pt")):
            try:
                content = th.load(file, map_location="cpu", weights_only=True)
            except Exception:  # a damaged file raises what its bytes make of pickle and zip
                continue
            ours = isinstance(content, dict) and content.get("format") == FORMAT
            if ours and isinstance(content["num_timesteps"], int):
                there.append((file, content))
        return sorted(there, key=lambda entry: entry[1]["num_timesteps"])

    def _content(self, played: dict[bool, Evaluation]) -> dict[str, Any]:
        """The agent as it is now, and the episodes that it has played, as data."""
        moments = moments_of(self.training_env).items()
        return {
            "format": FORMAT,
            "num_timesteps": self.num_timesteps,
            "policy": self.model.policy.state_dict(),
            "statistics": {
                name: (th.from_numpy(part.mean), th.from_numpy(part.var), float(part.count))
                for name, part in moments
            },
            "played": {
                kind: (float(episodes.returns.mean()), th.from_numpy(episodes.limited))
                for kind, episodes in played.items()
                if episodes.whole
            },
        }

    def _evaluated(self, played: dict[bool, Evaluation]) -> None:
        if 2 * self.num_timesteps < self.model._total_timesteps:
            return
        path = self._candidates / f"{self.num_timesteps}.pt"
        if path.exists() and path not in dict(self._read()):  # somebody else's
            return
        with replacing(path) as file:
            th.save(self._content(played), file)
        there = self._read()
        if len(there) > CANDIDATES:
            limits = self._certified_limits()
            ranks = [
                max((one.rank(limits, 1.0) for one in _played(content)), default=(False, -math.inf))
                for _, content in there
            ]
            there[ranks.index(min(ranks))][0].unlink()

    # The end

    def _on_training_end(self) -> None:
        if self.num_timesteps < self.model._total_timesteps:  # stopped before
            return
        began = time.process_time()
        sync_normalization(self.training_env, self.certificate_env)
        env, verbose = self.certificate_env, self.verbose > 0
        self.final = play_final(self.model, env, FINAL_EPISODES, self.final_seed, verbose)
        last = self._content({kind: self.final[kind] for kind in self.kinds()})
        last["policy"] = {name: part.clone() for name, part in last["policy"].items()}
        try:
            told = self._deliver(last)
        except ValueError as error:  # such as episodes without an end: the training is kept
            told = f"Nothing is delivered: {error}"
        finally:
            self._put(last)
        if self.certificate is None:
            self._withdraw()
        if self.verbose > 0:
            print(f"{told} ({time.process_time() - began:.0f} s of a processor)")

    def _deliver(self, last: dict[str, Any]) -> str:
        """Certify the best candidate; what to say of it."""
        limits, refused = self._certified_limits(), list[Certificate]()
        for candidate in self._tries([*(content for _, content in self._read()), last], limits):
            steps = self._put(candidate.content)
            certificate = certify(
                self.model,
                self.certificate_env,
                limits.values.tolist(),
                n_episodes=self.n_episodes,
                deterministic=candidate.deterministic,
                cost_keys=limits.keys,
                seed=self.seed + len(refused),
                tries=TRIES,
            )
            if certificate.verdict == "certified":
                self._write(certificate, steps)
                return f"Delivered, the policy of {steps:,} steps: {certificate}"
            refused.append(certificate)
        if not refused:
            raise ValueError("no candidate's episodes came to an end, with costs that are known")
        nearest = min(refused, key=lambda one: one.nearest.upper - one.nearest.limit)
        return f"Nothing is delivered. The nearest candidate: {nearest}; {HELP}"

    @staticmethod
    def _tries(contents: Sequence[dict[str, Any]], limits: Limits) -> Iterator[Candidate]:
        """Candidates in the order in which they are tried, each with more caution."""
        left = [candidate for content in contents for candidate in _played(content)]
        for caution in range(1, min(TRIES, len(left)) + 1):
            ranks = [candidate.rank(limits, caution) for candidate in left]
            yield left.pop(ranks.index(max(ranks)))

    def _put(self, content: dict[str, Any]) -> int:
        """Give the model and the environment the weights and statistics of a candidate."""
        self.model.policy.load_state_dict(content["policy"])
        moments = moments_of(self.certificate_env)
        for name, (mean, var, count) in content["statistics"].items():
            part = moments[name]
            part.mean, part.var, part.count = mean.numpy(), var.numpy(), count
        return int(content["num_timesteps"])

    def _withdraw(self) -> None:
        """Remove the agent of an earlier training, if there is one."""
        if (self.folder / CERTIFICATE).exists():
            for name in (CERTIFICATE, NORMALIZER, MODEL):  # without the first they are not taken
                (self.folder / name).unlink(missing_ok=True)

    def _write(self, certificate: Certificate, steps: int) -> None:
        """Put the certified agent into the place of an earlier one."""
        contents = {CERTIFICATE: certificate.to_json().encode()}
        if (normalizer := normalizer_of(self.certificate_env)) is not None:
            contents[NORMALIZER] = pickle.dumps(normalizer)
        trained, self.model.num_timesteps = self.model.num_timesteps, steps
        self.model.save(model := BytesIO())
        self.model.num_timesteps = trained
        contents[MODEL] = model.getvalue()
        with ExitStack() as files:
            # Until all are written the earlier agent stays. Then the files take their names, in
            # reverse: until the certificate does, the earlier one is of another agent.
            for name, content in contents.items():
                file = files.enter_context(replacing(self.folder / name))
                file.write(content)
                file.flush()
        if NORMALIZER not in contents:  # that of the earlier agent
            (self.folder / NORMALIZER).unlink(missing_ok=True)
        self.certificate = certificate


def _played(content: dict[str, Any]) -> list[Candidate]:
    """The candidates that a policy is, with each kind of actions; none if episodes did not end."""
    return [
        Candidate(content, kind, mean_return, costs.numpy())
        for kind, (mean_return, costs) in content["played"].items()
    ]
