"""The page in a browser: its environment is the package's, its agents act as onnxruntime's do."""

import importlib.util
import json
import re
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


def until(page: Page, condition: str) -> None:
    """Wait for a condition of the page."""
    code = f"""new Promise((done) => {{
      const look = () => ({condition}) ? done("") : setTimeout(look, 10);
      setTimeout(() => done(document.body.innerText), 60000);
      look();
    }})"""
    text = page.run(code)
    assert text == "", f"60 s without {condition}: {text}"


HUNDRED = "Number(document.getElementById('step').textContent) >= 100"


@pytest.mark.parametrize(("width", "dark"), [(1000, False), (400, True)])
def test_page_drives_on_its_own_files(page: Page, tmp_path: Path, width: int, dark: bool) -> None:
    address = page.run("address")
    page.messages.clear()
    page.look(width, 800, dark)
    page.open(f"{address}/index.html?{width}")
    until(page, "Number(document.getElementById('step').textContent) > 0")
    assert page.run("performance.now()") < 3000
    until(page, HUNDRED)
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
    until(page, HUNDRED)
    assert page.messages == []


# Worlds in the order of their first steps, the page's own before the rival's; and the picture
WATCH = """(async () => {
  const { World } = await import(`${address}/world.js`);
  const { Picture } = await import(`${address}/draw.js`);
  const { step } = World.prototype, { draw } = Picture.prototype;
  globalThis.worlds = [];
  World.prototype.step = function (action, ...rest) {
    if (!worlds.includes(this)) worlds.push(this);
    this.action = action;
    return step.call(this, action, ...rest);
  };
  Picture.prototype.draw = function (...all) { globalThis.picture = this; draw.apply(this, all); };
  globalThis.pixel = ([x, y]) => {
    const box = picture.canvas.getBoundingClientRect();
    return [box.left + (1 + x / picture.half) * box.width / 2,
            box.top + (1 - y / picture.half) * box.height / 2];
  };
  globalThis.click = (id) => document.getElementById(id).click();
  globalThis.says = (id) => document.getElementById(id).textContent;
})()"""


@pytest.fixture
def visited(page: Page) -> Page:
    """The page, opened anew, with an agent that has begun to drive."""
    page.messages.clear()
    page.look(1000, 1000)
    page.open(f"{page.run('address')}/index.html?visit")
    page.run(WATCH)
    until(page, "worlds[0]?.steps >= 5 && picture")
    return page


def point(page: Page, kind: str, device: str, x: float, y: float) -> None:
    """Press, move or release a mouse or a finger, pixels."""
    if device == "mouse":
        name = {"press": "mousePressed", "move": "mouseMoved", "release": "mouseReleased"}[kind]
        page.call("Input.dispatchMouseEvent", type=name, x=x, y=y, button="left", clickCount=1)
    else:
        name = {"press": "touchStart", "move": "touchMove", "release": "touchEnd"}[kind]
        points = [] if kind == "release" else [{"x": x, "y": y}]
        page.call("Input.dispatchTouchEvent", type=name, touchPoints=points)


def press(page: Page, code: str, down: bool, **more: int) -> None:
    kind = "keyDown" if down else "keyUp"
    page.call("Input.dispatchKeyEvent", type=kind, code=code, key=code[-1].lower(), **more)


SEEN = "({places: structuredClone(worlds[0].places), obs: [...worlds[0].observe()]})"


@pytest.mark.parametrize("name", ["hazards", "goal"])
@pytest.mark.parametrize("device", ["mouse", "touch"])
def test_dragging_moves_an_object_that_the_agent_observes(
    visited: Page, device: str, name: str
) -> None:
    visited.run("click('pause')")
    before = visited.run(SEEN)
    x, y = visited.run(f"pixel(worlds[0].places.{name}[0])")
    point(visited, "press", device, x + 2, y)
    for pixels in (10, 20, 30):
        point(visited, "move", device, x + 2 + pixels, y - pixels)
    point(visited, "release", device, x + 32, y - 30)
    point(visited, "move", "mouse", x + 200, y)  # nothing is held any more
    after = visited.run(SEEN)
    meters = visited.run("60 * picture.half / picture.canvas.clientWidth")
    (u, v), (w, z) = before["places"][name][0], after["places"][name][0]
    assert [w - u, z - v] == pytest.approx([meters, meters], abs=0.02)
    others = [[places.pop(name)[1:], places] for places in (before["places"], after["places"])]
    assert others[0] == others[1]
    assert np.abs(np.subtract(before["obs"], after["obs"])).max() > 1e-3
    visited.run("worlds[0].spec.steps = worlds[0].steps + 3; click('pause')")
    until(visited, "!document.getElementById('verdict').hidden")
    assert visited.run(RECORDS)[0].startswith("agent, limit 5, moved objects|1|")
    assert visited.messages == []


