"""The package uses the public names of its libraries alone, as its syntax trees show."""

import ast
import functools
import pkgutil
import re
from pathlib import Path

import pytest

import sb3_guard

ROOT = Path(sb3_guard.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
LIBRARIES = ("optuna", "rl_zoo3", "distributed", "dask", "mujoco")
PRIVATE = re.compile(r"_[a-zA-Z]\w*")
# Attributes that the package does not define itself, by whose they are.
ALLOWED = {
    "Stable-Baselines3's hooks for subclasses and their state": {
        "_current_progress_remaining", "_get_indices",
        "_last_episode_starts", "_last_obs", "_on_event", "_reset_options", "_reset_seeds",
        "_stats_window_size", "_total_timesteps", "_update_features_extractor",
        "_update_learning_rate", "_vec_normalize_env", "_wrap_env",
    },
    "steps before `learn`: SB3 has no other way to log the speed of a resumed run": {
        "_num_timesteps_at_start",
    },
    "the seeds of a VecEnv: its `seed` knows only seed, seed + 1, …": {"_seeds"},
    "the options of the next reset: SB3's own subclasses read them so": {"_options"},
    "Gymnasium's hook for vector environments": {"_add_info"},
    "documented in Python": {"_exit", "_replace"},
}  # fmt: skip
# MuJoCo's Renderer takes no backend, and MuJoCo chooses one before it is known whether it works.
# Python calls the second for every warning that it shows: a command has a process of its own.
PATCHED = {"mujoco.rendering.classic.gl_context.GLContext", "warnings.formatwarning"}


def private(name: str) -> bool:
    return PRIVATE.fullmatch(name) is not None


@functools.cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@functools.cache
def defined() -> set[str]:
    """Private names that the package defines: functions, classes, variables, own attributes."""
    names = set()
    for path in FILES:
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                names.add(node.id)
            elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
                if ast.unparse(node.value) in ("self", "cls"):
                    names.add(node.attr)
    return {name for name in names if private(name)}


def imports(module: ast.Module) -> dict[str, str]:
    """Names that a module imports from outside the package, and what they stand for."""
    names = {}
    for node in ast.walk(module):
        if isinstance(node, ast.ImportFrom):
            names |= {each.asname or each.name: f"{node.module}.{each.name}" for each in node.names}
        elif isinstance(node, ast.Import):
            for alias in node.names:
                top = alias.name.partition(".")[0]
                names[alias.asname or top] = alias.name if alias.asname else top
    return {name: path for name, path in names.items() if not path.startswith("sb3_guard")}


def offences(module: ast.Module) -> list[str]:
    allowed = defined().union(*ALLOWED.values())
    imported = imports(module)
    found = []

    def path(node: ast.expr) -> str:
        """``optuna.storages.X`` for ``storages.X``; empty: it is of nothing imported."""
        first, *others = ast.unparse(node).split(".")
        return ".".join([imported[first], *others]) if first in imported else ""

    for node in ast.walk(module):
        if isinstance(node, ast.ImportFrom | ast.Import):
            names = [*(getattr(node, "module", None) or "").split(".")]
            names += [part for alias in node.names for part in alias.name.split(".")]
            if names[0] in LIBRARIES or any(n.name.split(".")[0] in LIBRARIES for n in node.names):
                found += [f"imports {name}" for name in names if private(name)]
        elif isinstance(node, ast.Attribute):
            of_library = path(node).split(".")[0] in LIBRARIES
            if private(node.attr) and (node.attr not in allowed or of_library):
                found.append(f"uses {ast.unparse(node)}")
            if isinstance(node.ctx, ast.Store) and path(node) not in {"", *PATCHED}:
                found.append(f"patches {ast.unparse(node)}")
        elif isinstance(node, ast.ClassDef):
            bases = [path(base) for base in node.bases]
            bases = [pkgutil.resolve_name(b) for b in bases if b.split(".")[0] in LIBRARIES]
            methods = [part.name for part in node.body if isinstance(part, ast.FunctionDef)]
            found += [
                f"overrides {node.name}.{name}"
                for name in methods
                if private(name) and any(hasattr(base, name) for base in bases)
            ]
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("getattr", "setattr"):
            name = node.args[1]
            if isinstance(name, ast.Constant) and private(str(name.value)):
                if name.value not in allowed:
                    found.append(f"uses {ast.unparse(node)}")
            elif path(node.args[0]) and node.func.id == "setattr":
                found.append(f"patches {ast.unparse(node)}")
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_private_name_of_a_library(path):
    assert offences(tree(path)) == []


@pytest.mark.parametrize(
    "code",
    [
        "from optuna.storages._heartbeat import BaseHeartbeat",
        "study._storage.get_trial(trial.number)",
        "getattr(trial, '_trial_id')",
        "import optuna\nsetattr(optuna.Study, name, patched)",
        "model._num_timesteps = 1",
        "import optuna\noptuna.Study.ask = ask",
        "import optuna.storages as o\nclass S(o.RDBStorage):\n    def _create_new_trial(self): ...",
    ],
)
def test_such_names_are_noticed(code):
    assert len(offences(ast.parse(code))) >= 1


def test_own_names_may_be_stored():
    assert offences(ast.parse("import sb3_guard\nself._seeds = 1\nresult.given = set()")) == []


def test_what_is_allowed_is_used():
    used = {n.attr for p in FILES for n in ast.walk(tree(p)) if isinstance(n, ast.Attribute)}
    assert set[str]().union(*ALLOWED.values()) <= used
