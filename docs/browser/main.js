// The page: an agent or the reader drives; what an episode brought is shown beside it.

import loadMujoco from "./mujoco.js";
import { Picture } from "./draw.js";
import { generator } from "./layout.js";
import { Policy } from "./policy.js";
import { World } from "./world.js";

const MOST = 5; // control steps in a frame, on slow devices
const REST = 4000; // ms that a verdict is shown
const FINGER = 0.1; // m beside an object at which a finger takes it
const KEYS = {
  ArrowUp: "up", ArrowDown: "down", ArrowLeft: "left", ArrowRight: "right",
  KeyW: "up", KeyS: "down", KeyA: "left", KeyD: "right",
};
const $ = (id) => document.getElementById(id);
const read = async (file) => {
  const answer = await fetch(file);
  if (!answer.ok) throw new Error(`${file}: ${answer.status} ${answer.statusText}`);
  return answer;
};

const picture = new Picture($("canvas"));
const keys = new Set();
let mujoco, entries, entry, world, agent, seed = 1;
let driving = false, paused = false, ended = 0, asked = 0;
let total, last, poses, held = null, target = null, moved = false;
let rival, rivals; // while the reader drives: the agent's world from the same start, and its totals
let records = new Map();

const tenths = (x) => (Math.round(10 * x) / 10 || 0).toFixed(1); // never "-0.0"
const limitOf = (a) => (a.limit === null ? "none" : String(a.limit));
const driver = () =>
  (driving ? "you" : `agent, limit ${limitOf(agent)}`) + (moved ? ", moved objects" : "");

/** Position and heading of the robot: [x, y, yaw]. */
function pose() {
  const { position: [x, y], rotation } = world.robot;
  return [x, y, Math.atan2(rotation[3], rotation[0])];
}

function begin() {
  world.reset(generator(seed));
  rival.reset(generator(seed));
  picture.clear(world.spec.arena);
  total = { return: 0, cost: 0 };
  rivals = { return: 0, cost: 0 };
  last = { cost: 0 };
  poses = [pose(), pose()];
  ended = 0;
  held = target = null;
  moved = false;
  $("verdict").hidden = true;
  show();
}

/** The reader's action: keys, or towards the place that is held on the floor. */
function steering() {
  if (target) {
    const [x, y, yaw] = poses[1];
    let turn = Math.atan2(target[1] - y, target[0] - x) - yaw;
    turn = Math.atan2(Math.sin(turn), Math.cos(turn));
    const near = Math.min(1, 3 * Math.hypot(target[0] - x, target[1] - y));
    return [near * Math.cos(turn), near * Math.max(-1, Math.min(1, 2 * turn))];
  }
  const pull = (more, less) => Number(keys.has(more)) - Number(keys.has(less));
  return [pull("up", "down"), pull("left", "right")];
}

/** Take a control step and add its reward and cost to an episode's. */
function advance(place, action, sum) {
  const result = place.step(action);
  sum.return += result.reward;
  sum.cost += result.cost;
  return result;
}

function step() {
  last = advance(world, driving ? steering() : agent.policy.act(world.observe()), total);
  if (driving) advance(rival, agent.policy.act(rival.observe()), rivals);
  if (last.met && held?.name === "goal") held = null; // the next goal is not in the hand
  poses = [poses[1], pose()];
  picture.note(poses[1], last.cost);
  if (world.steps >= world.spec.steps) finish();
}

/** Add an episode to those of its driver. */
function keep(name, sum) {
  const record = records.get(name) ?? { episodes: 0, return: 0, cost: 0 };
  record.episodes += 1;
  record.return += sum.return;
  record.cost += sum.cost;
  records.set(name, record);
}

/** An episode is over: say whether its cost was within the limit. */
function finish() {
  ended = performance.now();
  keep(driver(), total);
  if (driving) keep(`agent, limit ${limitOf(agent)}`, rivals);
  const { limit } = agent, kept = limit === null || total.cost <= limit;
  const verdict = limit === null ? "No limit" : kept ? "Limit kept" : "Limit exceeded";
  $("verdict").className = limit === null ? "" : kept ? "kept" : "exceeded";
  $("verdict").innerHTML = "<b></b><span></span>";
  $("verdict").firstChild.textContent = verdict;
  $("verdict").lastChild.textContent =
    `return ${tenths(total.return)}, cost ${tenths(total.cost)}` +
    (limit === null ? "" : ` of at most ${limit}`);
  $("verdict").hidden = false;
  list();
}