def more(page: Page, steps: int) -> None:
    """Wait for so many control steps."""
    until(page, f"worlds[0].steps >= {page.run('worlds[0].steps') + steps}")


POSE = "(({ position: [x, y], rotation: r }) => [x, y, Math.atan2(r[3], r[0])])(worlds[0].robot)"


def test_keys_drive_beside_the_agent(visited: Page) -> None:
    press(visited, "KeyS", True, modifiers=2)  # Control + S belongs to the browser
    assert visited.run("says('drive')") == "Drive yourself"
    press(visited, "KeyW", True)
    assert visited.run("says('drive')") == "Let the agent drive"
    start = visited.run(POSE)
    until(visited, "worlds[0].steps >= 30")
    x, y, yaw = visited.run(POSE)
    ahead = (x - start[0]) * np.cos(start[2]) + (y - start[1]) * np.sin(start[2])
    assert ahead > 0.05 and abs(yaw - start[2]) < 0.2
    press(visited, "KeyW", False)
    press(visited, "ArrowLeft", True)
    more(visited, 10)
    press(visited, "ArrowLeft", False)
    turned = visited.run(POSE)[2] - yaw
    assert (turned + np.pi) % (2 * np.pi) - np.pi > 0.1
    assert visited.run("worlds[0].steps === worlds[1].steps && worlds[0].action[0] === 0")
    assert visited.run("says('return-agent')").startswith("agent ")


@pytest.mark.parametrize(
    ("cost", "driver", "verdict"),
    [(0, "agent", "kept"), (1, "agent", "exceeded"), (1, "you", "exceeded")],
)
def test_an_episode_ends_with_a_verdict(
    visited: Page, cost: int, driver: str, verdict: str
) -> None:
    if driver == "you":
        visited.run("click('drive')")
        visited.run(
            "{ const w = worlds[0], step = w.step.bind(w);"
            "w.step = (...all) => ({...step(...all), reward: -0.001}); }"
        )
    visited.run(f"worlds[0].cost = () => {cost}; worlds[0].spec.steps = 15; click('again')")
    until(visited, "worlds[0].steps >= 15")
    assert visited.run("says('verdict')").startswith(f"Limit {verdict}return ")
    assert f"cost {15 * cost}.0 of at most 5" in visited.run("says('verdict')")
    assert visited.run("document.getElementById('verdict').checkVisibility()")
    assert driver == "agent" or "return 0.0," in visited.run("says('verdict')")  # not -0.0
    rows = [row.split("|") for row in visited.run(RECORDS)]
    assert rows[0][:2] == [driver if driver == "you" else "agent, limit 5", "1"]
    assert float(rows[0][3]) == 15 * cost
    assert [row[0] for row in rows[1:]] == (["agent, limit 5"] if driver == "you" else [])
    visited.run("worlds[0].spec.steps = 1000")
    until(visited, "document.getElementById('verdict').hidden")  # the next episode begins


RECORDS = """[...document.querySelectorAll('#records tr')].map(
  (row) => [...row.cells].map((cell) => cell.textContent).join('|'))"""


def test_the_limit_chooses_the_agent_and_says_what_it_was_measured_to_do(
    folder: Path, visited: Page
) -> None:
    for number, entry in enumerate(json.loads((folder / "agents.json").read_text())):
        visited.run(f"document.querySelectorAll('#envs button')[{number}].click()")
        visited.run("new Promise((done) => setTimeout(done, 1000))")
        for index, agent in enumerate(entry["agents"]):
            visited.run(f"limit.value = {index}; limit.dispatchEvent(new Event('input'))")
            visited.run("new Promise((done) => setTimeout(done, 300))")
            name = "none" if agent["limit"] is None else str(agent["limit"])
            assert visited.run("[says('bound'), says('chosen')]") == [name, name]
            text, cost = visited.run("says('agent')"), agent["greedy"]
            assert ("without a limit" if name == "none" else f"Trained at {name},") in text
            numbers = [float(number) for number in re.findall(r"\d+\.\d", text)]
            assert numbers == pytest.approx([cost["cost"], cost["low"], cost["high"]], abs=0.051)
            assert (cost["verdict"] == "exceeds") == ("it exceeds the limit" in text)
            assert (cost["verdict"] == "certified") == ("certified, it keeps the limit." in text)
            cells = "[...document.querySelectorAll('#measured td:last-child')]"
            stated = visited.run(f"{cells}.map((cell) => cell.textContent)")
            assert stated == [agent[key]["verdict"] or "–" for key in ("sampled", "greedy")]
            for width in (400, 820, 1000):
                visited.look(width, 800)
                overflow = "[document.documentElement, document.querySelector('.panel')].map("
                overflow += "({ scrollWidth, clientWidth }) => scrollWidth - clientWidth)"
                assert visited.run(overflow) == [0, 0], width
    assert visited.messages == []
