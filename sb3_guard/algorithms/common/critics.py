"""Critics of the cost, and the regression that fits every critic."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn
from torch.nn import functional as F

from sb3_guard.algorithms.common.actor import n_rows, parameterless, rows, value_parameters
from sb3_guard.algorithms.common.mlp import TanhMlp, chunks


class CostCritic(nn.Module):
    """Expected discounted cost-to-go V_c(s), one output per constraint.

    It is built like the policy's own critic (same kind of extractor, same ``net_arch``) but shares
    nothing with it, so any ``ActorCriticPolicy`` can have one.

    :param policy: the policy whose extractor, architecture and optimizer class are taken
    :param n_costs: number m of constraints
    :param lr_schedule: learning rate as a function of the remaining progress
    """

    def __init__(self, policy: ActorCriticPolicy, n_costs: int, lr_schedule: Schedule) -> None:
        super().__init__()
        self.observation_space = policy.observation_space
        self.normalize_images = policy.normalize_images
        self.features_extractor = policy.make_features_extractor()
        arch = policy.net_arch if isinstance(policy.net_arch, list) else policy.net_arch["vf"]
        self.mlp_extractor = MlpExtractor(
            self.features_extractor.features_dim,
            {"pi": [], "vf": arch},
            policy.activation_fn,
            device=policy.device,
        )
        self.value_net = nn.Linear(self.mlp_extractor.latent_dim_vf, n_costs)
        if policy.ortho_init:
            self.features_extractor.apply(partial(policy.init_weights, gain=np.sqrt(2)))
            self.mlp_extractor.apply(partial(policy.init_weights, gain=np.sqrt(2)))
            self.value_net.apply(partial(policy.init_weights, gain=1.0))
        self.to(policy.device)
        self.optimizer = policy.optimizer_class(
            self.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **policy.optimizer_kwargs,
        )

    def extract_features(self, observations: PyTorchObs) -> th.Tensor:
        """Preprocessed and extracted features of observations, shape [B, features_dim]."""
        preprocessed = preprocess_obs(
            observations, self.observation_space, normalize_images=self.normalize_images
        )
        return self.features_extractor(preprocessed)

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """Values of observations, shape [B, m]."""
        features = self.extract_features(observations)
        return self.value_net(self.mlp_extractor.forward_critic(features))

    @th.no_grad()
    def predict(self, observations: PyTorchObs) -> th.Tensor:
        """:meth:`forward` without gradients, in slices that bound the memory."""
        slices = chunks(n_rows(observations))
        return th.cat([self(rows(observations, index)) for index in slices])


class Regression:
    """Least-squares fit of a critic to a batch, full-batch by default.

    :param values: maps observations to values, shape [B, m]
    :param parameters: what may move
    :param optimizer: moves them, whatever else it could move
    :param features: maps observations to a tanh network's input, if the critic is one
    :param layers: the layers of that network
    """

    def __init__(
        self,
        values: Callable[[PyTorchObs], th.Tensor],
        parameters: Sequence[th.Tensor],
        optimizer: th.optim.Optimizer,
        features: Callable[[PyTorchObs], th.Tensor] | None = None,
        layers: Sequence[nn.Linear] | None = None,
    ) -> None:
        self.values = values
        self.parameters = list(parameters)
        self.optimizer = optimizer
        self.features = features
        self.network = TanhMlp(layers) if layers is not None else None

    @classmethod
    def of_value(cls, policy: ActorCriticPolicy) -> "Regression":
        """The policy's own critic; parameters shared with the actor stay still."""
        parameters = value_parameters(policy)
        standard = type(policy).predict_values is ActorCriticPolicy.predict_values
        extractor = policy.vf_features_extractor
        layers = None
        if (
            standard
            and policy.device.type == "cpu"
            and type(policy.mlp_extractor) is MlpExtractor
            and parameterless(extractor)
        ):
            layers = TanhMlp.layers([*policy.mlp_extractor.value_net, policy.value_net])

        def features(observations: PyTorchObs) -> th.Tensor:
            return super(ActorCriticPolicy, policy).extract_features(observations, extractor)

        return cls(policy.predict_values, parameters, policy.optimizer, features, layers)

    @classmethod
    def of_cost(cls, critic: CostCritic) -> "Regression":
        """A cost critic."""
        layers = None
        if next(critic.parameters()).device.type == "cpu" and parameterless(
            critic.features_extractor
        ):
            layers = TanhMlp.layers([*critic.mlp_extractor.value_net, critic.value_net])
        return cls(
            critic, list(critic.parameters()), critic.optimizer, critic.extract_features, layers
        )

    def fit(
        self,
        observations: PyTorchObs,
        targets: th.Tensor,
        n_epochs: int,
        batch_size: int | None = None,
    ) -> float:
        """Take ``n_epochs`` passes over the batch, one optimizer step per minibatch.

        :param observations: N observations
        :param targets: shape [N, m]
        :param n_epochs: passes
        :param batch_size: rows per step; None for all of them
        :return: mean squared error during the last pass
        """
        n = len(targets)
        gradients = self._gradients_by_hand if self.network is not None else self._gradients
        with th.no_grad():
            if self.network is not None:
                assert self.features is not None
                observations = self.features(observations)
        self.optimizer.zero_grad(set_to_none=True)
        loss = 0.0
        for _ in range(n_epochs):
            if batch_size is None or batch_size >= n:
                loss = gradients(observations, targets)
                self.optimizer.step()
                continue
            loss = 0.0
            # Equal parts, so that no step is taken on a small remainder.
            for index in th.randperm(n).to(targets.device).tensor_split(-(-n // batch_size)):
                part = gradients(rows(observations, index), targets[index])
                loss += part * len(index) / n
                self.optimizer.step()
        return loss

    def _gradients(self, observations: PyTorchObs, targets: th.Tensor) -> float:
        """Set the parameters' gradients of the mean squared error; return the error."""
        self.optimizer.zero_grad(set_to_none=True)
        total = 0.0
        for index in chunks(len(targets)):
            values = self.values(rows(observations, index))
            loss = F.mse_loss(values, targets[index], reduction="sum") / targets.numel()
            loss.backward(inputs=self.parameters)
            total += loss.item()
        return total

    def _gradients_by_hand(self, features: PyTorchObs, targets: th.Tensor) -> float:
        assert self.network is not None and isinstance(features, th.Tensor)
        gradients = []
        for parameter in self.network.parameters:
            if parameter.grad is None:
                parameter.grad = th.zeros_like(parameter)
            gradients.append(parameter.grad.zero_())
        total = 0.0
        for index in chunks(len(targets)):
            activations = self.network.forward(features[index])
            error = activations[-1] - targets[index]
            total += float(error.flatten() @ error.flatten())
            error.mul_(2.0 / targets.numel())
            self.network.adjoint(activations, error, gradients)
        return total / targets.numel()
