// Where things are when an episode begins, and where the next goal is: clear places for discs.

const DRAWS = 128, RESTARTS = 2000;

/** Uniform numbers in [0, 1) that the same seed gives again (mulberry32). */
export function generator(seed) {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let mixed = Math.imul(state ^ (state >>> 15), state | 1);
    mixed ^= mixed + Math.imul(mixed ^ (mixed >>> 7), mixed | 61);
    return ((mixed ^ (mixed >>> 14)) >>> 0) / 2 ** 32;
  };
}

/** Draw a centre that keeps clear of those placed: [x, y] m, or null after `tries` draws. */
function draw(footprint, placed, half, random, tries) {
  const room = half - footprint.keepout;
  for (let i = 0; i < tries; i++) {
    const x = (2 * random() - 1) * room, y = (2 * random() - 1) * room;
    if (placed.every((other) =>
      Math.hypot(x - other.x, y - other.y) >= footprint.keepout + other.keepout)) return [x, y];
  }
  return null;
}

/** Places by name, [[x, y], ...] m each; the layout starts over where an object finds no room. */
export function arrange(footprints, half, random) {
  attempt: for (let i = 0; i < RESTARTS; i++) {
    const placed = [], places = {};
    for (const footprint of footprints) {
      places[footprint.name] = [];
      for (let k = 0; k < footprint.num; k++) {
        const place = draw(footprint, placed, half, random, DRAWS);
        if (!place) continue attempt;
        places[footprint.name].push(place);
        placed.push({ x: place[0], y: place[1], keepout: footprint.keepout });
      }
    }
    return places;
  }
  throw new Error("No clear layout was found.");
}

/** Draw the goal again among everything else: [x, y] m, or null where there is no room. */
export function redraw(footprints, places, half, random) {
  const goal = footprints.find(({ name }) => name === "goal");
  const others = footprints.filter((footprint) => footprint !== goal).flatMap(
    ({ name, keepout }) => places[name].map(([x, y]) => ({ x, y, keepout })));
  return draw(goal, others, half, random, 80 * DRAWS);
}
