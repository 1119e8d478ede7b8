"""Figures, the page about a grid, and the command that makes them."""

import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET

import matplotlib.image
import numpy as np
import pytest
from fake_runs import fake_run
from matplotlib.colors import to_rgb

from sb3_guard import cli, plot
from sb3_guard.envs import Scenario
from sb3_guard.envs.registry import SUITE_ROBOTS
from sb3_guard.zoo import figures
from sb3_guard.zoo.figures import FIGURES, INK, ROBOTS, Data, draw, inline_svg, pareto_front, save
from sb3_guard.zoo.report import report
from sb3_guard.zoo.results import CATEGORIES, LABELS, read_results, select

EFFECTS = dict(zip(LABELS, (1.0, 0.5, 0.6, 0.4, 0.7, 0.9, 0.8, 1.5), strict=True))
RESULTS = [
    f"{task}_{robot}_8{kind}"
    for task, kind in (("Goal", "Hazards"), ("Goal", "Ghosts"), ("Push", "Hazards"),
                       ("Chase", "Hazards"), ("Defense", "Hazards"))
    for robot in ROBOTS
]  # fmt: skip


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """The paper's 45 suites, eight algorithms; the second seed on two suites only."""
    folder = tmp_path_factory.mktemp("grid")
    for suite in RESULTS:
        for algo, effect in EFFECTS.items():
            for seed in (0, 1) if suite in RESULTS[:2] else (0,):
                fake_run(folder, algo, f"{suite}-v0", seed, returns=10 * min(effect, 1) + seed,
                         cost=4 * effect, epochs=3)  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def data(grid):
    return Data(select(read_results([grid]).runs))


@pytest.fixture
def small(tmp_path):
    """One suite, three algorithms, two seeds."""
    for algo in ("trpo", "cpo", "ppo"):
        for seed in (0, 1):
            fake_run(tmp_path / "logs", algo, seed=seed, returns=10 * EFFECTS.get(algo, 1.0),
                     cost=4 * EFFECTS.get(algo, 1.0), seconds=60.0, commit="f" * 40)  # fmt: skip
    return tmp_path / "logs"


def texts(figure) -> str:
    """All that a figure says."""
    return "\n".join(text.get_text() for text in figure.findobj(matplotlib.text.Text))


def lines(axis) -> dict[str, np.ndarray]:
    return {line.get_label(): np.asarray(line.get_ydata(), float) for line in axis.get_lines()}


# What is drawn


@pytest.mark.parametrize("kind", [kind for kind in FIGURES if kind not in ("curves", "pareto")])
def test_the_papers_figures_are_whole(kind, data):
    (drawing,) = draw(kind, data)
    assert drawing.figure is not None and drawing.missing == ""
    assert "Missing" not in texts(drawing.figure)


def test_one_figure_of_curves_and_of_pareto_per_suite(small):
    found = Data(select(read_results([small]).runs))
    for kind in ("curves", "pareto"):
        (drawing,) = draw(kind, found)
        assert drawing.name == f"{kind}_Goal_Point_8Hazards" and not drawing.missing


def test_curves_are_means_of_seeds_with_bands(data):
    (drawing,) = draw("q1", data)
    assert len(drawing.figure.axes) == 24
    axis = drawing.figure.axes[0]
    assert axis.get_ylabel() == "return" and set(LABELS.values()) <= set(lines(axis))
    # seeds reach 5 and 6 in three equal steps
    assert lines(axis)["CPO"] == pytest.approx([11 / 6, 11 / 3, 5.5])
    assert len(axis.collections) == 8
    assert len(drawing.figure.axes[3].collections) == 0  # one seed has no band
    assert "cost limit, 0" in lines(drawing.figure.axes[1])


def test_q2_shows_trpos_costs_and_the_slopes(data):
    (drawing,) = draw("q2", data)
    bars, reward, cost = drawing.figure.axes
    assert len(bars.patches) == 2 * len(ROBOTS)
    assert [bar.get_height() for bar in bars.patches] == pytest.approx([4.0] * 18)
    assert lines(cost)["TRPO-USL"] == pytest.approx([1.5, 1.5])
    # Hazards have two seeds: 5.5 of TRPO's 10.5; Ghosts one: 5 of 10
    assert lines(reward)["CPO"] == pytest.approx([5.5 / 10.5, 0.5])


