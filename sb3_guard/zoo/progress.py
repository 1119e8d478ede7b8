"""What a person watching a run wants to see: how far it is, how well it does, how safely."""

import sys
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from tqdm import tqdm

from sb3_guard.common.monitor import CostMonitor


def find_monitor(env: VecEnv) -> CostMonitor:
    """The cost monitor among an environment's wrappers."""
    layer = env
    while isinstance(layer, VecEnvWrapper):
        if isinstance(layer, CostMonitor):
            return layer
        layer = layer.venv
    raise ValueError("the environment is not wrapped in a CostMonitor")


class Epochs(BaseCallback):
    """
    Collect the episodes of each rollout, and show them on a progress bar.

    The paper's figures of merit are means over the episodes that ended in the final rollout, its
    *epoch*; :meth:`result` has them.

    :param total: steps at which training ends
    :param bar: show a progress bar on stderr
    """

    def __init__(self, total: int, bar: bool = False):
        super().__init__()
        self.total = total
        self.show = bar
        self.bar: Any = None
        self._episodes: list[dict[str, Any]] = []
        #: return, cost, length of the episodes of the last rollout in which any ended, [E, 3]
        self.last = np.zeros((0, 3))

    def _on_training_start(self) -> None:
        if self.show:
            self.bar = tqdm(
                total=self.total,
                initial=self.model.num_timesteps,
                unit=" steps",
                unit_scale=True,
                dynamic_ncols=True,
                file=sys.stderr,
            )
            self._describe()

    def _on_rollout_start(self) -> None:
        self._episodes = []

    def _on_step(self) -> bool:
        if np.any(self.locals["dones"]):
            self._episodes += [i["episode"] for i in self.locals["infos"] if "episode" in i]
        if self.bar is not None:
            self.bar.update(self.model.num_timesteps - self.bar.n)
        return True

    def _on_rollout_end(self) -> None:
        if self._episodes:
            self.last = np.array([(one["r"], one["c"], one["l"]) for one in self._episodes])
            self._describe()
        errors = find_monitor(self.training_env).physics_errors
        if errors:
            self.logger.record("rollout/physics_errors", errors)

    def _on_training_end(self) -> None:
        if self.bar is not None:
            self.bar.close()
            self.bar = None

    def _describe(self) -> None:
        if self.bar is not None and len(self.last):
            now = self.result()
            self.bar.set_postfix_str(
                f"return {now['return']:.2f}, cost {now['cost']:.2f}, rate {now['cost_rate']:.4f}"
            )

    def result(self) -> dict[str, Any]:
        """
        J_r, M_c and ρ_c as the paper defines them.

        :return: ``return``, ``cost`` and ``length``, means over the episodes of the last rollout in
            which any ended (None if none did), their number ``episodes``, ``cost_rate``,
            cumulative cost ÷ steps of the whole run, and ``physics_errors``, the number of episodes
            that ended because the physics diverged
        """
        monitor = find_monitor(self.training_env)
        means = self.last.mean(axis=0).tolist() if len(self.last) else [None] * 3
        rate = monitor.total_cost / monitor.total_steps if monitor.total_steps else None
        return {
            **dict(zip(("return", "cost", "length"), means, strict=True)),
            "cost_rate": rate,
            "episodes": len(self.last),
            "n_timesteps": self.model.num_timesteps,
            "physics_errors": monitor.physics_errors,
        }

    def state(self) -> dict[str, Any]:
        """What a resumed run needs to tell the same result."""
        return {"last": self.last}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state`."""
        self.last = state["last"]
