"""Make the trained agents that the package ships: ``python scripts/pretrain.py``.

Trains what is missing with the library's own command, writes a small copy of each agent to
``sb3_guard/pretrained`` in the layout of a log folder, and plays it for 100 episodes with its noise
and 100 without; what it got is in its ``result.json``, and ``enjoy --pretrained`` prints it.
Constrained agents are trained at a lower limit than the one they are shipped with, which their mean
cost keeps in both. ``--list`` prints how each agent is trained;
with ``-f`` runs are taken that are there, made by exactly this, such as::

    python -m sb3_guard.train --algo cpo --env Goal_Point_8Hazards -n 1e6 --seed 1 \
        --eval-freq -1 --num-threads 1 -params cost_limit:3
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import zipfile
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_guard import evaluate_policy, make_vec_env, train
from sb3_guard.common.evaluation import Estimate
from sb3_guard.zoo.agents.playback import PRETRAINED
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.checkpoint import read_normalizer
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder, run_path
from sb3_guard.zoo.run.hyperparams import build, check
from sb3_guard.zoo.run.make_envs import full_id, make_envs


class Agent(NamedTuple):
    """What is trained."""

    algo: str
    env: str
    seed: int
    trained_at: float | None = None  # cost limit
    limit: float | None = None  # which it is to keep

    @property
    def id(self) -> str:
        """Full id of the environment."""
        return full_id(self.env)

    @property
    def settings(self) -> dict[str, float]:
        """Hyperparameters that ``hyperparams/`` does not say."""
        return {"cost_limit": self.trained_at} if self.trained_at else {}

    @property
    def command(self) -> str:
        """How."""
        return (
            f"python -m sb3_guard.train --algo {self.algo} --env {self.env} -n 1e6 "
            f"--seed {self.seed} --eval-freq -1 --num-threads 1"
            + (" -params" if self.settings else "")
            + "".join(f" {key}:{value:g}" for key, value in self.settings.items())
        )

    @property
    def flags(self) -> dict[str, Any]:
        """The same as a run's ``args.yml`` has it."""
        return {"algo": self.algo, "env": self.id, "n_timesteps": 1_000_000,
                "seed": self.seed, "eval_freq": -1, "num_threads": 1,
                "hyperparams": self.settings or None,
                "env_kwargs": None, "conf_file": None}  # fmt: skip


AGENTS = (
    Agent("cpo", "Goal_Point_8Hazards", 1, trained_at=3, limit=5),
    Agent("cpo", "Goal_Point_8Ghosts", 0, trained_at=4, limit=5),
    Agent("trpo_lag", "SafetyPointGoal1-v0", 0, trained_at=15, limit=25),
    # without its noise the robot is faster, and speed costs
    Agent("cpo", "SafetyHalfCheetahVelocity-v1", 0, trained_at=8, limit=25),
    Agent("trpo", "Goal_Point_8Hazards", 0),
)
# What only training needs: loaded without it, an agent begins a new training where it stands.
TRAINING_ONLY = (
    "_last_obs", "_last_original_obs", "_last_episode_starts", "ep_info_buffer",
    "ep_success_buffer", "ep_cost_buffer", "episodes", "last_costs",
    "total_costs", "costs", "timing", "start_time", "_ended_costs", "_ended_lengths", "_warned",
)  # fmt: skip


def find(agent: Agent, folders: Sequence[str]) -> RunFolder:
    """The finished run of an agent in the first folder that has one; else it is trained now."""
    for folder in folders:
        for path in sorted(Path(folder, agent.algo).glob(f"{agent.id}_*")):
            run = RunFolder.open(path)
            args = run.args()
            if run.result.exists() and all(args[key] == v for key, v in agent.flags.items()):
                return run
    print(agent.command)
    if train.main([*agent.command.split()[3:], "-f", folders[0]]):
        raise SystemExit(f"not trained: {agent.command}")
    return find(agent, folders[:1])


def slim(model: BaseAlgorithm, path: Path) -> None:
    """Save an agent without what only training needs, compressed, the same bytes every time."""
    for name in model._get_torch_save_params()[0]:
        if name.endswith("optimizer"):
            attrgetter(name)(model).state.clear()
    buffer = io.BytesIO()
    model.save(buffer, exclude=TRAINING_ONLY)
    with zipfile.ZipFile(buffer) as full, zipfile.ZipFile(path, "w") as small:
        for name in full.namelist():
            if name == "system_info.txt":  # where it was trained is nobody's business
                continue
            content = full.read(name)
            if name == "data":
                content = json.dumps(_undescribed(json.loads(content))).encode()
            member = zipfile.ZipInfo(name)  # dated 1980
            member.external_attr = 0o644 << 16
            small.writestr(member, content, zipfile.ZIP_DEFLATED, 9)


