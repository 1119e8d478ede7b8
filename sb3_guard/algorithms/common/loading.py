"""Agents of other algorithms, such as SB3's PPO, loaded to be made safe.

``PPOLag.load("ppo.zip", env=env, cost_limit=25.0)`` takes over what PPO has learnt, the actor and
the critic of the reward. What only PPO-Lagrangian has, the cost critic and the multiplier, begins
anew.
"""

import inspect
import io
import warnings
from collections.abc import Iterable, Set
from typing import Any, ClassVar, Self

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, save_to_zip_file
from stable_baselines3.common.utils import get_system_info
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_guard import algorithms
from sb3_guard.algorithms import CLASSES
from sb3_guard.algorithms.common.arguments import check_names, own_arguments, stated

# SB3's buffers have no room for costs.
_BUFFERS = {
    "rollout_buffer_class", "rollout_buffer_kwargs", "replay_buffer_class", "replay_buffer_kwargs",
    "optimize_memory_usage",
}  # fmt: skip
# What means something else in a trust region.
GRADIENT_STEPS = {
    "batch_size", "learning_rate", "target_kl", "ent_coef", "vf_coef", "max_grad_norm"
}  # fmt: skip
# What goes on beside the hyperparameters.
_STATE = {
    "observation_space", "action_space", "policy_class", "n_envs", "num_timesteps",
    "learnt_normalized", "_stats_window_size", "verbose", "policy_kwargs",
}  # fmt: skip


def _warn(message: str) -> None:
    warnings.warn(message, UserWarning, stacklevel=3)  # the line that calls load


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "nothing"


def _same(one: Any, other: Any) -> bool:
    """Whether two hyperparameters say the same; schedules of SB3's have no equality."""
    return np.array_equal(one, other) or repr(one) == repr(other)


def _saver(data: dict[str, Any]) -> Any:
    """The class of this package that a file was saved by, ``object`` if by none."""
    name = data.get("saved_by", "")
    return getattr(algorithms, name) if name in CLASSES.values() else object


def _settings(data: dict[str, Any]) -> set[str]:
    """What a reader of a file would miss: hyperparameters, if a class of this package saved it."""
    if (saver := _saver(data)) is not object:
        return data.keys() & inspect.signature(saver).parameters
    return {k for k, v in data.items() if callable(v) or isinstance(v, int | float)}


def _bounds_something_else(cls: Any, data: dict[str, Any]) -> bool:
    """Whether one limits the sum of an episode's costs, and the other its worst step."""
    return getattr(_saver(data), "limit_on", "sum") != getattr(cls, "limit_on", "sum")


def lacks_statistics(model: Any, env: VecEnv | None) -> bool:
    """Whether an agent learnt from normalised observations, and ``env`` has no means of them."""
    if not getattr(model, "learnt_normalized", False):
        return False
    normalizer = None if env is None else unwrap_vec_normalize(env)
    if normalizer is None or not normalizer.norm_obs:
        return True
    means = normalizer.obs_rms
    # Those of a new VecNormalize are of no observation.
    return any(m.count < 1 for m in (means.values() if isinstance(means, dict) else [means]))


def name_of(cls: type) -> str:
    """The name of an algorithm: that of its base in this package, if it has one."""
    ours = [b.__name__ for b in cls.__mro__ if b.__module__.startswith("sb3_guard.algorithms.")]
    other = f"{cls.__module__}." * (cls.__name__ in CLASSES.values()) + cls.__name__
    return next((name for name in ours if name in CLASSES.values()), other)


def policy_for(cls: Any, kind: type) -> type:
    """
    The class of the policy that an algorithm goes on with.

    :param cls: the algorithm that loads the file of another one
    :param kind: the policy's class there
    :return: that one, or the one that the algorithm has in its place
    :raises ValueError: it is none that the algorithm can train
    """
    from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy

    kinds = [*cls.policy_aliases.values()]
    recurrent = issubclass(kind, RecurrentActorCriticPolicy)
    if not recurrent and any(issubclass(kind, allowed) for allowed in kinds):
        return kind
    for narrower in kinds:
        if issubclass(narrower, kind):
            return narrower
    names = ", ".join(allowed.__name__ for allowed in kinds)
    raise ValueError(
        f"{cls.__name__} can't take over an agent with a {kind.__name__}: allowed are {names} "
        "and their subclasses"
    )


