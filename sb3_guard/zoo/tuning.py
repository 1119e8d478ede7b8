"""Tuning: the hyper-parameters of the highest return whose agents keep the cost limit.

A trial trains an agent for each seed with the same hyper-parameters, evaluates them a few times on
the way and once at the end, and reports the means. Each cost is a constraint of the study,
``J_C - limit <= 0``, so samplers know which trials were feasible; between two trials the feasible
one is better, then the higher return, then the smaller violation.
"""

import math
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.exceptions import ExperimentalWarning, UpdateFinishedTrialError
from optuna.pruners import BasePruner, NopPruner
from optuna.trial import FrozenTrial, TrialState
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import sync_envs_normalization

from sb3_guard.common.callbacks import CostEvalCallback
from sb3_guard.common.evaluation import evaluate_policy
from sb3_guard.envs.layout import LayoutError
from sb3_guard.spelling import did_you_mean
from sb3_guard.train import DEFAULTS as TRAIN_DEFAULTS
from sb3_guard.zoo.algos import algorithm
from sb3_guard.zoo.config import check, read_hyperparams
from sb3_guard.zoo.environments import PROCESS_DIED, canonical_id
from sb3_guard.zoo.experiment import EVALUATION_SEED_OFFSET, Experiment
from sb3_guard.zoo.run_folder import folder_name, require_writable
from sb3_guard.zoo.samplers import SAMPLERS, Choice, Search, read_space, set_dotted
from sb3_guard.zoo.storages import Storage, StorageLost, open_storage, queue_again
from sb3_guard.zoo.tuning_report import Report, Verdict, number
from sb3_guard.zoo.usage import UsageError, import_packages, interrupts, one_line

PRUNERS = ("median", "halving", "none")
FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
# What the hyper-parameters of a trial may lead to; anything else is a mistake in the code.
FAILURES = (UsageError, ValueError, FloatingPointError, RuntimeError, AssertionError, LayoutError)
MOST_FAILURES = 3  # in a row, until it is not the hyper-parameters' fault
FAILED_VIOLATION = 1e9  # puts a trial that failed behind all others, for the sampler
POLL = 1.0  # seconds between two looks at what other workers do
SETTINGS = "settings"


@dataclass(frozen=True)
class Settings:
    """
    What a trial is: the same for all workers of a study, and whenever it is continued.

    :param algo: key of the algorithm
    :param env: full id of the environment
    :param hyperparams: where the space says nothing
    :param space: what is searched, as data
    :param n_timesteps: length of one training
    :param seeds: of the trainings of a trial
    :param n_evaluations: evaluations per training
    :param eval_episodes: episodes per evaluation
    :param cost_keys: entries of info that are costs
    :param cost_limit: highest feasible episode cost, one per cost key; None: no constraint
    :param pareto: search the trade-off of return and cost instead
    """

    algo: str
    env: str
    hyperparams: dict[str, Any]
    space: Any
    n_timesteps: int
    seeds: list[int]
    n_evaluations: int
    eval_episodes: int
    cost_keys: list[str]
    cost_limit: list[float] | None
    pareto: bool

    @property
    def steps(self) -> int:
        """Evaluations of a trial, over all its seeds."""
        return self.n_evaluations * len(self.seeds)

    def violation(self, costs: Sequence[float]) -> float:
        """By how much costs exceed the limits, summed over the cost keys."""
        if self.cost_limit is None:
            return 0.0
        return float(np.maximum(np.subtract(costs, self.cost_limit), 0.0).sum())

    def refuse_others(self, saved: Mapping[str, Any], study: str) -> None:
        """
        Compare with those that a study was begun with.

        :raises UsageError: they are not the same
        """
        for name, value in asdict(self).items():
            old = saved.get(name)
            if old == value:
                continue
            what = name.replace("_", " ")
            if isinstance(value, dict) and isinstance(old, dict):
                what, old, value = next(
                    (f"{what} {key}", old.get(key), value.get(key))
                    for key in sorted({*old, *value})
                    if old.get(key) != value.get(key)
                )
            raise UsageError(
                f"study {study!r} was begun with {what} {old}, not {value}: "
                "continue it as it was begun, or begin another with --study-name"
            )


