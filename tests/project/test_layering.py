"""Who may know whom: the layers of the package, read from its imports."""

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

import pytest

import sb3_guard

ROOT = Path(sb3_guard.__file__).parent
MODULES = {
    ".".join(("sb3_guard", *p.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): p
    for p in ROOT.rglob("*.py")
}


@functools.cache
def imports(name: str, types: bool = False) -> set[str]:
    """What a module imports, also inside functions; type-checking blocks count with ``types``."""
    tree = ast.parse(MODULES[name].read_text())
    skip = {
        id(node)
        for block in ast.walk(tree)
        if not types and isinstance(block, ast.If) and "TYPE_CHECKING" in ast.dump(block.test)
        for node in ast.walk(block)
    }
    found = set()
    for node in ast.walk(tree):
        if id(node) in skip:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} imports relatively"
            found.add(node.module)
            found |= {f"{node.module}.{a.name}" for a in node.names}
    return found


def touches(name: str, *packages: str) -> set[str]:
    return {i for i in imports(name) if any(i == p or i.startswith(p + ".") for p in packages)}


def below(package: str) -> list[str]:
    return sorted(m for m in MODULES if m == package or m.startswith(package + "."))


def in_cycles(edges: dict[str, set[str]]) -> set[str]:
    """What is on a cycle, or between two: the rest is stripped from its ends."""
    left = dict(edges)
    while True:
        pointed = {target for targets in left.values() for target in targets}
        inner = {m: targets & left.keys() for m, targets in left.items() if m in pointed}
        inner = {m: targets for m, targets in inner.items() if targets}
        if inner == left:
            return set(left)
        left = inner


def test_modules_that_import_each_other_are_noticed():
    chain = {"a": {"b"}, "b": {"c"}, "c": set()}
    assert in_cycles(chain) == set()
    assert in_cycles({**chain, "c": {"b"}}) == {"b", "c"}


def test_no_modules_import_each_other():
    """Not even for their types. Packages, which gather names of modules, are left out."""
    edges = {
        name: {i for i in imports(name, types=True) if i in MODULES and i != name}
        for name in MODULES
        if MODULES[name].name != "__init__.py"
    }
    assert in_cycles(edges) == set()


def test_envs_know_no_learning():
    for name in below("sb3_guard.envs"):
        assert not touches(
            name, "torch", "stable_baselines3", "sb3_contrib", "rl_zoo3", "optuna", "pandas",
            "sb3_guard.algorithms", "sb3_guard.common", "sb3_guard.zoo",
        ), name  # fmt: skip


def test_algorithms_know_no_simulator():
    for name in below("sb3_guard.algorithms"):
        assert not touches(
            name, "mujoco", "rl_zoo3",
            "sb3_guard.envs", "sb3_guard.common", "sb3_guard.zoo",
        ), name  # fmt: skip


def test_no_leaf_imports_a_leaf():
    leaves = [
        m for m in below("sb3_guard.algorithms") if m.count(".") == 2 and not m.endswith(".common")
    ]
    assert "sb3_guard.algorithms.cpo" in leaves
    # Other gains, another cost, a projection, no line search.
    pairs = {"cppo_pid": "ppo_lag", "scpo": "cpo", "pcpo": "cpo", "rcpo": "trpo_lag"}
    for leaf in leaves:
        allowed = f"sb3_guard.algorithms.{pairs.get(leaf.rpartition('.')[2])}"
        others = {other for other in leaves if other not in (leaf, allowed)}
        assert not touches(leaf, *others), leaf


def test_speed_tricks_are_known_where_they_are_chosen_alone():
    fast = "sb3_guard.algorithms.fast"
    others = [m for m in MODULES if not m.startswith(fast) and touches(m, fast)]
    assert {m.rpartition(".")[2] for m in others} == {
        "cost_critics", "critics", "first_order", "rollouts", "trust_region",
    }  # fmt: skip


@pytest.mark.parametrize("name", ["geometry", "layout", "observation", "motion", "parameters"])
def test_the_pure_modules_know_only_numpy(name):
    module = f"sb3_guard.envs.{name}"
    names = ("geometry", "layout", "observation", "parameters", "types")
    pure = {f"sb3_guard.envs.{n}" for n in names}
    ground = {"sb3_guard.errors", "sb3_guard.fields"}
    pure |= ground
    assert touches(module, "sb3_guard") <= {
        i for i in imports(module) if any(i.startswith(p) for p in pure)
    }
    assert not touches(module, "mujoco", "gymnasium")
    for floor in ground:
        assert {i for i in touches(floor, "sb3_guard") if not i.startswith(tuple(ground))} == set()
        assert not touches(floor, "mujoco", "gymnasium", "torch")


def test_parts_do_not_know_each_other_nor_the_engine():
    kinds = ("robots", "tasks", "constraints")
    for kind in kinds:
        others = [f"sb3_guard.envs.{k}" for k in kinds if k != kind]
        for module in below(f"sb3_guard.envs.{kind}"):
            assert not touches(module, "sb3_guard.envs.engine", *others), module


def test_only_the_bridge_imports_both_worlds():
    from sb3_guard.cli import COMMANDS, module_of

    commands = tuple(module_of(command) for command in COMMANDS)
    both = [
        m
        for m in MODULES
        if not m.startswith(("sb3_guard.zoo", *commands))
        and touches(m, "sb3_guard.envs")
        and touches(m, "stable_baselines3", "torch", "sb3_guard.vector")
    ]
    assert both == ["sb3_guard.common.native"]


def test_nothing_imports_the_zoo_but_the_commands():
    from sb3_guard.cli import COMMANDS, module_of

    commands = {"sb3_guard.cli", *(module_of(command) for command in COMMANDS)}
    for module in MODULES:
        if module.startswith("sb3_guard.zoo") or module in commands:
            continue
        assert not touches(module, "sb3_guard.zoo"), module


@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        (
            "from sb3_guard.algorithms import register_algorithm, CLASSES",
            ["torch", "stable_baselines3"],
        ),
        ("import sb3_guard.envs", ["torch", "stable_baselines3", "rl_zoo3", "optuna"]),
        (  # where MuJoCo is missing, too
            "import sys; sys.modules['mujoco'] = None\n"
            "from sb3_guard import CPO; import sb3_guard.algorithms",
            ["rl_zoo3", "optuna"],
        ),
    ],
)
def test_imports_stay_light(statement, absent):
    code = f"{statement}\nimport sys\nprint([m for m in {absent!r} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_every_public_name_exists():
    for name in sb3_guard.__all__:
        assert getattr(sb3_guard, name) is not None
    assert dir(sb3_guard) == sorted(sb3_guard.__all__)
    with pytest.raises(AttributeError, match="no attribute 'PPO'"):
        _ = sb3_guard.PPO


def test_a_test_has_an_empty_working_folder_of_its_own():
    assert list(Path.cwd().iterdir()) == []


def test_the_page_of_the_architecture_names_files_that_are_there():
    page = (ROOT.parent / "docs" / "architecture.md").read_text()
    for name in re.findall(r"`([\w/]+\.py)`", page):
        assert any(ROOT.rglob(name)) or (ROOT.parent / name).is_file(), name
