"""Hyperparameters as data: found, merged, checked, and turned into what constructors take.

They are RL-Zoo's files: ``hyperparams/<algo>.yml`` with a ``default`` entry, entries for single
environments or patterns of them (``Safety*``), and YAML anchors. What is read stays plain data, so
that the run folder's ``config.yml`` says exactly what was used; only the last three functions here
make objects of it.
"""

import importlib
import inspect
import runpy
import sys
from collections.abc import Mapping
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.noise import (
    ActionNoise,
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
)
from stable_baselines3.common.policies import BasePolicy

from sb3_guard.algorithms import ALGORITHMS, TrustRegion
from sb3_guard.algorithms.common.arguments import signature
from sb3_guard.fields import did_you_mean, fit, is_data
from sb3_guard.zoo.cli.names import (
    PAPER,
    as_data,
    import_class,
    with_classes,
)
from sb3_guard.zoo.cli.usage import UsageError, explained, read_mapping
from sb3_guard.zoo.run.algos import algorithm, baselines

# What a hyperparameter file may hold besides the algorithm's own arguments, as in RL-Zoo;
# `selection_limit` is ours (see CostEvalCallback).
RUN_KEYS: dict[str, Any] = {
    "n_timesteps": int,
    "n_envs": int,
    "normalize": bool | dict,
    "frame_stack": int | None,
    "env_kwargs": dict | None,
    "env_wrapper": str | list | dict | None,
    "vec_env_wrapper": str | list | dict | None,
    "callback": str | list | dict | None,
    "monitor_kwargs": dict,
    "selection_limit": float | list[float] | None,
}
N_TIMESTEPS = 1_000_000  # the length of training where neither a file nor a flag says
# RL-Zoo's two for the exploration noise of off-policy algorithms.
NOISE_KEYS: dict[str, Any] = {
    "noise_type": Literal["normal", "ornstein-uhlenbeck"] | None,
    "noise_std": float,
}
# Arguments of an algorithm that are flags of the command, or none of a user's
NOT_HYPERPARAMETERS = {
    "env", "seed", "device", "verbose", "tensorboard_log", "self", "_init_setup_model",
    "policy_base",
}  # fmt: skip


def hyperparams_folder() -> Path:
    """Where the shipped files are: inside an installed package, next to it in a checkout."""
    package = Path(__file__).parents[2]
    inside = package / "hyperparams"
    return inside if inside.is_dir() else package.parent / "hyperparams"


def read_file(path: str | Path) -> dict[str, Any]:
    """
    The content of a hyperparameter file: environment (or ``default``) to hyperparameters.

    :param path: a YAML file, or a Python file or module that has a dictionary ``hyperparams``
    :raises UsageError: it is absent, not readable or not of that form
    """
    name = str(path)
    form = "environments, or 'default', to hyperparameters such as {n_steps: 1000}"
    if name.endswith((".yml", ".yaml")):
        content = read_mapping(name, "hyperparameter file", form)
    else:
        fix = "give a .yml file, a Python file or module, a name such as ppo_lag, or paper"
        with explained(f"can't read hyperparameters from {name}", fix=fix):
            if name.endswith(".py"):
                module = _ran(Path(name).resolve(), Path(name).stat().st_mtime_ns)
            else:
                module = vars(importlib.import_module(name))
            content = module["hyperparams"]
    if not isinstance(content, dict) or not all(isinstance(v, dict) for v in content.values()):
        raise UsageError(f"{name} must map {form}")
    return content


@cache
def _ran(path: Path, modified: int) -> dict[str, Any]:
    module = sys.modules.get(path.stem)  # imported by --gym-packages: it registers parts once
    if module is not None and Path(getattr(module, "__file__", None) or "").resolve() == path:
        return vars(module)
    return runpy.run_path(str(path))


