"""The entropy coefficient of SAC's kind of algorithm, with a start that fits the rewards."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.preprocessing import get_action_dim

from sb3_guard.algorithms.common.replay import LagrangianReplay


class Temperature(LagrangianReplay):
    """α for the classes that maximise E[Σ r + α H(π)].

    SB3 learns log α from 0, at ``learning_rate``: where a step's reward is 0.02, the policy stays
    random for the 14,000 gradient steps in which α falls from 1. With ``"auto_reward"`` α begins at
    the mean absolute reward of the steps before the first gradient step, divided by the number n
    of action dimensions. At SB3's target entropy, -n, a step's entropy then weighs as much as its
    reward, whatever the unit of reward.

    :param ent_coef: α: a number; or learnt from 1 (``"auto"``, SB3's default), from a number
        (``"auto_0.1"``), or from the size of the rewards (``"auto_reward"``)
    """

    defaults: ClassVar[dict[str, Any]] = {"ent_coef": "auto_reward"}

    ent_coef: str | float
    target_entropy: str | float
    log_ent_coef: th.Tensor | None
    ent_coef_optimizer: th.optim.Adam | None
    ent_coef_tensor: th.Tensor

    def _check_hyperparameters(self) -> None:
        super()._check_hyperparameters()
        text = str(self.ent_coef)
        if text in ("auto", "auto_reward"):
            return
        try:
            start = float(text.removeprefix("auto_"))
        except ValueError:
            start = np.nan
        least = np.nextafter(0.0, 1.0) if text.startswith("auto_") else 0.0
        if not least <= start < np.inf:
            raise ValueError(
                f"ent_coef={self.ent_coef!r}: must be a number of at least 0, 'auto' (learnt, from "
                "1), 'auto_0.1' (learnt, from 0.1) or 'auto_reward' (from the size of the rewards)"
            )

    def _setup_model(self) -> None:
        start = self.ent_coef
        if start == "auto_reward":
            self.ent_coef = "auto"  # as far as SB3 is concerned
        super()._setup_model()
        self.ent_coef = start

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        if self._n_updates == 0 and self.ent_coef == "auto_reward":
            self._start_at_the_rewards()
        super().train(gradient_steps, batch_size)

    @th.no_grad()
    def _start_at_the_rewards(self) -> None:
        """log α from the rewards in the buffer; 1 where there has been none."""
        rewards = self.replay_buffer.rewards[: self.replay_buffer.size()]
        if self._vec_normalize_env is not None:
            rewards = self._vec_normalize_env.normalize_reward(rewards)
        size = float(np.mean(np.abs(rewards), dtype=np.float64))
        if size > 0.0 and self.log_ent_coef is not None:
            self.log_ent_coef.fill_(np.log(size / get_action_dim(self.action_space)))

    def fit_temperature(self, log_prob: th.Tensor) -> tuple[dict[str, float], th.Tensor]:
        """One step of log α, if it is learnt.

        :param log_prob: of the policy's actions, without gradient, shape [B, 1]
        :return: what to log, and α before the step
        """
        if self.ent_coef_optimizer is None or self.log_ent_coef is None:
            return {"ent_coef": self.ent_coef_tensor.item()}, self.ent_coef_tensor
        alpha = th.exp(self.log_ent_coef.detach())
        loss = -(self.log_ent_coef * (log_prob + float(self.target_entropy))).mean()
        self.ent_coef_optimizer.zero_grad()
        loss.backward()
        self.ent_coef_optimizer.step()
        return {"ent_coef": alpha.item(), "ent_coef_loss": loss.item()}, alpha