class FeasibleFirst(BasePruner):
    """
    Prune a trial that compares badly at the same step, where feasible is better than infeasible.

    A trial of given hyper-parameters, such as the first one, the file's, is never pruned: the best
    is to be compared with it.

    A feasible value is compared by its return, an infeasible one by the worst return of all minus
    its violation. Optuna's own pruners compare one number that is stored; the worst return may
    change with every trial.

    :param rule: ``"median"`` prunes what is worse than the median of the completed trials;
        ``"halving"`` looks at steps 1, 4, 16, … only and prunes what is not in the best quarter of
        all trials that came as far
    :param n_startup_trials: completed trials without which nothing is pruned (median)
    :param n_warmup_steps: steps at which nothing is pruned (median)
    """

    def __init__(self, rule: str, n_startup_trials: int = 0, n_warmup_steps: int = 0):
        self.rule = rule
        self.n_startup_trials = n_startup_trials
        self.n_warmup_steps = n_warmup_steps

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        """Whether to end the trial now."""
        step = trial.last_step
        # RL-Zoo's spaces know no place of the file's, and the first trial is like any other.
        if step is None or trial.system_attrs.get("fixed_params"):
            return False
        trials = [one for one in study.get_trials(deepcopy=False) if one.number != trial.number]
        returns = [v for one in (*trials, trial) for v in one.intermediate_values.values()]
        worst = min(returns)
        mine = _scores(trial, worst)
        if self.rule == "halving":
            if math.log(step + 1, 4) % 1 > 1e-9:
                return False
            others = [_scores(one, worst)[step] for one in trials if step in _steps(one)]
            kept = max((len(others) + 1) // 4, 1)
            return sum(other > mine[step] for other in others) >= kept
        complete = [one for one in trials if one.state == TrialState.COMPLETE]
        if len(complete) < max(self.n_startup_trials, 1) or step < self.n_warmup_steps:
            return False
        others = [_scores(one, worst)[step] for one in complete if step in _steps(one)]
        return bool(others) and mine[step] < float(np.median(others))


def _steps(trial: FrozenTrial) -> Mapping[int, float]:
    return trial.intermediate_values


def _scores(trial: FrozenTrial, worst: float) -> dict[int, float]:
    """What is compared at each step."""
    violations = trial.user_attrs.get("violations", [])
    scores = {}
    for step, value in trial.intermediate_values.items():
        violation = violations[step] if step < len(violations) else 0.0
        scores[step] = value if violation == 0.0 else worst - violation
    return scores


class Stopped(Exception):
    """A signal asked to stop: the trial under way goes back to the queue."""


class Evaluations(BaseCallback):
    """
    Evaluate an agent evenly through its training.

    :param experiment: what is trained
    :param settings: of the study
    :param after: called with all evaluations so far, each a list of the mean return and the mean
        episode costs; False ends the training
    :param stopped: whether to end the training at once
    """

    def __init__(
        self,
        experiment: Experiment,
        settings: Settings,
        after: Callable[[list[list[float]]], bool],
        stopped: Callable[[], bool],
    ):
        super().__init__()
        self.experiment = experiment
        self.settings = settings
        self.after = after
        self.stopped = stopped
        self.history: list[list[float]] = []
        self.ended = False

    def _on_step(self) -> bool:
        if self.stopped():
            raise Stopped
        number = len(self.history) + 1
        due = number * self.settings.n_timesteps / self.settings.n_evaluations
        # The last one is for the agent that has learned all it could: see finish.
        if number < self.settings.n_evaluations and self.num_timesteps >= due:
            self.ended = not self._evaluate()
        return not self.ended

    def finish(self) -> None:
        """Evaluate what training came to, unless it was ended."""
        if not self.ended:
            while len(self.history) < self.settings.n_evaluations and not self.ended:
                self.ended = not self._evaluate()

    def _evaluate(self) -> bool:
        env = self.experiment.eval_env
        assert env is not None
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, env)
        result = evaluate_policy(
            self.model,
            env,
            n_eval_episodes=self.settings.eval_episodes,
            seed=self.experiment.args["seed"] + EVALUATION_SEED_OFFSET,
            cost_keys=self.settings.cost_keys,
        )
        row = [float(result.returns.mean()), *result.key_costs.mean(axis=0).tolist()]
        if not np.isfinite(row).all():
            raise FloatingPointError(f"an evaluation gave {row}")
        self.history.append(row)
        return self.after(self.history)


