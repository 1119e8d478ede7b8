"""What tuning searches: a space of hyper-parameters per algorithm, as data, and how it is sampled.

A space maps names of hyper-parameters to a :class:`Range` or a :class:`Choice`. A file of one's own
(``--search-space``) says the same in YAML::

    target_kl: {low: 0.002, high: 0.05, log: true}
    gamma: {low: 0.95, high: 0.999, log: true, complement: true}
    n_envs: [10, 20, 30]
    policy_kwargs.net_arch: [{pi: [64, 64], vf: [64, 64]}, {pi: [256, 256], vf: [256, 256]}]

Ranges are drawn in the scale in which they matter, as RL-Zoo's samplers do it; those serve for the
algorithms that have no space here, and :func:`rl_zoo_sampler` makes one of a space for RL-Zoo.
"""

import ast
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import optuna
import yaml
from optuna.samplers import BaseSampler

from sb3_guard.plain_yaml import load_yaml
from sb3_guard.spelling import did_you_mean
from sb3_guard.zoo.algos import algorithm
from sb3_guard.zoo.config import NOISE_KEYS, RUN_KEYS, parameters
from sb3_guard.zoo.usage import UsageError, one_line

DIGITS = 4  # of a drawn number: enough to tell two apart, and readable in a file


@dataclass(frozen=True)
class Range:
    """
    Numbers from ``low`` to ``high``, whole ones if both bounds are.

    :param low: smallest value
    :param high: largest value
    :param log: draw uniformly in the logarithm
    :param complement: draw 1 - value instead, so that ``log`` resolves 0.99 from 0.999
    """

    low: float
    high: float
    log: bool = False
    complement: bool = False

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ValueError(f"{name}: {value!r} is not a number")
            if not math.isfinite(value):
                raise ValueError(f"{name}: {value!r} is not finite")
        for name in ("log", "complement"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name}: {getattr(self, name)!r} is not True or False")
        if not self.low < self.high:
            raise ValueError(f"low: {self.low} is not below high: {self.high}")
        least = 1 - self.high if self.complement else self.low
        if self.log and least <= 0:
            side = "high must be below 1" if self.complement else "low must be above 0"
            raise ValueError(f"{side} on a logarithmic scale")

    @property
    def whole(self) -> bool:
        """Whether only whole numbers are drawn."""
        return isinstance(self.low, int) and isinstance(self.high, int) and not self.complement

    def parameter(self, name: str) -> str:
        """The name under which the study knows it."""
        return f"one_minus_{name}" if self.complement else name

    def draw(self, trial: optuna.Trial, name: str) -> float:
        """A value for a trial."""
        if self.whole:
            return trial.suggest_int(name, int(self.low), int(self.high), log=self.log)
        low, high = (1 - self.high, 1 - self.low) if self.complement else (self.low, self.high)
        drawn = trial.suggest_float(self.parameter(name), low, high, log=self.log)
        drawn = float(f"{drawn:.{DIGITS}g}")
        return round(1 - drawn, 12) if self.complement else drawn

    def represent(self, value: Any) -> Any:
        """What the study stores for a value; None if the value is not in the range."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        if not self.low <= value <= self.high or (self.whole and int(value) != value):
            return None
        return round(1 - value, 12) if self.complement else value


@dataclass(frozen=True)
class Choice:
    """
    One of several values, plain data of any kind.

    :param options: at least two
    """

    options: tuple[Any, ...]

    def __post_init__(self) -> None:
        if len(self.options) < 2:
            raise ValueError("a choice needs at least two options")

    @property
    def labels(self) -> list[Any]:
        """What the study stores for each option: lists and mappings as text."""
        plain = (str, int, float, type(None))
        return [one if isinstance(one, plain) else json.dumps(one) for one in self.options]

    def parameter(self, name: str) -> str:
        """The name under which the study knows it."""
        return name

    def draw(self, trial: optuna.Trial, name: str) -> Any:
        """A value for a trial."""
        return self.options[self.labels.index(trial.suggest_categorical(name, self.labels))]

    def represent(self, value: Any) -> Any:
        """What the study stores for a value; None if it is not among the options."""
        return self.labels[self.options.index(value)] if value in self.options else None


Space = Mapping[str, Range | Choice]

SMALL, LARGE = ({"pi": [n, n], "vf": [n, n]} for n in (64, 256))
#: of every algorithm of this package
COMMON: dict[str, Range | Choice] = {
    "n_envs": Choice((10, 20, 30)),
    "gamma": Range(0.95, 0.999, log=True, complement=True),
    "gae_lambda": Range(0.9, 0.99, log=True, complement=True),
    "target_kl": Range(0.002, 0.05, log=True),
    "learning_rate": Range(1e-4, 1e-2, log=True),
    "n_critic_updates": Range(10, 100, log=True),
    "policy_kwargs.net_arch": Choice((SMALL, LARGE)),
    "policy_kwargs.log_std_init": Range(-1.5, 0.0),
}
SPACES: dict[str, dict[str, Range | Choice]] = {
    "trpo": COMMON,
    "cpo": {**COMMON, "cost_reduction": Range(0.0, 0.02)},
    "pcpo": {**COMMON, "projection": Choice(("kl", "l2"))},
    "trpo_lag": {
        **COMMON,
        "lambda_lr": Range(5e-4, 0.1, log=True),
        "lambda_init": Range(0.0, 2.0),
    },
    "trpo_fac": {
        **COMMON,
        "lambda_lr": Range(1e-5, 1e-2, log=True),
        "lambda_epochs": Range(1, 20, log=True),
    },
    "trpo_ipo": {
        **COMMON,
        "t": Range(1e-3, 1.0, log=True),
        "max_multiplier": Range(0.05, 20.0, log=True),
    },
    "trpo_sl": {**COMMON, "warmup": Range(0.0, 0.5), "drift": Choice((False, True))},
    "trpo_usl": {
        **COMMON,
        "warmup": Range(0.0, 0.5),
        "steps": Range(5, 40, log=True),
        "rate": Range(0.01, 0.2, log=True),
        "tolerance": Range(0.005, 0.5, log=True),
    },
    # RL-Zoo has none for it.
    "crossq": {
        "gamma": Range(0.97, 0.9999, log=True, complement=True),
        "learning_rate": Range(1e-5, 2e-3, log=True),
        "batch_size": Choice((64, 128, 256, 512)),
        "policy_delay": Range(1, 4),
        "policy_kwargs.net_arch": Choice(
            tuple({"pi": [256, 256], "qf": [n, n]} for n in (256, 512, 1024))
        ),
    },
}


def read_space(path: str) -> dict[str, Range | Choice]:
    """
    A search space from a YAML file.

    :raises UsageError: it can't be read, or an entry is neither a range nor a list
    """
    try:
        with open(path) as file:
            content = load_yaml(file.read())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise UsageError(f"--search-space: can't read {path}: {one_line(error)}") from error
    if not isinstance(content, dict) or not content:
        raise UsageError(
            f"--search-space: {path} must map names of hyper-parameters to ranges or lists, such "
            "as 'target_kl: {low: 0.002, high: 0.05, log: true}'"
        )
    return {str(name): _entry(path, str(name), value) for name, value in content.items()}


def _entry(path: str, name: str, value: Any) -> Range | Choice:
    try:
        if isinstance(value, list):
            return Choice(tuple(value))
        if not isinstance(value, dict):
            raise ValueError("write a list of options, or {low: …, high: …, log: true}")
        known = ("low", "high", "log", "complement")
        for key in value:
            if key not in known:
                raise ValueError(f"unknown key {key!r}; {did_you_mean(key, known)}")
        for key in ("low", "high"):
            if key not in value:
                raise ValueError(f"there is no {key!r}")
            if isinstance(value[key], str):  # YAML reads 1e-4 as text
                value = {**value, key: _number(key, value[key])}
        return Range(**value)
    except ValueError as error:
        raise UsageError(f"--search-space: {name} in {path}: {error}") from None


def _number(key: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{key}: {text!r} is not a number") from None


def describe(space: Space) -> dict[str, Any]:
    """A space as plain data, in the form of its file."""
    return {
        name: list(one.options) if isinstance(one, Choice) else asdict(one)
        for name, one in space.items()
    }


def set_dotted(values: Mapping[str, Any], name: str, value: Any) -> dict[str, Any]:
    """A copy of hyper-parameters with one changed, which may lie in a mapping: ``a.b``."""
    outer, dot, inner = name.partition(".")
    if not dot:
        return {**values, outer: value}
    mapping = values.get(outer) or {}
    if isinstance(mapping, str):
        # An expression, such as dict(activation_fn=nn.ReLU), is evaluated when the model is made.
        return {**values, outer: _changed(mapping, {inner: repr(value)})}
    return {**values, outer: set_dotted(mapping, inner, value)}


def get_dotted(values: Mapping[str, Any], name: str) -> Any:
    """One of the hyper-parameters, which may lie in a mapping; None if there is none."""
    outer, dot, inner = name.partition(".")
    value = values.get(outer)
    if not dot:
        return value
    return get_dotted(value, inner) if isinstance(value, Mapping) else None


class Search:
    """
    The search of one algorithm: what a trial tries, and with what it begins.

    :param algo: key of the algorithm
    :param base: hyper-parameters of the trials where the space says nothing
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
        self.base = dict(base)
        if space is None:
            space = SPACES.get(algo)
        self._rl_zoo: Callable[..., dict[str, Any]] | None = None
        if space is None:
            self._rl_zoo = HYPERPARAMS_SAMPLER.get(algo)
            if self._rl_zoo is None:
                raise UsageError(
                    f"there is no search space for {algo}; give one with --search-space FILE.yml"
                )
            space = {}
        fixed = fixed or {}
        self.space = {
            name: one
            for name, one in space.items()
            if name not in fixed and name.partition(".")[0] not in fixed
        }
        self._fixed = dict(fixed)
        if not self.space and self._rl_zoo is None:
            raise UsageError("nothing is left to search: -params fixes the whole space")

    def description(self) -> Any:
        """The space as plain data, or whose it is."""
        return "rl_zoo3" if self._rl_zoo is not None else describe(self.space)

    def draw(self, trial: optuna.Trial) -> dict[str, Any]:
        """All hyper-parameters of a trial, plain data."""
        if self._rl_zoo is not None:
            return self._draw_rl_zoo(trial)
        values = self.base
        for name, one in self.space.items():
            value, own = one.draw(trial, name), get_dotted(self.base, name)
            # The base's own value is not to be rounded.
            if own is not None and trial.params[one.parameter(name)] == one.represent(own):
                value = own
            values = set_dotted(values, name, value)
        return dict(sorted(values.items()))

    def _draw_rl_zoo(self, trial: optuna.Trial) -> dict[str, Any]:
        """RL-Zoo's samplers give objects; a file holds data."""
        assert self._rl_zoo is not None
        extra = {"using_her_replay_buffer": False, "her_kwargs": {}}
        drawn = self._rl_zoo(trial, 1, self.base.get("n_envs", 1), extra)
        # Made of two parameters, which are data; none may be drawn where the base has some.
        drawn.pop("action_noise", None)
        for name in NOISE_KEYS:
            if name in trial.params:
                drawn[name] = trial.params[name]
        values = dict(self.base)
        for name, value in drawn.items():
            if name in self._fixed:
                continue
            if name == "policy_kwargs":
                value = _expression(self.base.get(name) or {}, value)
            values[name] = value
        if values.get("noise_type") is None:
            values.pop("noise_std", None)
        return dict(sorted(values.items()))

    def first(self) -> dict[str, Any]:
        """
        The base's own place in the space, for the first trial, with the algorithm's defaults where
        the base says nothing; what lies outside is drawn.
        """
        defaults = {name: one.default for name, one in parameters(algorithm(self.algo)).items()}
        known = {}
        for name, one in self.space.items():
            own = get_dotted(self.base, name)
            known[one.parameter(name)] = one.represent(defaults.get(name) if own is None else own)
        return {name: value for name, value in known.items() if value is not None}


