"""Tuning: the hyperparameters with the highest return whose agents keep the cost limit.

Between two trials the feasible one is better, then the higher return, then the smaller violation.
The package adds the objective (:mod:`sb3_guard.zoo.tuning.trials`), the search space and the
report; ``study.optimize``, samplers, pruners and storages are Optuna's.
"""

import multiprocessing
import signal
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from multiprocessing.process import BaseProcess
from pathlib import Path

import optuna
from optuna.exceptions import ExperimentalWarning
from optuna.pruners import BasePruner, MedianPruner, NopPruner, SuccessiveHalvingPruner
from optuna.storages import JournalStorage
from optuna.study import MaxTrialsCallback
from optuna.trial import FrozenTrial

from sb3_guard.zoo.cli.usage import UsageError, interrupts, run
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import folder_name
from sb3_guard.zoo.run.hyperparams import check
from sb3_guard.zoo.run.run import Run, differences
from sb3_guard.zoo.tuning import studies
from sb3_guard.zoo.tuning.flags import TuneFlags
from sb3_guard.zoo.tuning.report import FINISHED, Report
from sb3_guard.zoo.tuning.spaces import SAMPLERS, Search, read_space
from sb3_guard.zoo.tuning.studies import Storage, open_storage, repeat_lost_trials
from sb3_guard.zoo.tuning.trials import Objective, Settings, Stopped

SETTINGS = "settings"


