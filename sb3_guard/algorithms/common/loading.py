"""Agents of other algorithms, such as SB3's PPO, loaded to be made safe.

``PPOLag.load("ppo.zip", env=env, cost_limit=25.0)`` takes over what PPO has learnt, the actor and
the critic of the reward. What only PPO-Lagrangian has, the cost critic and the multiplier, begins
anew.
"""

import inspect
import warnings
from typing import Any, ClassVar, Self, cast

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_guard import algorithms
from sb3_guard.algorithms import CLASSES
from sb3_guard.algorithms.common.arguments import check_names, stated

# SB3's buffers have no room for costs.
_BUFFERS: dict[str, Any] = {
    "rollout_buffer_class": None,
    "rollout_buffer_kwargs": {},
    "replay_buffer_class": None,
    "replay_buffer_kwargs": {},
}


# What means something else in a trust region.
GRADIENT_STEPS = {
    "batch_size", "learning_rate", "target_kl", "ent_coef", "vf_coef", "max_grad_norm"
}  # fmt: skip


def _warn(message: str) -> None:
    warnings.warn(message, UserWarning, stacklevel=3)  # the line that calls load


def _listed(names: list[str]) -> str:
    return ", ".join(names) or "nothing"


def _saver(data: dict[str, Any]) -> Any:
    """The class of this package that a file was saved by, ``object`` if by none."""
    name = data.get("saved_by", "")
    return getattr(algorithms, name) if name in CLASSES.values() else object


def _left_behind(data: dict[str, Any], blank: dict[str, Any]) -> list[str]:
    """The settings in the file of another algorithm that a new model does not have."""
    if "cost_keys" in data:  # what is no hyperparameter of ours may be a user's
        settings = data.keys() & inspect.signature(_saver(data)).parameters
    else:
        settings = {k for k, v in data.items() if callable(v) or isinstance(v, int | float)}
    return sorted(settings - blank.keys() - {"lr_schedule", "n_envs"})


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
    return next((name for name in ours if name in CLASSES.values()), cls.__name__)


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


def replacements(cls: Any, data: dict[str, Any], blank: dict[str, Any]) -> dict[str, Any]:
    """
    What takes the place of hyperparameters in the file of another algorithm.

    What one of the two fixes has the class's default; where that one knows no costs, all that the
    class states itself, since the same name may mean something else there: sb3-contrib's
    ``target_kl`` is a mean over the dimensions of an action, ours a sum. ``missing_cost``, which
    lets our TRPO run where nothing costs, is not taken over. Those of gradient steps are of the
    critics alone in a trust region: its ``max_grad_norm`` of 0 would keep any other algorithm from
    learning, and there are hundreds of PPO's minibatches in its rollouts.

    :param cls: the algorithm that loads the file
    :param data: attributes in the file
    :param blank: attributes of a new model of the algorithm
    """
    names = {*cls.fixed_arguments, *getattr(_saver(data), "fixed_arguments", ())}
    if "cost_keys" not in data:
        names |= stated(cls).keys()
    if data.get("saved_by") == "TRPO":
        names.add("missing_cost")
    # The whole rollout, and that of the reward, where another algorithm may need another one.
    names |= {name for name in ("batch_size", "cost_gae_lambda") if data.get(name) is None}
    if ("cg_max_steps" in data) != ("cg_max_steps" in blank):
        names |= GRADIENT_STEPS
    return {name: blank[name] for name in names & blank.keys()}


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
            is of an algorithm with limits
        :return: the agent
        :raises TypeError: an argument is not known; the message names the nearest one
        :raises ValueError: the file does not fit the environment or the algorithm
        """
        data, parts, _ = load_from_zip_file(path, device=device, custom_objects=custom_objects)
        if hasattr(path, "seek"):
            path.seek(0)
        data = data or {}
        saved_by = data.get("saved_by", name_of(cls) if "cost_keys" in data else "")
        another = bool(data) and saved_by != name_of(cls)
        without_limits = another and saved_by in ("", "TRPO")
        known = {*()} if without_limits else data.keys() - cls.fixed_arguments
        check_names(cls, kwargs.keys() - known)
        if (kwargs.get("policy_kwargs") or {}).items() <= data.get("policy_kwargs", {}).items():
            kwargs.pop("policy_kwargs", None)  # again those of the file
        left, but = [], ""
        if another:
            kind = policy_for(cls, data["policy_class"])
            blank = vars(cast(Any, cls)(policy=kind, env=None, _init_setup_model=False))
            taken = replacements(cls, data, blank)
            shared = taken.keys() & data.keys() - kwargs.keys() - (custom_objects or {}).keys()
            own = [
                f"{name}={taken[name]!r}" for name in sorted(shared) if taken[name] != data[name]
            ]
            but = f", but for {', '.join(own)}" if own else ""
            left = _left_behind(data, blank)
            buffers = {} if "cost_keys" in data else _BUFFERS
            custom_objects = {**taken, **buffers, "policy_class": kind, **(custom_objects or {})}
        model = cls._load(
            path, env, device, custom_objects, print_system_info, force_reset, **kwargs
        )
        for name in left:
            delattr(model, name)
        if lacks_statistics(model, model.get_env()):
            _warn(
                "the agent learnt from normalised observations: wrap its environment with "
                "VecNormalize.load(file, env), of what model.get_vec_normalize_env().save(file) "
                "kept in training",
            )
        if another:
            new = [name for name in model._get_torch_save_params()[0] if name not in (parts or ())]
            limit = f"; cost_limit is {model.cost_limit}" if model.constrained else ""
            _warn(
                f"{cls.__name__} goes on with policy, critics and hyperparameters of an agent of "
                f"{saved_by or 'another algorithm'}{but}; to begin anew: {_listed(new)}; left "
                f"behind: {_listed(left)}{limit}",
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
