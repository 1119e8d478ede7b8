"""The package uses the public names of its libraries alone, as its syntax trees show."""

import ast
import functools
import importlib
import re
from pathlib import Path
from typing import Any

import pytest

import sb3_guard

ROOT = Path(sb3_guard.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
LIBRARIES = ("optuna", "rl_zoo3", "distributed", "dask", "mujoco")
PRIVATE = re.compile(r"_[a-zA-Z]\w*")
# Attributes that the package does not define itself, by whose they are.
ALLOWED = {
    "Stable-Baselines3's hooks for subclasses and their state": {
        "_convert_train_freq", "_current_progress_remaining", "_get_indices",
        "_last_episode_starts", "_on_event", "_reset_options", "_reset_seeds",
        "_stats_window_size", "_total_timesteps", "_update_features_extractor",
        "_update_learning_rate", "_vec_normalize_env", "_wrap_env",
    },
    "Gymnasium's hook for vector environments": {"_add_info"},
    "documented in Python": {"_asdict", "_exit", "_replace"},
}  # fmt: skip


def private(name: str) -> bool:
    return PRIVATE.fullmatch(name) is not None


@functools.cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@functools.cache
def defined() -> set[str]:
    """Private names that the package defines: functions, classes, variables, attributes."""
    names = set()
    for path in FILES:
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(node.name)
            elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
                names.add(node.id if isinstance(node, ast.Name) else node.attr)
    return {name for name in names if private(name)}


def of_libraries(module: ast.Module) -> dict[str, Any]:
    """What a module has imported from the libraries, by the name that it has there."""
    names = {}
    for node in ast.walk(module):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in LIBRARIES:
            for alias in node.names:
                library = importlib.import_module(str(node.module))
                names[alias.asname or alias.name] = getattr(library, alias.name, None)
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] in LIBRARIES:
                    names[alias.asname or alias.name] = importlib.import_module(alias.name)
    return names


def root(node: ast.expr) -> str:
    """The first name of ``a.b.c``."""
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def offences(module: ast.Module) -> list[str]:
    allowed = defined().union(*ALLOWED.values())
    imported = of_libraries(module)
    found = []
    for node in ast.walk(module):
        if isinstance(node, ast.ImportFrom | ast.Import):
            names = [*(getattr(node, "module", None) or "").split(".")]
            names += [part for alias in node.names for part in alias.name.split(".")]
            if names[0] in LIBRARIES or any(n.name.split(".")[0] in LIBRARIES for n in node.names):
                found += [f"imports {name}" for name in names if private(name)]
        elif isinstance(node, ast.Attribute) and private(node.attr):
            if node.attr not in allowed or root(node) in imported:
                found.append(f"uses {ast.unparse(node)}")
        elif isinstance(node, ast.ClassDef):
            bases = [imported.get(root(base)) for base in node.bases]
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
            elif root(node.args[0]) in imported and node.func.id == "setattr":
                found.append(f"patches {ast.unparse(node)}")
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_private_name_of_a_library(path):
    assert offences(tree(path)) == []


@pytest.mark.parametrize(
    "code",
    [
        "from optuna.storages._heartbeat import BaseHeartbeat",
        "import optuna.storages._rdb",
        "study._storage.get_trial(trial.number)",
        "optuna.storages.RDBStorage._get_trials",
        "getattr(trial, '_trial_id')",
        "import optuna\nsetattr(optuna.Study, name, patched)",
        "from optuna import Study\nclass Mine(Study):\n    def _log_completed_trial(self): ...",
        "import mujoco\nmujoco._structs",
    ],
)
def test_such_names_are_noticed(code):
    assert len(offences(ast.parse(code))) >= 1


def test_what_is_allowed_is_used():
    used = {n.attr for p in FILES for n in ast.walk(tree(p)) if isinstance(n, ast.Attribute)}
    assert set[str]().union(*ALLOWED.values()) <= used
