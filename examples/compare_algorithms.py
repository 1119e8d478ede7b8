"""Train three algorithms and draw their returns and costs.

`sb3-guard benchmark` and `sb3-guard plot` do this for many environments, algorithms and seeds.
"""

import matplotlib.pyplot as plt
from stable_baselines3.common.monitor import load_results

from sb3_guard import make_model

LIMIT = 5.0

figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
for name in ("trpo", "cpo", "trpo_lag"):
    log = f"compare/{name}"
    model = make_model(
        name, "Goal_Point_8Hazards", cost_limit=LIMIT, n_envs=10, seed=0, monitor_path=f"{log}/0"
    )
    model.learn(300_000)
    model.get_env().close()
    episodes = load_results(log)  # a row per episode: return r, cost c, length l
    means = episodes.groupby(episodes.index // 10 * 10_000 + 10_000).mean()  # ten per update
    axes[0].plot(means.index, means["r"], label=name)
    axes[1].plot(means.index, means["c"], label=name)
    print(name, means[["r", "c"]].iloc[-1].round(2).to_dict())
axes[1].axhline(LIMIT, color="black", linestyle=":", label="limit")
axes[0].set(xlabel="steps", ylabel="return")
axes[1].set(xlabel="steps", ylabel="episode cost")
axes[1].legend()
figure.savefig("compare.png")
