"""The documents are true: examples run, pages match the code, links lead somewhere."""

import functools
import importlib
import importlib.util
import inspect
import itertools
import re
import sys
from pathlib import Path

import gymnasium
import pytest

import sb3_guard
from sb3_guard.cli import COMMANDS, module_of

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [path for path in sorted(DOCS.rglob("*.md")) if "_build" not in path.parts]
DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted(ROOT.glob("lab/*.md")), *PAGES]
# Of the page of an algorithm; some have "With a limit of 0" before the last one.
SECTIONS = [
    "When to use it", "Example", "Parameters", "Logs", "Mathematics",
    "Where implementations differ",
]  # fmt: skip
SAMPLED = (
    "quickstart", "several_costs", "keeping_a_limit", "evaluating", "trust", "writing_an_algorithm",
)  # fmt: skip
GUIDES = [
    ROOT / "README.md",
    *(DOCS / f"{name}.md" for name in SAMPLED),
    *sorted((DOCS / "algorithms").glob("*.md")),
]
RESULTS = (DOCS / "results.md").read_text()
KINDS = ("cpo", "ppo_lag", "sac_lag", "trpo_usl")  # whose samples run every time
# The samples as written, but for the length of the training.
SHORTER = {
    r"(\.learn\(|total_timesteps=)[\d_]+": r"\g<1>40",
    r"n_steps=1000": "n_steps=20",
    r"n_envs=\d+": "n_envs=2",
    # Off-policy, n_steps are those of a return.
    r"(make_model\(\"(?!sac|td3|tqc)[^()]*?),?\s*\)": r"\g<1>, n_envs=2, n_steps=20)",
    r"n_eval_episodes=\d+": "n_eval_episodes=2",
    r"(certify|DeliveryCallback)\((.*?)cost_limit=": r"\1(\2n_episodes=100, cost_limit=",
    r"progress_bar=True": "progress_bar=False",
}


