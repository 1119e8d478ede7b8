"""Figures, the page about runs, and the command that makes them."""

import re
import subprocess
import sys
import xml.etree.ElementTree as ET

import matplotlib.image
import numpy as np
import pandas as pd
import pytest
from fake_runs import LABELS, fake_run
from matplotlib.colors import to_rgb

from sb3_guard import cli, plot
from sb3_guard.algorithms import CLASSES
from sb3_guard.zoo.grids.presets import ALGOS, OPTIONS, RADAR4, ROBOTS
from sb3_guard.zoo.results import figures
from sb3_guard.zoo.results.figure_data import COLORS, INK, MARKS, Data
from sb3_guard.zoo.results.figures import FIGURES, draw, save
from sb3_guard.zoo.results.runs import read_results, select
from sb3_guard.zoo.results.tables import tables

EFFECTS = dict(zip(ALGOS, (1.0, 0.5, 0.6, 0.4, 0.7, 0.9, 0.8, 1.5), strict=True))
POINT = "Goal_Point_8Hazards"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """The paper's 45 suites, eight algorithms; two seeds on the first suite, one elsewhere."""
    folder = tmp_path_factory.mktemp("runs")
    for algo, effect in EFFECTS.items():
        for seed in (0, 1):
            fake_run(folder, algo, seed=seed, returns=10 * min(effect, 1) + seed, cost=4 * effect,
                     epochs=3)  # fmt: skip
    runs = read_results([folder]).runs
    one = runs[runs["seed"] == 0]
    suites = [option.format(robot) for option in OPTIONS.values() for robot in ROBOTS]
    return Data(pd.concat([runs, *(one.assign(suite=suite) for suite in suites if suite != POINT)]))


@pytest.fixture
def small(tmp_path):
    """One suite, three algorithms, two seeds."""
    for algo in ("trpo", "cpo", "ppo"):
        for seed in (0, 1):
            fake_run(tmp_path / "logs", algo, seed=seed, returns=10 * EFFECTS.get(algo, 1.0),
                     cost=4 * EFFECTS.get(algo, 1.0), seconds=60.0, commit="f" * 40)  # fmt: skip
    return tmp_path / "logs"


PER_SUITE = ("curves", "pareto")


def read(folder) -> Data:
    return Data(select(read_results([folder]).runs))


def lines(axis) -> dict[str, np.ndarray]:
    return {line.get_label(): np.asarray(line.get_ydata(), float) for line in axis.get_lines()}


# What is drawn


def test_curves_are_means_of_seeds_with_bands(data):
    (drawing,) = draw("q1", data).values()
    assert len(drawing.axes) == 24
    axis = drawing.axes[0]
    names = {LABELS[algo][0] for algo in ALGOS}
    assert axis.get_ylabel() == "return" and names <= set(lines(axis))
    # seeds reach 5 and 6 in three equal steps
    assert lines(axis)["CPO"] == pytest.approx([11 / 6, 11 / 3, 5.5])
    assert len(axis.collections) == 8
    assert len(drawing.axes[3].collections) == 0  # one seed has no band
    assert "cost limit, 0" in lines(drawing.axes[1])


def test_q2_shows_trpos_costs_and_the_slopes(data):
    (drawing,) = draw("q2", data).values()
    bars, cost = drawing.axes
    assert [bar.get_height() for bar in bars.patches] == pytest.approx([4.0] * 2 * len(ROBOTS))
    # Hazards have two seeds, Ghosts one.
    assert lines(cost)["TRPO-USL"] == pytest.approx([1.5, 1.5])


def test_q3_has_a_line_per_family_and_trpos_at_1(data):
    (drawing,) = draw("q3", data).values()
    reward, cost, rate = map(lines, drawing.axes)
    assert set(reward) == {"TRPO", "Lagrangian", "CPO-based", "hierarchical"}
    assert (reward["TRPO"] == 1).all() and [*cost] == [*rate]
    assert cost["Lagrangian"] == pytest.approx([(0.4 + 0.7 + 0.9) / 3] * len(RADAR4))


@pytest.mark.parametrize(
    ("kind", "shown"),
    [("q4", {"Lagrangian", "CPO-based", "hierarchical"}), ("q5", {"TRPO-Lagrangian", "TRPO-FAC"}),
     ("q6", {"CPO", "PCPO"}), ("q7", {"TRPO-USL", "TRPO-SL"})],
)  # fmt: skip
def test_q4_to_q7_go_by_degrees_of_freedom(kind, shown, data):
    (drawing,) = draw(kind, data).values()
    for axis in drawing.axes:
        assert set(lines(axis)) == shown | {"TRPO"}
        ticks = [tick.get_text() for tick in axis.get_xticklabels()]
        assert ticks == [f"{robot}\n{number}" for robot, number in ROBOTS.items()]


