"""RL-Zoo with this package's algorithms and search spaces.

``python -m sb3_guard.zoo.rl_zoo3 --algo cpo --env Goal_Point_8Hazards-v0 -conf
hyperparams/cpo.yml`` is ``python -m rl_zoo3.train`` with them. In RL-Zoo's table ``trpo`` stays
sb3-contrib's and ours is ``guard_trpo``. RL-Zoo evaluates and searches by return alone;
``sb3-guard train`` and ``sb3-guard tune`` know the cost limit.
"""

from sb3_guard.algorithms import ALGORITHMS
from sb3_guard.zoo.run.hyperparams import read_file, shipped_file
from sb3_guard.zoo.tuning.spaces import SPACES, rl_zoo_sampler, space_of


def key_in_rl_zoo(algo: str) -> str:
    """The key of one of our algorithms in RL-Zoo's table."""
    return "guard_trpo" if algo == "trpo" else algo


def register() -> None:
    """
    Add our algorithms and search spaces to RL-Zoo's tables; its environments are Gymnasium's, ours
    among them.
    """
    import rl_zoo3
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

    import sb3_guard  # noqa: F401  registers the environments

    for algo, cls in ALGORITHMS.items():
        rl_zoo3.ALGOS[key_in_rl_zoo(algo)] = cls
    for algo in {**ALGORITHMS, **SPACES}:
        path = shipped_file(algo)
        if space_of(algo):
            base = read_file(path)["default"] if path.is_file() else {}
            HYPERPARAMS_SAMPLER[key_in_rl_zoo(algo)] = rl_zoo_sampler(algo, base)


if __name__ == "__main__":
    from rl_zoo3.train import train

    register()
    train()
