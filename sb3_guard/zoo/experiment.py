"""A training run from flags to result: checked in full first, then made, trained, and resumed.

RL-Zoo's ``ExperimentManager`` makes the run folder before it has looked at the hyper-parameters,
and starts counters, seeds and environments anew when it continues; so its pieces are used here
(wrappers, callbacks and schedules, run numbers, file layout, flags) and its class is not.
"""

import copy
import shlex
import signal
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_guard.algorithms.common.on_policy import CostOnPolicyAlgorithm
from sb3_guard.common.callbacks import CostEvalCallback, LogCosts
from sb3_guard.common.files import replacing
from sb3_guard.common.monitor import find_monitor
from sb3_guard.zoo.algos import algorithm
from sb3_guard.zoo.checkpoint import (
    Checkpoints,
    Interrupted,
    is_checkpoint,
    load_model,
    monitor_offset,
    read_checkpoint,
    read_normalizer,
    restore_run,
)
from sb3_guard.zoo.config import Setup, build, check, read_hyperparams
from sb3_guard.zoo.environments import (
    BAD_ARGUMENTS,
    ERRORS_OF_OURS,
    PROCESS_DIED,
    canonical_id,
    choose_vec_env,
    make_envs,
)
from sb3_guard.zoo.logger import RunLogger
from sb3_guard.zoo.progress import Epochs
from sb3_guard.zoo.run_folder import (
    CHECKPOINT,
    RunFolder,
    as_read,
    is_disk_error,
    is_run,
    lock,
    require_writable,
    run_path,
)
from sb3_guard.zoo.usage import UsageError, import_packages, interrupts, one_line

# Flags that say how to watch or host a run, not what it is: they may change when it is resumed.
FREE_FLAGS = {"trained_agent", "progress", "verbose", "num_threads", "checkpoint_every", "track"}
# Those that say what a run is, beside its hyper-parameters.
IDENTITY = (
    "algo", "env", "seed", "trained_agent", "device", "vec_env", "eval_freq", "eval_episodes",
    "n_eval_envs", "eval_env_kwargs", "save_freq", "log_interval",
)  # fmt: skip
# The evaluation episodes are not those of training: seeds this far apart don't meet.
EVALUATION_SEED_OFFSET = 1_000_000
# Beside a run's configuration: its id at Weights & Biases.
TRACKED = "wandb.txt"


