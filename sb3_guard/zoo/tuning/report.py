"""What tuning leaves behind: the best as a file that ``train`` reads, and a table."""

import shlex
from collections.abc import Sequence
from pathlib import Path

import optuna
import pandas as pd
import yaml
from filelock import FileLock
from optuna.trial import FrozenTrial, TrialState

from sb3_guard.common.files import replacing
from sb3_guard.zoo.tuning.trials import Settings

FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


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
    :param settings: of the study
    :param packages: modules that register the environment
    """

    def __init__(self, folder: Path, settings: Settings, packages: Sequence[str] = ()):
        self.folder, self.settings, self.packages = folder, settings, packages

    def write(self, study: optuna.Study) -> None:
        """Write ``trials.csv`` and ``best.yml``."""
        trial = best(study.get_trials(deepcopy=False))
        with FileLock(self.folder / ".report.lock"):  # replacing is for one writer at a time
            with replacing(self.folder / "trials.csv") as file:
                file.write(self.table(study).encode())
            if trial is not None:
                with replacing(self.folder / "best.yml") as file:
                    file.write(self.hyperparams(trial).encode())

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
        result, keys = trial.user_attrs["result"], self.settings.cost_keys
        costs = [f"{'cost ' * (key != 'cost')}{key} {result[key]:.4g}" for key in keys]
        over, limited = result["violation"], self.settings.cost_limit is not None
        verdict = [f"{over:.4g} over the limit" if over else "within the limit"] * limited
        return ", ".join([f"return {result['return']:.4g}", *costs, *verdict])

    def hyperparams(self, trial: FrozenTrial) -> str:
        """A trial's hyperparameters as a file for ``train -conf``."""
        settings = self.settings
        seeds = " ".join(map(str, settings.seeds))
        values = {settings.env: trial.user_attrs["hyperparams"]}
        return (
            f"# Trial {trial.number} of tuning {settings.algo} on {settings.env}:\n"
            f"# {self.outcome(trial)} ({settings.n_timesteps:,} steps, --seeds {seeds}).\n"
            f"# Train with: {self.command()}\n"
            + yaml.safe_dump(values, default_flow_style=None, allow_unicode=True)
        )

    def command(self) -> str:
        """The command line that trains with the best."""
        flags = ["--algo", self.settings.algo, "--env", self.settings.env]
        flags += ["--gym-packages", *self.packages] if self.packages else []
        return shlex.join(["sb3-guard", "train", *flags, "-conf", str(self.folder / "best.yml")])

    def line(self, trial: FrozenTrial) -> str:
        """A finished trial in one line."""
        if "error" in trial.user_attrs:
            return f"Trial {trial.number}: failed: {trial.user_attrs['error']}"
        text = f"Trial {trial.number}: {self.outcome(trial)}"
        if trial.state == TrialState.PRUNED:
            total = self.settings.n_evaluations * len(self.settings.seeds)
            text += f"; pruned after {trial.last_step} of {total} evaluations"
        return text

    def summary(self, study: optuna.Study) -> str:
        """What the study came to."""
        finished = study.get_trials(deepcopy=False, states=FINISHED)
        complete = [trial for trial in finished if trial.state == TrialState.COMPLETE]
        pruned = len(finished) - len(complete)
        counts = f"finished trials: {len(finished)}, of them pruned: {pruned}"
        top = best(complete)
        if top is None:
            return f"{counts}\n  No trial went to its end: there is no best one."
        if self.settings.cost_limit is not None:
            feasible = sum(rank(trial)[0] for trial in complete)
            counts += f"; {feasible} of {len(complete)} kept the cost limit"
        return (
            f"{counts}\n  best         trial {top.number}: {self.outcome(top)}\n"
            f"  train with   {self.command()}"
        )
