"""What a run comes to: the episodes of its last epoch, and what it was made with."""

import platform
import subprocess
import time
from collections.abc import Mapping
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

import sb3_guard
from sb3_guard.algorithms.common.costs import limits_at
from sb3_guard.common.monitor import cost_keys_of, find_monitor
from sb3_guard.errors import NumberError
from sb3_guard.judging import Mean
from sb3_guard.zoo.run.folder import EPOCH

DIVERGED = 10  # episodes in a row that a physics error ended, after which training stops
PACKAGES = ("mujoco", "gymnasium", "stable_baselines3", "torch", "numpy")


def commit() -> str | None:
    """
    The git commit that this package's code is at, followed by ``-dirty`` if it was changed since.

    A package that was built from a checkout has the file ``COMMIT``.

    :return: None if nothing tells
    """
    git = ["git", "-C", str(Path(sb3_guard.__file__).parent)]
    describe = "describe --always --dirty --abbrev=40 --exclude=*".split()
    options: dict[str, Any] = {"capture_output": True, "text": True, "check": True, "timeout": 20}
    try:
        # A virtual environment inside somebody's checkout is not part of that checkout.
        subprocess.run([*git, "ls-files", "--error-unmatch", "__init__.py"], **options)
        return str(subprocess.run([*git, *describe], **options).stdout.strip())
    except (OSError, subprocess.SubprocessError):
        built = Path(sb3_guard.__file__).with_name("COMMIT")
        return built.read_text().strip() if built.is_file() else None


def processor() -> str:
    """Model of the processor, and the instructions of it that torch and NumPy round with."""
    model = platform.processor() or platform.machine()
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
    simd: Any = np.show_config(mode="dicts")["SIMD Extensions"]
    used = [*simd["baseline"], *simd.get("found", [])][-1]
    return f"{model}, torch {th.backends.cpu.get_cpu_capability()}, NumPy {used}"


def provenance() -> dict[str, Any]:
    """
    What a result was made with.

    :return: ``versions`` of what is there, git ``commit``, ``platform`` and :func:`processor`
    """
    versions = {"sb3_guard": sb3_guard.__version__, "python": platform.python_version()}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):  # the algorithms train without MuJoCo, too
            versions[package] = metadata.version(package)
    return {
        "versions": versions,
        "commit": commit(),
        "platform": platform.platform(),
        "processor": processor(),
    }