def test_pareto_names_the_points_and_shades_the_infeasible_side(small):
    found = read(small)
    (drawing,) = draw("pareto", found).values()
    (axis,) = drawing.axes
    assert [*draw("pareto", found)] == [f"pareto_{POINT}"] and "cost limit, 0" in lines(axis)
    labels = {found.looks[algo].label for algo in found.runs["algo"]}
    assert labels < {text.get_text() for text in drawing.legends[0].get_texts()}
    assert axis.get_title() == f"{POINT}: 2 seeds, 600 steps"
    (shade,) = axis.patches
    assert shade.get_x() == 0.0 and shade.get_width() == axis.get_xlim()[1]


def test_costs_below_0_are_shown(tmp_path):
    """At least so much of something is a negative limit."""
    fake_run(tmp_path, "cpo", cost=-40.0, cost_limit=-30.0)
    data = read(tmp_path)
    for kind, way in (("curves", "y"), ("pareto", "x")):
        (drawing,) = draw(kind, data).values()
        axes = [axis for axis in drawing.axes if "cost" in getattr(axis, f"get_{way}label")()]
        low, high = getattr(axes[0], f"get_{way}lim")()
        assert low < -40 < -30 < high <= 0.1 * (high - low)


def test_the_cost_axis_ends_near_the_limit(tmp_path):
    """An agent that ignores costs does not squash those that keep the limit."""
    fake_run(tmp_path, "trpo", cost=1000.0)
    fake_run(tmp_path, "cpo", cost=4.0, cost_limit=5.0)
    for kind, way in (("curves", "y"), ("pareto", "x")):
        (drawing,) = draw(kind, read(tmp_path)).values()
        axes = [axis for axis in drawing.axes if "cost" in getattr(axis, f"get_{way}label")()]
        assert getattr(axes[0], f"get_{way}lim")() == (0, 25)
        (beyond,) = axes[0].texts  # an arrow to the edge, with the number
        place = dict(zip("xy", beyond.xy, strict=True))
        assert beyond.get_text() == "1,000" and place[way] == 25


# What is missing


def test_without_trpo_there_is_nothing_to_compare_with(tmp_path):
    fake_run(tmp_path, "cpo")
    found = read(tmp_path)
    assert not any(draw(kind, found) for kind in set(FIGURES) - {*PER_SUITE, "q1"})


def test_a_gap_stays_a_gap(data):
    runs = data.runs
    lost = (runs["algo"] == "pcpo") & (runs["suite"] == "Goal_Arm3_8Hazards")
    (q6,) = draw("q6", Data(runs[~lost])).values()
    assert np.isnan(lines(q6.axes[0])["PCPO"]).tolist() == [n == "Arm3" for n in ROBOTS]


# How it looks


def contrast(color, page) -> float:
    """Of a colour on a page, as the WCAG defines it."""

    def luminance(rgb):
        part = np.array(rgb)
        part = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
        return part @ [0.2126, 0.7152, 0.0722]

    one, other = sorted((luminance(to_rgb(color)), luminance(to_rgb(page))))
    return (other + 0.05) / (one + 0.05)


def test_colours_are_readable_on_white_and_in_the_dark():
    for color in (INK, *COLORS):
        for page in ("#ffffff", "#131416"):
            assert contrast(color, page) > (4 if color == INK else 2.8), (color, page)


def test_no_two_algorithms_look_alike_and_ones_own_has_a_name(tmp_path):
    for algo in LABELS:
        fake_run(tmp_path, algo)
    looks = read(tmp_path).looks
    own = [looks[algo] for algo in LABELS]
    for one in (lambda o: (o.color, str(o.dashes)), lambda o: o.marker):
        assert len({one(look) for look in own}) == len(LABELS)
    assert looks["mine"].label == "My own" and looks["trpo"].color == INK
    assert looks["mine"].dashes == looks["trpo_lag"].dashes != looks["cpo"].dashes


def test_no_two_algorithms_have_one_colour_or_one_marker():
    assert {*CLASSES} - {"trpo"} <= MARKS.keys()
    for one in zip((INK, "o"), *MARKS.values(), strict=True):
        assert len({*one}) == len(one)


