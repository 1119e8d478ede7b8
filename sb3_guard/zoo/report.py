"""A page about a grid of runs: one HTML file that needs nothing else, on screens of any width."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd

import sb3_guard
from sb3_guard.zoo.figures import (
    FIGURES,
    INK,
    Data,
    draw,
    draw_curves,
    draw_pareto,
    inline_svg,
    line_style,
    panel,
)
from sb3_guard.zoo.results import METRICS, VERSIONS, label, tables

# A video is part of the page up to this size; the page's videos together, up to the other.
VIDEO_BYTES, VIDEOS_BYTES = 4_000_000, 40_000_000

_STYLE = """
:root { color-scheme: light dark; --ink: #1b1b1b; --paper: #fff; --soft: #f2f2f0; --line: #d5d5d0; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e6e3; --paper: #161618; --soft: #222226; --line: #3a3a40; }
}
* { box-sizing: border-box; }
body { color: var(--ink); background: var(--paper); margin: 0 auto; padding: 1rem;
  max-width: 104rem;
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.25rem; margin-top: 2.2rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .875rem; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .6rem; text-align: left; border-bottom: 1px solid var(--line);
  white-space: nowrap; }
th { background: var(--soft); }
th button { all: unset; cursor: pointer; font-weight: 600; }
th button:focus-visible { outline: 2px solid; }
th button::after { content: " \\2195"; opacity: .4; }
th[aria-sort=ascending] button::after { content: " \\2191"; opacity: 1; }
th[aria-sort=descending] button::after { content: " \\2193"; opacity: 1; }
.panels { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fit, minmax(min(19rem, 100%),
  1fr)); align-items: start; }