def test_q3_has_a_polygon_per_category_and_trpos_at_1(data):
    (drawing,) = draw("q3", data)
    assert [axis.get_title() for axis in drawing.figure.axes] == list(figures.RADAR4)
    polygons = lines(drawing.figure.axes[1])
    assert set(polygons) == {"TRPO", *CATEGORIES}
    assert (polygons["TRPO"] == 1).all()
    lagrangian = (0.4 + 0.7 + 0.9) / 3
    assert polygons["Lagrangian"] == pytest.approx([lagrangian] * 4)


@pytest.mark.parametrize(
    ("kind", "shown"),
    [("q4", {*CATEGORIES}), ("q5", {"TRPO-Lagrangian", "TRPO-FAC"}), ("q6", {"CPO", "PCPO"}),
     ("q7", {"TRPO-USL", "TRPO-SL"})],
)  # fmt: skip
def test_q4_to_q7_go_by_degrees_of_freedom(kind, shown, data):
    (drawing,) = draw(kind, data)
    for axis in drawing.figure.axes:
        assert set(lines(axis)) == shown | {"TRPO"}
        ticks = [tick.get_text() for tick in axis.get_xticklabels()]
        assert ticks == [f"{robot}\n{number}" for robot, number in ROBOTS.items()]


def test_q8_has_a_spider_per_algorithm(data):
    (drawing,) = draw("q8", data)
    assert [axis.get_title() for axis in drawing.figure.axes] == list(LABELS.values())[1:]
    usl = lines(drawing.figure.axes[-1])
    assert usl["cost"] == pytest.approx([1.5] * 6) and usl["reward"][2:5] == pytest.approx([1] * 3)
    assert set(usl) == {"TRPO", "reward", "cost", "cost rate"}


def test_robots_are_in_the_order_of_their_actions():
    actual = {robot: Scenario(robot=robot).build().robot.action_size for robot in SUITE_ROBOTS}
    assert actual == ROBOTS and list(ROBOTS.values()) == sorted(ROBOTS.values())


@pytest.mark.parametrize(
    ("points", "front"),
    [
        ([(1, 1), (2, 2), (3, 3)], [0, 1, 2]),
        ([(3, 1), (2, 2), (1, 3)], [2]),
        ([(1, 1), (1, 2), (2, 2)], [1]),  # the last is no better and costs more
        ([(2, 5), (1, 0), (3, 4)], [1, 0]),
    ],
)
def test_pareto_front(points, front):
    costs, returns = np.array(points, float).T
    assert pareto_front(costs, returns).tolist() == front


def test_pareto_marks_front_and_limit(small):
    found = Data(select(read_results([small]).runs))
    (drawing,) = draw("pareto", found)
    (axis,) = drawing.figure.axes
    assert lines(axis)["Pareto front"].tolist() == [5.0, 10.0]
    assert "cost limit, 0" in lines(axis)


def test_profiles_rise_and_fall(data):
    (drawing,) = draw("profiles", data)
    reward, cost, _ = map(lines, drawing.figure.axes)
    assert (np.diff(reward["CPO"]) <= 0).all() and (np.diff(cost["CPO"]) >= 0).all()
    assert (reward["CPO"][0], reward["CPO"][-1]) == (1.0, 0.0)
    assert (cost["CPO"][0], cost["CPO"][-1]) == (0.0, 1.0)


# What is missing


def test_missing_runs_are_named(tmp_path):
    fake_run(tmp_path, "trpo")
    fake_run(tmp_path, "cpo")
    found = Data(select(read_results([tmp_path]).runs))
    (drawing,) = draw("q6", found)
    assert "PCPO on Goal_Point_8Hazards" in drawing.missing
    assert "TRPO, CPO, PCPO on Goal_Swimmer_8Hazards, " in drawing.missing
    assert "Missing: PCPO on Goal_Point_8Hazards" in texts(drawing.figure)
    (drawing,) = draw("q7", found)
    assert drawing.figure is None and "TRPO-USL, TRPO-SL on Goal_Point_8Hazards" in drawing.missing