@pytest.mark.parametrize("form", figures.FORMATS)
def test_formats(small, tmp_path, form):
    found = read(small)
    paths = [tmp_path / name / f"figure.{form}" for name in ("a", "b")]
    for path in paths:
        (drawing,) = draw("pareto", found).values()
        save(drawing, path)
    content = paths[0].read_bytes()
    assert content == paths[1].read_bytes()  # the same figure is the same file
    if form == "png":
        image = matplotlib.image.imread(paths[0])
        assert image.shape[2] == 4 and image[0, 0, 3] == 0  # transparent
    elif form == "svg":
        assert ET.fromstring(content).tag.endswith("svg")
    else:
        assert content.startswith(b"%PDF")


# The command


def test_default_draws_curves_and_prints_tables(small, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    out = tmp_path / "figures"
    (fake_run(small, "cpo", seed=2) / "0.monitor.csv").write_text("#{}\nr,l,t,c\n")
    assert cli.main(["plot", str(small), "-o", str(out)]) == 0
    assert [path.name for path in out.iterdir()] == [f"curves_{POINT}.png"]
    printed, err = capsys.readouterr()
    assert max(map(len, printed.splitlines())) <= 120
    for text in ("return", "5.00\xa0±\xa00.00", "PPO", "0: exceeded"):
        assert text in printed
    assert "left out: " in err and "v0_3/0.monitor.csv: it has no episodes" in err
    results = printed.partition("\nVerdicts")[0].splitlines()
    (row,) = (line.split() for line in results if "CPO  " in line and "0:" in line)
    assert row[:5] == [POINT, "CPO", "0:", "exceeded", "2"]


def limited(folder, seed: int) -> None:
    """A run with limits of 5 and 2 on two costs, whose episodes cost 4 and 3."""
    path = fake_run(
        folder, "cpo", seed=seed, cost=7.0, cost_limit=[5.0, 2.0],
        costs={
            "heat": {"mean": 4.0, "low": 3.5, "high": 4.5, "limit": 5.0, "verdict": "kept"},
            "noise": {"mean": 3.0, "low": 1.5, "high": 4.5, "limit": 2.0, "verdict": "undecided"},
        },
    )  # fmt: skip
    file = path / "0.monitor.csv"
    first, head, *rows = file.read_text().splitlines()
    rows = [f"{row},4,3" for row in rows]
    file.write_text("\n".join([first, f"{head},c_heat,c_noise", *rows]) + "\n")


def test_each_of_several_costs_has_its_verdict_and_its_panel(tmp_path, capsys):
    limited(tmp_path / "logs", 0)
    found = read(tmp_path / "logs")
    (row,) = found.runs.to_dict("records")
    assert (row["M_c/heat"], row["cost_limit/noise"]) == (4, 2)
    shown = tables(found)
    assert shown["Results"]["limit"].tolist() == ["5 2: exceeded"]
    assert shown["Verdicts"][["cost key", "limit"]].to_numpy().tolist() == [
        ["heat", "5: kept"], ["noise", "2: exceeded"]
    ]  # fmt: skip
    limited(tmp_path / "logs", 1)
    fake_run(tmp_path / "logs", "trpo")  # which knows the total only
    found = read(tmp_path / "logs")
    assert tables(found)["Verdicts"]["cost key"].tolist() == ["total", "heat", "noise"]
    for kind, panels in (("curves", 5), ("pareto", 3)):
        (drawing,) = draw(kind, found).values()
        assert len(drawing.axes) == panels
    (drawing,) = draw("curves", found).values()
    heat = next(axis for axis in drawing.axes if "heat" in axis.get_ylabel())
    assert lines(heat)["CPO"] == pytest.approx([4.0] * 6)
    assert lines(heat)["heat limit, 5"].tolist() == [5, 5] and "TRPO" not in lines(heat)
    assert page_of(tmp_path / "logs").count("2: exceeded") == 2


def test_packed_logs_without_an_entry_for_each_cost_are_read(tmp_path):
    fake_run(tmp_path, "pcpo", cost_limit=25.0)
    (row,) = read_results([tmp_path]).runs.to_dict("records")
    assert (row["limits"], row["cost_limit"]) == ("25", 25)


@pytest.mark.slow
def test_all_of_it(small, tmp_path, capsys):
    paths = [str(tmp_path / name) for name in ("runs.csv", "table.md", "table.tex")]
    run = [str(small), "--figure", "all", "-o", str(tmp_path / "f"), "--format", "svg"]
    assert plot.main([*run, "--table", *paths]) == 0
    out = capsys.readouterr().out
    assert all(f"wrote {path}" in out for path in paths)
    made = {path.stem for path in (tmp_path / "f").iterdir()}
    per_suite = {f"{kind}_{POINT}" for kind in PER_SUITE}
    assert made == per_suite | {"q1", "q2", "q3", "q4", "q6", "q8"}
    # One asked for by name that can't be drawn is a failure.
    assert plot.main([str(small), "--figure", "q7", "-o", str(tmp_path / "g")]) == 2
    assert "q7 is not drawn: there are no runs" in capsys.readouterr().err


def test_a_table_of_runs_has_those_asked_for(small, tmp_path, capsys):
    file = tmp_path / "r.csv"
    fake_run(small, "cpo", cost_limit=5.0, seed=2)
    fake_run(small, "cpo", "Push_Point_8Hazards-v0", epochs=3, number=9)
    fake_run(small, "cpo", "Push_Point_8Hazards-v0", number=8)
    for flags, rows in (
        ([], 9),  # several limits and lengths
        (["--env", POINT], 7),
        (["--cost-limit", "5"], 3),
    ):
        assert plot.main([str(small), "--table", str(file), *flags]) == 0
        assert len(file.read_text().splitlines()) == 1 + rows, flags
    file.unlink()
    for flags in (["--env", "Goal_Pint_8Hazards"], ["--cost-limit", "77"]):
        assert plot.main([str(small), "--table", str(file), *flags]) == 2
        assert "there is no run" in capsys.readouterr().err
    assert not file.exists()
    means = [str(small), "--table", str(tmp_path / "r.md")]
    assert plot.main(means) == 2 and "differ in cost limit, 0, 5," in capsys.readouterr().err
    assert plot.main([*means, "--cost-limit", "5"]) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["absent"], "there is no run below 'absent'"),
        (["LOGS", "--figure", "q9"], "invalid choice: 'q9' (choose from"),
        (["LOGS", "--table", "r.xls"], "--table r.xls: unknown format '.xls'"),
        (["LOGS", "-o", "file/x"], "can't write to 'file/x/curves"),
        (["LOGS", "--table", "file/r.md"], "can't write to 'file/r.md'"),
    ],
)
def test_wrong_usage(small, tmp_path, monkeypatch, capsys, arguments, message):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    (elsewhere / "file").touch()
    arguments = [str(small) if one == "LOGS" else one for one in arguments]
    assert plot.main(arguments) == 2
    err = capsys.readouterr().err
    assert message in err and "Traceback" not in err
    assert [path.name for path in elsewhere.iterdir()] == ["file"]


