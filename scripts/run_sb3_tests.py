"""Run the tests of Stable-Baselines3 and sb3-contrib with our algorithms in place of theirs.

``python scripts/run_sb3_tests.py`` fetches the two source distributions of the installed versions
into a temporary folder and runs every test module that trains an algorithm like ours, once for each
of our classes: trust regions stand where the module says ``A2C``, ``PPO`` or ``TRPO``, first-order
ones for ``PPO``, off-policy ones for ``SAC``, ``TD3`` or ``TQC``. It prints what
passed per module and class, and for every test that failed whether that is ours or does not apply,
and why (``DOES_NOT_APPLY``); it fails if one is ours. ``--source DIR`` takes distributions that are
unpacked there already.

Their environments report no cost: here every third step costs 1, against a limit that some of them
keep and some break. The tests of actions other than a Box are skipped for the safety layers.
"""

from __future__ import annotations

import argparse
import fnmatch
import importlib.metadata
import importlib.util
import inspect
import itertools
import json
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read by torch's import

import pytest
import sb3_contrib
import stable_baselines3
from gymnasium.error import DependencyNotInstalled
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_guard.algorithms import (
    ALGORITHMS,
    FirstOrder,
    PPOLag,
    SACLag,
    TD3Lag,
    TQCLag,
    TrustRegion,
)
from sb3_guard.algorithms.common.filtering import FilteredTrustRegion
from sb3_guard.algorithms.common.policies import FilteredPolicy

PACKAGES = {"sb3": "stable_baselines3", "contrib": "sb3_contrib"}
# The classes that ours stand in for, with what they are made with where a test says nothing: as
# theirs, except that A2C's 5 steps per update are few for a trust-region step.
A2C = {"n_steps": 16, "normalize_advantage": False}
REPLACED: dict[type, dict[str, dict[str, dict[str, Any]]]] = {
    TrustRegion: {"sb3": {"A2C": A2C, "PPO": {}}, "contrib": {"TRPO": {}}},
    FirstOrder: {"sb3": {"PPO": {}}, "contrib": {}},
    PPOLag: {"sb3": {"PPO": {}}, "contrib": {}},
    SACLag: {"sb3": {"SAC": {}}, "contrib": {}},
    TD3Lag: {"sb3": {"TD3": {}}, "contrib": {}},
    TQCLag: {"sb3": {}, "contrib": {"TQC": {}}},
}
# What their classes take and ours have no use for, beside ``fixed_arguments``.
THEIR_ARGUMENTS = {"n_epochs", "sub_sampling_factor"}
OUR_ARGUMENTS = {"cost_limit": 50.0, "n_critic_updates": 20}
# Their costs are noise: as in hyperparams/trpo_ipo.yml, lest they weigh ten times the reward.
OF_CLASS: dict[str, dict[str, Any]] = {"TRPOIPO": {"max_multiplier": 0.5}}
# Of images nothing is learnt in these tests, and each pass over a rollout of them takes long.
OF_IMAGES = {"n_critic_updates": 2, "cg_max_steps": 3}
CLASSES = {cls.__name__: cls for cls in ALGORITHMS.values()}

