"""Networks, separate from the policy, that learn from costs, and the regression that fits them."""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_guard.algorithms.common.batches import CHUNK, chunks, n_rows, rows
from sb3_guard.algorithms.fast.optimizers import fuse


class StateNetwork(nn.Module):
    """A function of the observation that is fitted separately from the policy.

    It is built like the policy's own critic but shares nothing with it, so any
    ``ActorCriticPolicy`` can have one. ``net_arch={"pi": …, "vf": …, "cost": […]}`` gives it other
    layers, as to the networks of filters and of TRPO-FAC.

    :param policy: the policy whose extractor, architecture and optimizer class are taken
    :param n_outputs: number of outputs
    :param n_extra: number of inputs in addition to the observation
    """

    def __init__(self, policy: ActorCriticPolicy, n_outputs: int, n_extra: int = 0) -> None:
        super().__init__()
        self.observation_space = policy.observation_space
        self.normalize_images = policy.normalize_images
        self.features_extractor = policy.make_features_extractor()
        arch = policy.net_arch
        if isinstance(arch, dict):
            arch = arch.get("cost", arch.get("vf", []))  # as SB3's extractor reads it
        features = self.features_extractor.features_dim
        layers = create_mlp(features + n_extra, n_outputs, arch, policy.activation_fn)
        self.network = nn.Sequential(*layers)
        if policy.ortho_init:
            self.features_extractor.apply(partial(policy.init_weights, gain=np.sqrt(2)))
            self.network[:-1].apply(partial(policy.init_weights, gain=np.sqrt(2)))
            self.network[-1].apply(partial(policy.init_weights, gain=1.0))
        self.to(policy.device)
        self.train(False)
        self.optimizer = policy.optimizer_class(
            self.parameters(),
            lr=policy.optimizer.param_groups[0]["lr"],  # type: ignore[call-arg]
            **policy.optimizer_kwargs,
        )
        fuse(self.optimizer)

    def extract_features(self, observations: PyTorchObs) -> th.Tensor:
        """Preprocessed and extracted features of observations, shape [B, features_dim]."""
        preprocessed = preprocess_obs(
            observations, self.observation_space, normalize_images=self.normalize_images
        )
        return self.features_extractor(preprocessed)

    def forward(self, observations: PyTorchObs, extra: th.Tensor | None = None) -> th.Tensor:
        """Outputs, shape [B, n_outputs].

        :param observations: batch of B observations
        :param extra: the further inputs, shape [B, n_extra]
        """
        features = self.extract_features(observations)
        return self.network(features if extra is None else th.cat([features, extra], dim=1))

    @th.no_grad()
    def predict(self, observations: PyTorchObs, extra: th.Tensor | None = None) -> th.Tensor:
        """:meth:`forward` without gradients, in slices that bound the memory."""
        slices = chunks(n_rows(observations))
        return th.cat(
            [
                self(rows(observations, index), None if extra is None else extra[index])
                for index in slices
            ]
        )


def regress(
    values: Callable[[Any], th.Tensor],
    parameters: Iterable[th.Tensor],
    optimizer: th.optim.Optimizer,
    batch: Any,
    targets: th.Tensor,
    n_epochs: int,
    batch_size: int | None = None,
    rng: np.random.Generator | None = None,
) -> float:
    """Fit values to targets by least squares, one optimizer step per minibatch.

    Layers such as batch normalisation stay as they are in evaluation: the policy that a trust
    region is about is the one that acted.

    :param values: maps some rows of the batch to predictions, shape [B, k]
    :param parameters: what may move, whatever else ``values`` depends on
    :param optimizer: moves them, whatever else it could move
    :param batch: N rows: observations, or a tuple of them and whatever else ``values`` takes
    :param targets: shape [N, k]
    :param n_epochs: passes over the batch
    :param batch_size: rows per step, at most; None for all of them
    :param rng: shuffles the rows; None for torch's own generator
    :return: mean squared error during the last pass
    """
    n, loss = len(targets), 0.0
    moving = [part for part in parameters if part.requires_grad]  # a user may have frozen some
    parts = -(-n // (batch_size or n))  # of equal size, so that no step is taken on a small rest
    for _ in range(n_epochs):
        loss = 0.0
        order = th.arange(n)
        if parts > 1:
            order = th.randperm(n) if rng is None else th.as_tensor(rng.permutation(n))
        for index in order.to(targets.device).tensor_split(parts):
            optimizer.zero_grad(set_to_none=True)
            for chunk in index.split(CHUNK):
                difference = values(rows(batch, chunk)) - targets[chunk]
                error = difference.square().sum() / targets.shape[1]
                (error / len(index)).backward(inputs=moving)
                loss += error.item() / n
            optimizer.step()
    return loss