def overruled(cls: Any, data: dict[str, Any]) -> set[str]:
    """
    The arguments that have the class's defaults, whatever the file of another algorithm has.

    They are what one of the two fixes, and a limit on something else; where that one knows no
    costs, all that the class states itself, since the same name may mean something else there:
    sb3-contrib's ``target_kl`` is a mean over the dimensions of an action, ours a sum.
    ``missing_cost``, which lets our TRPO run where nothing costs, is not taken over. Those of
    gradient steps are of the critics alone in a trust region: its ``max_grad_norm`` of 0 would keep
    any other algorithm from learning, and there are hundreds of PPO's minibatches in its rollouts.

    :param cls: the algorithm that loads the file
    :param data: attributes in the file
    """
    names = {*cls.fixed_arguments, *getattr(_saver(data), "fixed_arguments", ())}
    if "cost_keys" not in data:
        names |= stated(cls).keys() | _BUFFERS
    if data.get("saved_by") == "TRPO":
        names.add("missing_cost")
    if _bounds_something_else(cls, data):
        names |= {"cost_limit", "limit_start"}
    # The whole rollout, and that of the reward, where another algorithm may need another one.
    names |= {name for name in ("batch_size", "cost_gae_lambda") if data.get(name) is None}
    if ("cg_max_steps" in data) != ("cg_max_steps" in inspect.signature(cls).parameters):
        names |= GRADIENT_STEPS
    return names


def usable(cls: Any, data: dict[str, Any], own: Set[str]) -> dict[str, Any]:
    """
    The attributes in the file of another algorithm that a class goes on with.

    :param cls: the algorithm that loads the file
    :param data: attributes in the file
    :param own: see :func:`overruled`
    """
    arguments = {one.name for base in cls.__mro__ for one in own_arguments(base)}
    names = (arguments | stated(cls).keys()) - own | _STATE
    if not _bounds_something_else(cls, data):
        names.add("cost_units")  # of the cost critic
    kept = {name: data[name] for name in names & data.keys()}
    return {**kept, "policy_class": policy_for(cls, data["policy_class"])}


def usable_parts(cls: Any, data: dict[str, Any], parts: dict[str, Any]) -> dict[str, Any]:
    """The states of networks in the file; a cost critic of something else is left out."""
    if not _bounds_something_else(cls, data):
        return parts
    return {name: part for name, part in parts.items() if not name.startswith("cost_critic")}


def differences(model: Any, data: dict[str, Any], parts: dict[str, Any], own: Set[str]) -> str:
    """In what a model is not the agent of another algorithm that it was loaded from."""
    names = sorted(own & data.keys() & vars(model).keys() - _BUFFERS)
    changed = [
        f"{name}={getattr(model, name)!r}"
        for name in names
        if not _same(getattr(model, name), data[name])
    ]
    but = f", but for {', '.join(changed)}" if changed else ""
    anew = {*model._get_torch_save_params()[0]} - parts.keys()
    left = _settings(data) - {*vars(model), "lr_schedule"}
    limit = f"; cost_limit is {model.cost_limit}" if model.constrained else ""
    return f"{but}; to begin anew: {_listed(anew)}; left behind: {_listed(left)}{limit}"