def _undescribed(data: dict[str, Any]) -> dict[str, Any]:
    """What SB3 saves, without the descriptions of objects, which have addresses in memory."""
    keep = (":type:", ":serialized:")
    return {
        name: {key: value[key] for key in keep}
        if isinstance(value, dict) and ":serialized:" in value
        else value
        for name, value in data.items()
    }


def export(run: RunFolder, agent: Agent) -> RunFolder:
    """Copy a run to the package, small; the copy plays as the original does."""
    where = (str(PRETRAINED), agent.algo, agent.id)
    shutil.rmtree(run_path(*where, 1), ignore_errors=True)
    flags = RunFlags.of({**run.args(), "log_folder": str(PRETRAINED)})
    copy = RunFolder.create(flags, run.hyperparams(), agent.command, run_path(*where, 1))
    for file in copy.path.rglob("args.yml"):  # where the package is installed is nobody's business
        file.write_text(file.read_text().replace(str(PRETRAINED), "logs"))
    cls = algorithm(agent.algo)
    model = cls.load(run.model, device="cpu")
    if agent.limit is not None:
        model.cost_limit = agent.limit
    slim(model, copy.model)
    if run.normalizer.exists():
        normalizer = read_normalizer(run.normalizer)
        normalizer.old_obs = normalizer.old_reward = np.array([])
        normalizer.set_venv(make_vec_env(agent.id, 1))  # only then it can be saved
        normalizer.save(str(copy.normalizer))
    observations = np.random.default_rng(0).normal(size=(100, *model.observation_space.shape))
    want, got = (one.predict(observations, deterministic=True)[0]
                 for one in (cls.load(run.model), cls.load(copy.model)))  # fmt: skip
    np.testing.assert_array_equal(want, got)
    result = json.loads(run.result.read_text())
    if agent.limit is not None:
        result |= {"trained_at": agent.trained_at, "cost_limit": agent.limit}
    copy.write_result({key: v for key, v in result.items() if key not in ("platform", "seconds")})
    return copy


def played(run: RunFolder, agent: Agent) -> dict[str, dict[str, Estimate]]:
    """Return and cost of an agent in 100 episodes with its noise and 100 without."""
    cls = algorithm(agent.algo)
    model = cls.load(run.model, device="cpu")
    setup = build(check(agent.algo, cls, run.hyperparams()))
    found = {}
    for seed, mode in ((10_000, "stochastic"), (20_000, "deterministic")):
        env = make_envs(
            agent.id, setup, n_envs=100, seed=seed, vec_env="native", env_kwargs=setup.env_kwargs,
            evaluation=True,
            normalizer=read_normalizer(run.normalizer) if run.normalizer.exists() else None,
        )  # fmt: skip
        one = evaluate_policy(model, env, 100, deterministic=mode == "deterministic")
        env.close()
        found[mode] = {"return": one.estimate(one.returns), "cost": one.estimate(one.costs)}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "-f", "--folders", nargs="+", default=["logs/pretrained"],
        help="log folders: a run is taken from the first that has it, or trained into the first",
    )  # fmt: skip
    parser.add_argument("--list", action="store_true", help="print the commands only")
    args = parser.parse_args()
    for agent in AGENTS:
        at = "" if agent.limit is None else f"  # keeps {agent.limit:g}"
        if args.list:
            print(f"{agent.command}{at}")
            continue
        copy = export(find(agent, args.folders), agent)
        found = played(copy, agent)
        copy.write_result({**(copy.read_result() or {}), "played": found})
        size = sum(file.stat().st_size for file in copy.path.rglob("*") if file.is_file())
        print(f"{copy.path.relative_to(PRETRAINED)} {size / 1024:.0f} KiB{at}")
        for mode, got in found.items():
            print(f"  {mode:<13} return {got['return']}, cost {got['cost']}", flush=True)
            if agent.limit is not None and got["cost"].mean > agent.limit:
                raise SystemExit(f"{agent.algo} on {agent.env} does not keep {agent.limit}")


if __name__ == "__main__":
    main()