#: Why a test that fails says nothing about our classes: pattern of "package/module::test" or
#: "package/module::test with class", and the reason
DOES_NOT_APPLY: dict[str, str] = {
    "sb3/test_buffers::test_custom_rollout_buffer": "asks for SB3's RolloutBuffer; ours holds "
    "costs as well, and says so when it is given another",
    "sb3/test_gae::test_gae_computation[*-0.9-*": "its advantages agree; as critic targets it "
    "expects λ-returns, ours are discounted returns",
    "sb3/test_gae::test_gae_computation[*-1.0-1.0-PPO] with CUP": "CUP weighs costs by what has no "
    "bound at a discount factor of 1; it says so",
    "sb3/test_her::*": "hindsight needs a buffer of its own; ours holds costs, and says so",
    "sb3/test_vec_normalize::test_her_*": "as sb3/test_her",
    "sb3/test_n_step_replay::*": "costs are replayed by step: n_steps must be 1, and it says so",
    "sb3/test_spaces::test_action_spaces[CartPole-v1-*": "wants an AssertionError; ours is a "
    "ValueError that names algorithms for such actions",
    "sb3/test_identity::test_continuous[PPO]": "wants the task solved in 4 updates, of KL <= 0.02 "
    "here and with costs that are noise: some get there, some do not",
    "sb3/test_logger::test_fps_logger[A2C]": "asks for 100 steps a second, updates included, which "
    "a trust-region step every 16 steps does not reach on a busy machine",
    "sb3/test_identity::test_continuous[A2C] with TRPOSL": "where costs are noise the layer "
    "corrects at random, and the reward is for exact actions",
    "sb3/test_train_eval_mode::test_a2c_ppo_train_with_batch_norm[*": "wants the statistics of the "
    "actor's batch normalisation to move while training, which would move the policy outside the "
    "trust region; ours keep them, and say so",
    "sb3/test_run::test_ppo[*": "clip_range_vf is PPO's",
    "sb3/test_run::test_ppo_warnings": "AssertionErrors and advice that are PPO's; ours refuses "
    "one step per update by a ValueError",
    "contrib/test_utils::test_trpo_warnings": "an AssertionError and a warning that are TRPO's; "
    "ours refuses one step per update by a ValueError and has no remainder of a minibatch",
    "sb3/test_save_load::test_save_load_backward_compatible*": "clip_range is PPO's",
    "sb3/test_save_load::test_save_load_clip_range_portable*": "clip_range is PPO's",
}


# In the process of a module


_made = False  # whether the test under way has made one of our models


def stand_in(cls: type, name: str, defaults: dict[str, Any]) -> type:
    """One of our classes that takes the arguments of theirs, on environments without costs."""
    filtered = issubclass(cls, FilteredTrustRegion)
    taken = inspect.signature(cls).parameters

    class StandIn(cls):  # type: ignore[misc, valid-type]
        def __new__(own, *args: Any, **kwargs: Any) -> Any:  # theirs are taken out below
            return object.__new__(own)

        def __init__(self, policy: Any, env: Any, *args: Any, **kwargs: Any) -> None:
            global _made
            _made = True
            for argument in THEIR_ARGUMENTS | cls.fixed_arguments:
                if argument not in taken:
                    kwargs.pop(argument, None)
            small = OF_IMAGES if policy == "CnnPolicy" else {}
            own = OF_CLASS.get(cls.__name__, {})
            ours = {**OUR_ARGUMENTS, **own, **small}
            ours = {argument: value for argument, value in ours.items() if argument in taken}
            kwargs = {**ours, **defaults, **kwargs}
            if filtered and isinstance(policy, type) and not issubclass(policy, FilteredPolicy):
                policy = type(f"Filtered{policy.__name__}", (FilteredPolicy, policy), {})
            try:
                super().__init__(policy, env, *args, **kwargs)
            except ValueError as error:
                if filtered and "corrects actions of a Box" in str(error):
                    pytest.skip(str(error))
                raise

        def learn(self, *args: Any, **kwargs: Any) -> Any:
            return super().learn(*args, **{"tb_log_name": name, **kwargs})

        def _update_info_buffer(self, infos: list[dict[str, Any]], dones: Any = None) -> None:
            costs = [float((self.num_timesteps + i) % 3 == 0) for i in range(self.n_envs)]
            pairs = itertools.zip_longest(infos, costs, fillvalue={})
            super()._update_info_buffer([{"cost": cost, **info} for info, cost in pairs], dones)

    StandIn.__name__ = StandIn.__qualname__ = name
    return StandIn


def replaced_by(cls: type) -> dict[str, dict[str, dict[str, Any]]]:
    """Their classes that one of ours stands in for, by package and name, with defaults."""
    return next(theirs for base, theirs in REPLACED.items() if issubclass(cls, base))


def holds(value: Any, depth: int = 3) -> Iterator[type]:
    """The algorithm classes in a value, a parametrisation for example."""
    if isinstance(value, type) and issubclass(value, BaseAlgorithm):
        yield value
    elif depth and isinstance(value, dict):
        for pair in value.items():
            yield from holds(pair, depth - 1)
    elif depth and isinstance(value, list | tuple | set | frozenset):
        for each in value:
            yield from holds(each, depth - 1)


