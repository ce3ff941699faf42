// What the page knows of each aircraft: the last state with its time of arrival, trees, trail, what was looked at.

export const CONE_RAD = (59 * Math.PI) / 180; // the camera's horizontal field of depth
export const CONE_M = 6;
const CONE_FROM_M = 0.5;
const CELL_M = 0.25;
const HALF_CELLS = 192;
const TRAIL_MAX = 4000;

export class Craft {
  constructor(uav) {
    this.uav = uav;
    this.view = null;
    this.at = -Infinity;
    this.heard = true; // the station knows of it; a new one may not yet
    this.trees = [];
    this.treesVersion = -1;
    this.treesMap = "";
    this.trail = [];
    this.map = "";
    this.shown = null; // smoothed place: x, y, yaw
    this.seen = new Seen();
    this.preview = null;
    this.previewAt = -Infinity;
  }

  /** Take a view; ages in it grow from `now` on. */
  take(view, now) {
    this.view = view;
    this.at = now;
    const at = view.pose?.at;
    if (!at) return;
    if (view.pose.map !== this.map) this.restart(view.pose.map);
    this.extend([at[0], at[1], at[3], at[2]]);
  }

  restart(map) {
    this.map = map;
    this.trail = [];
    this.seen.clear();
    this.shown = null;
  }

  takeTrail(map, points) {
    this.restart(map);
    for (const point of points) this.extend(point);
  }

  extend(point) {
    const last = this.trail.at(-1);
    const turned = last ? Math.abs(wrap(point[2] - last[2])) : 9;
    if (last && Math.hypot(point[0] - last[0], point[1] - last[1]) < 0.05 && turned < 0.05) return;
    this.trail.push(point);
    if (this.trail.length > TRAIL_MAX) this.trail.splice(0, 500);
    this.seen.look(point);
  }

  takeTrees(message) {
    this.treesVersion = message.version;
    this.treesMap = message.map;
    this.trees = message.rows.map((r) => ({
      id: r[0], x: r[1], y: r[2], z: r[3], radius: r[4], sigma: r[5], sigmaRadius: r[6], confidence: r[7], observations: r[8], suitable: r[9] === 1, arc: r[10],
    }));
  }

  /** Return seconds since the value was fresh, null when it never was. */
  age(seconds, now) {
    return seconds === null || seconds === undefined ? null : seconds + Math.max(0, now - this.at) / 1000;
  }

  linkAge(now) {
    return this.age(this.view?.link_age, now);
  }

  /** Return good, late, lost or none: the worse of what the station says and what our own clock says. */
  link(now) {
    if (!this.heard) return "lost";
    const age = this.linkAge(now);
    if (age === null) return "none";
    if (age > 1.5) return "lost";
    return this.view.link === "lost" ? "late" : this.view.link;
  }

  /** Why nothing new of it is shown. */
  get silence() {
    return this.heard ? "link lost" : "not heard";
  }

  /** Return what kind of tree this is on map and list. */
  kind(tree) {
    const mission = this.view?.mission;
    if (mission && mission.map === this.treesMap) {
      if (mission.target === tree.id) return "target";
      if (mission.visited.includes(tree.id)) return "visited";
    }
    return tree.suitable ? "suitable" : "unsuitable";
  }

  /** Move the shown place towards the last one; return whether it still moves. */
  glide(dt) {
    const at = this.view?.pose?.at;
    if (!at) {
      this.shown = null;
      return false;
    }
    if (!this.shown || Math.hypot(at[0] - this.shown.x, at[1] - this.shown.y) > 1.5) {
      this.shown = { x: at[0], y: at[1], yaw: at[3] };
      return true;
    }
    const share = 1 - Math.exp(-dt / 0.15);
    const dx = at[0] - this.shown.x, dy = at[1] - this.shown.y, dw = wrap(at[3] - this.shown.yaw);
    this.shown.x += dx * share;
    this.shown.y += dy * share;
    this.shown.yaw = wrap(this.shown.yaw + dw * share);
    return Math.abs(dx) + Math.abs(dy) > 0.002 || Math.abs(dw) > 0.002;
  }
}

/** Cells of the ground that the camera has looked at. */
class Seen {
  constructor() {
    this.canvas = null;
    this.cell = CELL_M;
    this.size = 2 * HALF_CELLS;
    this.cells = new Uint8Array(this.size * this.size);
    this.fresh = [];
    this.cleared = true;
  }

  clear() {
    this.cells.fill(0);
    this.fresh = [];
    this.cleared = true;
  }

  look([x, y, yaw]) {
    const n = Math.ceil(CONE_M / CELL_M), cx = Math.round(x / CELL_M), cy = Math.round(y / CELL_M);
    for (let i = -n; i <= n; i++) {
      for (let j = -n; j <= n; j++) {
        const dx = (cx + i) * CELL_M - x, dy = (cy + j) * CELL_M - y, far = Math.hypot(dx, dy);
        if (far > CONE_M || far < CONE_FROM_M || Math.abs(wrap(Math.atan2(dy, dx) - yaw)) > CONE_RAD / 2) continue;
        const u = cx + i + HALF_CELLS, v = HALF_CELLS - (cy + j);
        if (u < 0 || v < 0 || u >= this.size || v >= this.size) continue;
        const k = v * this.size + u;
        if (!this.cells[k]) {
          this.cells[k] = 1;
          this.fresh.push(k);
        }
      }
    }
  }

  /** Return the cells as an image (x right, y up, the origin in its middle) in `colour`. */
  image(colour) {
    if (!this.canvas) {
      this.canvas = document.createElement("canvas");
      this.canvas.width = this.canvas.height = this.size;
    }
    const c = this.canvas.getContext("2d");
    if (this.cleared || colour !== this.colour) {
      c.clearRect(0, 0, this.size, this.size);
      this.fresh = [...this.cells.keys()].filter((k) => this.cells[k]);
      this.cleared = false;
      this.colour = colour;
    }
    c.fillStyle = colour;
    for (const k of this.fresh) c.fillRect(k % this.size, Math.floor(k / this.size), 1, 1);
    this.fresh = [];
    return this.canvas;
  }
}

export function wrap(a) {
  return ((((a + Math.PI) % (2 * Math.PI)) + 2 * Math.PI) % (2 * Math.PI)) - Math.PI;
}
