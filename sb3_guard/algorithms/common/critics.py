"""Networks, separate from the policy, that learn from costs, and the regression that fits them."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import MlpExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.nn import functional as F

from sb3_guard.algorithms.common.actor import value_parameters
from sb3_guard.algorithms.common.batches import chunks, n_rows, rows
from sb3_guard.algorithms.fast.actor import parameterless
from sb3_guard.algorithms.fast.mlp import TanhMlp, squared_error
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


class CostCritic(StateNetwork):
    """Expected discounted cost-to-go V_c(s), one output per constraint."""


class Regression:
    """Least-squares fit of a network to a batch, full-batch by default.

    A batch is observations, or a tuple of observations and whatever else ``inputs`` takes. Layers
    such as batch normalisation stay as they are in evaluation: the policy that a trust region is
    about is the one that acted.

    :param extractor: what the features come from
    :param layers: the modules of a network, of which a tanh network is passed through in
        ``fast/mlp.py`` where the extractor has no parameters
    :param inputs: maps a batch to the input of the layers
    :param parameters: what may move
    :param optimizer: moves them, whatever else it could move
    :param values: maps a batch to predictions, shape [B, m]; None: by the layers alone
    :param readout: maps the layers' outputs and the batch to predictions; None: they are equal
    """

    def __init__(
        self,
        extractor: nn.Module,
        layers: Sequence[nn.Module],
        inputs: Callable[[Any], th.Tensor],
        parameters: Sequence[th.Tensor],
        optimizer: th.optim.Optimizer,
        values: Callable[[Any], th.Tensor] | None = None,
        readout: Callable[[th.Tensor, Any], th.Tensor] | None = None,
    ) -> None:
        self.inputs, self.parameters, self.optimizer = inputs, parameters, optimizer
        self.readout = readout
        last, chain = readout or (lambda outputs, batch: outputs), nn.Sequential(*layers)
        self.values = values or (lambda batch: last(chain(inputs(batch)), batch))
        fast = parameters[0].device.type == "cpu" and parameterless(extractor)
        self.network = TanhMlp.of(layers) if fast else None

    @classmethod
    def of_value(cls, policy: ActorCriticPolicy) -> "Regression":
        """The policy's own critic; what it shares with the actor stays still."""
        extractor = policy.vf_features_extractor
        standard = type(policy).predict_values is ActorCriticPolicy.predict_values
        layers: list[nn.Module] = []  # of another kind of critic nothing is known
        if standard and type(policy.mlp_extractor) is MlpExtractor:
            layers = [*policy.mlp_extractor.value_net, policy.value_net]

        def features(observations: PyTorchObs) -> th.Tensor:
            return super(ActorCriticPolicy, policy).extract_features(observations, extractor)

        moving = value_parameters(policy)
        return cls(extractor, layers, features, moving, policy.optimizer, policy.predict_values)

    @classmethod
    def of_network(
        cls,
        network: StateNetwork,
        inputs: Callable[[Any], th.Tensor] | None = None,
        readout: Callable[[th.Tensor, Any], th.Tensor] | None = None,
    ) -> "Regression":
        """A network that is separate from the policy.

        :param inputs: maps a batch to the input of ``network.network``; None: a batch is
            observations
        :param readout: see :class:`Regression`
        """
        return cls(
            network.features_extractor,
            [*network.network],
            inputs or network.extract_features,
            list(network.parameters()),
            network.optimizer,
            readout=readout,
        )

    def fit(
        self,
        batch: Any,
        targets: th.Tensor,
        n_epochs: int,
        batch_size: int | None = None,
        rng: np.random.Generator | None = None,
    ) -> float:
        """Take ``n_epochs`` passes over the batch, one optimizer step per minibatch.

        :param batch: N rows
        :param targets: shape [N, m]
        :param n_epochs: passes
        :param batch_size: rows per step; None for all of them
        :param rng: shuffles the rows; None for torch's own generator
        :return: mean squared error during the last pass
        """
        n, inputs = len(targets), None
        if self.network is not None:
            with th.no_grad():
                inputs = self.inputs(batch)
        self.optimizer.zero_grad(set_to_none=True)
        loss = 0.0
        for _ in range(n_epochs):
            if batch_size is None or batch_size >= n:
                loss = self._gradients(batch, targets, inputs)
                self.optimizer.step()
                continue
            loss = 0.0
            # Equal parts, so that no step is taken on a small remainder.
            order = th.randperm(n) if rng is None else th.as_tensor(rng.permutation(n))
            for index in order.to(targets.device).tensor_split(-(-n // batch_size)):
                part = None if inputs is None else inputs[index]
                error = self._gradients(rows(batch, index), targets[index], part)
                loss += error * len(index) / n
                self.optimizer.step()
        return loss

    def _gradients(self, batch: Any, targets: th.Tensor, inputs: th.Tensor | None) -> float:
        """Set the parameters' gradients of the mean squared error; return the error."""
        if inputs is not None:
            assert self.network is not None
            last = self.readout
            readout = None if last is None else lambda outputs, i: last(outputs, rows(batch, i))
            return squared_error(self.network, inputs, targets, readout)
        self.optimizer.zero_grad(set_to_none=True)
        total = 0.0
        for index in chunks(len(targets)):
            values = self.values(rows(batch, index))
            loss = F.mse_loss(values, targets[index], reduction="sum") / targets.numel()
            loss.backward(inputs=self.parameters)
            total += loss.item()
        return total
