"""What tuning searches: a space of hyperparameters per algorithm, as plain data.

A space maps names of hyperparameters to a range or to a list of options, as in the file of a user
(``--search-space``)::

    target_kl: {low: 0.002, high: 0.05, log: true}
    gamma: [0.95, 0.98, 0.99, 0.995, 0.999]
    policy_kwargs.net_arch: [{pi: [64, 64], vf: [64, 64]}, {pi: [256, 256], vf: [256, 256]}]

Whole bounds draw whole numbers; a name with a dot lies in a mapping. An algorithm states its own
space in the class attribute ``search_space``, to which those of its bases are added; RL-Zoo's
samplers serve for RL-Zoo's algorithms, and :func:`rl_zoo_sampler` makes one of a space for RL-Zoo.
"""

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import optuna
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution
from optuna.samplers import BaseSampler, GPSampler, NSGAIISampler, RandomSampler, TPESampler

from sb3_guard.zoo.cli.names import as_data, with_classes
from sb3_guard.zoo.cli.usage import UsageError, explained, read_mapping
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.hyperparams import NOISE_KEYS, RUN_KEYS, parameters

Space = Mapping[str, Any]

#: of RL-Zoo's algorithms for which RL-Zoo has none
SPACES: dict[str, dict[str, Any]] = {
    "crossq": {
        "gamma": [0.97, 0.98, 0.99, 0.995, 0.999, 0.9999],
        "learning_rate": {"low": 1e-5, "high": 2e-3, "log": True},
        "batch_size": [64, 128, 256, 512],
        "policy_delay": {"low": 1, "high": 4},
        "policy_kwargs.net_arch": [{"pi": [256, 256], "qf": [n, n]} for n in (256, 512, 1024)],
    },
}


def space_of(algo: str) -> dict[str, Any]:
    """
    The space of an algorithm: what its class and the bases of that say; empty if nobody does.

    What a class says None of is left out.

    :param algo: key of the algorithm
    :raises UsageError: there is no such algorithm, or one of the entries is wrong
    """
    space = dict(SPACES.get(algo, {}))
    for cls in reversed(algorithm(algo).__mro__):
        space |= vars(cls).get("search_space", {})
    return {n: _checked(n, entry, algo) for n, entry in space.items() if entry is not None}


def read_space(path: str) -> dict[str, Any]:
    """
    A search space from a YAML file.

    :raises UsageError: it can't be read, or an entry is neither a range nor a list
    """
    form = (
        "names of hyperparameters to ranges or lists, such as "
        "'target_kl: {low: 0.002, high: 0.05, log: true}'"
    )
    content = read_mapping(path, "--search-space", form)
    return {str(name): _checked(str(name), entry, path) for name, entry in content.items()}


def _checked(name: str, entry: Any, where: str) -> Any:
    """
    An entry of a space with numbers for bounds, which YAML may read as text (1e-4).

    :raises UsageError: it is neither a range nor a list
    """
    fix = "write a list of at least two options, or {low: 0.002, high: 0.05, log: true}"
    with explained(f"search space: {name}: {entry} in {where}", fix=fix):
        if isinstance(entry, list) and len(entry) > 1:
            return entry
        bounds = {**entry, **{key: _bound(entry[key]) for key in ("low", "high")}}
        return {"log": False, **bounds} if _distribution(bounds) else None


def _bound(value: Any) -> int | float:
    number = value if type(value) is int else float(str(value))
    if not math.isfinite(number):
        raise ValueError(f"{value} is not finite")
    return number


def _distribution(entry: Mapping[str, Any]) -> BaseDistribution:
    """What Optuna draws from; it refuses bounds that are none."""
    whole = isinstance(entry["low"], int) and isinstance(entry["high"], int)
    return (IntDistribution if whole else FloatDistribution)(**entry)


def _label(option: Any) -> Any:
    """What the study stores for an option: lists and mappings as text."""
    return json.dumps(option) if isinstance(option, list | dict) else option


def _draw(trial: optuna.Trial, name: str, entry: Any) -> Any:
    if isinstance(entry, list):
        labels = [_label(option) for option in entry]
        return entry[labels.index(trial.suggest_categorical(name, labels))]
    whole = isinstance(_distribution(entry), IntDistribution)
    return trial.suggest_int(name, **entry) if whole else trial.suggest_float(name, **entry)


def _contains(entry: Any, value: Any) -> bool:
    if isinstance(entry, list):
        return value in entry
    whole = isinstance(_distribution(entry), IntDistribution)
    number = type(value) is int or (type(value) is float and not whole)
    return number and entry["low"] <= value <= entry["high"]


def set_dotted(values: Mapping[str, Any], name: str, value: Any) -> dict[str, Any]:
    """A copy of hyperparameters with one changed, which may lie in a mapping: ``a.b``."""
    outer, dot, inner = name.partition(".")
    if not dot:
        return {**values, outer: value}
    return {**values, outer: set_dotted(values.get(outer) or {}, inner, value)}


def get_dotted(values: Mapping[str, Any], name: str) -> Any:
    """One of the hyperparameters, which may lie in a mapping; None if there is none."""
    outer, dot, inner = name.partition(".")
    value = values.get(outer)
    if not dot:
        return value
    return get_dotted(value, inner) if isinstance(value, Mapping) else None


