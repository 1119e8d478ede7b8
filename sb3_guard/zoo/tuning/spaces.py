"""What tuning searches: a space of hyperparameters per algorithm, as plain data.

A space maps names of hyperparameters to a range or to a list of options, as in the file of a user
(``--search-space``)::

    target_kl: {low: 0.002, high: 0.05, log: true}
    gamma: [0.95, 0.98, 0.99, 0.995, 0.999]
    policy_kwargs.net_arch: [{pi: [64, 64], vf: [64, 64]}, {pi: [256, 256], vf: [256, 256]}]

Whole bounds draw whole numbers; a name with a dot lies in a mapping. An algorithm states its own
space in the class attribute ``search_space``, to which those of its bases are added.
"""

import json
from collections.abc import Callable, Mapping
from typing import Any

import optuna
from optuna.distributions import FloatDistribution, IntDistribution
from optuna.samplers import BaseSampler, GPSampler, NSGAIISampler, RandomSampler, TPESampler

from sb3_guard.zoo.cli.names import as_data
from sb3_guard.zoo.cli.usage import UsageError, explained, read_mapping
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.hyperparams import annotations, parameters

# RL-Zoo's algorithms are searched in the space of their constrained relative, without its costs.
RELATIVES = {
    "ppo": "ppo_lag", "sac": "sac_lag", "td3": "td3_lag", "ddpg": "td3_lag", "tqc": "tqc_lag",
    "crossq": "sac_lag",
}  # fmt: skip

SAMPLERS: dict[str, Callable[[int | None, int], BaseSampler]] = {
    "tpe": lambda seed, startup: TPESampler(seed=seed, n_startup_trials=startup),
    "gp": lambda seed, startup: GPSampler(
        seed=seed, n_startup_trials=startup, warn_independent_sampling=False
    ),
    "nsgaii": lambda seed, startup: NSGAIISampler(seed=seed, population_size=max(startup, 2)),
    "random": lambda seed, startup: RandomSampler(seed=seed),
}


def space_of(algo: str) -> dict[str, Any]:
    """
    The space of an algorithm: what its class and the bases of that say; empty if nobody does.

    What a class says None of is left out.

    :param algo: key of the algorithm
    :raises UsageError: there is no such algorithm, or one of the entries is wrong
    """
    space: dict[str, Any] = {}
    for cls in reversed(algorithm(RELATIVES.get(algo, algo)).__mro__):
        space |= vars(cls).get("search_space", {})
    if algo in RELATIVES:
        names = annotations(algorithm(algo))
        space = {name: entry for name, entry in space.items() if name.partition(".")[0] in names}
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
        bounds: dict[str, Any] = {
            key: entry[key] if type(entry[key]) is int else float(entry[key])
            for key in ("low", "high")
        }
        bounds = {"log": False, **entry, **bounds}
        (IntDistribution if _is_whole(bounds) else FloatDistribution)(**bounds)
        return bounds


def _is_whole(entry: Mapping[str, Any]) -> bool:
    """Whether a range draws whole numbers."""
    return isinstance(entry["low"], int) and isinstance(entry["high"], int)


def _label(option: Any) -> Any:
    """What the study stores for an option: lists and mappings as text."""
    return json.dumps(option) if isinstance(option, list | dict) else option


def _draw(trial: optuna.Trial, name: str, entry: Any) -> Any:
    if isinstance(entry, list):
        labels = [_label(option) for option in entry]
        return entry[labels.index(trial.suggest_categorical(name, labels))]
    suggest = trial.suggest_int if _is_whole(entry) else trial.suggest_float
    return suggest(name, **entry)


def _contains(entry: Any, value: Any) -> bool:
    if isinstance(entry, list):
        return value in entry
    number = type(value) is int or (type(value) is float and not _is_whole(entry))
    return number and entry["low"] <= value <= entry["high"]


def set_dotted(values: Mapping[str, Any], name: str, value: Any) -> dict[str, Any]:
    """A copy of hyperparameters with one changed, which may lie in a mapping: ``a.b``."""
    outer, dot, inner = name.partition(".")
    if dot:
        value = set_dotted(values.get(outer) or {}, inner, value)
    return {**values, outer: value}


def get_dotted(values: Mapping[str, Any], name: str) -> Any:
    """One of the hyperparameters, which may lie in a mapping; None if there is none."""
    outer, dot, inner = name.partition(".")
    value = values.get(outer)
    return get_dotted(value or {}, inner) if dot else value


class Search:
    """
    The search of one algorithm: what a trial tries, and with what it begins.

    :param algo: key of the algorithm
    :param base: hyperparameters of the trials where the space says nothing
    :param space: what to search; None: that of the algorithm
    :param fixed: hyperparameters that are not searched, since the user has fixed them
    :raises UsageError: there is no space for the algorithm, or nothing is left of it
    """

    def __init__(
        self,
        algo: str,
        base: Mapping[str, Any],
        space: Mapping[str, Any] | None = None,
        fixed: Mapping[str, Any] | None = None,
    ):
        self.algo = algo
        self.base = {name: as_data(name, value) for name, value in base.items()}
        space = space_of(algo) if space is None else space
        if not space:
            raise UsageError(
                f"there is no search space for {algo}; give one with --search-space FILE.yml, or "
                "as the attribute search_space of its class"
            )
        names = {name for name in space if not {name, name.partition(".")[0]} & {*(fixed or ())}}
        #: entries by name, as data
        self.space = {name: entry for name, entry in space.items() if name in names}
        if not self.space:
            raise UsageError("nothing is left to search: -params fixes the whole space")

    def corners(self) -> list[dict[str, Any]]:
        """The base with each option or bound in turn, to be checked."""
        return [
            set_dotted(self.base, name, value)
            for name, entry in self.space.items()
            for value in (entry if isinstance(entry, list) else (entry["low"], entry["high"]))
        ]

    def draw(self, trial: optuna.Trial) -> dict[str, Any]:
        """All hyperparameters of a trial, plain data."""
        values = self.base
        for name, entry in self.space.items():
            values = set_dotted(values, name, _draw(trial, name, entry))
        return dict(sorted(values.items()))

    def first(self) -> dict[str, Any]:
        """
        The base's own place in the space, for the first trial, with the algorithm's defaults where
        the base says nothing. What lies outside is drawn.
        """
        places = {}
        cls = algorithm(self.algo)
        defaults = {name: parameter.default for name, parameter in parameters(cls).items()}
        defaults["policy_kwargs"] = getattr(cls, "policy_defaults", {})
        for name, entry in self.space.items():
            value = get_dotted(self.base, name)
            value = get_dotted(defaults, name) if value is None else value
            if _contains(entry, value):
                places[name] = _label(value)
        return places
