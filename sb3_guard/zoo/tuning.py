"""Tuning: the hyper-parameters with the highest return whose agents keep the cost limit.

Between two trials the feasible one is better, then the higher return, then the smaller violation.
What is ours is the objective (:mod:`sb3_guard.zoo.trials`), the search space and the report;
samplers, pruners and storages are Optuna's (:mod:`sb3_guard.zoo.studies` adds what that leaves
open).
"""

import multiprocessing
import signal
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict
from pathlib import Path

import numpy as np
import optuna
from optuna.exceptions import ExperimentalWarning, UpdateFinishedTrialError
from optuna.pruners import BasePruner, MedianPruner, NopPruner, SuccessiveHalvingPruner
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial

from sb3_guard.zoo import start
from sb3_guard.zoo.algos import algorithm
from sb3_guard.zoo.hyperparams import check, read_hyperparams
from sb3_guard.zoo.run import Experiment
from sb3_guard.zoo.run_flags import RunFlags
from sb3_guard.zoo.run_folder import folder_name, is_disk_error, require_writable
from sb3_guard.zoo.spaces import SAMPLERS, Search, read_space
from sb3_guard.zoo.studies import (
    FINISHED,
    NoneLeft,
    Outage,
    Storage,
    StorageLost,
    Study,
    open_storage,
)
from sb3_guard.zoo.trials import GIVEN, Objective, Settings, Stopped
from sb3_guard.zoo.tune_flags import TuneFlags
from sb3_guard.zoo.tuning_report import Report, short
from sb3_guard.zoo.usage import UsageError, interrupts, interrupts_ignored, run

MOST_FAILURES = 3  # in a row, until it is not the hyper-parameters' fault
POLL = 1.0  # seconds between two looks at what other workers do
SETTINGS = "settings"


