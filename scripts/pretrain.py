"""Ship the best certified agents of the grand table: ``python scripts/pretrain.py logs/grand``.

The runs below the folder are those that ``scripts/leaderboard.py --train`` writes. A run is
a candidate if the mean cost of its final episodes plus two standard errors is within the limit,
with sampled actions and with the most likely ones; of an environment's candidates that with the
highest return is taken. With less than a tenth of the best run's return, of whatever cost, it
hardly does its task and does not count. It is certified with each kind of actions, by fresh
episodes, and shipped if it is; else the next one is tried. An agent that is
shipped already is kept if its return is as high. Runs from a packed archive have no model:
``sb3-guard reproduce ROW`` trains them again, below ``logs/reproduced``. The package gets the
run's settings, its policy's tensors, ``<env>.pth``, and what it got, ``result.json``; the tests get
some observations and actions, ``tests/data/pretrained.npz``.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from archives import with_log_folder
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_guard import Certificate, certify
from sb3_guard.common.certificate import LEFT_OUT
from sb3_guard.judging import TRIES, Limits
from sb3_guard.zoo.agents.pretrained import (
    PLAYED,
    PRETRAINED,
    listed,
    load_pretrained,
    pretrained,
    weights,
)
from sb3_guard.zoo.results.runs import find_runs
from sb3_guard.zoo.run.checkpoint import load_model, read_normalizer
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder, is_run, run_path
from sb3_guard.zoo.run.run import Run

RECORDED = Path(__file__).parents[1] / "tests" / "data" / "pretrained.npz"
# Environments that the grand table is to find an agent for, and the limit it is to keep.
LIMITS = {
    "SafetyPointGoal1-v0": 25.0,
    "SafetyCarGoal1-v0": 25.0,
    "SafetyPointPush1-v0": 25.0,
    "SafetyPointCircle1-v0": 25.0,
    "SafetyHalfCheetahVelocity-v1": 25.0,
    "SafetyHopperVelocity-v1": 25.0,
    "SafetyWalker2dVelocity-v1": 25.0,
    "Goal_Point_8Hazards-v0": 2.0,
    "Goal_Drone_8Hazards-v0": 2.0,
    "Goal_Arm3_8Hazards-v0": 2.0,
    "Goal_Arm6_8Hazards-v0": 2.0,
    "Goal_Hopper_8Hazards-v0": 2.0,
    "Goal_Swimmer_8Hazards-v0": 2.0,
}
SEEDS = {"stochastic": 10_000, "deterministic": 20_000}
DROPPED = ("final", "platform", "seconds")  # of result.json


def candidates(folder: Path, env_id: str, least: float) -> Iterator[RunFolder]:
    """The certified runs on an environment that do its task, the highest return first.

    :param least: only those with a higher return
    """
    certified, best = [], -np.inf
    for path in find_runs(folder):
        if not is_run(path) or (run := RunFolder(path)).name != env_id:
            continue
        if (result := run.read_result()) is None:
            continue
        final = result.get("final", {})
        if not final or result.get("cost_limit") not in (None, LIMITS[env_id]):
            continue
        means = [float(np.mean(episodes["returns"])) for episodes in final.values()]
        limits = Limits(np.array([LIMITS[env_id]]))
        costs = [np.array(episodes["costs"])[:, None] for episodes in final.values()]
        safe = max(float(limits.excess(cost, 2.0)[0]) for cost in costs) <= 0.0
        best = max(best, means[0])
        if means[0] > least and safe:
            certified.append((means[0], min(means), str(path)))
    for mean, lower, name in sorted(certified, reverse=True):
        if lower < best / 10 and best > 0:
            continue
        run = RunFolder(Path(name))
        if run.model.exists():
            yield run
        else:
            row = "/".join(run.path.parts[-3:])
            print(f"return {mean:.4g}, but no model: sb3-guard reproduce {row}")


def shipped_return(env_id: str) -> float:
    """Of the agent with a limit that the package has; minus infinity without one."""
    results = [run.checked_result() for run in pretrained() if run.name == env_id]
    limited = [got for got in results if (got.get("cost_limit") or np.inf) <= LIMITS[env_id]]
    return max((got["played"]["stochastic"]["mean_return"] for got in limited), default=-np.inf)


def loaded(run: RunFolder, n_envs: int, seed: int) -> BaseAlgorithm:
    """The agent of a run as it was saved, with environments to play in."""
    played = Run(RunFlags.of({"algo": run.args()["algo"], "env": run.name}), run.hyperparams())
    normalizer = read_normalizer(run.normalizer) if run.normalizer.is_file() else None
    env = played.make_envs(n_envs, seed, vec_env="native", evaluation=True, normalizer=normalizer)
    return load_model(played.algorithm, run.model, env, "cpu")


def played(run: RunFolder) -> dict[str, Certificate]:
    """What fresh episodes show of an agent, with each kind of actions."""
    values = {}
    for actions, seed in SEEDS.items():
        model, greedy = loaded(run, 100, seed), actions == "deterministic"
        values[actions] = certify(
            model, model.env, LIMITS[run.name], deterministic=greedy, seed=seed, tries=TRIES
        )
        model.env.close()
    return values


def certify_again() -> None:
    """Play the shipped agents anew, for certificates of this version."""
    for run in pretrained():
        algo, result = run.path.parent.name, run.checked_result()
        for actions, seed in SEEDS.items():
            limits = [c["limit"] for c in result["played"][actions]["costs"].values()]
            model = load_pretrained(run.name, algo, seed=seed, n_envs=100, device="cpu")
            greedy = actions == "deterministic"
            got = certify(model, model.env, limits, deterministic=greedy, seed=seed, tries=TRIES)
            model.env.close()
            print(run.path, got, flush=True)
            result["played"][actions] = json.loads(got.to_json())
        run.write_result(result)


def actions_of(model: BaseAlgorithm, raw: np.ndarray, actions: str) -> np.ndarray:
    """What an agent does where it observes this, before normalisation."""
    normalizer = model.get_vec_normalize_env()
    seen = raw if normalizer is None else normalizer.normalize_obs(raw.copy())
    th.manual_seed(0)
    return model.predict(seen, deterministic=actions == "deterministic")[0]


def write(run: RunFolder, limit: float | None, got: dict[str, Certificate]) -> RunFolder:
    """
    Copy a run to the package; the copy acts as the original does, to the last bit.

    :param limit: that it is to keep
    :param got: see :func:`played`
    """
    algo, result = run.args()["algo"], run.checked_result()
    original = loaded(run, 10, 0)
    path = run_path(str(PRETRAINED), algo, run.name, 1)
    (path / run.name).mkdir(parents=True)
    shutil.copy(run.params / "config.yml", path / run.name)
    (path / run.name / "args.yml").write_bytes(with_log_folder(run.params / "args.yml", "logs"))
    copy = RunFolder(path)
    policy = original.policy.state_dict()
    left_out = tuple(f"{part}." for part in LEFT_OUT)
    acting = {n: t.clone() for n, t in policy.items() if not n.startswith(left_out)}
    saved: dict[str, Any] = {"policy": acting}
    if (normalizer := original.get_vec_normalize_env()) is not None:
        for name in ("mean", "var"):
            saved[name] = th.as_tensor(getattr(normalizer.obs_rms, name), dtype=th.float64)
    th.save(saved, weights(copy))
    kept = {key: value for key, value in result.items() if key not in DROPPED}
    if limit is None:
        kept.pop("cost_limit", None)
    else:
        if "cost_limit" in kept:
            kept.setdefault("trained_at", kept["cost_limit"])
        kept["cost_limit"] = limit
    shown = {actions: json.loads(certificate.to_json()) for actions, certificate in got.items()}
    copy.write_result({**kept, "played": shown})
    record(original, load_pretrained(run.name, algo), f"{algo}/{run.name}")
    return copy


def record(original: BaseAlgorithm, copy: BaseAlgorithm, name: str) -> None:
    """Compare what both do along an episode, and keep some of it for the tests."""
    observed, obs = [], original.env.reset()
    while len(observed) < 1000:
        normalizer = original.get_vec_normalize_env()
        observed.append(obs if normalizer is None else normalizer.get_original_obs())
        obs, *_ = original.env.step(original.predict(obs, deterministic=len(observed) % 2 == 0)[0])
    raw = np.concatenate(observed).astype(np.float32)
    some = raw[:: len(raw) // 16]
    content = dict(np.load(RECORDED)) if RECORDED.exists() else {}
    content[f"{name}/observations"] = some
    for actions in PLAYED:
        want, got = (actions_of(model, raw, actions) for model in (original, copy))
        np.testing.assert_array_equal(want, got)
        content[f"{name}/{actions}"] = actions_of(original, some, actions)
    shipped = {f"{run.path.parent.name}/{run.name}" for run in pretrained()}
    content = {key: array for key, array in content.items() if key.rpartition("/")[0] in shipped}
    np.savez_compressed(RECORDED, **content)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="folder of the grand table's runs")
    parser.add_argument("--again", action="store_true", help="certify the shipped agents anew")
    args = parser.parse_args()
    if args.again:
        certify_again()
        return
    for env_id, limit in LIMITS.items():
        shipped = shipped_return(env_id)
        for run in candidates(args.folder, env_id, shipped):
            got = played(run)
            print(run.path, *got.values(), sep="\n  ", flush=True)
            certified = all(one.verdict == "certified" for one in got.values())
            if not certified or got["stochastic"].mean_return <= shipped:
                continue
            for old in PRETRAINED.glob(f"*/{env_id}_1"):
                limited = "cost_limit" in json.loads((old / "result.json").read_text())
                if limited or old.parent.name == run.path.parent.name:
                    shutil.rmtree(old)
            write(run, limit, got)
            break
    print(listed())


if __name__ == "__main__":
    main()
