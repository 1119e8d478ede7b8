"""The page in a browser: its environment is the package's, its agents act as onnxruntime's do."""

import gzip
import importlib.util
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from chromium import CHROMIUM, Page, served

ROOT = Path(__file__).parents[2]
ENVS = ("Goal_Point_8Hazards-v0", "SafetyPointGoal1-v0")
NUMBER = 1000  # recorded control steps of each environment
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CHROMIUM, reason="there is no Chromium"),
    pytest.mark.skipif(shutil.which("npm") is None, reason="there is no npm"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "browser"
    spec = importlib.util.spec_from_file_location("make_browser", ROOT / "scripts/make_browser.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.build(path, NUMBER)
    return path


@pytest.fixture(scope="module")
def page(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    browser = Page(tmp_path_factory.mktemp("profile"))
    with served(folder) as address:
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=f"address = '{address}'")
        browser.look(1000, 800)
        browser.open(address)
        yield browser
    browser.close()


STEP_BY_STEP = """(async () => {
  const { World } = await import(`${address}/world.js`);
  const { default: load } = await import(`${address}/mujoco.js`);
  const read = async (name) => (await fetch(`${address}/${name}`)).json();
  const world = new World(await load(), await read('ENV.json'));
  return (await read('ENV.states.json')).map((state) => {
    world.restore(state);
    const { reward, cost } = world.step(state.action, () => state.goal);
    return [...world.observe(), reward, cost];
  });
})()"""


@pytest.mark.parametrize("env_id", ENVS)
def test_each_control_step_is_the_packages(folder: Path, page: Page, env_id: str) -> None:
    recorded = json.loads((folder / f"{env_id}.states.json").read_text())
    expected = np.array([[*s["obs"], s["reward"], s["cost"]] for s in recorded])
    reward, cost = expected[:, -2:].T
    assert len(recorded) == NUMBER and (cost > 0).sum() > 20 and (reward > 0.9).sum() > 5
    computed = np.array(page.run(STEP_BY_STEP.replace("ENV", env_id)))
    error = np.abs(computed - expected)
    print(f"{env_id}: largest error {error.max():.1e}")
    assert error.max() < 1e-4, np.argwhere(error >= 1e-4)[:20]


ACT = """(async () => {
  const { Policy } = await import(`${address}/policy.js`);
  const policy = new Policy(await (await fetch(`${address}/FILE`)).arrayBuffer());
  const states = await (await fetch(`${address}/ENV.states.json`)).json();
  return states.map(({ obs }) => Array.from(policy.act(Float32Array.from(obs))));
})()"""


def test_agents_act_as_with_onnxruntime(folder: Path, page: Page) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    for entry in json.loads((folder / "agents.json").read_text()):
        env_id = entry["env"]
        states = json.loads((folder / f"{env_id}.states.json").read_text())
        obs = np.array([state["obs"] for state in states], np.float32)
        for agent in entry["agents"]:
            session = onnxruntime.InferenceSession(folder / agent["file"])
            expected = session.run(["action"], {session.get_inputs()[0].name: obs})[0]
            code = ACT.replace("FILE", agent["file"]).replace("ENV", env_id)
            assert np.abs(np.array(page.run(code)) - expected).max() < 1e-5, agent["file"]


HUNDRED = """new Promise((done) => {
  const look = () => Number(document.getElementById('step').textContent) >= 100
    ? done(true) : setTimeout(look, 20);
  setTimeout(() => done(document.getElementById('loading').textContent), 60000);
  look();
})"""


@pytest.mark.parametrize(("width", "dark"), [(1000, False), (400, True)])
def test_page_drives_on_its_own_files(page: Page, tmp_path: Path, width: int, dark: bool) -> None:
    address = page.run("address")
    page.messages.clear()
    page.look(width, 800, dark)
    page.open(f"{address}/index.html?{width}")
    assert page.run(HUNDRED) is True
    assert page.run("document.documentElement.scrollWidth") <= width
    (tmp_path / "page.png").write_bytes(page.picture())
    picture = matplotlib.image.imread(tmp_path / "page.png")[..., :3]
    assert picture.shape[1] == width
    red, green, blue = picture.reshape(-1, 3).T
    assert ((blue > red + 0.2) & (blue > green + 0.1)).sum() > 2000  # hazards
    assert ((red > green + 0.3) & (red > blue + 0.3)).sum() > 50  # the robot
    assert (picture.mean() < 0.4) == dark
    page.run("document.querySelector('#envs button:last-child').click()")
    page.run("new Promise((done) => setTimeout(done, 500))")
    assert page.run(HUNDRED) is True
    assert page.messages == []


def test_page_is_small_enough(folder: Path) -> None:
    files = [path for path in folder.rglob("*") if path.is_file() and "states" not in path.name]
    assert sum(path.stat().st_size for path in files) <= 15e6
    assert sum(len(gzip.compress(path.read_bytes())) for path in files) <= 5e6
