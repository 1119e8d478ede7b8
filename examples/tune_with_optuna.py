"""How do I find the hyperparameters with the highest return within a cost limit?

`sb3-guard tune` does this for several seeds, processes and machines, with pruning and a report.
"""

import optuna

from sb3_guard import evaluate_policy, make_model

LIMIT = 5.0  # cost of an episode


def objective(trial: optuna.Trial) -> float:
    settings = {
        "target_kl": trial.suggest_float("target_kl", 0.005, 0.05, log=True),
        "lambda_lr": trial.suggest_float("lambda_lr", 0.02, 1.0, log=True),
    }
    model = make_model(
        "trpo_lag", "Goal_Point_8Hazards", cost_limit=LIMIT, n_envs=10, seed=0, **settings
    )
    env = model.learn(200_000).get_env()
    evaluation = evaluate_policy(model, env, n_eval_episodes=10, seed=1)
    trial.set_constraint("cost", evaluation.costs.mean() - LIMIT)  # feasible if at most 0
    return evaluation.returns.mean()


study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=0))
study.optimize(objective, n_trials=20)
for trial in study.trials:
    print(trial.number, trial.value, trial.constraints, trial.params)
try:
    print("best that keeps the limit:", study.best_params)
except ValueError:
    print("no trial keeps the limit: train longer, or raise it")
