"""Begin with what an algorithm without limits has learnt."""

import json
import zipfile
from pathlib import Path
from typing import Any, TypeVar

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, open_path

from sb3_guard.vector import moments_of

Algorithm = TypeVar("Algorithm", bound=BaseAlgorithm)


def warm_start(model: Algorithm, path: str | Path) -> Algorithm:
    """Take over the actor and the critic of the reward of an agent, as of SB3's PPO, SAC or TD3.

    Everything else remains the model's own: hyperparameters, optimizers, the critic of the costs,
    multipliers and filters. A line says what was taken. No code in the file runs. If the agent
    learnt from normalised observations, wrap the model's environment in
    ``VecNormalize.load(statistics, env)`` first; ``learn`` warns where they are absent.

    :param model: a new model with the agent's networks (``policy_kwargs``)
    :param path: the file that the agent was saved in
    :return: the model
    :raises ValueError: networks of the agent are absent in the model, or have other shapes
    """
    _, parts, _ = load_from_zip_file(path, device=model.device, load_data=False)
    ours: dict[str, Any] = model.policy.state_dict()
    theirs: Any = (parts or {}).get("policy", {})
    shapes = {name: f"{name} {[*weight.shape]}" for name, weight in theirs.items()}
    wrong = [shapes[n] for n in theirs if n not in ours or ours[n].shape != theirs[n].shape]
    if wrong or not theirs:
        raise ValueError(
            f"{path} has {', '.join(wrong) or 'no policy'}, which the model's "
            f"{type(model.policy).__name__} has not: make it with the agent's policy_kwargs"
        )
    model.set_parameters({"policy": theirs}, exact_match=False, device=model.device)
    with open_path(path, "r", suffix="zip") as file, zipfile.ZipFile(file) as archive:
        told = json.loads(archive.read("data"))
    # SB3's agents do not tell: the statistics that the model's environment has are of its kind.
    normalized = told.get("learnt_normalized", bool(moments_of(model.get_env())))
    model.learnt_normalized = normalized  # type: ignore[attr-defined]
    networks = dict.fromkeys(name.partition(".")[0] for name in theirs)
    rest = [name for name in model.get_parameters() if not name.startswith("policy")]
    new = ", ".join(name for name in rest if "optimizer" not in name and name not in networks)
    print(f"taken from {path}: {', '.join(networks)}; new: optimizers, {new or 'nothing else'}")
    return model