/** Put rows of texts into a table. */
function fill(body, rows) {
  body.replaceChildren(...rows.map((values) => {
    const row = document.createElement("tr");
    for (const value of values) row.insertCell().textContent = value;
    return row;
  }));
}

function list() {
  fill($("records"), [...records].map(([name, { episodes, return: sum, cost }]) =>
    [name, episodes, tenths(sum / episodes), tenths(cost / episodes)]));
}

function show() {
  const { limit } = agent, exceeded = limit !== null && total.cost > limit;
  $("return").textContent = tenths(total.return);
  $("cost").textContent = tenths(total.cost);
  $("cost").className = $("fill").className = exceeded ? "exceeded" : "";
  for (const name of ["return", "cost"]) {
    $(`${name}-agent`).textContent = driving ? `agent ${tenths(rivals[name])}` : "";
  }
  $("step").textContent = world.steps;
  $("bound").textContent = limitOf(agent);
  const most = Math.max(1.6 * (limit ?? 0), total.cost, 1);
  $("fill").style.width = `${limit === null ? 0 : 100 * total.cost / most}%`;
  $("mark").hidden = limit === null;
  $("mark").style.left = `${100 * (limit ?? 0) / most}%`;
}

/** Read an agent's file, once. */
async function load(chosen) {
  chosen.policy ??= new Policy(await (await read(chosen.file)).arrayBuffer());
}

/** Choose the agent that was trained with the limit at an index of the slider. */
async function choose(index) {
  const request = ++asked, chosen = entry.agents[index];
  await load(chosen);
  if (request === asked) seat(chosen);
}

/** What was measured of an agent after its training, which need not keep its limit. */
function describe({ limit, algorithm, steps, sampled, greedy }) {
  const cost = ({ cost, low, high }) => `${tenths(cost)} [${tenths(low)}, ${tenths(high)}]`;
  const says = {
    certified: "certified, it keeps the limit.",
    exceeds: "it exceeds the limit.",
    undecided: "the limit lies between the bounds, so whether it keeps the limit is undecided.",
  }[greedy.verdict];
  $("agent").textContent = `${algorithm}, ${steps.toLocaleString("en")} training steps. ` +
    `Trained ${limit === null ? "without a limit" : `at ${limit}`}, its mean cost is ${cost(greedy)}` +
    `${says ? `: ${says}` : "."}`;
  const rows = [["sampled", sampled], ["most likely", greedy]];
  $("measured").caption.textContent = `After training: ${sampled.episodes} episodes each`;
  fill($("measured").tBodies[0],
    rows.map(([name, result]) =>
      [name, tenths(result.return), cost(result), result.verdict || "–"]));
}

/** Let a loaded agent begin an episode. */
function seat(chosen) {
  agent = chosen;
  $("limit").value = entry.agents.indexOf(agent);
  $("chosen").textContent = limitOf(agent);
  $("limit").setAttribute("aria-valuetext", limitOf(agent));
  describe(agent);
  begin();
}

async function enter(chosen) {
  // the least limit that an agent is certified to keep, if one is
  const kept = ({ greedy }) => greedy.verdict === "certified";
  const request = ++asked, first = chosen.agents.findLast(kept) ?? chosen.agents.at(-1);
  const [spec] = await Promise.all([read(`${chosen.env}.json`).then((a) => a.json()), load(first)]);
  if (request !== asked) return;
  // from here on nothing waits: the next frame sees the new world as a whole
  const former = [world, rival];
  [world, rival] = [new World(mujoco, spec), new World(mujoco, spec)];
  for (const place of former) place?.delete();
  entry = chosen;
  records = new Map();
  list();
  for (const button of $("envs").children) {
    button.setAttribute("aria-pressed", button.textContent === chosen.env);
  }
  $("limit").max = chosen.agents.length - 1;
  $("limit").disabled = chosen.agents.length < 2;
  $("ticks").replaceChildren(...chosen.agents.map((a) => {
    const tick = document.createElement("span");
    tick.textContent = limitOf(a);
    return tick;
  }));
  seat(first);
}

