"""What tuning leaves behind: the best as a file that ``train`` reads, a table, and pictures."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
import pandas as pd
import yaml
from filelock import FileLock
from optuna.trial import FrozenTrial, TrialState

from sb3_guard.common.files import replacing

FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


def short(value: Any) -> str:
    """A number as short as it may be."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def rank(trial: FrozenTrial) -> tuple[bool, float, float]:
    """How good a trial is: a feasible one by its return, others first by violation."""
    result = trial.user_attrs["result"]
    return not result["violation"], -result["violation"], result["return"]


def best(trials: Sequence[FrozenTrial]) -> FrozenTrial | None:
    """The best of the trials that went to their end; None if there is none."""
    complete = (trial for trial in trials if trial.state == TrialState.COMPLETE)
    return max(complete, key=rank, default=None)


class Report:
    """
    The files of a study.

    :param folder: where they go; several processes may write them
    :param settings: of the study, as data
    :param packages: modules that register the environment
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any], packages: Sequence[str] = ()):
        self.folder, self.settings, self.packages = folder, settings, packages
        self.keys: list[str] = settings["cost_keys"]

    def write(self, study: optuna.Study) -> None:
        """Write ``trials.csv`` and ``best.yml``, and a file for each trial of the front."""
        files = {"best.yml": best(study.get_trials(deepcopy=False))}
        if self.settings["pareto"]:
            files |= {f"pareto/trial_{trial.number}.yml": trial for trial in study.best_trials}
        with FileLock(self.folder / ".report.lock"):
            with replacing(self.folder / "trials.csv") as file:
                file.write(self.table(study).encode())
            for path in self.folder.glob("pareto/*.yml"):
                if f"pareto/{path.name}" not in files:
                    path.unlink(missing_ok=True)
            for name, trial in files.items():
                if trial is not None:
                    (self.folder / name).parent.mkdir(exist_ok=True)
                    with replacing(self.folder / name) as file:
                        file.write(self.hyperparams(trial, name).encode())

    def table(self, study: optuna.Study) -> str:
        """A row per trial as comma-separated values: how it ended, its result, what it tried."""
        rows = [
            {
                "number": trial.number,
                "state": trial.state.name,
                **trial.user_attrs.get("result", {}),
                "seconds": trial.duration and trial.duration.total_seconds(),
                "error": trial.user_attrs.get("error"),
                **trial.params,
            }
            for trial in study.get_trials(deepcopy=False)
        ]
        return pd.DataFrame(rows).to_csv(index=False)

    def outcome(self, trial: FrozenTrial) -> str:
        """Return and costs in words."""
        result, limited = trial.user_attrs["result"], self.settings["cost_limit"] is not None
        costs = (
            f"{'' if key == 'cost' else 'cost '}{key} {short(result[key])}" for key in self.keys
        )
        over = result["violation"]
        verdict = [f"{short(over)} over the limit" if over else "within the limit"] * limited
        return ", ".join([f"return {short(result['return'])}", *costs, *verdict])

    def hyperparams(self, trial: FrozenTrial, name: str) -> str:
        """A trial's hyperparameters as a file for ``train -conf``."""
        settings = self.settings
        seeds = " ".join(map(str, settings["seeds"]))
        values = {settings["env"]: trial.user_attrs["hyperparams"]}
        return (
            f"# Trial {trial.number} of tuning {settings['algo']} on {settings['env']}:\n"
            f"# {self.outcome(trial)} ({settings['n_timesteps']:,} steps, --seeds {seeds}).\n"
            f"# Train with: {self.command(name)}\n"
            + yaml.safe_dump(values, default_flow_style=None, allow_unicode=True)
        )

    def command(self, name: str) -> str:
        """The command line that trains with one of the files."""
        flags = ["--algo", self.settings["algo"], "--env", self.settings["env"]]
        flags += ["--gym-packages", *self.packages] if self.packages else []
        return shlex.join(["sb3-guard", "train", *flags, "-conf", str(self.folder / name)])

    def line(self, trial: FrozenTrial) -> str:
        """A finished trial in one line."""
        if "error" in trial.user_attrs:
            return f"Trial {trial.number}: failed: {trial.user_attrs['error']}"
        text = f"Trial {trial.number}: {self.outcome(trial)}"
        if trial.state == TrialState.PRUNED:
            total = self.settings["n_evaluations"] * len(self.settings["seeds"])
            text += f"; pruned after {trial.last_step} of {total} evaluations"
        return text

    def summary(self, study: optuna.Study) -> str:
        """What the study came to."""
        complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        pruned = len(study.get_trials(deepcopy=False, states=(TrialState.PRUNED,)))
        top, limits = best(complete), self.settings["cost_limit"]
        lines = [f"finished trials: {len(complete) + pruned}, of them pruned: {pruned}"]
        if top is None:
            return f"{lines[0]}\n  No trial went to its end: there is no best one."
        if limits is not None:
            feasible = sum(rank(trial)[0] for trial in complete)
            lines[0] += f"; {feasible} of {len(complete)} kept the cost limit"
            if not feasible:
                lines.append(
                    f"  No trial kept the cost limit {', '.join(map(short, limits))}: the best one "
                    "is that of least violation."
                )
        lines.append(f"  best         trial {top.number}: {self.outcome(top)}")
        if self.settings["pareto"]:
            lines.append(f"  front        {self.folder / 'pareto'}/trial_N.yml")
            front = sorted(study.best_trials, key=lambda trial: -trial.values[0])
            lines += [f"               trial {t.number}: {self.outcome(t)}" for t in front]
        lines.append(f"  train with   {self.command('best.yml')}")
        return "\n".join(lines)

    def plot(self, study: optuna.Study) -> None:
        """Draw return against each cost, Optuna's picture of the front, in ``pareto.png``."""
        if best(study.get_trials(deepcopy=False)) is None:
            return
        import matplotlib

        matplotlib.use("agg")  # of a file; there may be no display
        import matplotlib.pyplot as plt
        from optuna.visualization.matplotlib import plot_pareto_front

        for key in self.keys:

            def place(trial: FrozenTrial, key: str = key) -> list[float]:
                return [trial.user_attrs["result"][name] for name in (key, "return")]

            names = [f"episode {key}", "return"]
            plot_pareto_front(study, targets=place, target_names=names)
            name = "pareto.png" if len(self.keys) == 1 else f"pareto_{key}.png"
            plt.savefig(self.folder / name, dpi=150)
            plt.close()