@functools.cache
def script(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:  # one may import another
        patch.setattr(sys, "path", [*sys.path, str(ROOT / "scripts")])
        spec.loader.exec_module(module)
    return module


@functools.cache
def generated_pages():
    return script("make_docs").pages()


def python_blocks(document):
    return re.findall(r"```python\n(.*?)```", document.read_text(), flags=re.DOTALL)


def prose(document):
    return re.sub(r"```.*?```", "", document.read_text(), flags=re.DOTALL)


@functools.cache
def anchors(document):
    """What GitHub and the site call the headings of a document."""
    headings = re.findall(r"^#+ (.*)$", prose(document), flags=re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.strip().replace(" ", "-") for heading in plain}


@pytest.mark.parametrize(
    "guide",
    [
        pytest.param(
            g, marks=[pytest.mark.slow] * (g.parent.name == "algorithms" and g.stem not in KINDS)
        )
        for g in GUIDES
    ],
    ids=lambda path: path.stem,
)
def test_the_guides_samples_run_in_order(guide, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for env_id in ("Goal_Point_8Hazards-v0", "SafetyPointGoal1-v0"):
        monkeypatch.setattr(gymnasium.registry[env_id], "max_episode_steps", 20)
    monkeypatch.setattr("sb3_guard.algorithms.ALGORITHMS", dict(sb3_guard.ALGORITHMS))
    blocks = python_blocks(guide)
    assert blocks
    names = {"gymnasium": gymnasium}
    for block in blocks:
        for long, short in SHORTER.items():
            block = re.sub(long, short, block)
        exec(compile(block, guide.name, "exec"), names)


def stated_defaults(page):
    """The rows of a page's tables of parameters: {name: default, or the class that has it}."""
    stated = {}
    header = r"^\| parameter \| default \|.*\n\|.*\n"
    for table in re.findall(rf"{header}((?:\|.*\n)+)", page, re.MULTILINE):
        for row in table.splitlines():
            names, default, meaning = row.strip("| ").split(" | ", 2)
            names = re.findall(r"`(\w+)`", names)
            if default == "SB3's":
                base = re.search(r"SB3(?:-contrib)?'s (\w+)", meaning)[1]
                values = [sb3_class(base)] * len(names)
            elif default.startswith("as for"):
                values = [sb3_guard.ALGORITHMS[default.split("`")[1].lower()]] * len(names)
            else:
                values = eval(f"[{default}]")
            stated |= dict(zip(names, values, strict=True))
    return stated


def sb3_class(name):
    package = "sb3_contrib" if name == "TQC" else "stable_baselines3"
    return getattr(importlib.import_module(package), name)


@functools.cache
def defaults(cls):
    return {name: p.default for name, p in inspect.signature(cls).parameters.items()}


@pytest.mark.parametrize("key", sb3_guard.ALGORITHMS)
def test_pages_of_algorithms_have_the_same_sections(key):
    headings = re.findall(
        r"^## (.*)", (DOCS / "algorithms" / f"{key}.md").read_text(), re.MULTILINE
    )
    shared = [heading for heading in headings if heading != "With a limit of 0"]
    assert shared == SECTIONS


# The section of algorithms.md whose parameters the algorithms with this argument have.
SHARED = {
    "Parameters of every algorithm": "cg_damping",
    "Parameters of multipliers": "lambda_units",
    "Parameters of first-order algorithms": "n_epochs",
}


@pytest.mark.parametrize("key", sb3_guard.ALGORITHMS)
def test_tables_of_parameters_have_the_defaults_of_the_classes(key):
    cls = sb3_guard.ALGORITHMS[key]
    stated = {}
    for section in re.split(r"^##+ ", (DOCS / "algorithms.md").read_text(), flags=re.MULTILINE):
        title, _, text = section.partition("\n")
        if title in SHARED:
            every = stated_defaults(text)
            assert SHARED[title] in every
            if SHARED[title] in defaults(cls):
                stated |= {name: every[name] for name in every if name in defaults(cls)}
    # A row of the algorithm's own page comes first.
    stated |= stated_defaults((DOCS / "algorithms" / f"{key}.md").read_text())
    assert stated
    for name, value in stated.items():
        value = defaults(value)[name] if isinstance(value, type) else value
        assert defaults(cls)[name] == value, name


def test_the_page_of_logs_has_every_key_that_an_algorithm_records():
    code = [path.read_text() for path in (ROOT / "sb3_guard" / "algorithms").rglob("*.py")]
    record = r"record(?:_per_cost)?\(\s*\"((?:train|rollout)/\w+)\""
    keys = {key for text in code for key in re.findall(record, text)}
    keys -= {"train/n_updates"}  # SB3's own
    assert {"train/cost_weight", "train/cost_margin", "train/multiplier_std"} <= keys
    page = (DOCS / "logging.md").read_text()
    assert not {key for key in keys if f"`{key}`" not in page}


@pytest.mark.parametrize("path", sorted(generated_pages()))
def test_generated_pages_match_the_code(path):
    assert (DOCS / path).read_text() == generated_pages()[path], "run `python scripts/make_docs.py`"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(document):
    for target, anchor in re.findall(r"\]\(([^)#\s]*)#?([^)\s]*)\)", prose(document)):
        if target.startswith(("http://", "https://")):
            continue
        file = document.parent / target if target else document
        assert file.exists(), f"{document.name} links to {target}"
        if anchor:
            assert anchor in anchors(file.resolve()), f"{document.name} links to {target}#{anchor}"


def test_what_a_page_includes_is_there():
    for page in DOCS.glob("**/*.md"):
        for path, options in re.findall(r"```\{include\} (\S+)\n(.*?)```", page.read_text(), re.S):
            text = (page.parent / path).read_text()
            for mark in re.findall(r":(?:start-after|end-before): \"?(.*?)\"?\n", options):
                assert mark in text, f"{page}: {mark}"


def test_every_page_is_in_the_contents():
    listed = {"index"}
    for page in PAGES:
        for tree in re.findall(r"```{toctree}\n(.*?)```", page.read_text(), flags=re.DOTALL):
            names = [line for line in tree.split() if not line.startswith(":")]
            folder = page.parent.relative_to(DOCS)
            listed |= {(folder / name).as_posix() for name in names}
    names = {page.relative_to(DOCS).with_suffix("").as_posix() for page in PAGES}
    assert listed >= names


def test_every_public_name_is_in_the_api_reference():
    text = (DOCS / "api" / "index.md").read_text()
    missing = [name for name in sb3_guard.__all__ if f"`{name}`" not in text]
    assert missing == ["__version__"]
    rows = re.findall(r"^\| `(sb3_guard[\w.]+)` \| ([^|]*) \|", text, re.MULTILINE)
    assert dict(rows).keys() >= {"sb3_guard.algorithms", "sb3_guard.envs.part"}
    for module, names in rows:
        for name in re.findall(r"`(\w+)`", names):
            assert hasattr(importlib.import_module(module), name), f"{module}.{name}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_named_in_the_pages_exist_and_take_the_flags(document):
    text = re.sub(r" *\\\n *", " ", document.read_text())
    for module in re.findall(r"python -m (sb3_guard(?:\.\w+)+)", text):
        assert importlib.util.find_spec(module), module
    for name, flags in re.findall(r"\bsb3-guard (\w+)\b(?!\|)([^`\n|#]*)", text):
        assert name in COMMANDS, name
        parser = importlib.import_module(module_of(name)).Flags.parser()
        for flag in re.findall(r"(?<= )--?[a-z][-a-z]*", flags):
            assert flag in parser._option_string_actions, f"{name} {flag}"


def test_scripts_exist_where_they_are_named_and_each_is_named_somewhere():
    code = [path for part in ("sb3_guard", "examples", "scripts", "tests")
            for path in (ROOT / part).rglob("*.py")]  # fmt: skip
    guides = [*{*DOCUMENTS} - {ROOT / "CHANGELOG.md"}, ROOT / "Makefile"]
    named = {
        path: set(re.findall(r"\bscripts/[\w/]+\.py", path.read_text())) for path in guides + code
    }
    for path, scripts in named.items():
        assert not {name for name in scripts if not (ROOT / name).exists()}, path
    scripts = {path.relative_to(ROOT).as_posix() for path in (ROOT / "scripts").rglob("*.py")}
    assert scripts <= set().union(*(named[path] for path in guides))


@pytest.mark.parametrize(
    "name", [pytest.param("grand_table", marks=pytest.mark.slow), "guard_limit2", "guard_limit5"]
)
def test_words_in_figures_lie_on_no_marker_and_not_on_each_other(name):
    drawn = [*script("results").figures("".join(re.findall(rf"images/{name}_pareto\S+", RESULTS)))]
    assert drawn
    for file, figure in drawn:
        figure.draw_without_rendering()
        (axis,), (legend,) = figure.axes, figure.legends
        texts = [*legend.get_texts(), axis.title, axis.xaxis.label, axis.yaxis.label]
        for side in (axis.xaxis, axis.yaxis):
            low, high = sorted(side.get_view_interval())
            ticks = zip(side.get_ticklocs(), side.get_ticklabels(), strict=True)
            texts += [text for place, text in ticks if low <= place <= high]
        boxes = {text: text.get_window_extent() for text in texts}
        for (one, box), (other, its) in itertools.combinations(boxes.items(), 2):
            assert not box.overlaps(its), f"{file}: {one}, {other}"
        for text, box in boxes.items():
            assert not box.overlaps(axis.get_window_extent()), f"{file}: {text} is among markers"
            assert figure.bbox.padded(1).fully_containsx(box.x0), f"{file}: {text} is cut"
            assert figure.bbox.padded(1).fully_containsx(box.x1), f"{file}: {text} is cut"


def test_files_of_the_repository_that_pages_name_exist():
    """Paths from its root, and tests by their names; contributors write others by recipes."""
    folders = "docs|examples|hyperparams|scripts|sb3_guard|tests"
    for page in [ROOT / "README.md", *PAGES]:
        text = page.read_text()
        paths = set(re.findall(rf"\b(?:{folders})/[\w/-]+\.(?:py|yml)\b", text))
        assert not {path for path in paths if not (ROOT / path).is_file()}, page
        tests = set(re.findall(r"`(test_\w+\.py)`", text))
        assert not {name for name in tests if not any((ROOT / "tests").rglob(name))}, page


@pytest.mark.slow
def test_tables_of_results_are_made_of_their_logs():
    for path, text in script("results").pages().items():
        assert path.read_text() == text, "run `python scripts/results.py`"
    for path, text in script("known_optima").pages().items():
        assert path.read_text() == text, "run `python scripts/known_optima.py --seeds`"
