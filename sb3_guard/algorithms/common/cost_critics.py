"""Critics of costs Q_C(s, a) for off-policy algorithms, all networks of them in one product."""

import copy
from itertools import pairwise
from typing import Any

import torch as th
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.nn import functional as F

from sb3_guard.algorithms.fast.optimizers import fuse


class Stacked(nn.Module):
    """Linear layers of n networks side by side: y_k = x_k W_k + b_k.

    :param n: number of networks
    :param inputs: width of x
    :param outputs: width of y
    """

    def __init__(self, n: int, inputs: int, outputs: int) -> None:
        super().__init__()
        layers = [nn.Linear(inputs, outputs) for _ in range(n)]  # PyTorch's first weights
        self.weight = nn.Parameter(th.stack([layer.weight.detach().T for layer in layers]))
        self.bias = nn.Parameter(th.stack([layer.bias.detach()[None] for layer in layers]))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: shape [n, B, inputs]
        :return: shape [n, B, outputs]
        """
        return th.baddbmm(self.bias, x, self.weight)


class CostNetworks(BaseModel):
    """n networks of the shape of a policy's critic, which share a features extractor alone.

    ``net_arch={"pi": …, "qf": …, "cost": […]}`` gives them other layers.

    :param policy: a policy of SAC's, TD3's or TQC's kind
    :param n: number of networks
    :param outputs: of each
    """

    def __init__(self, policy: BasePolicy, n: int, outputs: int) -> None:
        kwargs = policy._update_features_extractor(policy.critic_kwargs, None)  # type: ignore
        super().__init__(
            kwargs["observation_space"],
            kwargs["action_space"],
            features_extractor=kwargs["features_extractor"],
            normalize_images=kwargs["normalize_images"],
        )
        arch: Any = policy.net_arch
        hidden = kwargs["net_arch"]
        if isinstance(arch, dict):
            hidden = arch.get("cost", hidden)
        first = kwargs["features_dim"] + get_action_dim(self.action_space)
        widths = [first, *hidden, outputs]
        layers: list[nn.Module] = []
        for inputs, out in pairwise(widths):
            layers += [Stacked(n, inputs, out), kwargs["activation_fn"]()]
        self.n, self.layers = n, nn.Sequential(*layers[:-1])

    def forward(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """Outputs of the networks, shape [B, n, outputs]."""
        assert self.features_extractor is not None
        features = self.extract_features(observations, self.features_extractor)
        x = th.cat([features, actions], dim=1)
        return self.layers(x.expand(self.n, *x.shape)).transpose(0, 1)


class CostQ(nn.Module):
    """Expected discounted cost-to-go Q_C(s, a): per cost, the larger of two networks' values.

    They are built like the policy's critic, learn with its kind of optimizer and share nothing
    with it.

    :param policy: a policy of SAC's or TD3's kind
    :param n_costs: number m of costs
    :param learning_rate: at the beginning
    :param networks: number of networks per cost
    :param outputs: of each network
    """

    def __init__(
        self,
        policy: BasePolicy,
        n_costs: int,
        learning_rate: float,
        networks: int = 2,
        outputs: int = 1,
    ) -> None:
        super().__init__()
        self.n_costs, self.networks = n_costs, networks
        online = CostNetworks(policy, networks * n_costs, outputs)
        self.online = online.to(policy.device)
        self.target = copy.deepcopy(self.online)
        self.train(False)
        self.optimizer = policy.optimizer_class(
            self.online.parameters(),
            lr=learning_rate,  # type: ignore[call-arg]
            **policy.optimizer_kwargs,
        )
        fuse(self.optimizer)

    def predict(
        self, network: CostNetworks, observations: PyTorchObs, actions: th.Tensor
    ) -> th.Tensor:
        """Outputs per cost, shape [B, m, networks, outputs].

        :param network: ``online`` or ``target``
        :param observations: of B transitions
        :param actions: as the buffer has them, in [-1, 1]
        """
        return network(observations, actions).unflatten(1, (self.n_costs, self.networks))

    def value(self, predicted: th.Tensor) -> th.Tensor:
        """What a cost counts for, shape [B, m]: here the larger value."""
        return predicted.amax(dim=(2, 3))

    def samples(self, predicted: th.Tensor) -> th.Tensor:
        """Costs-to-go of the next states that the target is made of, shape [B, m, K]."""
        return self.value(predicted)[:, :, None]

    def loss(self, predicted: th.Tensor, target: th.Tensor) -> th.Tensor:
        """
        :param predicted: shape [B, m, networks, outputs]
        :param target: shape [B, m, K]
        """
        return F.mse_loss(predicted, target[:, :, None].expand_as(predicted))

    def forward(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """Q_C of actions as the buffer has them, in [-1, 1], shape [B, m]."""
        return self.value(self.predict(self.online, observations, actions))
