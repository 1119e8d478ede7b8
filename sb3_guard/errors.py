"""Errors of environments, and of numbers that nothing can be learnt from."""


class NumberError(FloatingPointError, ValueError):
    """A reward, cost, observation, action or loss is a number that nothing can be learnt from."""


class ContractError(ValueError):
    """An environment breaks Gymnasium's contract, or does not report what it must cost."""


class WorldError(Exception):
    """One of our environments can't be: it has no layout, no picture, or a part that is wrong."""