# The page


def page_of(folder) -> str:
    found = read_results([folder])
    runs = select(found.runs)
    return plot.page_of(Data(runs), "A <grid>", found.left_out)


def test_page_is_complete_and_by_itself(small):
    broken = small / "cpo" / f"{POINT}-v0_2"
    (broken / "result.json").write_text("{")
    page = page_of(small)
    assert "A &lt;grid&gt;" in page
    assert f"{broken} is left out: result.json is damaged" in page
    assert "runs: 5, algorithms: 3, environments: 1, steps: 3,000" in page
    # Names of XML namespaces are the only addresses; nothing is loaded.
    addresses = set(re.findall(r"https?://[^\"'\s<)]+", page))
    assert addresses <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    assert INK not in page  # dark pages have light ink
    assert {*re.findall(r"TRPO|PPO|f{10}|pareto_\w+", page)} >= {"TRPO", "PPO", "f" * 10}
    assert page.count("<table") == 4 and page.count("<svg") > 7
    assert f"<td>{small / 'trpo' / POINT}-v0_1</td>" in page  # nothing is abbreviated


def test_the_command_runs_as_a_module_and_loads_no_torch(small, tmp_path):
    table = tmp_path / "r.csv"
    code = (
        "import runpy, sys\n"
        "try:\n"
        "    runpy.run_module('sb3_guard.plot', run_name='__main__', alter_sys=True)\n"
        "finally:\n"
        "    print([m for m in ('torch', 'rl_zoo3') if m in sys.modules])"
    )
    run = subprocess.run(
        [sys.executable, "-c", code, str(small), "--table", str(table)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert run.stdout == f"wrote {table}\n[]\n" and run.stderr == ""
