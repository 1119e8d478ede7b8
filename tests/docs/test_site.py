"""The documentation as a site: it builds without a warning and fits the window of a browser."""

import subprocess
import sys
from pathlib import Path

import pytest
from chromium import CHROMIUM, Page, served

DOCS = Path(__file__).parents[2] / "docs"
# Each page without code and indices; a table or a block of code may scroll in its own box.
WIDER = "document.documentElement.scrollWidth - document.documentElement.clientWidth"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", DOCS, folder / "html"]
    done = subprocess.run(
        [*command, "-d", folder / "doctrees"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder / "html"


def test_the_site_has_its_pages(site: Path) -> None:
    assert (site / "index.html").exists()
    assert "how it handles the limit" in (site / "algorithms.html").read_text()


@pytest.mark.skipif(not CHROMIUM, reason="there is no Chromium")
@pytest.mark.parametrize("width", [400, 1280])
def test_no_page_is_wider_than_the_window(site: Path, width: int, tmp_path: Path) -> None:
    pages = [
        page.relative_to(site) for page in site.rglob("*.html") if "_modules" not in page.parts
    ]
    browser = Page(tmp_path)
    with served(site) as address:
        browser.look(width, 900)
        wider = {}
        for page in pages:
            browser.open(f"{address}/{page}")
            wider[str(page)] = browser.run(WIDER)
    browser.close()
    assert {page: pixels for page, pixels in wider.items() if pixels > 0} == {}