@pytest.mark.parametrize("kind", [k for k in FIGURES if k not in ("curves", "pareto", "q1")])
def test_without_trpo_there_is_nothing_to_compare_with(tmp_path, kind):
    fake_run(tmp_path, "cpo")
    (drawing,) = draw(kind, Data(select(read_results([tmp_path]).runs)))
    assert drawing.figure is None
    assert "TRPO" in drawing.missing.split(" on ")[0].split(", ")


def test_a_gap_stays_a_gap(grid, tmp_path):
    shutil.copytree(grid, tmp_path / "grid")
    shutil.rmtree(tmp_path / "grid" / "pcpo" / "Goal_Arm3_8Hazards-v0_1")
    shutil.rmtree(tmp_path / "grid" / "cpo" / "Push_Ant_8Hazards-v0_1")
    found = Data(select(read_results([tmp_path / "grid"]).runs))
    (q6,) = draw("q6", found)
    assert np.isnan(lines(q6.figure.axes[0])["PCPO"]).tolist() == [n == "Arm3" for n in ROBOTS]
    (q8,) = draw("q8", found)
    assert "Push\n(8/9)" in texts(q8.figure) and "Chase\n(" not in texts(q8.figure)


def test_a_run_without_its_episodes_is_left_out_of_the_curves(small, capsys, tmp_path):
    (small / "cpo" / "Goal_Point_8Hazards-v0_2" / "0.monitor.csv").write_text("#{}\nr,l,t,c\n")
    assert plot.main([str(small), "-o", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    assert "left out of the curves: can't draw" in err and "v0_2/0.monitor.csv" in err
    assert "| CPO       | 0     | 2 " in out  # its result counts all the same


# How it looks


def test_colours_are_okabe_and_itos_and_no_two_algorithms_look_alike():
    palette = {
        "#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
    }  # fmt: skip
    colors = {figures.line_style(algo)["color"] for algo in LABELS}
    assert {"#000000" if color == INK else color for color in colors} == palette
    assert np.allclose(to_rgb(INK), 0, atol=0.02)
    looks = [figures.line_style(algo) for algo in (*LABELS, *figures.BASELINES, "mine")]
    assert len({(str(s["color"]), str(s["linestyle"])) for s in looks}) == len(looks)


@pytest.mark.parametrize("kind", FIGURES)
def test_legends_cover_no_data(kind, small):
    for drawing in draw(kind, Data(select(read_results([small]).runs))):
        if drawing.figure is None or not drawing.figure.legends:
            continue
        drawing.figure.draw_without_rendering()
        (legend,) = drawing.figure.legends
        box = legend.get_window_extent()
        for axis in drawing.figure.axes:
            assert not box.overlaps(axis.get_window_extent()), (kind, axis)


@pytest.mark.parametrize("form", figures.FORMATS)
def test_formats(small, tmp_path, form):
    found = Data(select(read_results([small]).runs))
    paths = [tmp_path / name / f"figure.{form}" for name in ("a", "b")]
    for path in paths:
        (drawing,) = draw("pareto", found)
        save(drawing.figure, path)
    content = paths[0].read_bytes()
    assert content == paths[1].read_bytes()  # the same figure is the same file
    if form == "png":
        assert matplotlib.image.imread(paths[0]).std() > 0.01
    elif form == "svg":
        assert ET.fromstring(content).tag.endswith("svg")
    else:
        assert content.startswith(b"%PDF")


# The command


def test_default_draws_curves_and_prints_tables(small, tmp_path, capsys):
    out = tmp_path / "figures"
    assert cli.main(["plot", str(small), "-o", str(out)]) == 0
    assert [path.name for path in out.iterdir()] == ["curves_Goal_Point_8Hazards.png"]
    printed = capsys.readouterr().out
    for text in ("| return, first | last", "return J_r", "5.00 ± 0.00", "PPO"):
        assert text in printed


def test_all_of_it(small, tmp_path, capsys):
    paths = [str(tmp_path / name) for name in ("runs.csv", "table.md", "table.tex")]
    run = [str(small), "--figure", "all", "-o", str(tmp_path / "f"), "--format", "svg"]
    assert plot.main([*run, "--table", *paths]) == 0
    out, err = capsys.readouterr()
    assert all(f"wrote {path}" in out for path in paths)
    made = {path.stem for path in (tmp_path / "f").iterdir()}
    assert made == {"curves_Goal_Point_8Hazards", "pareto_Goal_Point_8Hazards", "profiles", "iqm",
                    "q1", "q2", "q3", "q4", "q6", "q8"}  # fmt: skip
    assert "q7 is not drawn; missing: TRPO-USL, TRPO-SL on Goal_Point_8Hazards" in err


def test_a_figure_asked_for_by_name_that_can_not_be_is_a_failure(small, tmp_path, capsys):
    assert plot.main([str(small), "--figure", "q7", "-o", str(tmp_path / "f")]) == 1
    assert "q7 is not drawn" in capsys.readouterr().err
    assert not (tmp_path / "f").exists()


def test_table_of_runs_needs_no_choice_of_limit(small, tmp_path, capsys):
    fake_run(small, "cpo", cost_limit=5.0, seed=2)
    assert plot.main([str(small), "--table", str(tmp_path / "r.csv")]) == 0
    assert len((tmp_path / "r.csv").read_text().splitlines()) == 8
    assert plot.main([str(small), "--table", str(tmp_path / "r.md")]) == 2
    assert "several cost limits, 0, 5" in capsys.readouterr().err
    table = ["--table", str(tmp_path / "r.md")]
    assert plot.main([str(small), *table, "--cost-limit", "5"]) == 0


def test_table_of_runs_has_those_asked_for(small, tmp_path, capsys):
    file = tmp_path / "r.csv"
    fake_run(small, "cpo", cost_limit=5.0, seed=2)
    fake_run(small, "cpo", "Push_Point_8Hazards-v0", epochs=3, number=9)
    fake_run(small, "cpo", "Push_Point_8Hazards-v0", number=8)
    for flags, rows in (
        (["--env", "Goal_Point_8Hazards"], 7),
        (["--cost-limit", "5"], 3),
        (["--steps", "300"], 8),
    ):
        assert plot.main([str(small), "--table", str(file), *flags]) == 0
        assert len(file.read_text().splitlines()) == 1 + rows, flags
    file.unlink()
    capsys.readouterr()
    for flags in (["--env", "Goal_Pint_8Hazards"], ["--cost-limit", "77"], ["--steps", "1"]):
        assert plot.main([str(small), "--table", str(file), *flags]) == 2
        assert "there is no run" in capsys.readouterr().err
    assert not file.exists()


def test_damaged_runs_are_named_and_the_others_shown(small, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sb3_guard.zoo.report.FIGURES", {})
    broken = small / "cpo" / "Goal_Point_8Hazards-v0_2"
    (broken / "result.json").write_text("{")
    assert plot.main([str(small), "--report", str(tmp_path / "page.html")]) == 0
    assert f"left out: {broken}: result.json can't be read" in capsys.readouterr().err
    page = (tmp_path / "page.html").read_text()
    assert f"{broken} is left out: result.json can&#x27;t be read" in page
    assert "runs: 5, algorithms: 3, suites: 1, steps: 3,000" in page


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["absent"], "there is no folder 'absent'"),
        (["."], "there is no run below '.'"),
        (["LOGS", "--figure", "q9"], "invalid choice: 'q9'"),
        (["LOGS", "--format", "gif"], "invalid choice: 'gif'"),
        (["LOGS", "--table", "r.xls"], "unknown format '.xls'"),
        (["LOGS", "--report", "r.pdf"], "--report 'r.pdf' is not an .html file"),
        (["LOGS", "--env", "Goal_Point_8Gosts"], "did you mean"),
        (["LOGS", "--figures", "q1"], "did you mean --figure?"),
        (["LOGS", "-o", "file/x"], "-o: can't write to folder 'file/x'"),
        (["LOGS", "--table", "file/r.md"], "--table: can't write to folder 'file'"),
        (["LOGS", "--report", "file/r.html"], "--report: can't write to folder 'file'"),
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


def test_only_unfinished_runs(tmp_path, capsys):
    (fake_run(tmp_path) / "result.json").unlink()
    assert plot.main([str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert "unfinished" in err and "there is no finished run below" in err


def test_help_shows_examples_and_figures(capsys):
    with pytest.raises(SystemExit):
        plot.main(["--help"])
    out = capsys.readouterr().out
    assert "sb3-guard plot logs" in out and "Feasibility projection: CPO against PCPO." in out


# The page


def page_of(folder) -> str:
    found = read_results([folder])
    return report(Data(select(found.runs)), "A <grid>", found.left_out, ["a & b"])


def test_page_is_whole_and_by_itself(small):
    page = page_of(small)
    assert "A &lt;grid&gt;" in page and "a &amp; b" in page
    # Names of XML namespaces are the only addresses; nothing is loaded.
    addresses = set(re.findall(r"https?://[^\"'\s<)]+", page))
    assert addresses <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    assert not re.search(r"<link|<iframe|<script src|@import|url\((?!#)", page)
    assert INK not in page  # dark pages have light ink
    for name in ("TRPO", "CPO", "PPO", "f" * 10, "PROFILES"):
        assert name in page
    assert page.count("<table>") == 3 and page.count("<svg") > 8


def test_page_holds_small_videos_and_names_large_ones(small, monkeypatch):
    monkeypatch.setattr("sb3_guard.zoo.report.FIGURES", {})
    runs = sorted((small / "cpo").iterdir())
    (runs[0] / "small.mp4").write_bytes(b"small")
    (runs[0] / ".half.mp4").write_bytes(b"half")
    (runs[1] / "videos").mkdir()
    (runs[1] / "videos" / "large.mp4").write_bytes(b"large" * 10)
    monkeypatch.setattr("sb3_guard.zoo.report.VIDEO_BYTES", 10)
    page = page_of(small)
    assert page.count("<video") == 1 and "data:video/mp4;base64,c21hbGw=" in page
    assert "seed 1: large.mp4, 0.0 MB: " + str(runs[1] / "videos" / "large.mp4") in page


def test_inline_figures_are_labelled(small):
    (drawing,) = draw("pareto", Data(select(read_results([small]).runs)))
    text = inline_svg(drawing.figure, "title")
    assert 'role="img" aria-label="title"' in text and ET.fromstring(text) is not None


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")


@pytest.mark.skipif(CHROMIUM is None, reason="no browser: apt-get install chromium")
def test_tables_sort_in_a_browser(small, tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_guard.zoo.report.FIGURES", {})
    for seed in range(2, 12):
        fake_run(small, "cpo", seed=seed, returns=-100.0 + 20 * seed)
    probe = """<script>
      const table = [...document.querySelectorAll("table")].at(-1);
      const column = name => [...table.tHead.rows[0].cells].findIndex(c => c.textContent == name);
      const read = i => [...table.tBodies[0].rows].map(r => r.cells[i].textContent).join(" ");
      const click = name => table.tHead.rows[0].cells[column(name)].firstChild.click();
      const shown = [];
      for (const name of ["return J_r", "return J_r", "seed", "algorithm", "limit", "limit"]) {
        click(name); shown.push(read(column(name)));
      }
      document.title = "SORTED " + shown.join(";") + ";" +
        [...table.tHead.rows[0].cells].map(c => c.getAttribute("aria-sort")).filter(Boolean);
    </script>"""
    file = tmp_path / "page.html"
    file.write_text(page_of(small).replace("</body>", probe + "</body>"))
    shown = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
         f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", file.as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    ).stdout  # fmt: skip
    up, down, seeds, algos, low, high, state = re.search("<title>SORTED (.*?)</title>", shown)[
        1
    ].split(";")
    values = [float(one.replace("−", "-")) for one in up.split()]
    assert values == sorted(values) and values[0] == -60 and len(values) == 16
    assert [float(one.replace("−", "-")) for one in down.split()] == values[::-1]
    assert [int(one) for one in seeds.split()] == sorted(int(one) for one in seeds.split())
    assert algos.split() == sorted(algos.split())
    # What has no limit comes last, up or down.
    assert low.split()[-2:] == high.split()[-2:] == ["–", "–"]
    assert state == "descending"


def test_the_command_runs_as_a_module(small, tmp_path):
    run = subprocess.run(
        [sys.executable, "-m", "sb3_guard.plot", str(small), "--table", str(tmp_path / "r.csv")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert run.stdout == f"wrote {tmp_path / 'r.csv'}\n" and run.stderr == ""
