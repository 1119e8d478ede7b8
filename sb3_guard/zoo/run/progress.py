"""What a person watching a run wants to see: how far it is, how well it does, how safely."""

import platform
import shlex
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from tqdm import tqdm

import sb3_guard
from sb3_guard.algorithms.common.costs import limits_at
from sb3_guard.checks import NumberError
from sb3_guard.common.evaluation import bounded_name
from sb3_guard.common.monitor import cost_keys_of, find_monitor
from sb3_guard.costs import beside, estimate, verdict
from sb3_guard.zoo.cli.usage import packages_flag
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import EPOCH, RunFolder, cost_words

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


def merit(
    episodes: np.ndarray, keys: Sequence[str], limits: Sequence[float | None], cut: bool = False
) -> dict[str, Any]:
    """
    What a result says of the episodes of the last epoch, see :meth:`Epochs.result`.

    :param episodes: return, cost, length, and what each of the m limits bounds, [E, 3 + m]; costs
        are NaN of those that a physics error ended: they are in no mean
    :param keys: of the m costs
    :param limits: of the m costs; None: there is none
    :param cut: a wrapper ended the episodes early, which leaves no verdict
    :return: ``return``, ``cost``, ``length``, ``costs`` and the number of ``episodes``
    """
    known = ~np.isnan(episodes[:, 1])
    episodes, diverged = episodes[known], int((~known).sum())
    means = episodes.mean(axis=0).tolist() if len(episodes) else [None] * (3 + len(keys))
    costs = {}
    for key, limit, mean, values in zip(keys, limits, means[3:], episodes.T[3:], strict=True):
        interval = estimate(values)
        cost: dict[str, Any] = {"mean": mean, "limit": limit}
        if not np.isnan(interval.low):
            cost |= {"low": interval.low, "high": interval.high}
            if limit is not None and not cut:
                cost["verdict"] = verdict(interval.low, interval.high, limit, diverged)
        if diverged:
            cost["physics_errors"] = diverged
        costs[key] = cost
    measures = dict(zip(("return", "cost", "length"), means, strict=False))
    return {**measures, "costs": costs, "episodes": len(episodes)}