def prepare(flags: TuneFlags) -> tuple[RunFlags, Settings, Search]:
    """
    Check everything before anything is written.

    :return: the flags of a training, and what the study is
    :raises UsageError: something is wrong with the flags
    """
    fixed = dict(flags.hyperparams or {})
    own = dict(fixed)
    if flags.cost_limit is not None:
        # Beside the trials: training with the result keeps the best model by the same limit.
        limit = flags.cost_limit
        own["selection_limit"] = limit[0] if len(limit) == 1 else limit
    how = {"hyperparams": own, "seed": flags.seeds[0], "verbose": 0, "progress": False}
    run, values = start.prepare(RunFlags.shared(flags, **how))
    n_timesteps = values["n_timesteps"]
    # Training with the result is as long as the file says, whatever the trials are.
    filed = read_hyperparams(run.algo, run.env, run.conf_file, own)
    cls, length = algorithm(run.algo), filed.get("n_timesteps", n_timesteps)
    base = check(run.algo, cls, {**values, "n_timesteps": length})
    n_evaluations = flags.n_evaluations or max(n_timesteps // 100_000, 4)
    if n_evaluations > n_timesteps:
        raise UsageError(
            f"--n-evaluations {n_evaluations} is not allowed; there are {n_timesteps} steps"
        )
    space = read_space(flags.search_space) if flags.search_space else None
    search = Search(flags.algo, base, space, fixed)
    for corner in search.corners():
        check(run.algo, cls, corner)
    with closing(Experiment(run, values)) as experiment:
        assert experiment.evaluation is not None
        limits = experiment.evaluation.limits().tolist()
    settings = Settings(
        algo=run.algo,
        env=run.env,
        hyperparams=base,
        space=search.description(),
        n_timesteps=n_timesteps,
        seeds=flags.seeds,
        n_evaluations=n_evaluations,
        eval_episodes=flags.eval_episodes,
        cost_keys=list(experiment.cost_keys),
        cost_limit=limits if np.isfinite(limits).all() else None,
        pareto=flags.pareto,
    )
    return run, settings, search


def _pruner(flags: TuneFlags, settings: Settings) -> BasePruner:
    if flags.pruner == "none" or settings.pareto:
        return NopPruner()
    if flags.pruner == "halving":
        return SuccessiveHalvingPruner(min_resource=1, reduction_factor=4)
    warmup = settings.n_evaluations // 3 + 1
    return MedianPruner(n_startup_trials=flags.n_startup_trials, n_warmup_steps=warmup)


def _begin(
    study: Study, settings: Settings, search: Search, directions: list[StudyDirection]
) -> bool:
    """Write down what the study is, and its first trial, if nobody has; whether somebody had."""
    saved, begun = study.user_attrs.get(SETTINGS), bool(study.trials)
    if saved is not None:
        settings.refuse_others(saved, study.study_name)
    elif begun or study.directions != directions:
        raise UsageError(
            f"{study.shared.shown} has a study {study.study_name!r} that is not one of "
            "sb3_guard's; choose another --study-name"
        )
    else:
        # First of all: a worker may die after any of these lines, and the next one continues.
        study.set_user_attr(SETTINGS, asdict(settings))
    if not begun:
        # So that the best is never worse than where one came from.
        first = search.first()
        study.enqueue_trial(first, user_attrs={GIVEN: bool(first)})
    return begun


def open_study(
    flags: TuneFlags, settings: Settings, search: Search, name: str, storage: Storage
) -> Study:
    """
    Begin the study, or join it.

    :raises UsageError: it was begun with other settings
    """
    directions = [StudyDirection.MAXIMIZE]
    if settings.pareto:
        directions += [StudyDirection.MINIMIZE] * len(settings.cost_keys)
    optuna.create_study(
        storage=storage, study_name=name, directions=directions, load_if_exists=True
    )
    study = Study(name, storage, flags.n_trials)
    try:
        with storage.exclusive():
            begun = _begin(study, settings, search, directions)
    except Outage:
        time.sleep(POLL)
        return open_study(flags, settings, search, name, storage)
    study.pruner = _pruner(flags, settings)
    # Workers that drew the same numbers would try the same things: only the first has the seed.
    seed = flags.seed if not begun and flags.seed >= 0 else None
    study.sampler = SAMPLERS[flags.sampler](seed, flags.n_startup_trials)
    return study


def work(study: Study, objective: Objective, report: Report) -> None:
    """
    Work until the study has all its trials, or until stopped.

    :raises UsageError: trial after trial fails
    :raises StorageLost: the storage is lost
    """

    def after(_: optuna.Study, trial: FrozenTrial) -> None:
        trials = study.get_trials(deepcopy=False)
        report.write(study)
        if objective.flags.verbose:
            print(report.line(trials, trial), flush=True)
        if objective.failures >= MOST_FAILURES:
            raise UsageError(
                f"{objective.failures} trials in a row failed, the last one: "
                f"{trial.user_attrs['error']}"
            )
        if objective.stopped():
            study.stop()

    said = False
    while not objective.stopped():
        try:
            study.optimize(objective, callbacks=[after])
        except Stopped:
            return
        except Outage:
            time.sleep(POLL)
        except NoneLeft as none:
            if not none.running:
                return
            # If one of them is lost, its trial is for us.
            if not said and objective.flags.verbose:
                print(f"Waiting for {none.running} trial(s) of other workers", flush=True)
            said = True
            time.sleep(POLL)
        except Exception as error:
            if study.shared.lost is not None:
                raise study.shared.lost from error
            # Optuna refuses to tell what somebody else has told.
            refused = str(error).startswith("Cannot tell a")
            if not refused and not isinstance(error, UpdateFinishedTrialError):
                raise
            print("A trial was taken for lost and given to another worker")


def tune(flags: TuneFlags, main: bool = True) -> int:
    """
    Tune.

    :param main: this is the process that the user started, not one of ``--n-jobs``
    :return: exit status: 0, or 128 + the signal's number when interrupted
    :raises UsageError: something is wrong with the flags, or the storage is lost
    """
    optuna.logging.set_verbosity(optuna.logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            # What is reported again by a trial that is done again, or after an outage.
            warnings.filterwarnings("ignore", message="The (reported|constraint) value is ignored")
            warnings.filterwarnings("ignore", message="The number of trials is too small")
            warnings.filterwarnings("ignore", message="PedAnovaImportanceEvaluator computes")
            return _tune(flags, main)
    except StorageLost as error:
        raise UsageError(str(error)) from error
    except OSError as error:
        if not is_disk_error(error):
            raise
        raise UsageError(
            f"can't write the study: {error.strerror}; what is in it is intact: the same command "
            "continues it"
        ) from error


def _tune(flags: TuneFlags, main: bool) -> int:
    training, settings, search = prepare(flags)
    suffix = f"_{folder_name(flags.study_name)}" if flags.study_name else ""
    folder = Path(flags.log_folder) / settings.algo / f"{folder_name(settings.env)}_tune{suffix}"
    require_writable(folder, "-f")
    name = flags.study_name or f"{settings.algo}_{settings.env}"
    storage = open_storage(
        flags.storage, folder / "study.journal", flags.heartbeat, flags.storage_timeout
    )
    try:
        study = open_study(flags, settings, search, name, storage)
        objective = Objective(flags, training, settings, search)
        report = Report(folder, asdict(settings), flags.gym_packages)
        loud = main and flags.verbose > 0
        if loud:
            print(_header(flags, settings, study, folder), flush=True)

        def stop(number: int) -> None:
            objective.stop = True
            if loud:
                print("\nStopping; Ctrl-C again stops immediately.", file=sys.stderr)

        with interrupts(stop) as received:
            if not main:
                signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process passes it on
            with _other_workers(flags, flags.n_jobs - 1 if main else 0):
                work(study, objective, report)
        if main:
            report.write(study)
            report.plot(study)
            if loud:
                print(report.summary(study, interrupted=bool(received)))
        return 128 + received[0] if received else 0
    finally:
        storage.close()


@contextmanager
def _other_workers(flags: TuneFlags, n: int) -> Iterator[None]:
    """Let more processes work on the study; they stop when this one does."""
    context = multiprocessing.get_context("spawn")
    others = [context.Process(target=_work_beside, args=(flags,)) for _ in range(n)]
    with interrupts_ignored():  # by those that inherit it; Ctrl-C reaches this process
        for one in others:
            one.start()
    try:
        yield
    finally:
        for one in others:
            one.terminate()
        for one in others:
            one.join()


def _work_beside(flags: TuneFlags) -> None:
    sys.exit(run(lambda: tune(flags, main=False)))


def _header(flags: TuneFlags, settings: Settings, study: Study, folder: Path) -> str:
    trials = study.get_trials(deepcopy=False)
    finished = sum(one.state in FINISHED for one in trials)
    if settings.pareto:
        goal = "the trade-off of return and episode cost"
    elif settings.cost_limit is None:
        goal = f"the highest return ({settings.algo} has no cost limit; --cost-limit sets one)"
    else:
        limits = ", ".join(short(one) for one in settings.cost_limit)
        goal = f"the highest return with an episode cost of at most {limits}"
    seeds = f" × {len(settings.seeds)} seeds" if len(settings.seeds) > 1 else ""
    pruner = "none" if settings.pareto else flags.pruner
    return "\n".join(
        [
            f"Study {study.study_name}: {finished} of {flags.n_trials} trials are finished",
            f"  searching    {goal}",
            f"  each trial   {settings.n_timesteps:,} steps{seeds}, sampler {flags.sampler}, "
            f"pruner {pruner}",
            f"  folder       {folder}",
            f"  watch with   optuna-dashboard {study.shared.shown}",
        ]
    )
