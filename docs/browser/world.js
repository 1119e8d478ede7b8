// The environment: MuJoCo's physics, and what sb3_guard computes of them in a control step.

import { arrange, redraw } from "./layout.js";

const REDRAWS = 20;
const clip = (x, low, high) => Math.min(Math.max(x, low), high);
const distance = ([x, y], [u, v]) => Math.hypot(x - u, y - v);

/** Closeness of points in each direction around the robot, as sb3_guard.envs.observation.Lidar. */
function scan(points, frame, lidar) {
  const { bins, falloff, gain, alias } = lidar, range = lidar.range ?? 3;
  const out = new Float64Array(bins);
  const show = (bin, closeness) => { out[bin] = Math.max(out[bin], closeness); };
  for (const point of points) {
    const [x, y] = into(frame, point);
    const length = Math.hypot(x, y);
    const closeness = falloff === "exponential"
      ? Math.exp(-gain * length) : Math.max(0, range - length) / range;
    const turn = ((Math.atan2(y, x) * bins / (2 * Math.PI)) % bins + bins) % bins;
    const bin = Math.min(Math.floor(turn), bins - 1);
    show(bin, closeness);
    if (alias) {
      show((bin + 1) % bins, (turn - bin) * closeness);
      show((bin + bins - 1) % bins, closeness - (turn - bin) * closeness);
    }
  }
  return out;
}

/** A point on the floor in a body's frame, [x, y] m. */
function into({ position, rotation }, [x, y]) {
  const offset = [x - position[0], y - position[1], -position[2]];
  return [0, 1].map((axis) => offset.reduce((sum, o, i) => sum + o * rotation[3 * i + axis], 0));
}

/** One environment: a robot among hazards, and a goal that moves on once it is reached. */
export class World {
  /**
   * @param mujoco the WebAssembly module
   * @param spec what scripts/make_browser.py wrote: model, parameters, order of the observation
   */
  constructor(mujoco, spec) {
    this.mujoco = mujoco;
    this.spec = spec;
    this.model = mujoco.MjModel.from_xml_string(spec.model);
    this.data = new mujoco.MjData(this.model);
    this.places = {};
  }

  /** Free MuJoCo's memory. */
  delete() {
    this.data.delete();
    this.model.delete();
  }

  /** Begin an episode; the same generator gives the same start. */
  reset(random) {
    const { spec } = this;
    this.random = random;
    this.steps = 0;
    this.mujoco.mj_resetData(this.model, this.data);
    const { robot, ...places } = arrange(spec.footprints, spec.arena, random);
    this.places = places;
    const last = spec.footprints.some(({ name, last }) => name === "goal" && last);
    if (last) this.places.goal = [redraw(spec.footprints, { ...places, robot }, spec.arena, random)];
    const yaw = 2 * Math.PI * random();
    this.data.mocap_pos.set([...robot[0], 0], 3 * spec.robot.mocap);
    this.data.mocap_quat.set([Math.cos(yaw / 2), 0, 0, Math.sin(yaw / 2)], 4 * spec.robot.mocap);
    for (const { name, index, qpos, height } of spec.bodies) {
      const turn = Math.PI * random();
      this.data.qpos.set(
        [...places[name][index], height, Math.cos(turn), 0, 0, Math.sin(turn)], qpos);
    }
    this.mujoco.mj_forward(this.model, this.data);
    this.before = this.gap();
  }

  /** Continue from a state that sb3_guard recorded. */
  restore({ qpos, qvel, mocap_pos, mocap_quat, qacc_warmstart, places }) {
    this.mujoco.mj_resetData(this.model, this.data);
    this.data.mocap_pos.set(mocap_pos);
    this.data.mocap_quat.set(mocap_quat);
    this.data.qpos.set(qpos);
    this.data.qvel.set(qvel);
    this.places = structuredClone(places);
    this.mujoco.mj_forward(this.model, this.data);
    this.data.qacc_warmstart.set(qacc_warmstart);
    this.before = this.gap();
  }

  /** Position and rotation of a body, as MuJoCo has them. */
  frame(body) {
    return {
      position: Array.from(this.data.xpos.subarray(3 * body, 3 * body + 3)),
      rotation: Array.from(this.data.xmat.subarray(9 * body, 9 * body + 9)),
    };
  }

  get robot() {
    return this.frame(this.spec.robot.body);
  }

  /** Distance from the robot to the goal, m. */
  gap() {
    return distance(this.robot.position, this.places.goal[0]);
  }

  /** The cost of being where the robot is. */
  cost() {
    const { position } = this.robot;
    let cost = 0;
    for (const { name, size, weight } of this.spec.zones) {
      for (const place of this.places[name]) {
        cost += weight * Math.max(0, size - distance(position, place));
      }
    }
    return this.spec.cost === "any" ? Number(cost > 0) : cost;
  }

  /**
   * Advance by one control step.
   * @param action within the action space, else it is clipped
   * @param next gives the goal's next place, [x, y] m; without it, it is drawn
   */
  step(action, next = () => this.nextGoal()) {
    const { spec } = this, { low, high, center, half } = spec.control, { goal } = spec;
    this.data.ctrl.set(
      center.map((middle, i) => middle + half[i] * clip(action[i], low[i], high[i])));
    for (let i = 0; i < spec.frame_skip; i++) this.mujoco.mj_step(this.model, this.data);
    this.mujoco.mj_forward(this.model, this.data); // sensors describe the new state
    this.steps += 1;
    const now = this.gap();
    const limit = goal.reward_limit ?? Infinity;
    let reward = clip(goal.reward_distance * (this.before - now), -limit, limit);
    const cost = this.cost(), met = now <= goal.size;
    this.before = now;
    if (met) {
      reward += goal.bonus;
      this.places.goal = [next() ?? this.places.goal[0]];
      this.before = this.gap();
    }
    return { reward, cost, met };
  }

  /** A place for the next goal, one still to be reached. */
  nextGoal() {
    const { spec } = this, robot = this.robot.position;
    const places = { robot: [robot] };
    for (const name of Object.keys(this.places)) places[name] = this.positions(name);
    let place = null;
    for (let i = 0; i < REDRAWS; i++) {
      place = redraw(spec.footprints, places, spec.arena, this.random);
      if (!place || distance(place, robot) > spec.goal.size) break;
    }
    return place;
  }

  /** Put a hazard or the goal somewhere else; nothing is gained by moving the goal. */
  move(name, index, place) {
    this.places[name][index] = place;
    this.before = this.gap();
  }

  /** Where the objects of a name are now, those that can be pushed included. */
  positions(name) {
    const bodies = this.spec.bodies.filter((body) => body.name === name);
    return bodies.length
      ? bodies.map(({ body }) => this.frame(body).position) : this.places[name];
  }

  /** What lidar shows of the objects of a name, [bins]. */
  lidar(name) {
    return scan(this.positions(name), this.robot, this.spec.lidar);
  }

  /** The flat observation, in the order in which the agent was trained. */
  observe() {
    const parts = this.spec.observation.map((component) => {
      if (component.kind === "sensor") {
        const { first, size } = component;
        return Array.from(this.data.sensordata.subarray(first, first + size));
      }
      if (component.kind === "lidar") return Array.from(this.lidar(component.of));
      const [x, y] = into(this.robot, this.places[component.of][0]);
      return [x, y].map((v) => v / (Math.hypot(x, y) + 0.001));
    });
    return Float32Array.from(parts.flat());
  }
}
