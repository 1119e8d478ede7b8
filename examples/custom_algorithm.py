"""How do I write an algorithm of my own that the commands train, tune and plot?

sb3-guard train --gym-packages custom_algorithm --algo trpo_price \
    -conf custom_algorithm.py --env Goal_Point_8Hazards -n 1e6
"""

from sb3_guard import make_vec_env, register_algorithm
from sb3_guard.algorithms import TrustRegion, hyperparameter


class TRPOPrice(TrustRegion):
    """Cost with a fixed weight p: maximise E[ratio · (A - p Σ A_Ci)] within the trust region.

    :param price: p, weight of a unit of cost, in standard deviations of the advantage
    """

    label, family = "TRPO with a fixed weight", "Lagrangian"

    price: float = hyperparameter(1.0)

    def advantages(self, batch):
        return batch.advantages - self.price * batch.cost_advantages.sum(dim=1)


register_algorithm("trpo_price", TRPOPrice)
hyperparams = {"default": {"n_envs": 10, "n_steps": 1000, "cost_limit": 5.0, "price": 10.0}}

if __name__ == "__main__":
    env = make_vec_env("Goal_Point_8Hazards", n_envs=10, seed=0)
    model = TRPOPrice("MlpPolicy", env, n_steps=1000, price=10.0, seed=0).learn(100_000)
    print("cost of an episode:", model.costs.episode_cost)
