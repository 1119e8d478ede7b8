"""How do I write an algorithm of my own and compare it with one of the package?

sb3-guard benchmark --gym-packages custom_algorithm --algos trpo_lag trpo_price \
    --envs Goal_Point_8Hazards --seeds 0 1 2 -f logs/price
sb3-guard plot logs/price
"""

from sb3_guard import make_vec_env, register_algorithm
from sb3_guard.algorithms import TrustRegion, hyperparameter


class TRPOPrice(TrustRegion):
    """Cost with a fixed weight p: maximise E[ratio · (A - p Σ A_Ci)] within the trust region.

    :param price: p, weight of a unit of cost, in standard deviations of the advantage
    """

    label, family = "TRPO with a fixed weight", "Lagrangian"

    price: float = hyperparameter(10.0)

    def advantages(self, batch):
        return batch.advantages - self.price * batch.cost_advantages.sum(dim=1)


register_algorithm("trpo_price", TRPOPrice)  # with trpo's hyperparameters

if __name__ == "__main__":
    env = make_vec_env("Goal_Point_8Hazards", n_envs=10, seed=0)
    model = TRPOPrice("MlpPolicy", env, n_steps=1000, cost_limit=5.0, seed=0).learn(100_000)
    print("cost of an episode:", model.costs.episode_cost)