class Epochs(BaseCallback):
    """
    Collect the episodes of each epoch, and show them on a progress bar.

    The paper's figures of merit are means over the episodes that ended in the final *epoch*, the
    final rollout; :meth:`result` has them. Off-policy algorithms, whose rollouts are too short to
    end many episodes, have epochs of 30,000 steps.

    :param total: steps at which training ends
    :param bar: show a progress bar on stderr
    :param cut: a wrapper ends the episodes early, so that their costs do not say whether the agent
        keeps its limits
    """

    def __init__(self, total: int, bar: bool = False, cut: bool = False):
        super().__init__()
        self.total = total
        self.show = bar
        self.cut = cut
        self.bar = tqdm(disable=True)
        # step at which it ended, return, cost, length, and what the m limits bound: the episodes
        # of the epoch under way
        self._episodes: list[list[float]] = []
        #: the same without the step, of the last epoch in which any ended, [E, 3 + m]
        self.last = np.zeros((0, 4))
        self._diverged = 0  # episodes in a row that a physics error ended
        # Taken now: what lies on disk may change while the run continues.
        self._provenance = provenance()
        #: steps after each part of the run that was to be shorter than it came to be
        self.learned: list[int] = []

    def _on_training_start(self) -> None:
        self.bar = tqdm(
            total=self.total,
            initial=self.model.num_timesteps,
            unit=" steps",
            unit_scale=True,
            dynamic_ncols=True,
            disable=not self.show,
        )
        self._describe()

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
        self.bar.update(self.model.num_timesteps - self.bar.n)
        return True

    def _on_rollout_end(self) -> None:
        if isinstance(self.model, OffPolicyAlgorithm):
            begin = self.model.num_timesteps - EPOCH
            self._episodes = [episode for episode in self._episodes if episode[0] > begin]
        if self._episodes:
            self.last = np.array(self._episodes)[:, 1:]
            self._describe()
        if self._diverged >= DIVERGED:
            raise NumberError(
                f"the last {self._diverged} episodes all ended in a physics error, and nothing can "
                "be learnt from them: reduce the robot's timestep, or the gears, gains and control "
                "ranges of its actuators"
            )
        errors = find_monitor(self.training_env).physics_errors
        if errors:
            self.logger.record("rollout/physics_errors", errors)

    def _on_training_end(self) -> None:
        self.bar.close()

    def _describe(self) -> None:
        if self.show and len(self.last):
            earned, cost, _, *means = np.nanmean(self.last, axis=0).tolist()
            rows = zip(self._keys, means, self._limits, strict=True)
            costs = {key: {"mean": mean, "limit": limit} for key, mean, limit in rows}
            self.bar.set_postfix_str(
                f"return {earned:.2f}, {cost_words({'cost': cost, 'costs': costs})}, "
                f"rate {self._cost_rate():.4f}"
            )

    @property
    def _keys(self) -> tuple[str, ...]:
        return cost_keys_of(self.model, self.training_env)

    @property
    def _limits_worst(self) -> bool:
        return getattr(self.model, "limit_on", "sum") == "max"

    def _cost_rate(self) -> float | None:
        monitor = find_monitor(self.training_env)
        return monitor.total_cost / monitor.total_steps if monitor.total_steps else None

    @property
    def _limits(self) -> list[float | None]:
        model: Any = self.model
        constrained = getattr(model, "constrained", False)
        return model.final_cost_limits.tolist() if constrained else [None] * len(self._keys)

    def result(self) -> dict[str, Any]:
        """
        J_r, M_c and ρ_c as the paper defines them, and what they were obtained with.

        :return: ``label`` and ``family`` that the algorithm's class states (None: it states none),
            ``return``, ``cost`` and ``length``, means over the episodes of the last epoch in
            which any ended (None if none did), their number ``episodes``, ``costs``, for each
            cost key the ``mean`` of what its limit bounds, the 95 % interval of that mean
            (``low``, ``high``), the ``limit`` (None: unconstrained) and the ``verdict``, "kept",
            "exceeded" or "undecided" (without interval and verdict if fewer than five episodes
            ended), and the number of further episodes that ended in ``physics_errors``, if any did,
            ``cost_rate``, cumulative cost ÷ steps of the whole run, ``physics_errors``, the
            number of episodes that ended because the physics diverged, ``cost_limit`` (None:
            unconstrained), ``limit_on`` of an algorithm that limits the worst step, ``cut`` where a
            wrapper ended the episodes early, which leaves no verdict, ``seconds`` of training, and
            :func:`provenance`. ``learned``, absent from a straight run, is the steps at which it
            was made longer, since warm-up and schedules were those of shorter runs until then
        """
        monitor = find_monitor(self.training_env)
        episodes = self.last if len(self.last) else np.zeros((0, 3 + len(self._keys)))
        constrained = getattr(self.model, "constrained", False)
        limit = limits_at(getattr(self.model, "cost_limit", None), 0.0) if constrained else None
        algorithm = type(self.model)
        return {
            "label": getattr(algorithm, "label", None),
            "family": getattr(algorithm, "family", None),
            **merit(episodes, self._keys, self._limits, self.cut),
            "cost_rate": self._cost_rate(),
            "n_timesteps": self.model.num_timesteps,
            "physics_errors": monitor.physics_errors,
            "cost_limit": limit,
            **({"limit_on": "max"} if self._limits_worst else {}),
            **({"cut": True} if self.cut else {}),
            # SB3's clock, which a resumed run sets back
            "seconds": round((time.time_ns() - self.model.start_time) / 1e9, 3),
            **({"learned": self.learned} if self.learned else {}),
            **self._provenance,
        }

    def state(self) -> dict[str, Any]:
        """What a resumed run needs to tell the same result."""
        return {
            "last": self.last,
            "diverged": self._diverged,
            "episodes": self._episodes,
            "total": self.total,
            "steps": self.model.num_timesteps,
            "learned": self.learned,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state`."""
        self.last, self._episodes = state["last"], list(state["episodes"])
        self._diverged = state["diverged"]
        self.learned = list(state["learned"])
        if state["total"] != self.total:
            self.learned.append(state["steps"])


def rounded(values: np.ndarray) -> list[float | None]:
    """Numbers of six significant digits, for a file; None: it is not known."""
    return [None if np.isnan(value) else float(f"{value:.6g}") for value in values]


def summary(
    folder: RunFolder, flags: RunFlags, result: Mapping[str, Any], seconds: float, finished: bool
) -> str:
    """What a run came to, as the paper measures it, on a few lines."""

    def number(value: float | None, digits: int) -> str:
        return "– (no episode has ended)" if value is None else f"{value:.{digits}f}"

    def bounded(cost: Mapping[str, Any]) -> str:
        text = number(cost["mean"], 3)
        if "low" in cost:
            text += f"   [{cost['low']:.3f}, {cost['high']:.3f}]"
        if cost["limit"] is not None:
            text += f"   limit {cost['limit']:g}"
        text += f": {cost['verdict']}" if "verdict" in cost else ""
        return text + beside(cost.get("physics_errors", 0))

    costs, limit_on = result["costs"], result.get("limit_on", "sum")
    alone = len(costs) == 1 and limit_on == "sum"
    lines = [
        f"{'Finished' if finished else 'Interrupted'} at {result['n_timesteps']:,} steps, "
        f"{seconds:.0f} s",
        f"  run folder         {folder.path}",
        f"  return       J_r   {number(result['return'], 3)}",
        f"  episode cost M_c   {bounded(*costs.values()) if alone else number(result['cost'], 3)}",
        *(
            f"    {bounded_name(key, limit_on):<16} {bounded(cost)}"
            for key, cost in ({} if alone else costs).items()
        ),
        f"  cost rate    ρ_c   {number(result['cost_rate'], 5)}",
    ]
    for name, played in result["final"].items():
        lines.append(
            f"  final, {name:<12}return {np.mean(played['returns']):.3f}, cost "
            f"{(cost := estimate(np.array(played['costs'], float)))}, {len(played['costs'])} "
            f"episodes{beside(cost.diverged)}"
        )
        for key, values in played.get("bounded", {}).items():
            cost, limit = estimate(np.array(values, float)), costs[key]["limit"]
            against = "" if limit is None else f"   {cost.against(limit)}"
            lines.append(f"    {bounded_name(key, limit_on):<16} {cost}{against}")
    packages = packages_flag(flags.gym_packages)
    if not finished:
        lines.append(f"  continue with      {folder.again(flags)}")
    elif (exp_id := folder.path.name[len(folder.name) + 1 :]).isdigit():
        lines.append(
            f"  see the agent      sb3-guard enjoy --algo {flags.algo} --env {flags.env} "
            f"-f {shlex.quote(str(folder.path.parent.parent))} --exp-id {exp_id}{packages}"
        )
    return "\n".join(lines)