class Worker:
    """
    Takes trials of a study and works on them, beside any number of others.

    :param args: flags of the command
    :param settings: of the study
    :param search: where hyper-parameters come from
    :param study: the study
    :param storage: where it lives
    :param report: what is written about it
    """

    def __init__(
        self,
        args: Mapping[str, Any],
        settings: Settings,
        search: Search,
        study: optuna.Study,
        storage: Storage,
        report: Report,
    ):
        self.args = args
        self.settings = settings
        self.search = search
        self.study = study
        self.storage = storage
        self.report = report
        self.stop = False
        self._failures = 0
        self._parent = args["worker_of"]

    def stopped(self) -> bool:
        """Whether to stop: a signal came, or the process that started this one is gone."""
        return self.stop or (self._parent is not None and os.getppid() != self._parent)

    def work(self) -> None:
        """
        Work until the study has all its trials, or until stopped.

        :raises UsageError: trial after trial fails, or the storage is lost
        """
        said = False
        while not self.stopped():
            trial, others = self.storage.call(self._take)
            if trial is not None:
                said = False
                self._work_on(trial)
                continue
            if not others:
                return
            # If one of them is lost, its trial is for us.
            if not said and self.args["verbose"]:
                print(f"Waiting for {others} trial(s) of other workers", flush=True)
            said = True
            time.sleep(POLL)

    def _take(self) -> tuple[optuna.Trial | None, int]:
        """The next trial, if there is one left, and how many others are under way."""
        with self.storage.claim(self.study):
            trials = self.study.get_trials(deepcopy=False)
            finished = sum(one.state in FINISHED for one in trials)
            running = sum(one.state == TrialState.RUNNING for one in trials)
            if finished + running >= self.args["n_trials"]:
                return None, running if finished < self.args["n_trials"] else 0
            trial = self.study.ask()
            self.storage.own(trial)
            return trial, running

    def _work_on(self, trial: optuna.Trial) -> None:
        call, tell = self.storage.call, self.study.tell
        began = time.monotonic()
        try:
            with self.storage.working_on(trial):
                try:
                    mean = self._objective(trial)
                except (StorageLost, UpdateFinishedTrialError):
                    raise
                except optuna.TrialPruned:
                    call(tell, trial, state=TrialState.PRUNED, skip_if_finished=True)
                except FAILURES as error:
                    self._fail(trial, error)
                else:
                    values = mean if self.settings.pareto else mean[0]
                    call(tell, trial, values, skip_if_finished=True)
                    self._failures = 0
        except UpdateFinishedTrialError:
            print(f"Trial {trial.number} was taken for lost and given to another worker")
            return
        except Stopped:
            call(queue_again, self.study, self._frozen(trial))
            call(tell, trial, state=TrialState.FAIL, skip_if_finished=True)
            return
        except StorageLost:
            raise
        except BaseException:
            call(tell, trial, state=TrialState.FAIL, skip_if_finished=True)
            raise
        trials = call(self.study.get_trials, deepcopy=False)
        self.report.write(trials)
        if self.args["verbose"]:
            print(
                self.report.line(trials, trials[trial.number], time.monotonic() - began),
                flush=True,
            )
        if self._failures >= MOST_FAILURES:
            raise UsageError(
                f"{self._failures} trials in a row failed, the last one: "
                f"{trials[trial.number].user_attrs['error']}"
            )

    def _frozen(self, trial: optuna.Trial) -> FrozenTrial:
        return self.study.get_trials(deepcopy=False)[trial.number]

    def _fail(self, trial: optuna.Trial, error: BaseException) -> None:
        """Count a trial that could not be trained as the worst of all."""
        if self.args["verbose"] > 1:
            raise error
        self._failures += 1
        self.storage.call(trial.set_user_attr, "error", one_line(error)[:600])
        for key in self.settings.cost_keys if self._constrained else ():
            self.storage.call(trial.set_constraint, key, FAILED_VIOLATION)
        self.storage.call(self.study.tell, trial, state=TrialState.PRUNED, skip_if_finished=True)

    @property
    def _constrained(self) -> bool:
        return self.settings.cost_limit is not None and not self.settings.pareto

    def _objective(self, trial: optuna.Trial) -> list[float]:
        """
        Train an agent for each seed.

        :return: means over the seeds: return, and each episode cost
        :raises optuna.TrialPruned: it is not worth to go on
        """
        call = self.storage.call
        values = call(self.search.draw, trial)
        call(trial.set_user_attr, "hyperparams", values)
        finished: list[list[list[float]]] = []
        violations: list[float] = []

        def after(history: list[list[float]]) -> bool:
            """Report the mean of the seeds so far; whether to go on."""
            mean = np.mean([one[-1] for one in [*finished, history]], axis=0).tolist()
            violation = self.settings.violation(mean[1:])
            violations.append(violation)
            call(trial.set_user_attr, "violations", violations)
            call(trial.set_user_attr, "result", mean)
            last = len(violations) == self.settings.steps
            if self.settings.pareto:
                return True
            call(trial.report, mean[0], len(violations) - 1)
            return last or not call(trial.should_prune)

        for seed in self.settings.seeds:
            # A trial that is tried again has kept the seeds that were done.
            key = f"seed {seed}"
            history = trial.user_attrs.get(key)
            if history is None:
                history, on = self._train(values, seed, after)
                if on:
                    call(trial.set_user_attr, key, history)
            else:
                on = all(after(history[: i + 1]) for i in range(len(history)))
            if not on:
                self._constrain(trial)
                raise optuna.TrialPruned
            finished.append(history)
        self._constrain(trial)
        return trial.user_attrs["result"]

    def _constrain(self, trial: optuna.Trial) -> None:
        if not self._constrained:
            return
        costs = trial.user_attrs["result"][1:]
        limits = self.settings.cost_limit or []
        for key, cost, limit in zip(self.settings.cost_keys, costs, limits, strict=True):
            self.storage.call(trial.set_constraint, key, cost - limit)

    def _train(
        self, values: Mapping[str, Any], seed: int, after: Callable[[list[list[float]]], bool]
    ) -> tuple[list[list[float]], bool]:
        """One training: its evaluations, and whether it went to the end."""
        settings = self.settings
        values = {**values, "n_timesteps": settings.n_timesteps}
        values = check(settings.algo, algorithm(settings.algo), values)
        experiment = Experiment({**training_flags(self.args, settings), "seed": seed}, values)
        try:
            evaluations = Evaluations(experiment, settings, after, self.stopped)
            experiment.model.set_logger(Logger(folder=None, output_formats=[]))
            experiment.model.learn(
                settings.n_timesteps, callback=[evaluations, *experiment.setup.callbacks]
            )
            evaluations.finish()
        except PROCESS_DIED as error:
            if self.stopped():  # the signal was for all processes
                raise Stopped from error
            raise UsageError("a process of --vec-env subproc has died") from error
        finally:
            experiment.close()
        return evaluations.history, not evaluations.ended


