"""The agents that come with the package: settings as text, weights as tensors, no programs."""

import json
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_guard.common.certificate import Certificate
from sb3_guard.fields import did_you_mean
from sb3_guard.ids import with_version
from sb3_guard.vector import normalizer_of
from sb3_guard.zoo.cli.markdown import table
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder
from sb3_guard.zoo.run.run import Run

#: A log folder, written by ``scripts/pretrain.py``; instead of a model a run has ``<env>.pth``.
PRETRAINED = Path(__file__).parents[2] / "pretrained"
#: Kinds of actions in ``result.json``, and in words.
PLAYED = {"stochastic": "sampled", "deterministic": "most likely"}


def pretrained() -> list[RunFolder]:
    """The folders of all of them, those without a limit last."""
    runs = [RunFolder(path) for path in sorted(PRETRAINED.glob("*/*_1"))]
    return sorted(runs, key=lambda run: "cost_limit" not in run.checked_result())


def weights(run: RunFolder) -> Path:
    """The tensors of an agent: of its policy, and ``mean`` and ``var`` of observations."""
    return run.path / f"{run.name}.pth"


def find_pretrained(env_id: str, algo: str | None = None) -> RunFolder:
    """
    The folder of an agent.

    :param env_id: without a version it is the latest one
    :param algo: None: the one with a limit, if there is one
    :raises UsageError: there is none; the message lists those that there are
    """
    runs = {f"{run.path.parent.name} on {run.name}": run for run in pretrained()}
    name = with_version(env_id)
    for run in runs.values():
        if run.name == name and algo in (None, run.path.parent.name):
            return run
    asked = name if algo is None else f"{algo} on {name}"
    raise UsageError(f"no agent comes with the package for {asked}; {did_you_mean(asked, runs)}")


def load_pretrained(
    env_id: str, algo: str | None = None, *, seed: int = 0, n_envs: int = 1, device: str = "auto"
) -> BaseAlgorithm:
    """
    An agent that comes with the package, in an environment of its own: ``model.get_env()``.

    Nothing is unpickled. The networks that playing does not need, critics and the like, are new.

    :param env_id: without a version it is the latest one
    :param algo: key of the algorithm; None: the one with a limit, if there is one
    :param seed: of the environment
    :param n_envs: number of parallel environments
    :param device: torch device
    :raises UsageError: there is none; the message lists those that there are
    """
    run = find_pretrained(env_id, algo)
    result = run.checked_result()
    named = {"algo": run.path.parent.name, "env": run.name, "vec_env": "native"}
    flags = RunFlags.of({**named, "seed": seed, "device": device})
    values = {**run.hyperparams(), "n_envs": n_envs}
    if "cost_limit" in values:  # that of the training may be lower
        values["cost_limit"] = result["cost_limit"]
    model = Run(flags, values).make_model()
    model.num_timesteps = result["n_timesteps"]
    saved = th.load(weights(run), map_location=model.device, weights_only=True)
    model.set_parameters({"policy": saved["policy"]}, exact_match=False, device=model.device)
    normalizer = normalizer_of(model.get_env())
    if normalizer is not None:
        normalizer.training = False
        model.learnt_normalized = normalizer.norm_obs  # type: ignore[attr-defined]
        statistics: Any = normalizer.obs_rms  # not a dictionary of several
        statistics.mean, statistics.var = (
            saved[name].numpy(force=True) for name in ("mean", "var")
        )
        statistics.count = 1.0  # they are of something
    return model


def certificates(run: RunFolder) -> dict[str, Certificate]:
    """What an agent's fresh episodes have shown, of each of :data:`PLAYED`."""
    played = run.checked_result()["played"]
    return {
        actions: Certificate.from_json(json.dumps(content)) for actions, content in played.items()
    }


def listed() -> str:
    """A table of them with return and cost, and the confidence bound that decides."""
    header = ["environment", "algorithm", "steps", "trained at"]
    for actions in PLAYED.values():
        header += [f"return, {actions} actions", f"cost, {actions} actions"]
    rows = []
    for run in pretrained():
        result = run.checked_result()
        limit = result.get("trained_at", result.get("cost_limit"))
        trained_at = "–" if limit is None else f"{limit:g}"
        cells = [run.name, run.path.parent.name, f"{result['n_timesteps']:,}", trained_at]
        for certificate in certificates(run).values():
            cells += [
                f"{certificate.mean_return:.1f}",
                f"{certificate.verdict}: {certificate.nearest}",
            ]
        rows.append(cells)
    return table(header, rows)
