// The arena from above, drawn on a canvas.

const COLORS = {
  light: { floor: "#eceff2", tile: "#e2e6ea", edge: "#b9c2cc", shadow: "rgba(20, 30, 45, 0.22)" },
  dark: { floor: "#222b36", tile: "#28323e", edge: "#4a5766", shadow: "rgba(0, 0, 0, 0.45)" },
};
const RGB = { goal: "20, 165, 110", hazards: "25, 105, 215", vases: "30, 175, 190" };
const TRAIL = 250; // control steps

/** Draws a world; `point` turns a place on the screen into one in the world. */
export class Picture {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.clear(2);
  }

  /** Forget the trail, before another episode. */
  clear(arena) {
    this.trail = [];
    this.half = arena + 0.35;
  }

  /** Note where the robot is after a control step, and whether it incurs a cost there. */
  note([x, y], cost) {
    this.trail.push({ x, y, cost });
    if (this.trail.length > TRAIL) this.trail.shift();
  }

  /** World coordinates, [x, y] m, of a pointer. */
  point({ clientX, clientY }) {
    const box = this.canvas.getBoundingClientRect();
    return [
      (2 * (clientX - box.left) / box.width - 1) * this.half,
      (1 - 2 * (clientY - box.top) / box.height) * this.half,
    ];
  }

  disc(x, y, radius, fill, stroke) {
    const { pen } = this;
    pen.beginPath();
    pen.arc(x, y, radius, 0, 2 * Math.PI);
    if (fill) { pen.fillStyle = fill; pen.fill(); }
    if (stroke) { pen.strokeStyle = stroke; pen.stroke(); }
  }

  floor(arena, colors) {
    const { pen, half } = this, size = 0.5, reach = Math.ceil(half / size);
    pen.fillStyle = colors.floor;
    pen.fillRect(-half, -half, 2 * half, 2 * half);
    pen.fillStyle = colors.tile;
    for (let i = -reach; i < reach; i++) {
      for (let k = -reach; k < reach; k++) {
        if ((i + k) & 1) pen.fillRect(i * size, k * size, size, size);
      }
    }
    pen.strokeStyle = colors.edge;
    pen.lineWidth = 0.012;
    pen.setLineDash([0.06, 0.05]);
    pen.strokeRect(-arena, -arena, 2 * arena, 2 * arena);
    pen.setLineDash([]);
  }

  zone(x, y, radius, rgb, held) {
    const { pen } = this;
    const glow = pen.createRadialGradient(x, y, 0, x, y, radius);
    glow.addColorStop(0, `rgba(${rgb}, 0.55)`);
    glow.addColorStop(1, `rgba(${rgb}, 0.3)`);
    pen.lineWidth = held ? 0.04 : 0.018;
    this.disc(x, y, radius, glow, `rgba(${rgb}, 0.95)`);
  }

  goal(x, y, radius, time) {
    const { pen } = this;
    this.zone(x, y, radius, RGB.goal);
    for (let i = 0; i < 2; i++) {
      const share = (time / 1600 + i / 2) % 1;
      pen.lineWidth = 0.02;
      this.disc(x, y, radius * share, null, `rgba(${RGB.goal}, ${0.8 * (1 - share)})`);
    }
    this.disc(x, y, 0.05, `rgb(${RGB.goal})`);
  }

  path() {
    const { pen, trail } = this;
    pen.lineCap = "round";
    pen.lineWidth = 0.03;
    for (let i = 1; i < trail.length; i++) {
      const { x, y, cost } = trail[i], share = 0.75 * i / trail.length;
      pen.strokeStyle = cost > 0 ? `rgba(220, 55, 45, ${share})` : `rgba(120, 130, 145, ${share})`;
      pen.beginPath();
      pen.moveTo(trail[i - 1].x, trail[i - 1].y);
      pen.lineTo(x, y);
      pen.stroke();
    }
  }

  box(x, y, yaw, half, colors) {
    const { pen } = this;
    pen.save();
    pen.translate(x, y);
    pen.rotate(yaw);
    pen.fillStyle = colors.shadow;
    pen.fillRect(-half + 0.03, -half - 0.03, 2 * half, 2 * half);
    pen.fillStyle = `rgb(${RGB.vases})`;
    pen.fillRect(-half, -half, 2 * half, 2 * half);
    pen.restore();
  }

  rings(world, x, y, yaw) {
    const bins = world.spec.lidar.bins;
    const seen = world.spec.observation.filter(({ kind }) => kind === "lidar");
    seen.forEach(({ of }, ring) => world.lidar(of).forEach((closeness, bin) => {
      const angle = yaw + 2 * Math.PI * (bin + 0.5) / bins, far = 0.23 + 0.06 * ring;
      const color = `rgba(${RGB[of] ?? RGB.hazards}, ${closeness})`;
      this.disc(x + far * Math.cos(angle), y + far * Math.sin(angle), 0.021, color);
    }));
  }

  robot(x, y, yaw, cost, colors) {
    const { pen } = this;
    this.disc(x + 0.03, y - 0.03, 0.105, colors.shadow);
    pen.save();
    pen.translate(x, y);
    pen.rotate(yaw);
    pen.fillStyle = "#7c1d16";
    pen.fillRect(0.05, -0.05, 0.1, 0.1);
    const shade = pen.createRadialGradient(0.02, 0.03, 0.01, 0, 0, 0.1);
    shade.addColorStop(0, cost > 0 ? "#ffb3a8" : "#ff8d79");
    shade.addColorStop(1, "#c2321f");
    this.disc(0, 0, 0.1, shade);
    pen.restore();
    if (cost > 0) {
      pen.lineWidth = 0.03;
      this.disc(x, y, 0.16, null, "rgba(220, 55, 45, 0.9)");
    }
  }

  /**
   * @param world the environment
   * @param pose [x, y, yaw] of the robot, between two control steps
   * @param cost of the last step
   * @param held what is dragged: { name, index }
   */
  draw(world, [x, y, yaw], cost, held, time) {
    const { canvas, pen } = this, { arena, zones, bodies, goal } = world.spec;
    const colors = COLORS[this.dark.matches ? "dark" : "light"];
    const pixels = Math.round(canvas.clientWidth * devicePixelRatio) || 1;
    if (canvas.width !== pixels) canvas.width = canvas.height = pixels;
    const half = Math.min(Math.max(arena + 0.35, Math.abs(x) + 0.4, Math.abs(y) + 0.4), 3 * arena);
    this.half += 0.08 * (half - this.half);
    const scale = pixels / (2 * this.half);
    pen.setTransform(scale, 0, 0, -scale, pixels / 2, pixels / 2);
    this.floor(arena, colors);
    const [[u, v]] = world.places.goal;
    this.goal(u, v, goal.size, time);
    for (const { name, size } of zones) {
      world.places[name].forEach(([a, b], index) =>
        this.zone(a, b, size, RGB.hazards, held?.name === name && held.index === index));
    }
    this.path();
    for (const { body, size } of bodies) {
      const { position: [a, b], rotation } = world.frame(body);
      this.box(a, b, Math.atan2(rotation[3], rotation[0]), size, colors);
    }
    this.rings(world, x, y, yaw);
    this.robot(x, y, yaw, cost, colors);
  }
}