class Epochs(BaseCallback):
    """
    Collect the episodes of each epoch.

    The paper's figures of merit are means over the episodes that ended in the final *epoch*, the
    final rollout; :meth:`result` has them. Off-policy algorithms, whose rollouts are too short to
    end many episodes, have epochs of 30,000 steps.

    :param cut: a wrapper ends the episodes early, so that their costs do not say whether the agent
        keeps its limits
    """

    def __init__(self, cut: bool = False):
        super().__init__()
        self.cut = cut
        # step at which it ended, return, cost, length, and what the m limits bound: the episodes
        # of the epoch under way
        self._episodes: list[list[float]] = []
        #: the same without the step, of the last epoch in which any ended, [E, 3 + m]
        self.last = np.zeros((0, 4))
        self._diverged = 0  # episodes in a row that a physics error ended
        # Taken now: what lies on disk may change while the run continues.
        self._provenance = provenance()

    def _on_rollout_start(self) -> None:
        if not isinstance(self.model, OffPolicyAlgorithm):
            self._episodes = []

    def _on_step(self) -> bool:
        bounded = "max" if self._limits_worst else "c"
        for i in np.flatnonzero(self.locals["dones"]):
            episode = self.locals["infos"][i]["episode"]
            costs = [episode.get(f"{bounded}_{key}", episode[bounded]) for key in self._keys]
            totals = [episode[name] for name in "rcl"]
            self._episodes.append([self.model.num_timesteps, *totals, *costs])
            self._diverged = self._diverged + 1 if np.isnan(episode["c"]) else 0
        return True

    def _on_rollout_end(self) -> None:
        if isinstance(self.model, OffPolicyAlgorithm):
            begin = self.model.num_timesteps - EPOCH
            self._episodes = [episode for episode in self._episodes if episode[0] > begin]
        if self._episodes:
            self.last = np.array(self._episodes)[:, 1:]
        if self._diverged >= DIVERGED:
            raise NumberError(
                f"the last {self._diverged} episodes all ended in a physics error, and nothing can "
                "be learnt from them: reduce the robot's timestep, or the gears, gains and control "
                "ranges of its actuators"
            )
        errors = find_monitor(self.training_env).physics_errors
        if errors:
            self.logger.record("rollout/physics_errors", errors)

    @property
    def _keys(self) -> tuple[str, ...]:
        return cost_keys_of(self.model, self.training_env)

    @property
    def _limits_worst(self) -> bool:
        return getattr(self.model, "limit_on", "sum") == "max"

    def result(self) -> dict[str, Any]:
        """
        J_r, M_c and ρ_c as the paper defines them, and what they were obtained with.

        :return: ``label`` and ``family`` that the algorithm's class states; of the last epoch in
            which any episode ended the number of ``episodes``, ``return``, ``cost`` and
            ``length``, means, and ``costs``, by key the ``mean`` of what its limit bounds, its
            ``standard_error``, the ``limit``, and the number of further episodes that ended in
            ``physics_errors``;
            ``cost_rate``, cumulative cost ÷ steps of the whole run, ``physics_errors``, the number
            of episodes that one ended, ``cost_limit`` (None: unconstrained), ``limit_on`` of an
            algorithm that limits the worst step, ``cut`` where a wrapper ended the episodes early,
            ``seconds`` of training, and :func:`provenance`
        """
        model: Any = self.model
        monitor, keys = find_monitor(self.training_env), self._keys
        constrained = getattr(model, "constrained", False)
        limits = model.final_cost_limits.tolist() if constrained else [None] * len(keys)
        known = ~np.isnan(self.last[:, 1])  # the cost of those that a physics error ended is not
        episodes = self.last[known]
        means = episodes[:, :3].mean(axis=0).tolist() if len(episodes) else [None] * 3
        bounded = self.last[:, 3:].T if len(self.last) else np.zeros((len(keys), 0))
        costs = {
            key: {**Mean.of(values).data(), "limit": limit}
            for key, values, limit in zip(keys, bounded, limits, strict=True)
        }
        rate = monitor.total_cost / monitor.total_steps if monitor.total_steps else None
        return {
            "label": getattr(model, "label", None),
            "family": getattr(model, "family", None),
            **dict(zip(("return", "cost", "length"), means, strict=True)),
            "costs": costs,
            "episodes": len(episodes),
            "cost_rate": rate,
            "n_timesteps": model.num_timesteps,
            "physics_errors": monitor.physics_errors,
            "cost_limit": limits_at(model.cost_limit, 0.0) if constrained else None,
            **({"limit_on": "max"} if self._limits_worst else {}),
            **({"cut": True} if self.cut else {}),
            # SB3's clock, which a resumed run sets back
            "seconds": round((time.time_ns() - model.start_time) / 1e9, 3),
            **self._provenance,
        }

    def state(self) -> dict[str, Any]:
        """What a resumed run needs to tell the same result."""
        return {
            "last": self.last,
            "diverged": self._diverged,
            "episodes": self._episodes,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state`."""
        self.last, self._episodes = state["last"], list(state["episodes"])
        self._diverged = state["diverged"]


def summary(result: Mapping[str, Any]) -> str:
    """What a training came to, as the paper measures it, in a line."""
    if result["return"] is None:
        return "no episode has ended"
    line = "return J_r {return:.5g}, episode cost M_c {cost:.5g}, cost rate ρ_c {cost_rate:.5g}"
    return line.format(**result)
