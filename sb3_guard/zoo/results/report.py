"""A page about runs: one HTML file that needs nothing else, on screens of any width."""

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd

import sb3_guard
from sb3_guard.zoo.results.figure_data import INK, Data, Look
from sb3_guard.zoo.results.figures import cost_name, draw_curves, draw_pareto, inline_svg, panel
from sb3_guard.zoo.results.paper import FIGURES, draw
from sb3_guard.zoo.results.runs import VERSIONS
from sb3_guard.zoo.results.tables import RUNS, spelled, tables

# A video is part of the page up to this size; the page's videos together, up to the other.
VIDEO_BYTES, VIDEOS_BYTES = 4_000_000, 40_000_000
PER_SUITE = ("curves", "pareto", "q1")


def report(data: Data, title: str, left_out: Mapping[str, str], notes: Sequence[str]) -> str:
    """
    The page.

    :param data: the runs
    :param title: what the page is called
    :param left_out: why a run could not be read, by its path
    :param notes: what a reader of the means should know
    :return: HTML
    """
    loader = jinja2.PackageLoader("sb3_guard.zoo.results", ".")
    page = jinja2.Environment(loader=loader, autoescape=True).get_template("report.html.jinja")
    suites = {
        suite: {
            "keys": [(dash_array(data.looks[a]), data.looks[a]) for a in data.algos(suite)],
            "panels": _panels(data, suite),
        }
        for suite in data.suites
    }
    titles = {kind: (f.__doc__ or "").strip() for kind, f in FIGURES.items()}
    drawings = {kind: draw(kind, data) for kind in FIGURES if kind not in PER_SUITE}
    return page.render(
        title=title,
        runs=data.runs,
        made={name: sorted(data.runs[name].dropna().unique()) for name in (*VERSIONS, "commit")},
        version=sb3_guard.__version__,
        notes=[*notes, *data.unread.values()],
        left_out=left_out,
        tables={heading: _html(one) for heading, one in tables(data.runs).items()},
        suites=suites,
        comparisons=[
            (kind, titles[kind], inline_svg(drawing.figure, titles[kind]))
            for kind, found in drawings.items()
            for drawing in found
            if drawing.figure is not None
        ],
        videos=_videos(data),
        run_table=_html(spelled(data.runs, RUNS)),
    )


def _html(table: pd.DataFrame) -> str:
    with pd.option_context("display.max_colwidth", None):
        return str(table.to_html(index=False, border=0, justify="left"))


def _panels(data: Data, suite: str) -> list[str]:
    """Learning curves and return against cost, as SVG."""
    name = suite.translate(dict.fromkeys(map(ord, '<>&"'), "_"))
    charts = [
        inline_svg(panel(lambda axis, m=m: draw_curves(axis, data, suite, m)), f"{m}, {name}")  # type: ignore[misc]
        for m in data.panels(suite)
        if any(data.curves(suite, algo) for algo in data.algos(suite))
    ]
    if data.runs.loc[data.runs["suite"] == suite, "J_r"].notna().any():
        for cost in data.costs(suite):
            chart = panel(lambda axis, c=cost: draw_pareto(axis, data, suite, c))  # type: ignore[misc]
            charts.append(inline_svg(chart, f"return against {cost_name(cost)}, {name}"))
    return charts


def dash_array(look: Look) -> dict[str, str]:
    """A line as SVG attributes, for the legend."""
    dashes = "none" if look.dashes == "-" else " ".join(f"{2.5 * n:g}" for n in look.dashes[1])
    color = look.color.replace(INK, "currentColor")
    return {"stroke": color, "dashes": dashes}


def _videos(data: Data) -> dict[str, list[Any]]:
    """Videos found in run folders: shown if small, named if not."""
    shown: list[tuple[str, str]] = []
    named: list[tuple[str, float, Path]] = []
    total = 0
    for run in data.runs.to_dict("records"):
        for film in sorted(Path(run["path"]).rglob("[!.]*.mp4")):
            size = film.stat().st_size
            name = f"{run['label']}, {run['suite']}, seed {run['seed']}: {film.name}"
            if size > VIDEO_BYTES or total + size > VIDEOS_BYTES:
                named.append((name, size / 1e6, film))
                continue
            total += size
            shown.append((name, base64.b64encode(film.read_bytes()).decode()))
    return {"shown": shown, "named": named}
