"""What tuning leaves behind: the best as a file that ``train`` reads, a table, and plots."""

import io
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from optuna.trial import FrozenTrial, TrialState

from sb3_guard.common.files import replacing
from sb3_guard.zoo.storages import OWNER, locked
from sb3_guard.zoo.usage import UsageError, one_line

BLUE, ORANGE, GREY, BLACK = "#0072B2", "#D55E00", "#999999", "#222222"


def number(value: float) -> str:
    """A number as short as it may be."""
    return f"{value:.4g}"


@dataclass(frozen=True)
class Verdict:
    """
    How good trials are: feasible ones by return, then infeasible ones by violation.

    :param violation: by how much costs exceed the limits
    """

    violation: Callable[[Sequence[float]], float]

    def of(self, trial: FrozenTrial) -> tuple[bool, float, float]:
        """Whether a completed trial is feasible, then what decides: the greater is the better."""
        value, *costs = trial.user_attrs["result"]
        violation = self.violation(costs)
        return violation == 0.0, -violation, value

    def best(self, trials: Sequence[FrozenTrial]) -> FrozenTrial | None:
        """The best completed trial; None if there is none."""
        return max(complete(trials), key=self.of, default=None)

    def scores(self, trials: Sequence[FrozenTrial]) -> dict[int, float]:
        """One number a trial: its return, or the worst return minus its violation."""
        done = complete(trials)
        worst = min((one.user_attrs["result"][0] for one in done), default=0.0)
        return {
            one.number: value if feasible else worst + minus
            for one in done
            for feasible, minus, value in [self.of(one)]
        }


