"""What tuning leaves behind: the best as a file that ``train`` reads, a table, and plots."""

import io
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


def complete(trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """The trials that went to their end."""
    return [trial for trial in trials if trial.state == TrialState.COMPLETE]


def rank(trial: FrozenTrial) -> tuple[bool, float, float]:
    """How good a trial is: a feasible one by its return, others first by violation."""
    result = trial.user_attrs["result"]
    return not result["violation"], -result["violation"], result["return"]


def best(trials: Sequence[FrozenTrial]) -> FrozenTrial | None:
    """The best complete trial; None if there is none."""
    return max(complete(trials), key=rank, default=None)


def front(study: optuna.Study) -> list[FrozenTrial]:
    """The trials that no other beats in return and costs, by falling return."""
    return sorted(study.best_trials, key=lambda trial: -trial.values[0])


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
        self.limits: list[float] | None = settings["cost_limit"]

    def write(self, study: optuna.Study) -> None:
        """Write ``trials.csv`` and ``best.yml``, and the front where there is one."""
        trials = study.get_trials(deepcopy=False)
        files = {"trials.csv": self.table(trials).to_csv(index=False).encode()}
        chosen = {"best.yml": best(trials)}
        if self.settings["pareto"]:
            chosen |= {f"pareto/trial_{trial.number}.yml": trial for trial in front(study)}
        for name, trial in chosen.items():
            if trial is not None:
                files[name] = self.hyperparams(trial, name).encode()
        self.save(files)

    def save(self, files: Mapping[str, bytes]) -> None:
        """Write files, each in one step."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(self.folder / ".report.lock"):
            for name, content in files.items():
                path = self.folder / name
                path.parent.mkdir(exist_ok=True)
                with replacing(path) as file:
                    file.write(content)
            for path in (self.folder / "pareto").glob("*.yml"):
                if "trials.csv" in files and f"pareto/{path.name}" not in files:
                    path.unlink()

    def table(self, trials: Sequence[FrozenTrial]) -> pd.DataFrame:
        """A row per trial: how it ended, what it came to, what it tried."""
        columns = ["return", *self.keys, "violation"]
        return pd.DataFrame(
            {
                "trial": trial.number,
                "state": trial.state.name.lower(),
                **dict.fromkeys(columns),
                **trial.user_attrs.get("result", {}),
                "feasible": rank(trial)[0] if "result" in trial.user_attrs else None,
                "seconds": trial.duration and trial.duration.total_seconds(),
                "retry_of": trial.system_attrs.get("failed_trial"),
                "worker": trial.user_attrs.get("worker"),
                "error": trial.user_attrs.get("error"),
                **trial.params,
            }
            for trial in trials
        )

    def outcome(self, trial: FrozenTrial) -> str:
        """Return and costs in words."""
        result = trial.user_attrs["result"]
        costs = ", ".join(
            f"{key if key == 'cost' else f'cost {key}'} {short(result[key])}" for key in self.keys
        )
        text = f"return {short(result['return'])}, {costs}"
        if self.limits is None:
            return text
        over = result["violation"]
        return f"{text}, {f'{short(over)} over' if over else 'within'} the limit"

    def hyperparams(self, trial: FrozenTrial, name: str) -> str:
        """A trial's hyperparameters as a file for ``train -conf``."""
        settings = self.settings
        seeds = ", ".join(map(str, settings["seeds"]))
        steps = f"{settings['n_timesteps']:,} steps, seed{'s' if ',' in seeds else ''} {seeds}"
        head = [
            f"Trial {trial.number} of tuning {settings['algo']} on {settings['env']}:",
            f"{self.outcome(trial)} ({steps}).",
            f"Train with: {self.command(name)}",
        ]
        values = {settings["env"]: trial.user_attrs["hyperparams"]}
        body = yaml.safe_dump(values, default_flow_style=None, allow_unicode=True)
        return "".join(f"# {line}\n" for line in head) + body

    def command(self, name: str) -> str:
        """The command line that trains with one of the files."""
        settings, packages = self.settings, self.packages
        flags = ["--algo", settings["algo"], "--env", settings["env"]]
        flags += ["--gym-packages", *packages] if packages else []
        conf = str(self.folder / name)
        return shlex.join(["sb3-guard", "train", *flags, "-conf", conf])

    def line(self, trials: Sequence[FrozenTrial], trial: FrozenTrial) -> str:
        """A finished trial in one line."""
        head = f"Trial {trial.number}:"
        if "error" in trial.user_attrs:
            return f"{head} failed: {trial.user_attrs['error']}"
        seconds = trial.duration.total_seconds() if trial.duration else 0.0
        text = f"{head} {self.outcome(trial)}, {seconds:.0f} s"
        if trial.state == TrialState.PRUNED:
            total = self.settings["n_evaluations"] * len(self.settings["seeds"])
            return f"{text}; pruned after {trial.last_step} of {total} evaluations"
        top = best(trials)
        return f"{text}; best so far" if top and top.number == trial.number else text

    def summary(self, study: optuna.Study) -> str:
        """What the study came to."""
        trials = study.get_trials(deepcopy=False)
        done, top = complete(trials), best(trials)
        pruned = sum(trial.state == TrialState.PRUNED for trial in trials)
        lines = [f"finished trials: {len(done) + pruned}, of them pruned: {pruned}"]
        if self.limits is not None:
            feasible = sum(rank(trial)[0] for trial in done)
            lines[0] += f"; {feasible} of {len(done)} kept the cost limit"
        if top is None:
            return "\n".join([*lines, "  No trial went to its end: there is no best one."])
        if self.limits is not None and not rank(top)[0]:
            limits = ", ".join(map(short, self.limits))
            lines.append(
                f"  No trial kept the cost limit {limits}: the best one is that of least violation."
            )
        lines.append(f"  best         trial {top.number}: {self.outcome(top)}")
        lines += [f"               {name}: {short(value)}" for name, value in top.params.items()]
        if self.settings["pareto"]:
            lines.append("  front")
            lines += [f"               trial {t.number}: {self.outcome(t)}" for t in front(study)]
            lines.append(f"               {self.folder / 'pareto'}/trial_N.yml")
        lines.append(f"  train with   {self.command('best.yml')}")
        lines.append(f"               for {self.settings['n_timesteps']:,} steps, or those of -n")
        return "\n".join(lines)

    def plot(self, study: optuna.Study) -> None:
        """Draw ``pareto.png``: return against each cost, the trials over the limit hollow."""
        done = complete(study.get_trials(deepcopy=False))
        if not done:
            return
        from matplotlib.figure import Figure

        figure = Figure(figsize=(6.4 * len(self.keys), 4.8), layout="constrained")
        figure.suptitle(f"{self.settings['algo']} on {self.settings['env']}")
        table = self.table(done)
        panels = figure.subplots(1, len(self.keys), sharey=True, squeeze=False)[0]
        for i, (axis, key) in enumerate(zip(panels, self.keys, strict=True)):
            for feasible, rows in table.groupby("feasible", sort=False):
                face, label = ("C0", "trial within the limit") if feasible else ("none", "over it")
                axis.scatter(rows[key], rows["return"], ec="C0", facecolors=face, label=label)
            if self.limits is not None:
                axis.axvline(self.limits[i], color="C1", linestyle="--", label="cost limit")
            axis.set(xlabel=f"episode {key}", ylabel="return")
            axis.legend()
        with io.BytesIO() as buffer:
            figure.savefig(buffer, format="png", dpi=150)
            self.save({"pareto.png": buffer.getvalue()})