class Plugin:
    """Puts our class in place, leaves out what is about other algorithms, writes a report."""

    def __init__(self, name: str, report: Path) -> None:
        self.report = report
        self.ours: set[type] = set()
        for package, key in ((stable_baselines3, "sb3"), (sb3_contrib, "contrib")):
            for replaced, defaults in replaced_by(CLASSES[name])[key].items():
                ours = stand_in(CLASSES[name], replaced, defaults)
                setattr(package, replaced, ours)
                self.ours.add(ours)

    def concerns(self, item: pytest.Function) -> bool:
        """Whether a test may be about a replaced class: no other class is its parameter."""
        parameters = item.callspec.params if hasattr(item, "callspec") else {}
        named = set(holds(list(parameters.values())))
        return not named or bool(named & self.ours)

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [i for i in items if isinstance(i, pytest.Function) and self.concerns(i)]

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        global _made
        _made = False
        yield

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Iterator[None]:
        result: Any = yield
        report = result.get_result()
        if report.when != "call" and report.outcome == "passed":
            return
        outcome, why = report.outcome, str(report.longrepr or "")
        absent = (ModuleNotFoundError, DependencyNotInstalled)
        if outcome == "failed" and call.excinfo is not None and call.excinfo.errisinstance(absent):
            outcome, why = "skipped", str(call.excinfo.value)
        elif outcome == "skipped" and isinstance(report.longrepr, tuple):
            why = report.longrepr[2].removeprefix("Skipped: ")
        row = {"test": item.name, "outcome": outcome, "why": why, "ours": _made}
        with self.report.open("a") as file:
            file.write(json.dumps(row) + "\n")


# The command


def fetch(folder: Path) -> None:
    """Download and unpack the source distributions of the installed versions."""
    for package in PACKAGES.values():
        version = importlib.metadata.version(package)
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "download"]
        what = ["--no-deps", "--no-binary", ":all:", "--dest", str(folder)]
        subprocess.run([*pip, *what, f"{package}=={version}"], check=True)
        with tarfile.open(next(folder.glob(f"{package}-*.tar.gz"))) as archive:
            archive.extractall(folder, filter="data")


def place(source: Path, folder: Path) -> list[Path]:
    """Copy the tests away from the packages, so that the installed ones are tested.

    :return: their test modules
    """
    modules = []
    for key, package in PACKAGES.items():
        found = sorted(source.glob(f"{package}-*/tests"))
        if not found:
            raise SystemExit(f"error: {source} has no {package}-<version>/tests")
        tests = folder / key / "tests"
        shutil.copytree(found[-1], tests)
        shutil.copy(found[-1].parent / "pyproject.toml", folder / key)
        if importlib.util.find_spec("ale_py") is None:
            # test_utils imports it for wrappers of Atari games, in which nothing is trained.
            (tests / "ale_py.py").touch()
        modules += sorted(tests.glob("test_*.py"))
    return modules


def mentions(module: Path, name: str) -> bool:
    """Whether a module names a class that one of ours stands in for."""
    theirs = replaced_by(CLASSES[name])[module.parent.parent.name]
    return any(re.search(rf"\b{each}\b", module.read_text()) for each in theirs)


def run(module: Path, name: str, report: Path, seconds: float) -> list[dict[str, Any]]:
    """Run one module with one of our classes in place, in a process of its own.

    :return: a row per test: its name, outcome, and why it failed or was skipped
    """
    # A fork has imported torch and all the rest already, which takes longer than most modules.
    process = multiprocessing.get_context("fork").Process(target=test, args=(module, name, report))
    process.start()
    process.join(seconds)
    if process.is_alive():
        process.kill()
        process.join()
    rows = [json.loads(line) for line in report.read_text().splitlines()] if report.exists() else []
    if process.exitcode not in (0, 1, 5):  # all passed, some failed, there were none
        log = report.with_suffix(".log").read_text()
        why = f"the process ended with {process.exitcode}:\n{log[-2000:]}"
        rows.append({"test": "the module", "outcome": "failed", "why": why, "ours": True})
    return rows


