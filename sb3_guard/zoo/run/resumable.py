"""The state of environments, so that a resumed run continues in the middle of its episodes."""

import pickle
from typing import Any

import cloudpickle  # type: ignore[import-untyped]
import gymnasium as gym
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_guard.zoo.cli.usage import explained

# What a new environment brings itself and what need not be picklable.
_OWN = {"env", "venv", "class_attributes", "spec", "_cached_spec", "metadata", "render_mode"}


def _attributes(layer: Any) -> dict[str, Any]:
    return {key: value for key, value in vars(layer).items() if key not in _OWN}


class ResumableEnv(gym.Wrapper):
    """
    Give a single environment, with all its wrappers, ``state()`` and ``restore(state)``.

    An environment that has the two methods itself is asked; of any other, and of wrappers, the
    attributes are taken. It is the outermost wrapper, so that a vectorised environment reaches it
    by ``env_method`` even in another process.
    """

    def layers(self) -> list[Any]:
        """The wrappers from the outside in, and the environment itself last."""
        layers: list[Any] = []
        env: gym.Env = self.env
        while isinstance(env, gym.Wrapper):
            layers.append(env)
            env = env.env
        return [*layers, env]

    def state(self) -> bytes | None:
        """Everything the next step depends on; None if it can't be pickled."""
        *wrappers, base = self.layers()
        own = hasattr(base, "state") and hasattr(base, "restore")
        parts = [_attributes(wrapper) for wrapper in wrappers]
        parts.append(base.state() if own else _attributes(base))
        try:
            return cloudpickle.dumps(parts)
        except Exception:
            # What can't be pickled says so in many ways; that it can't is all that matters here.
            return None

    def restore(self, state: bytes) -> None:
        """Go on from :meth:`state`; the environment has been reset before."""
        *wrappers, base = self.layers()
        *parts, last = pickle.loads(state)
        for wrapper, attributes in zip(wrappers, parts, strict=True):
            vars(wrapper).update(attributes)
        if hasattr(base, "state") and hasattr(base, "restore"):
            base.restore(last)
        else:
            vars(base).update(last)


def capture(layer: VecEnv) -> list[Any]:
    """
    The state of a vectorised environment: of its wrappers from the outside in, then its own.

    :return: picklable parts; the last one is None if the environment itself can't tell its state
    """
    own: Any = layer if hasattr(type(layer), "state") else None
    if isinstance(layer, VecEnvWrapper):
        return [_attributes(layer) if own is None else own.state(), *capture(layer.venv)]
    try:
        states = layer.env_method("state") if own is None else own.state()
    except AttributeError:
        return [None]
    return [None if own is None and None in states else states]


def restore(layer: Any, parts: list[Any]) -> None:
    """
    Put an environment that was made the same way, and reset, into a captured state.

    :raises UsageError: it was made in another way, as by another version
    """
    part, *rest = parts
    if hasattr(type(layer), "restore") and part is not None:
        with explained("the checkpoint belongs to another environment", ValueError):
            layer.restore(part)
    elif rest:
        vars(layer).update(part)
    else:
        for index, state in enumerate(part or []):
            layer.env_method("restore", state, indices=index)
    if rest:
        restore(layer.venv, rest)
