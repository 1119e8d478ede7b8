"""Forward, tangent and adjoint passes of a tanh network, written out.

A few dozen Fisher products over the whole rollout are the larger part of an update. Written out,
over slices that fit the cache, each takes a quarter of autograd's time, for the same numbers.
"""

from collections.abc import Sequence

import numpy as np
import torch as th
from torch import nn


def _tanh_(x: th.Tensor) -> th.Tensor:
    # On some processors torch's kernel is seven times slower than NumPy's, on none faster.
    if x.device.type == "cpu":
        array = x.numpy()
        np.tanh(array, out=array)
        return x
    return x.tanh_()


def _tanh_backward(gradient: th.Tensor, output: th.Tensor) -> th.Tensor:
    """``gradient · (1 - output²)``, in place and in one pass."""
    return th.ops.aten.tanh_backward.grad_input(gradient, output, grad_input=gradient)


class TanhMlp:
    """A view of linear layers with tanh between them and none after the last.

    It owns no weights: ``parameters`` are the layers' own, ``[W_1, b_1, …, W_L, b_L]``, and every
    list of tensors here (gradients, tangents) follows their order. Nothing is recorded by autograd.

    :param layers: at least one linear layer with bias, float32
    """

    def __init__(self, layers: Sequence[nn.Linear]) -> None:
        self.parameters: list[th.Tensor] = []
        for layer in layers:
            self.parameters += [layer.weight, layer.bias]

    @classmethod
    def of(cls, modules: Sequence[nn.Module]) -> "TanhMlp | None":
        """A view of a chain of modules, or None if it is no tanh network.

        Exact types are asked for: a subclass may compute something else.
        """
        linear = [
            module
            for module in modules[0::2]
            if type(module) is nn.Linear
            and module.bias is not None
            and module.weight.dtype is th.float32
            and module.weight.requires_grad
            and module.bias.requires_grad
        ]
        plain = all(type(module) is nn.Tanh for module in modules[1::2])
        return cls(linear) if plain and len(modules) == 2 * len(linear) - 1 else None

    def _pairs(self, tensors: Sequence[th.Tensor]) -> list[tuple[th.Tensor, th.Tensor]]:
        return list(zip(tensors[0::2], tensors[1::2], strict=True))

    @th.no_grad()
    def forward(self, x: th.Tensor) -> list[th.Tensor]:
        """All activations, from the input ``[n, d]`` to the output ``[n, k]``."""
        activations = [x]
        pairs = self._pairs(self.parameters)
        for i, (weight, bias) in enumerate(pairs):
            x = th.addmm(bias, x, weight.t())
            activations.append(_tanh_(x) if i + 1 < len(pairs) else x)
        return activations

    @th.no_grad()
    def tangent(
        self, activations: Sequence[th.Tensor], direction: Sequence[th.Tensor]
    ) -> th.Tensor:
        """Change of the output when the parameters move along ``direction``, shape ``[n, k]``."""
        change: th.Tensor | None = None
        weights = self.parameters[0::2]
        moves = self._pairs(direction)
        for i, (dweight, dbias) in enumerate(moves):
            following = th.addmm(dbias, activations[i], dweight.t())
            if change is not None:
                following.addmm_(change, weights[i].t())
            change = following
            if i + 1 < len(moves):
                _tanh_backward(change, activations[i + 1])
        assert change is not None
        return change

    @th.no_grad()
    def adjoint(
        self,
        activations: Sequence[th.Tensor],
        gradient: th.Tensor,
        out: Sequence[th.Tensor],
    ) -> None:
        """Add to ``out`` the parameters' gradient, given that of the output, ``[n, k]``."""
        ones = gradient.new_ones(len(gradient))
        weights = self.parameters[0::2]
        for i, (dweight, dbias) in reversed(list(enumerate(self._pairs(out)))):
            dweight.addmm_(gradient.t(), activations[i])
            dbias.addmv_(gradient.t(), ones)
            if i > 0:
                gradient = _tanh_backward(gradient @ weights[i], activations[i])
