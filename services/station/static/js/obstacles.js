// What stands in the height of flight, from above: cells of the map in which the cloud has enough points.

const CELL_M = 0.25, HALF_CELLS = 192, SIDE = 2 * HALF_CELLS;
const LOW_M = 0.6, HIGH_M = 2.2; // above the start: the mission flies at 1.5 m
const ENOUGH = 6; // points: fewer are leaves and noise
const AGAIN_MS = 400;

export class Obstacles {
  constructor(cloud, onChange) {
    this.cell = CELL_M;
    this.size = SIDE;
    this.counts = new Uint32Array(SIDE * SIDE);
    this.shares = new Map(); // number -> cells of its points in the band
    this.onChange = onChange;
    cloud.listen((number, submap) => this.put(number, submap));
  }

  put(number, submap) {
    for (const k of this.shares.get(number) ?? []) this.counts[k]--;
    this.shares.delete(number);
    if (submap) {
      const cells = cellsOf(submap);
      for (const k of cells) this.counts[k]++;
      this.shares.set(number, cells);
    }
    this.dirty = true;
    this.onChange();
  }

  get found() {
    return this.counts.reduce((sum, n) => sum + (n >= ENOUGH), 0);
  }

  /** Return the cells as an image (x right, y up, the origin in its middle) in `colour`. */
  image(colour, now) {
    if (this.canvas && colour === this.colour && (!this.dirty || now - this.drawnAt < AGAIN_MS)) return this.canvas;
    this.canvas ??= Object.assign(document.createElement("canvas"), { width: SIDE, height: SIDE });
    const c = this.canvas.getContext("2d");
    c.clearRect(0, 0, SIDE, SIDE);
    c.fillStyle = colour;
    this.counts.forEach((n, k) => n >= ENOUGH && c.fillRect(k % SIDE, Math.floor(k / SIDE), 1, 1));
    Object.assign(this, { colour, drawnAt: now, dirty: false });
    return this.canvas;
  }
}

function cellsOf({ points, place: m }) {
  const cells = [];
  for (let i = 0; i < points.length; i += 3) {
    const x = points[i] / 100, y = points[i + 1] / 100, z = points[i + 2] / 100, up = m[8] * x + m[9] * y + m[10] * z + m[11];
    if (up < LOW_M || up > HIGH_M) continue;
    const u = Math.round((m[0] * x + m[1] * y + m[2] * z + m[3]) / CELL_M) + HALF_CELLS, v = HALF_CELLS - Math.round((m[4] * x + m[5] * y + m[6] * z + m[7]) / CELL_M);
    if (u >= 0 && v >= 0 && u < SIDE && v < SIDE) cells.push(v * SIDE + u);
  }
  return cells;
}