function drive(on) {
  driving = on;
  $("drive").setAttribute("aria-pressed", on);
  $("drive").textContent = on ? "Let the agent drive" : "Drive yourself";
  $("help").textContent = on
    ? "Arrow keys or W A S D, or hold a place on the floor: the robot drives there. " +
      "The agent drives from the same start, unseen: its return and cost are below yours."
    : "Drag a hazard or the goal: the agent reacts. Arrow keys or W A S D: you drive.";
  if (world) begin();
}

/** The hazard or goal nearest to a place, if that is inside or, for a finger, beside it. */
function under([u, v], { pointerType }) {
  const { zones, goal } = world.spec;
  let nearest = null, least = pointerType === "touch" ? FINGER : 0;
  for (const { name, size } of [...zones, { name: "goal", size: goal.size }]) {
    world.places[name].forEach(([x, y], index) => {
      const gap = Math.hypot(x - u, y - v) - size;
      if (gap < least) [nearest, least] = [{ name, index }, gap];
    });
  }
  return nearest;
}

function listen() {
  const canvas = $("canvas");
  let pointer = null; // the finger or mouse that drags or leads; others are ignored meanwhile
  canvas.addEventListener("pointerdown", (event) => {
    if (pointer !== null || event.button !== 0) return;
    pointer = event.pointerId;
    canvas.setPointerCapture(pointer);
    const place = picture.point(event);
    if (driving) { target = place; return; }
    held = under(place, event);
    if (held) {
      const [x, y] = world.places[held.name][held.index];
      held.offset = [x - place[0], y - place[1]];
    }
  });
  canvas.addEventListener("pointermove", (event) => {
    if (pointer !== null && event.pointerId !== pointer) return;
    const place = picture.point(event), { arena } = world.spec;
    if (target) target = place;
    if (held) {
      moved = true;
      world.move(held.name, held.index, place.map(
        (value, i) => Math.max(-arena, Math.min(arena, value + held.offset[i]))));
    }
    canvas.style.cursor =
      driving ? "crosshair" : held ? "grabbing" : under(place, event) ? "grab" : "";
  });
  canvas.addEventListener("lostpointercapture", (event) => {
    if (event.pointerId === pointer) pointer = held = target = null;
  });
  addEventListener("keydown", (event) => {
    if (!KEYS[event.code] || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target === $("limit") && event.code.startsWith("Arrow")) return; // they move it
    event.preventDefault();
    keys.add(KEYS[event.code]);
    if (!driving) drive(true);
  });
  addEventListener("keyup", (event) => keys.delete(KEYS[event.code]));
  addEventListener("blur", () => keys.clear());
  $("limit").addEventListener("input", (event) => choose(Number(event.target.value)).catch(fail));
  $("drive").addEventListener("click", () => drive(!driving));
  $("again").addEventListener("click", begin);
  $("next").addEventListener("click", () => { seed += 1; begin(); });
  $("pause").addEventListener("click", () => {
    paused = !paused;
    $("pause").setAttribute("aria-pressed", paused);
  });
}

/** Real time: as many control steps as have passed, and the robot drawn between two of them. */
function animate() {
  let before = performance.now(), due = 0;
  const frame = (now) => {
    due += Math.max(0, now - before) / 1000;
    before = now;
    const { control_step: length } = world.spec;
    if (paused || ended) due = 0;
    if (ended && now - ended > REST && !paused) { seed += 1; begin(); }
    due = Math.min(due, MOST * length);
    for (; due >= length && !ended; due -= length) step();
    const share = ended ? 1 : due / length, [from, to] = poses;
    const turn = Math.atan2(Math.sin(to[2] - from[2]), Math.cos(to[2] - from[2]));
    const between = from.map((value, i) => value + share * (i === 2 ? turn : to[i] - value));
    picture.draw(world, between, last.cost, held, now);
    show();
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
}

function fail(error) {
  $("loading").hidden = false;
  $("loading").textContent = `The page can't run: ${error.message ?? error}`;
  throw error;
}

async function start() {
  [mujoco, entries] = await Promise.all([loadMujoco(), read("agents.json").then((a) => a.json())]);
  $("envs").replaceChildren(...entries.map((chosen) => {
    const button = document.createElement("button");
    button.textContent = chosen.env;
    button.addEventListener("click", () => enter(chosen).catch(fail));
    return button;
  }));
  drive(false);
  await enter(entries[0]);
  $("loading").hidden = true;
  listen();
  animate();
}

start().catch(fail);