def shipped_file(algo: str) -> Path:
    """The hyperparameter file of an algorithm: ours, else RL-Zoo's."""
    ours = hyperparams_folder() / f"{algo}.yml"
    if ours.is_file():
        return ours
    import rl_zoo3

    theirs = Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo}.yml"
    return theirs if theirs.is_file() else ours


def nearest(algo: str, conf_file: str | None = None) -> str:
    """The algorithm whose shipped file is read: this one, else its nearest base that has one."""
    if conf_file not in (None, PAPER) or shipped_file(algo).is_file():
        return algo
    table = {**baselines(), **ALGORITHMS, "trpo": TrustRegion}  # TRPO adds nothing to it
    ours = {path.stem for path in hyperparams_folder().glob("*.yml")}
    bases = {cls: key for key, cls in table.items() if key in ours}
    return next((bases[cls] for cls in algorithm(algo).__mro__ if cls in bases), algo)


def usual_limit(env_id: str) -> float | None:
    """The cost limit of an episode in the shipped files; None: they have none."""
    return (entry(read_file(shipped_file("cpo")), env_id) or {}).get("cost_limit")


def read_hyperparams(
    algo: str, env_id: str, conf_file: str | None = None, overrides: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """
    The hyperparameters of an algorithm on an environment, not yet checked.

    :param algo: key of the algorithm, names the shipped file; one without a file takes that of its
        nearest base, where its class states no other default
    :param env_id: its own entry is taken, with or without a version, else the longest pattern
        that fits, else ``default``
    :param conf_file: file to read instead of the shipped one, or the algorithm whose shipped one;
        ``paper``: the shipped one, with what is different in the paper's table
    :param overrides: what the command line says
    :raises UsageError: the file can't be read, or has no entry that fits
    """
    changes: dict[str, Any] = {}
    base = nearest(algo, conf_file)
    if conf_file == PAPER:
        content = read_file(hyperparams_folder() / "paper.yml")
        changes = entry(content.pop("all"), env_id) or {}
        if base not in content:
            raise UsageError(f"-conf {PAPER} has no {algo!r}; {did_you_mean(algo, content)}")
        changes |= content[base]
        conf_file = None
    named = conf_file or base  # an algorithm, or a file
    path = shipped if (shipped := shipped_file(named)).is_file() else conf_file or shipped
    # An algorithm of a user may have no base of ours; its own defaults serve.
    absent = conf_file is None and not Path(path).is_file()
    content = {"default": {}} if absent else read_file(path)
    values = entry(content, env_id)
    if values is None:
        hint = did_you_mean(env_id, content)
        raise UsageError(f"{path} has no entry for {env_id!r} and no 'default'; {hint}")
    values = {**values, **changes}
    if base != algo:  # without those of which the class states another default
        mine, theirs = (parameters(algorithm(key)) for key in (algo, base))
        for name in values.keys() & theirs.keys():
            if name not in mine or mine[name].default != theirs[name].default:
                del values[name]
    return {**values, **(overrides or {})}


def entry(content: Mapping[str, dict[str, Any]], env_id: str) -> dict[str, Any] | None:
    """The entry of a file that an environment takes; None: there is none."""
    env_id = env_id.rpartition(":")[2]  # without the module that registers it
    fitting = (name for name in content if "*" in name and fnmatchcase(env_id, name))
    patterns = sorted(fitting, key=len, reverse=True)
    for name in (env_id, env_id.rsplit("-v", 1)[0], *patterns, "default"):
        if name in content:
            return content[name]
    return None


def merged(there: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of an environment, in which those of a part, such as ``robot``, are joined too."""
    both = (k for k in given if isinstance(there.get(k), dict) and isinstance(given[k], dict))
    return {**there, **given, **{k: there[k] | given[k] for k in both}}


def parameters(algorithm: type[BaseAlgorithm]) -> dict[str, inspect.Parameter]:
    """The hyperparameters an algorithm takes, from its constructor and those it hands on to."""
    arguments = signature(algorithm, getattr(algorithm, "fixed_arguments", frozenset())).parameters
    return {name: arguments[name] for name in arguments if name not in NOT_HYPERPARAMETERS}


def annotations(algorithm: type[BaseAlgorithm]) -> dict[str, Any]:
    """The hyperparameters that runs of an algorithm may have: name to type annotation."""
    hints = {
        name: Any if parameter.annotation is parameter.empty else parameter.annotation
        for name, parameter in parameters(algorithm).items()
    }
    return {**hints, **RUN_KEYS, **(NOISE_KEYS if "action_noise" in hints else {})}


def check(algo: str, algorithm: type[BaseAlgorithm], values: Mapping[str, Any]) -> dict[str, Any]:
    """
    The same hyperparameters as data, numbers in their proper type, or an error that says what to
    mend.

    :raises UsageError: a name or policy the algorithm does not know, a value of the wrong type, or
        a NaN
    """
    hints = annotations(algorithm)
    checked = {}
    for name, value in values.items():
        if name not in hints:
            hint = did_you_mean(name, sorted(hints))
            raise UsageError(f"{algo} has no hyperparameter {name!r}; {hint}")
        if not is_data(value):
            raise UsageError(
                f"hyperparameter {name}: {value!r} is more than plain data; write classes and "
                "calls as text, such as policy_kwargs: dict(activation_fn=nn.ReLU)"
            )
        with explained("hyperparameter", ValueError):
            checked[name] = fit(name, as_data(name, value), hints[name])
    checked.setdefault("n_envs", 1)
    checked.setdefault("n_timesteps", N_TIMESTEPS)
    aliases = algorithm.policy_aliases
    policy = checked.setdefault("policy", next(iter(aliases)))  # MlpPolicy, or its recurrent twin
    if isinstance(policy, str) and "." not in policy and policy not in aliases:
        raise UsageError(f"{algo} has no policy {policy!r}; {did_you_mean(policy, aliases)}")
    return dict(sorted(checked.items()))


def model_arguments(values: Mapping[str, Any]) -> dict[str, Any]:
    """
    What the algorithm's constructor takes, of checked hyperparameters: schedules and classes made.

    :raises UsageError: text that should name a class or be an expression does not
    """
    model = {n: value for n, value in values.items() if n not in {**RUN_KEYS, **NOISE_KEYS}}
    for name, value in model.items():
        if name == "policy":
            if "." in value:
                model[name] = import_class(name, value, BasePolicy)
        elif isinstance(value, str) and value.startswith("lin_") and name != "cost_limit":
            what = f"hyperparameter {name}: {value!r} is not a schedule"
            with explained(what, ValueError, fix="write e.g. lin_0.001"):
                initial = float(value.removeprefix("lin_"))
            # The last rollout may go beyond the training's end.
            model[name] = lambda remaining, initial=initial: max(remaining, 0.0) * initial
        elif isinstance(value, Mapping):
            model[name] = with_classes(name, value)
        elif name == "train_freq" and isinstance(value, list):
            model[name] = tuple(value)
        elif isinstance(value, str) and name.endswith("_class"):
            model[name] = import_class(name, value, BaseBuffer)
    return model


def normalization(values: Mapping[str, Any]) -> dict[str, Any] | None:
    """Arguments of VecNormalize; None: it is not used."""
    if not (given := values.get("normalize")):
        return None
    # Returns are scaled by the discount they are learned with.
    learned = {"gamma": values["gamma"]} if "gamma" in values else {}
    return learned | (given if isinstance(given, dict) else {})


def action_noise(values: Mapping[str, Any], space: spaces.Box) -> ActionNoise | None:
    """Exploration noise for actions of a space, if there is any."""
    noises = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}
    if (kind := values.get("noise_type")) is None:
        return None
    return noises[kind](np.zeros(space.shape), np.full(space.shape, values.get("noise_std", 0.0)))