class LoadsOthers(BaseAlgorithm):
    """Loads agents of algorithms without limits. Mixed in before an algorithm."""

    #: Arguments of SB3's constructors that the class fills in itself.
    fixed_arguments: ClassVar[frozenset[str]] = frozenset()

    @classmethod
    def load(
        cls,
        path: Any,
        env: Any = None,
        device: Any = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """Load an agent as SB3's ``load`` does, also one that an algorithm without limits trained.

        Then actor, critic of the reward, their optimizers and the hyperparameters that both
        algorithms take from SB3 are those of the file, but for those of gradient steps between a
        trust region and another; a warning says which, what begins anew and what is left behind.

        :param path: the file
        :param env: environment to train in; None: to predict only
        :param device: torch device
        :param custom_objects: what replaces attributes in the file
        :param print_system_info: whether to print the versions that the file was written with
        :param force_reset: whether the next ``learn`` begins new episodes
        :param kwargs: arguments to change, such as ``cost_limit``; also attributes, where the file
            is of the same algorithm
        :return: the agent
        :raises TypeError: an argument is not known; the message names the nearest one
        :raises ValueError: the file does not fit the environment or the algorithm
        """
        if print_system_info:
            print("== CURRENT SYSTEM INFO ==")
            get_system_info()
        data, parts, tensors = load_from_zip_file(
            path, device=device, custom_objects=custom_objects, print_system_info=print_system_info
        )
        if hasattr(path, "seek"):
            path.seek(0)
        data, parts = data or {}, parts or {}
        saved_by = data.get("saved_by", name_of(cls) if "cost_keys" in data else "")
        theirs = {base.__name__ for base in cls.__mro__} - {*CLASSES.values()}  # a user's
        another = bool(data) and saved_by not in {name_of(cls), *theirs}
        check_names(cls, kwargs.keys() - ({*()} if another else data.keys() - cls.fixed_arguments))
        if (kwargs.get("policy_kwargs") or {}).items() <= data.get("policy_kwargs", {}).items():
            kwargs.pop("policy_kwargs", None)  # again those of the file
        own: Set[str] = set()
        if another:  # a file as if the class had saved it
            own = overruled(cls, data) - kwargs.keys() - (custom_objects or {}).keys()
            path, parts = io.BytesIO(), usable_parts(cls, data, parts)
            custom_objects = usable(cls, data, own)  # as they are, not pickled again
            save_to_zip_file(path, dict.fromkeys(custom_objects), parts, tensors)
            path.seek(0)
        model = cls._load(path, env, device, custom_objects, False, force_reset, **kwargs)
        if lacks_statistics(model, model.get_env()):
            _warn(
                "the agent learnt from normalised observations: wrap its environment with "
                "VecNormalize.load(file, env), of what model.get_vec_normalize_env().save(file) "
                "kept in training",
            )
        if another:
            _warn(
                f"{cls.__name__} goes on with policy, critics and hyperparameters of an agent of "
                f"{saved_by or 'another algorithm'}{differences(model, data, parts, own)}"
            )
        return model

    @classmethod
    def _load(cls, *args: Any, **kwargs: Any) -> Any:
        """SB3's ``load``, which takes every ValueError for a sign of an old file."""
        try:
            return super().load(*args, **kwargs)
        except KeyError as error:
            raise (
                error.__context__ if isinstance(error.__context__, ValueError) else error
            ) from None
        except RuntimeError as error:
            if "state_dict" not in str(error):
                raise
            line = " ".join(str(error).split())
            raise ValueError(f"{cls.__name__}: the file has other networks: {line}") from error

    def set_parameters(
        self, load_path_or_dict: Any, exact_match: bool = True, device: Any = "auto"
    ) -> None:
        """Set networks and optimizers as SB3 does; those that SB3's algorithm lacks may be absent,
        all of them.

        :param load_path_or_dict: a file, or states by name
        :param exact_match: whether all that SB3's algorithm has must be there
        :param device: torch device
        """
        given = load_path_or_dict
        if not isinstance(given, dict):
            _, given, _ = load_from_zip_file(given, load_data=False, device=device)
        theirs = super()._get_torch_save_params()[0]
        ours = {name: now for name, now in self.get_parameters().items() if name not in theirs}
        weights = self.policy.state_dict()
        filters = {k: v for k, v in weights.items() if k.startswith("action_filter.")}
        policy = given.get("policy", {})
        if not ours.keys() & given.keys() and not filters.keys() & policy.keys():
            given = {**ours, **given}
            if policy:
                given["policy"] = {**filters, **policy}
        names = self.get_parameters()
        if exact_match and given.keys() != names.keys():
            absent, more = (
                ", ".join(sorted(a.keys() - b.keys())) for a, b in ((names, given), (given, names))
            )
            raise ValueError(
                f"{type(self).__name__}: names of parameters do not match, {absent or 'none'} is "
                f"absent, {more or 'none'} unknown; load a file with the class and the arguments "
                "of the agent that was saved"
            )
        super().set_parameters(given, exact_match, device)