def complete(trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """The trials that went to their end."""
    return [one for one in trials if one.state == TrialState.COMPLETE]


def front(trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """The completed trials that no other beats in return and costs, by falling return."""
    done = complete(trials)
    if not done:
        return []
    points = np.array([one.user_attrs["result"] for one in done])  # [K, 1 + m]
    points[:, 0] *= -1.0
    no_worse = (points[:, None] <= points[None]).all(axis=2)  # [K, K]: i nowhere worse than j
    better = (points[:, None] < points[None]).any(axis=2)
    beaten = np.any(no_worse & better, axis=0)
    kept = [one for i, one in enumerate(done) if not beaten[i]]
    return sorted(kept, key=lambda one: -one.user_attrs["result"][0])


class Report:
    """
    The files of a study.

    :param folder: where they go; several processes may write them
    :param settings: of the study, as data
    :param verdict: how trials compare
    :param packages: modules that register the environment
    """

    def __init__(
        self,
        folder: Path,
        settings: Mapping[str, Any],
        verdict: Verdict,
        packages: Sequence[str] = (),
    ):
        self.packages = packages
        self.folder = folder
        self.settings = settings
        self.verdict = verdict
        self.keys: list[str] = settings["cost_keys"]
        self.limits: list[float] | None = settings["cost_limit"]

    def write(self, trials: Sequence[FrozenTrial]) -> None:
        """
        Write ``trials.csv`` and ``best.yml``, and the front where there is one.

        :raises UsageError: the folder can't be written
        """
        files = {"trials.csv": self.table(trials).to_csv(index=False)}
        best = self.verdict.best(trials)
        if best is not None:
            files["best.yml"] = self.hyperparams(best, "best.yml")
        if self.settings["pareto"]:
            for one in front(trials):
                name = f"pareto/trial_{one.number}.yml"
                files[name] = self.hyperparams(one, name)
        self._save({name: text.encode() for name, text in files.items()})

    def _save(self, files: Mapping[str, bytes]) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with locked(self.folder / ".report.lock"):
                for name, content in files.items():
                    path = self.folder / name
                    path.parent.mkdir(exist_ok=True)
                    with replacing(path) as file:
                        file.write(content)
                for path in (self.folder / "pareto").glob("*.yml"):
                    if "trials.csv" in files and f"pareto/{path.name}" not in files:
                        path.unlink()
        except OSError as error:
            raise UsageError(
                f"can't write to {self.folder}: {error.strerror}; the study is intact"
            ) from error

    def table(self, trials: Sequence[FrozenTrial]) -> pd.DataFrame:
        """A row per trial: how it ended, what it came to, what it tried."""
        rows = []
        for one in trials:
            value, *costs = one.user_attrs.get("result") or [None] * (1 + len(self.keys))
            violation = None if value is None else self.verdict.violation(costs)
            seconds = None if one.duration is None else one.duration.total_seconds()
            rows.append(
                {
                    "trial": one.number,
                    "state": one.state.name.lower(),
                    "return": value,
                    **dict(zip(self.keys, costs, strict=True)),
                    "violation": violation,
                    "feasible": None if violation is None else violation == 0.0,
                    "seconds": seconds,
                    "retry_of": one.system_attrs.get("failed_trial"),
                    "worker": one.user_attrs.get(OWNER, {}).get("name"),
                    "error": one.user_attrs.get("error"),
                    **one.params,
                }
            )
        return pd.DataFrame(rows)

    def outcome(self, trial: FrozenTrial) -> str:
        """Return and costs in words."""
        value, *costs = trial.user_attrs["result"]
        violation = self.verdict.violation(costs)
        cost = ", ".join(
            f"{key if key == 'cost' else f'cost {key}'} {number(cost)}"
            for key, cost in zip(self.keys, costs, strict=True)
        )
        text = f"return {number(value)}, {cost}"
        if self.limits is None:
            return text
        return f"{text}, {f'{number(violation)} over' if violation else 'within'} the limit"

    def hyperparams(self, trial: FrozenTrial, name: str) -> str:
        """A trial's hyper-parameters as a file for ``train -conf``."""
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
        what = ["--algo", settings["algo"], "--env", settings["env"]]
        what += ["--gym-packages", *packages] if packages else []
        conf = str(self.folder / name)
        return shlex.join(["python", "-m", "sb3_guard.train", *what, "-conf", conf])

    def line(self, trials: Sequence[FrozenTrial], trial: FrozenTrial, seconds: float) -> str:
        """A finished trial in one line."""
        head = f"Trial {trial.number}:"
        if "error" in trial.user_attrs:
            return f"{head} failed: {trial.user_attrs['error']}"
        text = f"{head} {self.outcome(trial)}, {seconds:.0f} s"
        if trial.state == TrialState.PRUNED:
            done = len(trial.user_attrs["violations"])
            total = self.settings["n_evaluations"] * len(self.settings["seeds"])
            return f"{text}; pruned after {done} of {total} evaluations"
        best = self.verdict.best(trials)
        return f"{text}; best so far" if best and best.number == trial.number else text

    def summary(self, trials: Sequence[FrozenTrial], interrupted: bool = False) -> str:
        """What the study came to."""
        done = complete(trials)
        pruned = sum(one.state == TrialState.PRUNED for one in trials)
        feasible = sum(self.verdict.of(one)[0] for one in done)
        lines = [f"{len(done) + pruned} trials are finished, {pruned} of them pruned"]
        if self.limits is not None:
            lines[0] += f"; {feasible} of {len(done)} kept the cost limit"
        if interrupted:
            lines.append("  The same command continues the study.")
        best = self.verdict.best(trials)
        if best is None:
            return "\n".join([*lines, "  No trial went to its end: there is no best one."])
        if self.limits is not None and not self.verdict.of(best)[0]:
            limits = ", ".join(number(one) for one in self.limits)
            lines.append(
                f"  No trial kept the cost limit {limits}: the best one is that of least violation."
            )
        lines.append(f"  best         trial {best.number}: {self.outcome(best)}")
        lines += [f"               {name}: {_short(value)}" for name, value in best.params.items()]
        if self.settings["pareto"]:
            lines.append("  front")
            lines += [f"               trial {t.number}: {self.outcome(t)}" for t in front(trials)]
            lines.append(f"               {self.folder / 'pareto'}/trial_N.yml")
        lines.append(f"  train with   {self.command('best.yml')}")
        return "\n".join(lines)

    # Plots

    def plot(self, study: optuna.Study, trials: Sequence[FrozenTrial]) -> None:
        """
        Draw ``history.png``, ``importances.png`` and ``pareto.png``.

        :raises UsageError: the folder can't be written
        """
        if not complete(trials):
            return
        figures = {
            "history.png": self._history(trials),
            "importances.png": self._importances(study, trials),
            "pareto.png": self._pareto(trials),
        }
        files = {}
        for name, figure in figures.items():
            buffer = io.BytesIO()
            FigureCanvasAgg(figure).print_png(buffer)
            files[name] = buffer.getvalue()
        self._save(files)

    def _title(self) -> str:
        return f"{self.settings['algo']} on {self.settings['env']}"

    def _split(self, trials: Sequence[FrozenTrial]) -> tuple[list[FrozenTrial], ...]:
        done = complete(trials)
        feasible = [one for one in done if self.verdict.of(one)[0]]
        infeasible = [one for one in done if not self.verdict.of(one)[0]]
        pruned = [t for t in trials if t.state == TrialState.PRUNED and "result" in t.user_attrs]
        return feasible, infeasible, pruned

    def _legend(self, figure: Figure, trials: Sequence[FrozenTrial], line: str) -> None:
        """Below the axes; only of what is there."""
        handles = [_mark(BLUE, "o", "trial" if self.limits is None else "within the limit")]
        if self.limits is not None:
            handles.append(_mark(ORANGE, "o", "over it", "none"))
        if self._split(trials)[2]:
            handles.append(_mark(GREY, "x", "pruned"))
        handles.append(Line2D([], [], color=BLACK, linewidth=1.2, label=line))
        if self.limits is not None:
            handles.append(Line2D([], [], color=ORANGE, linestyle="--", label="cost limit"))
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))

    def _history(self, trials: Sequence[FrozenTrial]) -> Figure:
        names = ["return", *(_cost_name(key) for key in self.keys)]
        figure = Figure(figsize=(7.0, 2.4 * len(names) + 0.8), layout="constrained", dpi=150)
        axes = figure.subplots(len(names), sharex=True, squeeze=False)[:, 0]
        for row, (axis, name) in enumerate(zip(axes, names, strict=True)):
            for group, style in zip(self._split(trials), _STYLES, strict=True):
                axis.scatter(
                    [one.number for one in group],
                    [one.user_attrs["result"][row] for one in group],
                    **style,
                )
            axis.set_ylabel(name)
            _grid(axis)
        best: FrozenTrial | None = None
        steps: list[tuple[int, list[float]]] = []
        for one in complete(trials):
            if best is None or self.verdict.of(one) > self.verdict.of(best):
                best = one
            steps.append((one.number, best.user_attrs["result"]))
        for row, axis in enumerate(axes):
            axis.step(
                [n for n, _ in steps],
                [result[row] for _, result in steps],
                where="post",
                color=BLACK,
                linewidth=1.2,
                zorder=1,
            )
            if row and self.limits is not None:
                axis.axhline(self.limits[row - 1], color=ORANGE, linestyle="--", linewidth=1.0)
        axes[-1].set_xlabel("trial")
        axes[-1].xaxis.get_major_locator().set_params(integer=True)
        figure.suptitle(self._title())
        self._legend(figure, trials, "best so far")
        return figure

    def _importances(self, study: optuna.Study, trials: Sequence[FrozenTrial]) -> Figure:
        figure = Figure(figsize=(7.0, 3.6), layout="constrained", dpi=150)
        axis = figure.subplots()
        scores = self.verdict.scores(trials)
        try:
            found = optuna.importance.get_param_importances(
                study,
                evaluator=optuna.importance.PedAnovaImportanceEvaluator(),
                # It explains low values.
                target=lambda one: -scores.get(one.number, min(scores.values())),
            )
        except (ValueError, RuntimeError) as error:
            axis.text(0.5, 0.5, _wrap(one_line(error)), ha="center", va="center")
            axis.set_axis_off()
            found = {}
        names = list(found)[::-1]
        axis.barh(names, [found[name] for name in names], color=BLUE)
        if names:
            axis.set_xlabel("share in being among the best trials (PED-ANOVA)")
            axis.spines[["top", "right"]].set_visible(False)
        figure.suptitle(f"{self._title()}: {len(scores)} complete trials")
        return figure

    def _pareto(self, trials: Sequence[FrozenTrial]) -> Figure:
        columns = len(self.keys)
        figure = Figure(figsize=(max(6.2 * columns, 7.5), 4.6), layout="constrained", dpi=150)
        axes = figure.subplots(1, columns, sharey=True, squeeze=False)[0]
        for column, (axis, key) in enumerate(zip(axes, self.keys, strict=True), start=1):
            for group, style in zip(self._split(trials), _STYLES, strict=True):
                axis.scatter(
                    [one.user_attrs["result"][column] for one in group],
                    [one.user_attrs["result"][0] for one in group],
                    **style,
                )
            points = [
                (one.user_attrs["result"][column], one.user_attrs["result"][0])
                for one in complete(trials)
            ]
            edge = _edge(points)
            axis.step(*zip(*edge, strict=True), where="post", color=BLACK, linewidth=1.2, zorder=1)
            if self.limits is not None:
                axis.axvline(self.limits[column - 1], color=ORANGE, linestyle="--", linewidth=1.0)
            axis.set_xlabel(_cost_name(key))
            _grid(axis)
        axes[0].set_ylabel("return")
        figure.suptitle(self._title())
        self._legend(figure, trials, "Pareto front")
        return figure


_STYLES: tuple[dict[str, Any], ...] = (
    {"color": BLUE, "marker": "o", "s": 32, "zorder": 3},
    {"edgecolors": ORANGE, "facecolors": "none", "marker": "o", "s": 32, "zorder": 3},
    {"color": GREY, "marker": "x", "s": 24, "zorder": 2},
)


def _mark(color: str, marker: str, label: str, face: str | None = None) -> Line2D:
    return Line2D(
        [],
        [],
        linestyle="none",
        marker=marker,
        color=color,
        markerfacecolor=face or color,
        label=label,
    )


def _grid(axis: Any) -> None:
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)


def _cost_name(key: str) -> str:
    return "episode cost" if key == "cost" else f"episode cost ({key})"


def _edge(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The (cost, return) pairs that no other beats in both, by rising cost."""
    edge: list[tuple[float, float]] = []
    for cost, value in sorted(points, key=lambda one: (one[0], -one[1])):
        if not edge or value > edge[-1][1]:
            edge.append((cost, value))
    return edge


def _short(value: Any) -> str:
    return number(value) if isinstance(value, float) else str(value)


def _wrap(text: str, width: int = 60) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, width))
