"""A training that ends with a certified agent: candidates, screening, certificate."""

import copy
import math
import os
import pickle
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.td3.policies import TD3Policy

from sb3_guard.common.certificate import (
    LEAST,
    MOST,
    Certificate,
    certify,
    limits_of,
    refuse_training_only,
)
from sb3_guard.common.evaluation import check_agent, evaluate_policy, sync_normalization
from sb3_guard.common.files import replacing
from sb3_guard.common.monitor import cost_keys_of
from sb3_guard.fields import fit
from sb3_guard.vector import moments_of, normalizer_of

HELP = (
    "a training with more steps (-n), more episodes (--certify), a lower cost_limit than you need, "
    "or SAC-Lagrangian may help"
)
CERTIFICATE = "certificate.json"
MODEL, NORMALIZER = "certified_model.zip", "certified_model_vecnormalize.pkl"
CANDIDATE = {"num_timesteps", "policy", "statistics"}  # the entries of its file
Candidates = Mapping[int, dict[str, Any]]  # what is in their files, by their steps
TRIES = 3  # of candidates, with one kind of actions or the other; they share the error


class DeliveryCallback(BaseCallback):
    """
    End a training with an agent that is certified to keep its limit.

    From the middle of the training on its policies are kept as *candidates*, with their observation
    statistics. After its end each plays a few episodes with its most likely actions and a few with
    sampled ones. Of those whose mean cost plus its standard error is within the limit, the one of
    highest return is certified by fresh episodes (:func:`~sb3_guard.certify`); if it is refused,
    others follow, which are further within it. The three tries share the error. What is certified
    is written as ``certified_model.zip``, with ``certified_model_vecnormalize.pkl`` where
    observations are normalised, and ``certificate.json``, which vouches for them: it is of the last
    training that ended in this folder. The model itself keeps its last weights.

    A training that was cut and continues keeps the candidates that it has, and ends alike; one that
    begins takes those of another away.

    :param eval_env: environment to play in, wrapped as the training environment is, but for
        wrappers that are for training only
    :param folder: where the files are written; the current one unless it is given
    :param cost_limit: d, one number or one per cost; None: the model's own at the end
    :param candidates: how many policies are kept, the last one among them
    :param screening: episodes of each, with each kind of actions
    :param n_episodes: most episodes of a certificate, at least 100
    :param deterministic: certify the most likely actions, or sampled ones; None: either, if the
        agent can be exported with sampled ones
    :param seed: the episodes' seeds are drawn from it
    :param verbose: 1 prints what is delivered, or how far the nearest candidate is away
    """

    def __init__(
        self,
        eval_env: VecEnv,
        folder: str | os.PathLike[str] = ".",
        cost_limit: float | Sequence[float] | None = None,
        *,
        candidates: int = 4,
        screening: int = 50,
        n_episodes: int = MOST,
        deterministic: bool | None = None,
        seed: int = 0,
        verbose: int = 1,
    ) -> None:
        super().__init__(verbose)
        fit("n_episodes", n_episodes, int, LEAST, ends="[)")
        fit("candidates", candidates, int, 1, ends="[)")
        fit("screening", screening, int, 2, ends="[)")
        self.eval_env, self.folder = eval_env, Path(folder)
        self.cost_limit, self.candidates, self.screening = cost_limit, candidates, screening
        self.n_episodes, self.deterministic, self.seed = n_episodes, deterministic, seed
        #: of the agent that was delivered; None: none was
        self.certificate: Certificate | None = None

    def _init_callback(self) -> None:
        """
        :raises ValueError: the limit is not finite, or does not fit the costs, or ``eval_env`` is
            not normalised as the training is, has other actions, or a wrapper that is for training
            only
        :raises OSError: the folder can't be written, or ``certificate.json`` is of something else
        """
        self._limits()
        refuse_training_only(self.eval_env)
        sync_normalization(self.training_env, self.eval_env)
        check_agent(self.model, self.eval_env)
        if (file := self.folder / CERTIFICATE).exists() and not (self.folder / MODEL).exists():
            raise FileExistsError(f"{file} would be replaced; move it, or choose another folder")
        (self.folder / "candidates").mkdir(parents=True, exist_ok=True)

    def _limits(self) -> list[float]:
        keys = cost_keys_of(self.model, self.eval_env)
        return limits_of(self.model, self.cost_limit, keys)

    def _on_training_start(self) -> None:
        self.certificate = None
        for file, candidate in self._kept():
            steps = candidate["num_timesteps"]
            if steps > self.num_timesteps or self._candidate(steps) != file:
                file.unlink()  # of another training

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if 2 * self.num_timesteps >= self.model._total_timesteps:
            self._keep()

    def _kept(self) -> Iterator[tuple[Path, dict[str, Any]]]:
        """Files of candidates, and what is in them; not what is damaged, or was put there."""
        for file in sorted((self.folder / "candidates").glob("*.pt")):
            content = None
            with suppress(Exception):  # torch has many words for a file that it can't read
                content = th.load(file, map_location="cpu", weights_only=True)
            if file.stem.isdigit() and isinstance(content, dict) and content.keys() == CANDIDATE:
                yield file, content

    def _candidate(self, steps: int) -> Path:
        """Where the first policy of one of equal parts of the training's last half is kept."""
        share = 2 * min(steps / self.model._total_timesteps, 1.0) - 1.0
        part = math.floor(share * (self.candidates - 1))
        return self.folder / "candidates" / f"{part:03d}.pt"

    def _keep(self) -> dict[str, Any]:
        """The policy as it is, which its file gets if there is no such file yet."""
        content = {
            "num_timesteps": self.num_timesteps,
            "policy": self.model.policy.state_dict(),
            "statistics": {
                name: (th.from_numpy(part.mean), th.from_numpy(part.var), float(part.count))
                for name, part in moments_of(self.training_env).items()
            },
        }
        if not (file := self._candidate(self.num_timesteps)).exists():
            with replacing(file) as written:
                th.save(content, written)
        return content

    def _on_training_end(self) -> None:
        if self.num_timesteps < self.model._total_timesteps:  # stopped before
            return
        trained = copy.deepcopy(self._keep())
        kept = {candidate["num_timesteps"]: candidate for _, candidate in self._kept()}
        began = time.process_time()
        try:
            tried = self._deliver(kept | {self.num_timesteps: trained})
        except ValueError as error:  # such as episodes without an end: the training is kept
            tried = f"Nothing is delivered: {error}"
        finally:
            self._put(trained)
        if self.certificate is None:
            self._withdraw()
        if self.verbose > 0:
            taken = f"({time.process_time() - began:.0f} s of a processor)"
            print(f"{tried} {taken}")

    def _withdraw(self) -> None:
        """Remove the agent of an earlier training."""
        for name in (CERTIFICATE, NORMALIZER, MODEL):  # without the first they are not taken
            (self.folder / name).unlink(missing_ok=True)

    def _deliver(self, candidates: Candidates) -> str:
        """Certify the best candidate; what to say of it."""
        limits = self._limits()
        refused: list[Certificate] = []
        for steps, deterministic in self._tries(candidates, np.array(limits)):
            self._put(candidates[steps])
            certificate = certify(
                self.model,
                self.eval_env,
                limits,
                n_episodes=self.n_episodes,
                deterministic=deterministic,
                seed=self.seed + len(refused),
                tries=TRIES,
            )
            if certificate.verdict == "certified":
                self._write(certificate, steps)
                return f"Delivered, the policy of {steps:,} steps: {certificate}"
            refused.append(certificate)
        nearest = min(refused, key=lambda certificate: certificate.nearest.excess)
        return f"Nothing is delivered. The nearest candidate: {nearest}; {HELP}"

    def _tries(self, candidates: Candidates, limits: np.ndarray) -> Iterator[tuple[int, bool]]:
        """
        Candidates in the order in which they are tried, and whether with their most likely actions.

        First the one of highest return whose mean cost plus its standard error is within the limit;
        after a refusal plus twice that, then three times. If none is, the nearest.
        """
        screened = {
            (steps, deterministic): self._screen(candidate, deterministic, limits)
            for deterministic in self._kinds()
            for steps, candidate in candidates.items()
        }
        for caution in range(1, min(TRIES, len(screened)) + 1):
            ranks = dict[tuple[int, bool], tuple[bool, float]]()
            for candidate, (mean_return, excess, error) in screened.items():
                most = float(np.max(excess + caution * error))
                ranks[candidate] = (True, mean_return) if most <= 0.0 else (False, -most)
            best = max(ranks, key=lambda candidate: ranks[candidate])
            if caution > 1 and ranks[best][1] == -np.inf:  # its episodes did not end
                return
            del screened[best]
            yield best

    def _kinds(self) -> list[bool]:
        """The kinds of actions: whether the most likely ones."""
        if self.deterministic is not None:
            return [self.deterministic]
        # Those whose sampled actions are the same, are of noise that is not saved, or can't be
        # exported, have the most likely ones alone.
        policy, noisy = self.model.policy, getattr(self.model, "use_sde", False)
        box = isinstance(self.model.action_space, spaces.Box)
        return [True, False] if box and not noisy and not isinstance(policy, TD3Policy) else [True]

    def _screen(
        self, candidate: Mapping[str, Any], deterministic: bool, limits: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Mean return, mean costs above the limits and their standard errors, shape [m]."""
        self._put(candidate)
        played = evaluate_policy(
            self.model, self.eval_env, self.screening, deterministic, seed=self.seed
        )
        costs = played.limited  # [E, m]; NaN after a physics error
        if len(costs) < self.screening or np.isnan(costs).any():
            return -np.inf, np.full(len(limits), np.inf), np.zeros(len(limits))
        error = costs.std(axis=0, ddof=1) / np.sqrt(len(costs))
        return float(played.returns.mean()), costs.mean(axis=0) - limits, error

    def _put(self, content: Mapping[str, Any]) -> None:
        """Give the model and the environment the weights and statistics of a candidate."""
        self.model.policy.load_state_dict(content["policy"])
        moments = moments_of(self.eval_env)
        for name, (mean, var, count) in content["statistics"].items():
            part = moments[name]
            part.mean, part.var, part.count = mean.numpy(), var.numpy(), count

    def _write(self, certificate: Certificate, steps: int) -> None:
        contents = {CERTIFICATE: certificate.to_json().encode()}
        if (normalizer := normalizer_of(self.eval_env)) is not None:
            contents[NORMALIZER] = pickle.dumps(normalizer)
        trained, self.model.num_timesteps = self.model.num_timesteps, steps
        self.model.save(model := BytesIO())
        self.model.num_timesteps = trained
        contents[MODEL] = model.getvalue()
        with ExitStack() as files:
            # Once all are written they take their names, the certificate as the last one.
            for name, content in contents.items():
                file = files.enter_context(replacing(self.folder / name))
                file.write(content)
                file.flush()
            self._withdraw()
        self.certificate = certificate