class Experiment:
    """
    One training run, made and checked but not yet on disk.

    :param args: all flags of the command, with their defaults
    :param hyperparams: hyper-parameters as data, checked
    :param folder: the folder of the run to continue; None: a new run
    :raises UsageError: the environment, the algorithm or a wrapper refuses a value, or TensorBoard
        events can't be written
    """

    def __init__(
        self,
        args: Mapping[str, Any],
        hyperparams: Mapping[str, Any],
        folder: RunFolder | None = None,
    ):
        self.args = dict(args)
        self.hyperparams = dict(hyperparams)
        self.algo: str = args["algo"]
        self.algorithm = algorithm(self.algo)
        self.setup: Setup = build(hyperparams)
        #: the checkpoint to continue from
        self.state = None if folder is None else read_checkpoint(folder.checkpoint)
        self._saved = None if folder is None else folder.checkpoint
        #: training ends after the rollout under way when this file is gone
        self.permit: Path | None = None
        #: its folder is to state flags and hyper-parameters anew once training can go on
        self.restates = False
        self._tracker: Any = None  # the run at Weights & Biases
        self.cost_keys = tuple(self.setup.model.get("cost_keys", ("cost",)))
        self._check_selection_limit()
        if self._tensorboard_folder is not None:
            require_writable(self._tensorboard_folder, "--tensorboard-log")
        self.vec_env = choose_vec_env(
            args["vec_env"], canonical_id(args["env"])[1], self.setup.env_wrapper is not None
        )
        if args["num_threads"] > 0:
            import torch as th

            th.set_num_threads(args["num_threads"])
        set_random_seed(args["seed"])
        self._try_environment(self.setup.env_kwargs)
        if args["eval_freq"] > 0 and args["eval_env_kwargs"] is not None:
            self._try_environment(args["eval_env_kwargs"])
        self.env = self._make_envs(self.setup.n_envs, args["seed"])
        try:
            self.model = self._make_model()
            self.model.verbose = max(args["verbose"] - 1, 0)
            self.eval_env = self._make_eval_envs() if args["eval_freq"] > 0 else None
        except BaseException:
            self.env.close()
            raise

    def _make_envs(self, n_envs: int, seed: int, **kwargs: Any) -> VecEnv:
        kwargs = {"vec_env": self.vec_env, "env_kwargs": self.setup.env_kwargs, **kwargs}
        return make_envs(
            self.args["env"],
            self.setup,
            n_envs=n_envs,
            seed=seed,
            cost_keys=self.cost_keys,
            num_threads=self.args["num_threads"] if self.args["num_threads"] > 0 else None,
            normalizer=self._warm_start_normalizer(),
            **kwargs,
        )

    def _check_selection_limit(self) -> None:
        limit = self.setup.selection_limit
        if isinstance(limit, list) and len(limit) != len(self.cost_keys):
            raise UsageError(
                f"hyper-parameter selection_limit: {limit} has {len(limit)} entries, but there "
                f"{'is one cost' if len(self.cost_keys) == 1 else 'are several costs'}, "
                f"{', '.join(self.cost_keys)}; give one number, or a list of one per cost"
            )

    def _try_environment(self, env_kwargs: Mapping[str, Any]) -> None:
        """Make one environment and take a step, so that nothing fails later for want of a cost."""
        vec_env = "dummy" if self.vec_env == "subproc" else self.vec_env
        env = self._make_envs(1, self.args["seed"], vec_env=vec_env, env_kwargs=env_kwargs)
        try:
            env.reset()
            env.action_space.seed(self.args["seed"])
            info = env.step(np.array([env.action_space.sample()]))[3][0]
        except BAD_ARGUMENTS as error:
            raise UsageError(
                f"{self.args['env']} fails at its first step: {one_line(error)}"
            ) from error
        finally:
            env.close()
        if not getattr(self.algorithm, "constrained", False):
            return
        if self.setup.model.get("missing_cost", "error") == "zero":
            return
        for key in self.cost_keys:
            if key not in info:
                raise UsageError(
                    f"{self.args['env']} reports no cost {key!r} in its info, which has "
                    f"{', '.join(sorted(info)) or 'nothing'}; name its costs with "
                    "-params cost_keys:\"['name']\", or count a missing cost as 0 with "
                    "-params missing_cost:zero"
                )

    def _make_model(self) -> BaseAlgorithm:
        seed, device = self.args["seed"], self.args["device"]
        if self._saved is not None:
            return load_model(self.algorithm, self._saved, self.env, device)
        arguments = copy.deepcopy(self.setup.model)  # some algorithms add to their policy_kwargs
        try:
            if self.args["trained_agent"]:
                # What the networks are is for the saved agent to say.
                for name in ("policy", "policy_kwargs"):
                    arguments.pop(name, None)
                path = Path(self.args["trained_agent"])
                return load_model(self.algorithm, path, self.env, device, seed=seed, **arguments)
            noise = self._action_noise()
            if noise is not None:
                arguments["action_noise"] = noise
            return self.algorithm(env=self.env, device=device, seed=seed, **arguments)
        except (*BAD_ARGUMENTS, RuntimeError) as error:
            raise UsageError(f"{self.algo} can't be made: {one_line(error)}") from error

    def _action_noise(self) -> ActionNoise | None:
        space = self.env.action_space
        return self.setup.action_noise(space.shape[0]) if isinstance(space, spaces.Box) else None

    def _warm_start_normalizer(self) -> VecNormalize | None:
        """Observation statistics that belong to the agent given by ``-i model.zip``."""
        if self.state is not None or not self.args["trained_agent"] or self.setup.normalize is None:
            return None
        found = sorted(Path(self.args["trained_agent"]).parent.glob("*/vecnormalize.pkl"))
        return read_normalizer(found[0]) if found else None

    def _make_eval_envs(self) -> VecEnv:
        number = self.args["n_eval_envs"]
        if number is None:
            # All episodes at once where that is cheap; a process each would not be.
            number = self.args["eval_episodes"] if self.vec_env == "native" else 1
        kwargs = self.args["eval_env_kwargs"]
        return self._make_envs(
            number,
            self.args["seed"] + EVALUATION_SEED_OFFSET,
            evaluation=True,
            env_kwargs=self.setup.env_kwargs if kwargs is None else kwargs,
        )

    def _make_callbacks(self, folder: RunFolder) -> tuple[Checkpoints, Epochs, list[BaseCallback]]:
        args, n_envs = self.args, self.setup.n_envs
        epochs = Epochs(self.setup.n_timesteps, bar=args["progress"])
        others: list[BaseCallback] = [epochs]
        if not isinstance(self.model, CostOnPolicyAlgorithm):
            others.append(LogCosts())
        if args["save_freq"] > 0:
            others.append(
                CheckpointCallback(
                    max(args["save_freq"] // n_envs, 1),
                    str(folder.path),
                    name_prefix="rl_model",
                    save_vecnormalize=True,
                )
            )
        if self.eval_env is not None:
            others.append(
                CostEvalCallback(
                    self.eval_env,
                    selection_limit=self.setup.selection_limit,
                    seed=args["seed"] + EVALUATION_SEED_OFFSET,
                    n_eval_episodes=args["eval_episodes"],
                    eval_freq=max(args["eval_freq"] // n_envs, 1),
                    log_path=folder.path,
                    best_model_save_path=folder.path,
                    verbose=int(args["verbose"] > 0 and self._prints_tables),
                )
            )
        others += self.setup.callbacks
        log_interval = args["log_interval"] if args["log_interval"] > 0 else 1
        checkpoints = Checkpoints(
            folder.checkpoint, others, every=args["checkpoint_every"], log_interval=log_interval
        )
        # The checkpoint comes first: it must see the others as the last rollout left them.
        first = [] if self.permit is None else [Permit(self.permit, checkpoints)]
        return checkpoints, epochs, [*first, checkpoints, *others]

    @property
    def _prints_tables(self) -> bool:
        # The progress bar shows the same live; two displays would be one too many.
        return self.args["verbose"] > (1 if self.args["progress"] else 0)

    def train(self, folder: RunFolder) -> int:
        """
        Train to the end, or to an interrupt, and report.

        :param folder: the run's folder, owned by this process
        :return: exit status: 0, or 128 + the signal's number when interrupted
        :raises UsageError: training can't go on, or the disk is full or read-only
        """
        try:
            return self._train(folder)
        except PROCESS_DIED as error:
            raise UsageError(
                "a process of --vec-env subproc has died, perhaps for want of memory; "
                f"continue with -i {folder.path}"
            ) from error
        except OSError as error:
            if not is_disk_error(error):
                raise
            raise UsageError(
                f"can't write to {folder.path}: {error.strerror}; what was written before is "
                f"intact: make room, then continue with -i {folder.path}"
            ) from error
        finally:
            self.close()

    def close(self) -> None:
        """Release the environments, and let Weights & Biases have what it has not yet."""
        for env in (self.env, self.eval_env):
            with suppress(*PROCESS_DIED):
                if env is not None:
                    env.close()
        if self._tracker is not None:
            try:
                self._tracker.finish()
            except Exception as error:  # its client raises what it likes; the run is on disk
                print(
                    f"--track: Weights & Biases did not get everything: {one_line(error)}; "
                    "send it with: wandb sync",
                    file=sys.stderr,
                )
            self._tracker = None

    def _train(self, folder: RunFolder) -> int:
        state, verbose = self.state, self.args["verbose"] > 0
        if verbose:
            print(f"Run folder: {folder.path} (seed {self.args['seed']})")
        self.track(folder)
        try:
            find_monitor(self.env).log_to(
                folder.monitor, offset=None if state is None else monitor_offset(state)
            )
        except (OSError, ValueError) as error:
            if is_disk_error(error):
                raise
            raise UsageError(one_line(error)) from error
        logger = RunLogger(
            folder.path,
            stdout=self._prints_tables,
            tensorboard=self._tensorboard(folder),
            state=None if state is None else state["logger"],
        )
        self.model.set_logger(logger)
        checkpoints, epochs, callbacks = self._make_callbacks(folder)
        if state is not None:
            checkpoints.restore(state)
            # In this order, and only now: a result in the folder is always that of its config.
            folder.result.unlink(missing_ok=True)
            if self.restates:
                folder.write_config(self.args, self.hyperparams)
            restore_run(self.model, state)

        def stop(number: int) -> None:
            checkpoints.stop = True
            if verbose:
                print("\nStopping after this rollout; once more to stop at once.", file=sys.stderr)

        began = time.monotonic()
        with interrupts(stop) as received:
            finished = self._learn(callbacks, received)
        with replacing(folder.model) as file:
            self.model.save(file)
        normalizer = self.model.get_vec_normalize_env()
        if normalizer is not None:
            normalizer.save(str(folder.normalizer))
        logger.close()
        result = epochs.result()
        if finished:
            folder.write_result({"algo": self.algo, "env": self.args["env"], **result})
        if verbose:
            print(summary(folder, result, time.monotonic() - began, finished))
        return 0 if finished else 128 + (received or [signal.SIGTERM])[0]

    @property
    def _tensorboard_folder(self) -> Path | None:
        name = self.args["tensorboard_log"] or ("runs" if self.args["track"] else None)
        return Path(name) if name else None

    def _tensorboard(self, folder: RunFolder) -> Path | None:
        parent = self._tensorboard_folder
        if parent is None:
            return None
        # Of the run's own number, so that a resumed run finds it again.
        return parent / folder.name / f"{self.algo}{folder.path.name[len(folder.name) :]}"

    def track(self, folder: RunFolder | None = None) -> None:
        """
        Send the run's TensorBoard events to Weights & Biases, if asked to.

        Called before the first event file is opened, or they would not be seen; for a new run
        before its folder is made, so that a refusal leaves nothing behind.

        :param folder: the run's, which remembers the id: a resumed run goes on there, too
        :raises UsageError: Weights & Biases refuses, e.g. for want of a key or a network
        """
        if not self.args["track"]:
            return
        path = None if folder is None else folder.params / TRACKED
        if self._tracker is None:
            import wandb

            known = None
            if path is not None and self.state is not None and path.exists():
                known = path.read_text().strip()
            name = f"{self.args['env']}__{self.algo}__{self.args['seed']}__{int(time.time())}"
            try:
                self._tracker = wandb.init(
                    id=known,
                    resume="allow" if known else None,
                    name=None if known else name,
                    project=self.args["wandb_project_name"],
                    entity=self.args["wandb_entity"],
                    group=self.args["wandb_group"],
                    tags=self.args["wandb_tags"],
                    config={**self.args, "hyperparams": self.hyperparams},
                    sync_tensorboard=True,
                )
            except Exception as error:  # its client raises what it likes
                raise UsageError(
                    f"--track: Weights & Biases can't be used: {one_line(error)}; log in with: "
                    "wandb login, set WANDB_MODE=offline, or leave out --track"
                ) from error
        if folder is not None and path is not None:
            path.write_text(self._tracker.id)
            self._tracker.config.update({"folder": str(folder.path)}, allow_val_change=True)

    def _learn(self, callbacks: list[BaseCallback], received: list[int]) -> bool:
        left = self.setup.n_timesteps - (self.model.num_timesteps if self.state else 0)
        interval = self.args["log_interval"]
        kwargs: dict[str, Any] = {}
        if interval != -1:
            kwargs["log_interval"] = interval if interval > 0 else None
        try:
            self.model.learn(
                left, callback=callbacks, reset_num_timesteps=self.state is None, **kwargs
            )
        except Interrupted:
            return False
        except PROCESS_DIED:
            # SIGTERM to all processes at once, as batch systems send it, ends the environments'
            # own before the rollout is done; this one may get it last.
            time.sleep(0.2)
            if not received:
                raise
            return False
        except (ValueError, FloatingPointError, *ERRORS_OF_OURS) as error:
            # What an environment or algorithm refuses, e.g. a NaN: its message says it all.
            if self.args["verbose"] > 1:
                raise
            raise UsageError(
                f"training stopped at {self.model.num_timesteps} steps: {one_line(error)[:600]} "
                "(--verbose 2 shows where)"
            ) from error
        finally:
            for callback in callbacks:
                if isinstance(callback, Epochs):
                    callback.on_training_end()  # leaves the terminal tidy
        return True


class Permit(BaseCallback):
    """
    Let training end with a checkpoint when a file is gone, wherever on a cluster it runs.

    :param path: the file; on a full disk files can still be removed
    :param checkpoints: the run's; its turn comes after this one's
    """

    def __init__(self, path: Path, checkpoints: Checkpoints):
        super().__init__()
        self.path = path
        self.checkpoints = checkpoints
        self._looked = -np.inf

    def _on_rollout_start(self) -> None:
        # Rollouts of off-policy algorithms are a few steps long.
        if time.monotonic() - self._looked > 1.0:
            self._looked = time.monotonic()
            self.checkpoints.stop |= not self.path.exists()

    def _on_step(self) -> bool:
        return True


def prepare(args: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """
    What a new run is: all its flags and hyper-parameters, as its folder will state them.

    :param args: all flags, with their defaults
    :return: flags and hyper-parameters, checked as far as that goes without making anything
    :raises UsageError: anything is wrong with them
    """
    args = dict(args)
    algorithm(args["algo"])
    import_packages(args["gym_packages"])
    args["env"], ours = canonical_id(args["env"])
    if args["seed"] < 0:
        args["seed"] = int(np.random.default_rng().integers(2**31))
    overrides = dict(args["hyperparams"] or {})
    if args["n_timesteps"] > 0:
        overrides["n_timesteps"] = args["n_timesteps"]
    values = read_hyperparams(args["algo"], args["env"], args["conf_file"], overrides)
    values = check(args["algo"], algorithm(args["algo"]), values)
    if args["env_kwargs"]:
        values["env_kwargs"] = {**(values.get("env_kwargs") or {}), **args["env_kwargs"]}
    wrapped = values.get("env_wrapper") is not None
    args["vec_env"] = choose_vec_env(args["vec_env"], ours, wrapped)
    return args, values


def start(args: Mapping[str, Any]) -> int:
    """
    Start a new run.

    :param args: all flags, with their defaults
    :return: exit status
    :raises UsageError: anything is wrong with them; nothing has been written then
    """
    args, values = prepare(args)
    experiment = Experiment(args, values)
    try:
        experiment.track()
        folder = RunFolder.create(
            args["log_folder"],
            args["algo"],
            args["env"],
            args,
            values,
            shlex.join(sys.orig_argv),
            unique=args["uuid"],
        )
    except UsageError:
        experiment.close()
        raise
    with folder.owned():
        return experiment.train(folder)


def complete(
    args: Mapping[str, Any],
    values: Mapping[str, Any],
    number: int,
    command: str,
    permit: Path,
    grid: str = "",
) -> int:
    """
    Bring a run of a given number to its end: start it, or go on from where it was cut.

    :param args: its flags, as :func:`prepare` returns them
    :param values: its hyper-parameters, likewise
    :param number: of its folder
    :param command: the command line it is part of
    :param permit: a file; when it is gone, training ends after the rollout under way
    :param grid: on whose behalf, for the run's lock
    :return: exit status, 0 if it is complete, now or already before
    :raises RunInUse: another process has the run
    :raises UsageError: it can't be trained, or the folder holds another run
    """
    import_packages(args["gym_packages"])
    path = run_path(args["log_folder"], args["algo"], args["env"], number)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"can't make folder {path}: {error.strerror}") from error
    with lock(path, grid):
        if is_run(path):
            folder = RunFolder(path)
            refuse_another(folder, args, values)
        else:
            folder = RunFolder.create(
                args["log_folder"], args["algo"], args["env"], args, values, command, number=number
            )
        if folder.read_result() is not None:
            return 0
        # Without a checkpoint nothing of it is worth keeping, and it begins anew in its place.
        begun = folder.checkpoint.exists()
        quiet = {**args, "progress": False, "verbose": 0}
        experiment = Experiment(quiet, values, folder if begun else None)
        experiment.permit = permit
        return experiment.train(folder)


def refuse_another(folder: RunFolder, args: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """
    Make sure that a folder holds the run that is asked for.

    :raises UsageError: it holds another, or is damaged
    """
    own, asked = folder.args(), as_read(args)
    pairs = [(name, own.get(name), asked[name]) for name in IDENTITY]
    own, asked = folder.hyperparams(), as_read(values)
    pairs += [(name, own.get(name), asked.get(name)) for name in sorted({*own, *asked})]
    differences = [
        f"{name}: {'none' if a == '' else a} there, {'none' if b == '' else b} here"
        for name, a, b in pairs
        if a != b
    ]
    if differences:
        raise UsageError(
            f"{folder.path} holds another run ({'; '.join(differences[:3])}); "
            "choose another folder with -f"
        )


def continues_run(path: Path) -> bool:
    """
    Whether ``-i path`` means a run to continue, rather than a model to begin from.

    :raises UsageError: it is neither
    """
    if path.is_dir() or path.name == CHECKPOINT or is_checkpoint(path):
        return True
    if not path.is_file():
        raise UsageError(f"-i: there is no run folder or model {str(path)!r}")
    return False


def resume(given: Mapping[str, Any], defaults: Mapping[str, Any]) -> int:
    """
    Continue a run in its folder.

    :param given: the flags given now; ``trained_agent`` is the run's folder or checkpoint
    :param defaults: all flags with their defaults
    :return: exit status
    :raises UsageError: the run can't be continued, or a flag contradicts what it is
    """
    folder = RunFolder.open(given["trained_agent"])
    with folder.owned():
        saved = _saved_flags(folder, defaults)
        values = folder.hyperparams()
        import_packages(saved["gym_packages"])
        _refuse_contradictions(given, saved, values, folder)
        args = {**saved, **{k: v for k, v in given.items() if k in FREE_FLAGS}}
        args["trained_agent"] = saved["trained_agent"]
        if "progress" not in given:
            args["progress"] = defaults["progress"]
        done = read_checkpoint(folder.checkpoint)["num_timesteps"]
        wanted = given.get("n_timesteps", -1)
        if 0 < wanted < done:
            raise UsageError(
                f"-n {wanted} is less than the {done} steps that {folder.path} has done"
            )
        if wanted > 0:
            values["n_timesteps"] = args["n_timesteps"] = wanted
        values = check(args["algo"], algorithm(args["algo"]), values)
        if folder.read_result() is not None and done >= values["n_timesteps"]:
            print(
                f"{folder.path} is finished: {done} of {values['n_timesteps']} steps; "
                "a larger -n continues it"
            )
            return 0
        experiment = Experiment(args, values, folder)
        experiment.restates = True
        return experiment.train(folder)


def _saved_flags(folder: RunFolder, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """The flags a run was started with: all of them, since one guessed would be another run."""
    saved = folder.args()
    damaged = [
        name
        for name, default in defaults.items()
        if name not in saved or (default is not None and type(saved[name]) is not type(default))
    ]
    if damaged:
        names = ", ".join(damaged[:4]) + (", …" if len(damaged) > 4 else "")
        raise UsageError(
            f"{folder.params / 'args.yml'} is damaged: it has no proper {names}; "
            "put the file back as it was, or start a new run without -i"
        )
    return saved


def _refuse_contradictions(
    given: Mapping[str, Any],
    saved: Mapping[str, Any],
    values: Mapping[str, Any],
    folder: RunFolder,
) -> None:
    """Raise if a flag asks for something other than what the run is."""
    pairs = []
    for name, value in given.items():
        flag, own = "--" + name.replace("_", "-") + " ", saved[name]
        if name in FREE_FLAGS or name == "n_timesteps":
            continue
        if name == "hyperparams":
            asked = check(saved["algo"], algorithm(saved["algo"]), {**values, **value})
            pairs += [(f"-params {key}:", asked[key], values.get(key)) for key in value]
        elif name == "log_folder":
            pairs.append((flag, Path(value).resolve(), folder.path.parent.parent.resolve()))
        elif name == "env":
            pairs.append((flag, canonical_id(value)[0], own))
        else:
            pairs.append((flag, as_read({name: value})[name], own))
    for flag, value, own in pairs:
        if value != own:
            raise UsageError(
                f"{flag}{value} contradicts {flag}{own} of {folder.path}; "
                "leave it out, or start a new run without -i"
            )


def summary(folder: RunFolder, result: Mapping[str, Any], seconds: float, finished: bool) -> str:
    """What a run came to, as the paper measures it, on a few lines."""

    def number(value: float | None, digits: int) -> str:
        return "– (no episode has ended)" if value is None else f"{value:.{digits}f}"

    lines = [
        f"{'Finished' if finished else 'Interrupted'} at {result['n_timesteps']:,} steps, "
        f"{seconds:.0f} s",
        f"  run folder         {folder.path}",
        f"  return       J_r   {number(result['return'], 3)}",
        f"  episode cost M_c   {number(result['cost'], 3)}",
        f"  cost rate    ρ_c   {number(result['cost_rate'], 5)}",
    ]
    if not finished:
        lines.append(f"  continue with      -i {folder.path}")
    return "\n".join(lines)
