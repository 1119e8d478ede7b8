"""The state of environments, so that a resumed run goes on in the middle of its episodes."""

import pickle
from typing import Any

import cloudpickle  # type: ignore[import-untyped]
import gymnasium as gym
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

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


def capture(venv: VecEnv) -> list[Any]:
    """
    The state of a vectorised environment: of its wrappers from the outside in, then its own.

    :return: picklable parts; the last one is None if the environment itself can't tell its state
    """
    parts: list[Any] = []
    layer: Any = venv
    while isinstance(layer, VecEnvWrapper):
        own = hasattr(type(layer), "state")
        parts.append(layer.state() if own else _attributes(layer))
        layer = layer.venv
    if hasattr(type(layer), "state"):
        return [*parts, layer.state()]
    try:
        states = layer.env_method("state")
    except AttributeError:
        return [*parts, None]
    return [*parts, None if any(state is None for state in states) else states]


def restore(venv: VecEnv, parts: list[Any]) -> None:
    """Put an environment that was made the same way, and reset, into a captured state."""
    *wrappers, own = parts
    layer: Any = venv
    for part in wrappers:
        if hasattr(type(layer), "restore"):
            layer.restore(part)
        else:
            vars(layer).update(part)
        layer = layer.venv
    if own is None:
        return
    if hasattr(type(layer), "restore"):
        layer.restore(own)
    else:
        for index, state in enumerate(own):
            layer.env_method("restore", state, indices=index)