figure { margin: 0 0 1rem; } figcaption { font-size: .875rem; }
figure svg { width: 100%; height: auto; display: block; }
.wide > svg { min-width: 46rem; max-width: 76rem; }
.keys { display: flex; flex-wrap: wrap; gap: .2rem 1rem; font-size: .875rem; margin: .4rem 0; }
.keys svg { vertical-align: middle; margin-right: .3rem; }
details { margin: .8rem 0; } summary { cursor: pointer; font-weight: 600; }
video { width: 100%; max-width: 32rem; background: #000; }
"""

_SCRIPT = """
const number = cell => {
  const text = cell.dataset.value ?? cell.textContent;
  const value = parseFloat(text.replaceAll(",", "").replaceAll("\\u2212", "-"));
  return /^[-\\u2212]?[\\d.]/.test(text) ? value : NaN;
};
for (const button of document.querySelectorAll("th button")) button.onclick = () => {
  const head = button.parentNode, body = head.closest("table").tBodies[0];
  const up = head.getAttribute("aria-sort") !== "ascending", i = head.cellIndex;
  for (const other of head.parentNode.cells) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", up ? "ascending" : "descending");
  const numeric = [...body.rows].some(row => !isNaN(number(row.cells[i])));
  const rows = [...body.rows].sort((a, b) => {
    const [x, y] = [a, b].map(row => row.cells[i]);
    if (!numeric) return (up ? 1 : -1) * x.textContent.localeCompare(y.textContent);
    const [p, q] = [number(x), number(y)];
    if (isNaN(p) || isNaN(q)) return isNaN(p) - isNaN(q);  // what has no value comes last
    return (up ? 1 : -1) * (p - q);
  });
  body.append(...rows);
};
"""


def report(data: Data, title: str, left_out: Mapping[str, str], notes: Sequence[str]) -> str:
    """
    The page.

    :param data: the runs
    :param title: what the page is called
    :param left_out: why a run could not be read, by its path
    :param notes: what a reader of the means should know
    :return: HTML
    """
    runs = data.runs
    parts = [f"<h1>{escape(title)}</h1>", _summary(runs)]
    suites = [_suite(data, suite, opened=i < 4) for i, suite in enumerate(data.suites)]
    lines = [*notes, *data.unread.values()]
    lines += [f"{path} is left out: {why}" for path, why in left_out.items()]
    if lines:
        parts.append("<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>")
    for heading, table in tables(runs).items():
        parts += [f"<h2>{escape(heading)}</h2>", _table(table)]
    parts.append("<p>J_r, M_c: means over the episodes of the final epoch; ρ_c: cumulative cost ÷ "
                 "steps. Mean ± standard deviation over seeds, 95 % bootstrap interval of the mean "
                 "in brackets. A click on a heading sorts.</p>")  # fmt: skip
    parts += ["<h2>Learning curves</h2>", *suites]
    parts += _figures(data)
    parts += _videos(runs)
    parts += ["<h2>Runs</h2>", _table(_run_table(runs))]
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; \
script-src 'unsafe-inline'; img-src data:; media-src data:">
<title>{escape(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
{chr(10).join(parts)}
<script>{_SCRIPT}</script>
</body>
</html>
"""


def _summary(runs: pd.DataFrame) -> str:
    made = [f"{name} {', '.join(sorted(runs[name].dropna().unique()))}" for name in VERSIONS
            if runs[name].notna().any()]  # fmt: skip
    commits = sorted(runs["commit"].dropna().unique())
    hours = runs["seconds"].sum() / 3600
    lines = [
        f"runs: {len(runs)}, algorithms: {runs['algo'].nunique()}, suites: "
        f"{runs['suite'].nunique()}, steps: {runs['steps'].sum():,}"
        + (f", hours: {hours:,.1f}" if hours else ""),
        "made with " + ", ".join(made) if made else "",
        "commit " + ", ".join(commits) if commits else "",
        f"page by sb3_guard {sb3_guard.__version__}",
    ]
    return "<p>" + "<br>".join(escape(line) for line in lines if line) + "</p>"


def _table(table: pd.DataFrame) -> str:
    head = "".join(
        f'<th scope="col"><button type="button">{escape(str(name))}</button></th>'
        for name in table.columns
    )
    rows = (
        "<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>"
        for row in table.astype(str).to_numpy().tolist()
    )
    body = "\n".join(rows)
    return (
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>'
        "</table></div>"
    )


def _run_table(runs: pd.DataFrame) -> pd.DataFrame:
    def spelled(name: str, form: str) -> list[str]:
        return ["–" if pd.isna(one) else form.format(one) for one in runs[name]]

    return pd.DataFrame(
        {
            "suite": runs["suite"],
            "algorithm": runs["algo"].map(label),
            "seed": runs["seed"].map(str),
            "limit": spelled("limits", "{}"),
            "steps": spelled("steps", "{:,}"),
            "return J_r": spelled("J_r", "{:.2f}"),
            "episode cost M_c": spelled("M_c", "{:.2f}"),
            "cost rate ρ_c": spelled("rho_c", "{:.5f}"),
            "physics errors": spelled("physics_errors", "{:.0f}"),
            "seconds": spelled("seconds", "{:,.0f}"),
            "commit": [
                "–" if pd.isna(one) else one[:10] + "-dirty" * one.endswith("-dirty")
                for one in runs["commit"]
            ],
            "folder": runs["path"],
        }
    )


def _suite(data: Data, suite: str, opened: bool) -> str:
    charts = [
        inline_svg(
            panel(lambda axis, m=metric: draw_curves(axis, data, suite, m)),  # type: ignore[misc]
            f"{name} on {escape(suite)}",
        )
        for metric, name in METRICS.items()
        if any(data.curves(suite, algo) for algo in data.algos(suite))
    ]
    if data.runs.loc[data.runs["suite"] == suite, "J_r"].notna().any():
        chart = panel(lambda axis: draw_pareto(axis, data, suite))
        charts.append(inline_svg(chart, f"return against episode cost on {escape(suite)}"))
    keys = "".join(f"<span>{_key(algo)}{escape(label(algo))}</span>" for algo in data.algos(suite))
    figures = "".join(f"<figure>{chart}</figure>" for chart in charts)
    return (
        f"<details{' open' * opened}><summary>{escape(suite)}</summary>"
        f'<div class="keys">{keys}<span>dotted: cost limit</span>'
        "<span>grey steps: Pareto front</span></div>"
        f'<div class="panels">{figures}</div></details>'
    )


def _key(algo: str) -> str:
    """An algorithm's line as a legend shows it."""
    style: dict[str, Any] = line_style(algo)
    dashes = style["linestyle"]
    width = 2.5
    pattern = " ".join(f"{width * one:g}" for one in dashes[1]) if dashes != "-" else "none"
    color = style["color"].replace(INK, "currentColor")
    return (
        f'<svg width="30" height="8" aria-hidden="true"><line x1="0" y1="4" x2="30" y2="4" '
        f'stroke="{color}" stroke-width="{width}" stroke-dasharray="{pattern}"/></svg>'
    )


def _figures(data: Data) -> list[str]:
    parts = []
    for kind, function in FIGURES.items():
        # Those per suite are above.
        if kind in ("curves", "pareto", "q1"):
            continue
        title = (function.__doc__ or "").strip()
        for drawing in draw(kind, data):
            if drawing.figure is not None:
                chart = inline_svg(drawing.figure, escape(title))
                parts.append(
                    f"<figure><figcaption><strong>{kind.upper()}</strong> {escape(title)}"
                    f'</figcaption><div class="wide">{chart}</div></figure>'
                )
    return ["<h2>Comparisons</h2>", *parts] if parts else []


def _videos(runs: pd.DataFrame) -> list[str]:
    """Films found in run folders: shown if small, named if not."""
    shown, named, total = [], [], 0
    for run in runs.to_dict("records"):
        for film in sorted(Path(run["path"]).rglob("[!.]*.mp4")):
            size = film.stat().st_size
            name = f"{label(run['algo'])}, {run['suite']}, seed {run['seed']}: {film.name}"
            caption = escape(name)
            if size > VIDEO_BYTES or total + size > VIDEOS_BYTES:
                named.append(f"<li>{caption}, {size / 1e6:.1f} MB: {escape(str(film))}</li>")
                continue
            total += size
            content = base64.b64encode(film.read_bytes()).decode()
            shown.append(
                f'<figure><video controls muted loop preload="metadata" '
                f'src="data:video/mp4;base64,{content}"></video>'
                f"<figcaption>{caption}</figcaption></figure>"
            )
    if not shown and not named:
        return []
    rest = f"<p>Too large for this page:</p><ul>{''.join(named)}</ul>" if named else ""
    return ["<h2>Videos</h2>", f'<div class="panels">{"".join(shown)}</div>{rest}']