def prepare(flags: TuneFlags, main: bool = True) -> tuple[RunFlags, Settings, Search]:
    """
    Check everything before anything is written.

    :param main: see :func:`tune`
    :return: the flags of a training, and what the study is
    :raises UsageError: something is wrong with the flags
    """
    fixed, hyperparams = flags.hyperparams or {}, dict(flags.hyperparams or {})
    if limit := flags.cost_limit:
        # Beside the trials: training with the result keeps the best model by the same limit.
        hyperparams["selection_limit"] = limit[0] if len(limit) == 1 else limit
    how = {"hyperparams": hyperparams, "seed": flags.seeds[0], "progress": False}
    run = Run.check(RunFlags.shared(flags, certify=0, verbose=flags.verbose * main, **how))
    run.flags.verbose = 0  # of the trials
    values, n_timesteps = run.hyperparams, run.hyperparams["n_timesteps"]
    space = read_space(flags.search_space) if flags.search_space else None
    search = Search(flags.algo, values, space, fixed)
    for corner in search.corners():
        check(flags.algo, run.algorithm, corner)
    run.make().close()
    limits = run.limits()
    settings = Settings(
        algo=run.flags.algo,
        env=run.flags.env,
        hyperparams=values,
        space=search.space,
        n_timesteps=n_timesteps,
        seeds=list(dict.fromkeys(flags.seeds)),
        n_evaluations=flags.n_evaluations or max(n_timesteps // 100_000, 4),
        eval_episodes=flags.eval_episodes,
        cost_keys=list(run.cost_keys),
        cost_limit=limits.values.tolist() if limits else None,
    )
    return run.flags, settings, search


def _pruner(flags: TuneFlags, settings: Settings) -> BasePruner:
    if flags.pruner == "none":
        return NopPruner()
    if flags.pruner == "halving":
        return SuccessiveHalvingPruner(min_resource=1, reduction_factor=4)
    warmup = settings.n_evaluations // 3 + 1
    return MedianPruner(n_startup_trials=flags.n_startup_trials, n_warmup_steps=warmup)


def open_study(
    flags: TuneFlags, settings: Settings, search: Search, name: str, storage: Storage
) -> optuna.Study:
    """
    Begin the study, or join it.

    :raises UsageError: it was begun with other settings
    """
    study = optuna.create_study(
        storage=storage,
        study_name=name,
        direction="maximize",
        pruner=_pruner(flags, settings),
        load_if_exists=True,
    )
    saved, begun = study.user_attrs.get(SETTINGS), bool(study.trials)
    if saved is None:
        saved = asdict(settings)
        study.set_user_attr(SETTINGS, saved)
    for then, now in ((saved["hyperparams"], settings.hyperparams), (saved, asdict(settings))):
        for part, old, value in differences(then, now):
            raise UsageError(
                f"study {name!r} was begun with {part} {old}, not {value}: "
                "continue it as it was begun, or begin another with --study-name"
            )
    if not begun:
        # So that the best is not worse than the starting point, as far as the space has it.
        study.enqueue_trial(search.first(), skip_if_exists=True)
    # Workers that drew the same numbers would try the same things: only the first has the seed.
    seed = flags.seed if not begun and flags.seed >= 0 else None
    study.sampler = SAMPLERS[flags.sampler](seed, flags.n_startup_trials)
    return study


def tune(flags: TuneFlags, main: bool = True) -> int:
    """
    Tune.

    :param main: this is the process that the user started, not one of ``--n-jobs``
    :return: exit status: 0, or 128 + the signal's number when interrupted
    :raises UsageError: something is wrong with the flags, or the study can't be written
    """
    optuna.logging.set_verbosity(optuna.logging.CRITICAL)
    again = "its trials are kept, and the same command continues the study"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            return _tune(flags, main)
    except Exception as error:
        if (text := studies.database_error(error)) is None:
            raise
        raise UsageError(f"the study's database fails: {text}; {again}") from error


def _tune(flags: TuneFlags, main: bool) -> int:
    training, settings, search = prepare(flags, main)
    suffix = f"_{folder_name(flags.study_name)}" if flags.study_name else ""
    folder = Path(flags.log_folder) / settings.algo / f"{folder_name(settings.env)}_tune{suffix}"
    name = flags.study_name or f"{settings.algo}_{settings.env}"
    storage, shown = open_storage(flags.storage, folder / "study.journal")
    folder.mkdir(parents=True, exist_ok=True)
    study = open_study(flags, settings, search, name, storage)
    objective = Objective(flags, training, settings, search)
    report = Report(folder, settings, flags.gym_packages)
    loud = main and flags.verbose > 0
    if loud:
        print(_header(flags, settings, study, folder, shown), flush=True)

    def stop(number: int) -> None:
        objective.stop = True
        if loud:
            print("\nStopping; Ctrl-C again stops immediately.", file=sys.stderr)

    def after(study: optuna.Study, trial: FrozenTrial) -> None:
        report.write(study)
        if flags.verbose:
            print(report.line(trial), flush=True)
        if objective.stopped():
            study.stop()

    with interrupts(stop) as received:
        if main and isinstance(storage, JournalStorage):
            repeat_lost_trials(study)
        with _other_workers(flags, flags.n_jobs - 1 if main else 0) as others:
            if len(study.get_trials(deepcopy=False, states=FINISHED)) < flags.n_trials:
                enough = MaxTrialsCallback(flags.n_trials, states=FINISHED)
                with suppress(Stopped):
                    # A model refers to itself, and Python seldom looks for that.
                    study.optimize(objective, callbacks=[after, enough], gc_after_trial=True)
            while not objective.stopped() and any(process.is_alive() for process in others):
                time.sleep(0.2)
    if main:
        report.write(study)
        if loud:
            print(report.summary(study))
            if received:
                print("The same command continues the study.")
    return 128 + received[0] if received else 0


@contextmanager
def _other_workers(flags: TuneFlags, n: int) -> Iterator[list[BaseProcess]]:
    """Let more processes work on the study; those left at the end of the block are stopped."""
    context = multiprocessing.get_context("spawn")
    others: list[BaseProcess] = [
        context.Process(target=_work_beside, args=(flags,)) for _ in range(n)
    ]
    for process in others:
        process.start()
    try:
        yield others
    finally:
        for process in others:
            process.terminate()
        for process in others:
            process.join()


def _work_beside(flags: TuneFlags) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that began it
    sys.exit(run(lambda: tune(flags, main=False)))


def _header(
    flags: TuneFlags, settings: Settings, study: optuna.Study, folder: Path, shown: str
) -> str:
    finished = len(study.get_trials(deepcopy=False, states=FINISHED))
    limits = zip(settings.cost_limit or (), settings.cost_keys, strict=False)
    bounds = [f"{key} of at most {limit:.4g}" for limit, key in limits]
    goal = f"with an episode {', '.join(bounds)}" if bounds else "(--cost-limit sets a limit)"
    seeds = " ".join(map(str, settings.seeds))
    return f"""Study {study.study_name}: {finished} of {flags.n_trials} trials are finished
  searching    the highest return {goal}
  each trial   {settings.n_timesteps:,} steps, --seeds {seeds}
  folder       {folder}
  watch with   optuna-dashboard {shown}"""