def training_flags(args: Mapping[str, Any], settings: Settings) -> dict[str, Any]:
    """The flags of a trial's training."""
    mine = {name: args[name] for name in ("device", "vec_env", "num_threads", "gym_packages")}
    return {
        **TRAIN_DEFAULTS,
        **mine,
        "algo": settings.algo,
        "env": settings.env,
        "eval_episodes": settings.eval_episodes,
        "seed": settings.seeds[0],
        "verbose": 0,
        "progress": False,
    }


def prepare(args: Mapping[str, Any]) -> tuple[Settings, Search]:
    """
    Check everything before anything is written.

    :param args: all flags, with their defaults
    :raises UsageError: something is wrong with them
    """
    cls = algorithm(args["algo"])
    import_packages(args["gym_packages"])
    env_id, _ = canonical_id(args["env"])
    allowed: dict[str, Sequence[str]] = {"sampler": list(SAMPLERS), "pruner": PRUNERS}
    for name, choices in allowed.items():
        if args[name] not in choices:
            raise UsageError(f"unknown {name} {args[name]!r}; {did_you_mean(args[name], choices)}")
    fixed = dict(args["hyperparams"] or {})
    values = read_hyperparams(args["algo"], env_id, args["conf_file"], fixed)
    if args["n_timesteps"] > 0:
        values.setdefault("n_timesteps", args["n_timesteps"])
    if args["cost_limit"] is not None:
        # Beside the trials: training with the result keeps the best model by the same limit.
        limit = args["cost_limit"]
        values["selection_limit"] = limit[0] if len(limit) == 1 else limit
    base = check(args["algo"], cls, values)
    if args["env_kwargs"]:
        base["env_kwargs"] = {**(base.get("env_kwargs") or {}), **args["env_kwargs"]}
    n_timesteps = args["n_timesteps"] if args["n_timesteps"] > 0 else base["n_timesteps"]
    n_evaluations = args["n_evaluations"] or max(n_timesteps // 100_000, 4)
    if n_evaluations > n_timesteps:
        raise UsageError(
            f"--n-evaluations {n_evaluations} is not allowed; there are {n_timesteps} steps"
        )
    space = read_space(args["search_space"]) if args["search_space"] else None
    search = Search(args["algo"], base, space, fixed)
    for name, one in search.space.items():
        for value in one.options if isinstance(one, Choice) else (one.low, one.high):
            check(args["algo"], cls, set_dotted(base, name, value))
    settings = Settings(
        algo=args["algo"],
        env=env_id,
        hyperparams=base,
        space=search.description(),
        n_timesteps=n_timesteps,
        seeds=list(args["seeds"]),
        n_evaluations=n_evaluations,
        eval_episodes=args["eval_episodes"],
        cost_keys=[],
        cost_limit=None,
        pareto=args["pareto"],
    )
    experiment = Experiment(training_flags(args, settings), {**base, "n_timesteps": n_timesteps})
    try:
        assert experiment.eval_env is not None
        rule = CostEvalCallback(experiment.eval_env, selection_limit=base.get("selection_limit"))
        rule.model = experiment.model
        limits = rule.limits().tolist()
    finally:
        experiment.close()
    return replace(
        settings,
        cost_keys=list(experiment.cost_keys),
        cost_limit=limits if np.isfinite(limits).all() else None,
    ), search


def _pruner(args: Mapping[str, Any], settings: Settings) -> BasePruner:
    if args["pruner"] == "none" or settings.pareto:
        return NopPruner()
    return FeasibleFirst(args["pruner"], args["n_startup_trials"], settings.n_evaluations // 3)


def _open_study(
    args: Mapping[str, Any], settings: Settings, search: Search, name: str, storage: Storage
) -> optuna.Study:
    """
    Begin the study, or join it.

    :raises UsageError: it was begun with other settings
    """
    directions = ["maximize"]
    if settings.pareto:
        directions += ["minimize"] * len(settings.cost_keys)
    study = storage.call(
        optuna.create_study,
        storage=storage.storage,
        study_name=name,
        directions=directions,
        pruner=_pruner(args, settings),
        load_if_exists=True,
    )

    def begin() -> bool:
        """Write down what the study is, and its first trial, if nobody has; whether that was so."""
        with storage.claim(study):
            saved, begun = study.user_attrs.get(SETTINGS), bool(study.trials)
            if saved is not None:
                settings.refuse_others(saved, name)
            elif begun or [one.name.lower() for one in study.directions] != directions:
                raise UsageError(
                    f"{storage.shown} has a study {name!r} that is not one of sb3_guard's; choose "
                    "another --study-name"
                )
            else:
                # First of all: a worker may die after any of these lines, and the next one goes on.
                study.set_user_attr(SETTINGS, asdict(settings))
            if not begun:
                # So that the best is never worse than where one came from.
                study.enqueue_trial(search.first())
            return not begun

    # Workers that drew the same numbers would try the same things: only the first has the seed.
    seeded = storage.call(begin) and args["seed"] >= 0
    sampler = SAMPLERS[args["sampler"]]
    study.sampler = sampler(args["seed"] if seeded else None, args["n_startup_trials"])
    return study


@contextmanager
def _other_workers(number: int, argv: Sequence[str]) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Start more processes of the same command; they stop when this one does."""
    command = [sys.executable, "-m", "sb3_guard.tune", *argv, "--n-jobs", "1"]
    command += ["--worker-of", str(os.getpid())]
    others = [
        # Of their own session: Ctrl-C reaches this process, which passes it on once.
        subprocess.Popen(command, start_new_session=True)
        for _ in range(number)
    ]
    try:
        yield others
    finally:
        for one in others:
            if one.poll() is None:
                one.terminate()
        for one in others:
            one.wait()


def tune(args: Mapping[str, Any], argv: Sequence[str]) -> int:
    """
    Tune.

    :param args: all flags, with their defaults
    :param argv: the command line they are from
    :return: exit status: 0, or 128 + the signal's number when interrupted
    :raises UsageError: something is wrong with the flags, or the storage is lost
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        # Hearts beat in Database.working_on.
        warnings.filterwarnings("ignore", message="Heartbeat of storage is supposed to be used")
        # What is reported again after an outage.
        warnings.filterwarnings("ignore", message="The (reported|constraint) value is ignored")
        warnings.filterwarnings("ignore", message="PedAnovaImportanceEvaluator computes")
        warnings.filterwarnings("ignore", message="The number of trials is too small")
        return _tune(args, argv)


def _tune(args: Mapping[str, Any], argv: Sequence[str]) -> int:
    settings, search = prepare(args)
    suffix = f"_{folder_name(args['study_name'])}" if args["study_name"] else ""
    folder = Path(args["log_folder"]) / settings.algo / f"{folder_name(settings.env)}_tune{suffix}"
    require_writable(folder, "-f")
    name = args["study_name"] or f"{settings.algo}_{settings.env}"
    storage = open_storage(
        args["storage"], folder / "study.journal", args["heartbeat"], args["storage_timeout"]
    )
    verbose = args["verbose"] > 0
    try:
        study = _open_study(args, settings, search, name, storage)
        report = Report(folder, asdict(settings), Verdict(settings.violation), args["gym_packages"])
        worker = Worker(args, settings, search, study, storage, report)
        if verbose and args["worker_of"] is None:
            print(_header(args, settings, study, storage, folder), flush=True)

        def stop(number: int) -> None:
            worker.stop = True
            if verbose:
                print("\nStopping; once more to stop at once.", file=sys.stderr)

        with interrupts(stop) as received:
            with _other_workers(args["n_jobs"] - 1, argv):
                worker.work()
        trials = storage.call(study.get_trials, deepcopy=False)
        if args["worker_of"] is None:
            report.write(trials)
            report.plot(study, trials)
            if verbose:
                print(report.summary(trials, interrupted=bool(received)))
        return 128 + received[0] if received else 0
    finally:
        storage.close()


def _header(
    args: Mapping[str, Any],
    settings: Settings,
    study: optuna.Study,
    storage: Storage,
    folder: Path,
) -> str:
    trials = storage.call(study.get_trials, deepcopy=False)
    finished = sum(one.state in FINISHED for one in trials)
    if settings.pareto:
        goal = "the trade-off of return and episode cost"
    elif settings.cost_limit is None:
        goal = f"the highest return ({settings.algo} has no cost limit; --cost-limit sets one)"
    else:
        limits = ", ".join(number(one) for one in settings.cost_limit)
        goal = f"the highest return with an episode cost of at most {limits}"
    seeds = f" × {len(settings.seeds)} seeds" if len(settings.seeds) > 1 else ""
    pruner = "none" if settings.pareto else args["pruner"]
    return "\n".join(
        [
            f"Study {study.study_name}: {finished} of {args['n_trials']} trials are finished",
            f"  searching    {goal}",
            f"  each trial   {settings.n_timesteps:,} steps{seeds}, sampler {args['sampler']}, "
            f"pruner {pruner}",
            f"  folder       {folder}",
            f"  watch with   optuna-dashboard {storage.shown}",
        ]
    )