def _named(value: Any) -> Any:
    """Data that :func:`~sb3_guard.zoo.cli.names.with_classes` makes these objects of."""
    if isinstance(value, Mapping):
        return {name: _named(item) for name, item in value.items()}
    if isinstance(value, type):
        return f"{value.__module__}.{value.__qualname__}"
    return value


class Search:
    """
    The search of one algorithm: what a trial tries, and with what it begins.

    :param algo: key of the algorithm
    :param base: hyperparameters of the trials where the space says nothing
    :param space: what to search; None: that of the algorithm
    :param fixed: names that are not searched, since the user has fixed them
    :raises UsageError: there is no space for the algorithm, or nothing is left of it
    """

    def __init__(
        self,
        algo: str,
        base: Mapping[str, Any],
        space: Space | None = None,
        fixed: Mapping[str, Any] | None = None,
    ):
        from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

        self.algo = algo
        self.base = {name: as_data(name, value) for name, value in base.items()}
        self._fixed = dict(fixed or {})
        space = space_of(algo) if space is None else space
        self._rl_zoo = None if space else HYPERPARAMS_SAMPLER.get(algo)
        if not space and self._rl_zoo is None:
            raise UsageError(
                f"there is no search space for {algo}; give one with --search-space FILE.yml, or "
                "as the attribute search_space of its class"
            )
        self.space = {
            name: entry
            for name, entry in space.items()
            if name not in self._fixed and name.partition(".")[0] not in self._fixed
        }
        if not self.space and self._rl_zoo is None:
            raise UsageError("nothing is left to search: -params fixes the whole space")

    def description(self) -> Any:
        """The space as plain data, or whose it is."""
        return "rl_zoo3" if self._rl_zoo is not None else self.space

    def corners(self) -> list[dict[str, Any]]:
        """The base with each option or bound in turn, to be checked."""
        return [
            set_dotted(self.base, name, value)
            for name, entry in self.space.items()
            for value in (entry if isinstance(entry, list) else (entry["low"], entry["high"]))
        ]

    def draw(self, trial: optuna.Trial) -> dict[str, Any]:
        """All hyperparameters of a trial, plain data."""
        if self._rl_zoo is not None:
            return self._draw_rl_zoo(trial)
        values = self.base
        for name, entry in self.space.items():
            values = set_dotted(values, name, _draw(trial, name, entry))
        return dict(sorted(values.items()))

    def _draw_rl_zoo(self, trial: optuna.Trial) -> dict[str, Any]:
        """RL-Zoo's samplers give objects; a file holds data."""
        assert self._rl_zoo is not None
        extra = {"using_her_replay_buffer": False, "her_kwargs": {}}
        drawn = self._rl_zoo(trial, 1, self.base.get("n_envs", 1), extra)
        # Made of two parameters, which are data; none may be drawn where the base has some.
        drawn.pop("action_noise", None)
        drawn |= {name: trial.params[name] for name in NOISE_KEYS if name in trial.params}
        values = dict(self.base)
        for name, value in drawn.items():
            if name in self._fixed:
                continue
            if name == "policy_kwargs":
                value = {**(values.get(name) or {}), **_named(value)}
            values[name] = value
        if values.get("noise_type") is None:
            values.pop("noise_std", None)
        return dict(sorted(values.items()))

    def first(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        The base's own place in the space, for the first trial, with the algorithm's defaults where
        the base says nothing; and what lies outside, for which the first trial draws another.
        """
        places, outside = {}, {}
        cls = algorithm(self.algo)
        defaults = {name: parameter.default for name, parameter in parameters(cls).items()}
        defaults["policy_kwargs"] = getattr(cls, "policy_defaults", {})
        for name, entry in self.space.items():
            value = get_dotted(self.base, name)
            value = get_dotted(defaults, name) if value is None else value
            if _contains(entry, value):
                places[name] = _label(value)
            elif value is not None:
                outside[name] = value
        return places, outside


def rl_zoo_sampler(algo: str, base: Mapping[str, Any]) -> Callable[..., dict[str, Any]]:
    """
    The space of an algorithm as one of RL-Zoo's samplers, which return arguments of the model.

    RL-Zoo replaces ``policy_kwargs`` as a whole, so what is not drawn of it comes from ``base``;
    how many environments there are is not for its samplers to say.

    :param base: hyperparameters of the trials where the space says nothing
    """
    search = Search(algo, base, fixed={name: base.get(name) for name in RUN_KEYS})
    names = {name.partition(".")[0] for name in search.space}

    def sample(
        trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: Mapping[str, Any]
    ) -> dict[str, Any]:
        values = search.draw(trial)
        return {name: with_classes(name, values[name]) for name in names}

    return sample


SAMPLERS: dict[str, Callable[[int | None, int], BaseSampler]] = {
    "tpe": lambda seed, startup: TPESampler(seed=seed, n_startup_trials=startup),
    "gp": lambda seed, startup: GPSampler(
        seed=seed, n_startup_trials=startup, warn_independent_sampling=False
    ),
    "nsgaii": lambda seed, startup: NSGAIISampler(seed=seed, population_size=max(startup, 2)),
    "random": lambda seed, startup: RandomSampler(seed=seed),
}