def test(module: Path, name: str, report: Path) -> None:
    """What the process does."""
    with report.with_suffix(".log").open("w") as log:
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
    os.chdir(report.parent)
    root = module.parent.parent
    flags = ["-c", str(root / "pyproject.toml"), "--rootdir", str(root), "-q", "--tb=short"]
    flags += ["-p", "no:cacheprovider", "-m", "not expensive"]
    sys.exit(pytest.main([*flags, "--durations=5", str(module)], plugins=[Plugin(name, report)]))


def reason(where: str, name: str) -> str | None:
    """Why a failing test does not apply to a class, or None."""
    for pattern, why in DOES_NOT_APPLY.items():
        pattern = pattern.replace("[", "[[]")
        if any(fnmatch.fnmatchcase(each, pattern) for each in (where, f"{where} with {name}")):
            return why
    return None


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--source", type=Path, help="a folder with the unpacked distributions")
    parser.add_argument("--classes", nargs="+", choices=CLASSES, default=list(CLASSES))
    parser.add_argument("--modules", nargs="+", metavar="GLOB", help="such as sb3/test_run")
    parser.add_argument("--timeout", type=float, default=900.0, help="seconds per module and class")
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        source = args.source
        if source is None:
            source = folder / "source"
            source.mkdir()
            fetch(source)
        modules = place(source, folder)
        return table(modules, args, folder)


def table(modules: Sequence[Path], args: argparse.Namespace, folder: Path) -> int:
    """Run everything and print the table, then what failed; the exit status."""
    failures: list[tuple[str, str, str, str | None]] = []
    skips: Counter[tuple[str, str]] = Counter()
    total: Counter[str] = Counter()
    print(f"| module | {' | '.join(args.classes)} |\n|---|{'---|' * len(args.classes)}", flush=True)
    start = time.perf_counter()
    for module in modules:
        key = f"{module.parent.parent.name}/{module.stem}"
        if args.modules and not any(fnmatch.fnmatchcase(key, each) for each in args.modules):
            continue
        if not any(mentions(module, name) for name in args.classes):
            continue
        cells = []
        for name in args.classes:
            report = folder / f"{key.replace('/', '-')}-{name}.jsonl"
            rows = run(module, name, report, args.timeout) if mentions(module, name) else []
            counts: Counter[str] = Counter()
            for row in rows:
                where, outcome = f"{key}::{row['test']}", row["outcome"]
                if not row["ours"]:
                    continue  # it made no model of ours: nothing of it is about us
                if outcome == "failed":
                    why = reason(where, name)
                    failures.append((where, name, row["why"], why))
                    outcome = "n/a" if why else "failed"
                elif outcome == "skipped":
                    skips[where.partition("[")[0], row["why"]] += 1
                counts[outcome] += 1
            total.update(counts)
            cells.append(" / ".join(str(counts[o]) for o in ("passed", "failed", "skipped", "n/a")))
        print(f"| {key} | {' | '.join(cells)} |", flush=True)
    print("\nEach cell: passed / failed / skipped / does not apply.")
    for where, name, error, why in failures:
        if why is None:
            print(f"\nFAILED {where} with {name}\n{error}")
    print("\nDoes not apply:")
    grouped: dict[tuple[str, str], list[str]] = {}
    for where, name, _, why in failures:
        if why is not None:
            grouped.setdefault((where, why), []).append(name)
    for (where, why), names in grouped.items():
        every = len(names) == len(args.classes)
        print(f"* {where} ({'all' if every else ', '.join(names)}): {why}")
    print("\nSkipped:")
    for (where, why), count in skips.items():
        print(f"* {where} ({count}): {why}")
    seconds = time.perf_counter() - start
    print(
        f"\n{total['passed']} passed, {total['failed']} failed, {total['skipped']} skipped, "
        f"{total['n/a']} do not apply ({seconds / 60:.0f} minutes)"
    )
    return int(total["failed"] > 0)


if __name__ == "__main__":
    sys.exit(main())
