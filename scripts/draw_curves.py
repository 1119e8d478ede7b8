"""Draw the curve of each algorithm's page, from the logs: ``python scripts/draw_curves.py``.

Return, episode cost and cost rate against steps, beside an unconstrained algorithm, from the first
of ``GRIDS`` in ``docs/data`` that has the algorithm, as ``docs/images/curve_<algo>.png``.
"""

import tarfile
import tempfile
from pathlib import Path

from sb3_guard.zoo.figures import Data, save
from sb3_guard.zoo.paper import draw
from sb3_guard.zoo.runs import read_results

DOCS = Path(__file__).parents[1] / "docs"
# Archives, the suite, and whom an algorithm is beside.
GRIDS = (
    (("safety_gymnasium", "safety_gymnasium_others"), "SafetyPointGoal1-v0", "ppo"),
    (("guard_limit2",), "Goal_Point_8Hazards", "trpo"),
    (("off_policy",), "SafetyPointGoal1-v0", None),
)


def main() -> None:
    left = {page.stem for page in DOCS.glob("algorithms/*.md")}
    for names, suite, reference in GRIDS:
        with tempfile.TemporaryDirectory() as folder:
            for name in names:
                with tarfile.open(DOCS / "data" / f"{name}.tar.xz") as archive:
                    archive.extractall(folder, filter="data")
            runs = read_results([folder]).runs
            runs = runs[runs["suite"] == suite]
            for algo in sorted(left & {*runs["algo"]}):
                shown = runs[runs["algo"].isin([algo, reference])]
                (drawing,) = draw("curves", Data(shown))
                assert drawing.figure is not None, drawing.missing
                save(drawing.figure, DOCS / "images" / f"curve_{algo}.png")
                left.remove(algo)
                print(f"{algo}: {suite}")
    print("without logs:", *sorted(left))


if __name__ == "__main__":
    main()
