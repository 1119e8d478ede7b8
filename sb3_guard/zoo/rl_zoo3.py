"""RL-Zoo with this package's algorithms and environments.

``python -m sb3_guard.zoo.rl_zoo3 --algo cpo --env Goal_Point_8Hazards-v0 -conf
hyperparams/cpo.yml`` is ``python -m rl_zoo3.train`` with them. In RL-Zoo's table ``trpo`` stays
sb3-contrib's and ours is ``guard_trpo``. RL-Zoo evaluates by return alone; ``sb3-guard train`` and
``sb3-guard tune`` know the cost limit.
"""

from sb3_guard.algorithms import ALGORITHMS


def register() -> None:
    """
    Add our algorithms to RL-Zoo's table; its environments are Gymnasium's, ours among them.
    """
    import rl_zoo3

    import sb3_guard  # noqa: F401  registers the environments

    for algo, cls in ALGORITHMS.items():
        rl_zoo3.ALGOS["guard_trpo" if algo == "trpo" else algo] = cls


if __name__ == "__main__":
    from rl_zoo3.train import train

    register()
    train()
