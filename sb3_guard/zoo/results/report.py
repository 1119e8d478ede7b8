"""A page about runs: one HTML file that needs nothing else, on screens of any width."""

from collections.abc import Mapping

import jinja2
import pandas as pd

import sb3_guard
from sb3_guard.zoo.results.figure_data import Data
from sb3_guard.zoo.results.figures import inline_svg
from sb3_guard.zoo.results.paper import FIGURES, draw
from sb3_guard.zoo.results.runs import VERSIONS
from sb3_guard.zoo.results.tables import CAPTIONS, RUNS, spelled, tables


def report(data: Data, title: str, left_out: Mapping[str, str]) -> str:
    """
    The page.

    :param data: the runs
    :param title: what the page is called
    :param left_out: why a run could not be read, by its path
    :return: HTML
    """
    loader = jinja2.PackageLoader("sb3_guard.zoo.results", ".")
    page = jinja2.Environment(loader=loader, autoescape=True).get_template("report.html.jinja")
    figures = [
        (name, FIGURES[kind].__doc__, inline_svg(figure, name))
        for kind in FIGURES
        for name, figure in draw(kind, data).items()
    ]
    return page.render(
        title=title,
        runs=data.runs,
        made={name: sorted(data.runs[name].dropna().unique()) for name in (*VERSIONS, "commit")},
        version=sb3_guard.__version__,
        left_out=left_out,
        tables={heading: _html(table) for heading, table in tables(data).items()},
        captions=CAPTIONS,
        figures=figures,
        run_table=_html(spelled(data.runs, RUNS)),
    )


def _html(table: pd.DataFrame) -> str:
    with pd.option_context("display.max_colwidth", None):
        return str(table.to_html(index=False, border=0, justify="left"))
