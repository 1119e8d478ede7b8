"""Adam's step as one operation."""

import torch as th


def fuse(optimizer: th.optim.Optimizer) -> None:
    """Let Adam take its steps on the CPU in one operation per tensor.

    That takes a quarter of the time of the dozen operations that are torch's default there, for the
    same numbers up to rounding. Other optimizers, and those that were told how to, stay as they
    are.
    """
    if type(optimizer) not in (th.optim.Adam, th.optim.AdamW):
        return
    for group in optimizer.param_groups:
        on_cpu = all(parameter.device.type == "cpu" for parameter in group["params"])
        told = group["fused"] is not None or group["foreach"] or group["differentiable"]
        if on_cpu and not told:
            group["fused"] = True