def rl_zoo_sampler(algo: str, base: Mapping[str, Any]) -> Callable[..., dict[str, Any]]:
    """
    The space of an algorithm as one of RL-Zoo's samplers, which return arguments of the model.

    RL-Zoo replaces ``policy_kwargs`` as a whole, so what is not drawn of it comes from ``base``;
    how many environments there are is not for its samplers to say.

    :param base: hyper-parameters of the trials where the space says nothing
    """
    search = Search(algo, base, fixed={name: base.get(name) for name in RUN_KEYS})
    names = {name.partition(".")[0] for name in search.space}

    def sample(
        trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: Mapping[str, Any]
    ) -> dict[str, Any]:
        values = search.draw(trial)
        return {name: values[name] for name in names}

    return sample


def _expression(base: Any, changes: Mapping[str, Any]) -> str:
    """Arguments of a policy, classes among them, as text that evaluates to them."""

    def text(value: Any) -> str:
        return f"nn.{value.__name__}" if isinstance(value, type) else repr(value)

    old = base if isinstance(base, str) else repr(base)
    return _changed(old, {name: text(value) for name, value in changes.items()})


def _changed(old: str, changes: Mapping[str, str]) -> str:
    """The text of a mapping, ``dict(a=1)`` or ``{"a": 1}``, with some of its entries changed."""
    try:
        tree = ast.parse(old.strip(), mode="eval").body
        if isinstance(tree, ast.Dict):
            names = [key and ast.literal_eval(key) for key in tree.keys]
            nodes = tree.values
        elif isinstance(tree, ast.Call) and ast.unparse(tree.func) == "dict" and not tree.args:
            names = [one.arg for one in tree.keywords]
            nodes = [one.value for one in tree.keywords]
        else:
            names, nodes = [None], []
        if None in names:
            raise ValueError("it is no mapping")
    except (SyntaxError, ValueError) as error:
        raise UsageError(
            f"can't change entries of {old!r}: {one_line(error)}; write dict(name=value)"
        ) from error
    own: dict[Any, str] = {name: ast.unparse(node) for name, node in zip(names, nodes, strict=True)}
    return f"dict({', '.join(f'{name}={text}' for name, text in {**own, **changes}.items())})"


def _gp(seed: int | None, n_startup_trials: int) -> BaseSampler:
    return optuna.samplers.GPSampler(
        seed=seed, n_startup_trials=n_startup_trials, warn_independent_sampling=False
    )


def _tpe(seed: int | None, n_startup_trials: int) -> BaseSampler:
    return optuna.samplers.TPESampler(seed=seed, n_startup_trials=n_startup_trials)


def _nsgaii(seed: int | None, n_startup_trials: int) -> BaseSampler:
    return optuna.samplers.NSGAIISampler(seed=seed, population_size=max(n_startup_trials, 2))


def _random(seed: int | None, n_startup_trials: int) -> BaseSampler:
    return optuna.samplers.RandomSampler(seed=seed)


SAMPLERS: dict[str, Callable[[int | None, int], BaseSampler]] = {
    "tpe": _tpe,
    "gp": _gp,
    "nsgaii": _nsgaii,
    "random": _random,
}
