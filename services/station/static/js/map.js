// The map from above: x up the screen (the first camera heading), y to the left, metres.

import { listen } from "./hands.js";
import { CONE_M, CONE_RAD } from "./model.js";
import { circle, label, line, palette } from "./paint.js";

const MIN_SCALE = 6, MAX_SCALE = 400; // pixels per metre

export class MapView {
  constructor(canvas, { onPick = null, bare = false } = {}) {
    this.canvas = canvas;
    this.bare = bare;
    this.onPick = onPick;
    this.centre = { x: 0, y: 0 };
    this.scale = 40;
    this.follow = false;
    this.fitted = true; // as long as nobody moved it, it keeps everything in view
    this.craft = null;
    this.selected = null;
    this.inset = { top: 0, bottom: 0, right: 0 }; // covered by what lies over the map
    this.colours = palette();
    this.dirty = true;
    if (!bare) listen(this);
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  resize() {
    const ratio = Math.min(devicePixelRatio || 1, 2), box = this.canvas.getBoundingClientRect();
    this.width = box.width;
    this.height = box.height;
    this.canvas.width = Math.max(1, Math.round(box.width * ratio));
    this.canvas.height = Math.max(1, Math.round(box.height * ratio));
    this.ratio = ratio;
    this.dirty = true;
  }

  show(craft) {
    if (this.craft !== craft) this.fitted = true;
    this.craft = craft;
    this.dirty = true;
  }

  /** Map to pixels: map x is up, map y is left. */
  px(x, y) {
    return [this.width / 2 - (y - this.centre.y) * this.scale, this.height / 2 - (x - this.centre.x) * this.scale];
  }

  at(u, v) {
    return { x: this.centre.x - (v - this.height / 2) / this.scale, y: this.centre.y - (u - this.width / 2) / this.scale };
  }

  // -- what hands do

  move(du, dv) {
    this.centre.x += dv / this.scale;
    this.centre.y += du / this.scale;
    this.follow = this.fitted = false;
    this.dirty = true;
    this.onMoved?.();
  }

  zoom(by, u = this.width / 2, v = this.height / 2) {
    const before = this.at(u, v);
    this.scale = Math.min(MAX_SCALE, Math.max(MIN_SCALE, this.scale * by));
    const after = this.at(u, v);
    this.centre.x += before.x - after.x;
    this.centre.y += before.y - after.y;
    this.fitted = false;
    this.dirty = true;
  }

  pick({ u, v }) {
    const p = this.at(u, v);
    let best = null, near = 26 / this.scale;
    for (const tree of this.craft?.trees ?? []) {
      const far = Math.max(0, Math.hypot(tree.x - p.x, tree.y - p.y) - tree.radius);
      if (far < near) [best, near] = [tree, far];
    }
    this.onPick?.(best);
  }

  /** Show trees and aircraft whole, at least 8 m across. */
  fit() {
    this.fitted = true;
    this.follow = false;
    this.dirty = true;
    this.onMoved?.();
  }

  applyFit() {
    const craft = this.craft;
    if (!craft || !this.width) return;
    const points = craft.trees.filter((t) => Math.hypot(t.x, t.y) < 60).map((t) => [t.x, t.y]), at = craft.shown;
    points.push([0, 0]);
    if (at) points.push([at.x, at.y], ...[-0.5, 0, 0.5].map((k) => coneEnd(at, k)));
    const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
    const box = { x0: Math.min(...xs), x1: Math.max(...xs), y0: Math.min(...ys), y1: Math.max(...ys) };
    const { top, bottom, right } = this.inset, margin = Math.min(34, 0.06 * Math.min(this.width, this.height) + 4);
    const scale = Math.min((this.width - 2 * margin - right) / Math.max(8, box.y1 - box.y0), (this.height - 2 * margin - top - bottom) / Math.max(8, box.x1 - box.x0));
    this.scale = Math.min(MAX_SCALE, Math.max(MIN_SCALE * 0.5, scale));
    this.centre = { x: (box.x0 + box.x1) / 2 + (top - bottom) / 2 / this.scale, y: (box.y0 + box.y1) / 2 - right / 2 / this.scale };
  }

  // -- drawing

  draw(now) {
    if (!this.width) return;
    if (this.fitted) this.applyFit();
    else if (this.follow && this.craft?.shown) this.centre = { x: this.craft.shown.x, y: this.craft.shown.y };
    const c = this.canvas.getContext("2d");
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.fillStyle = this.colours.map;
    c.fillRect(0, 0, this.width, this.height);
    const craft = this.craft;
    if (craft) this.drawCells(c, craft.seen, craft.seen.image(this.colours.seen), true);
    if (craft && this.obstacles) this.drawCells(c, this.obstacles, this.obstacles.image(this.colours.solid, now), false);
    this.drawGrid(c);
    if (!craft) return;
    this.drawTrail(c, craft);
    this.drawCone(c, craft);
    this.drawWay(c, craft);
    for (const tree of craft.trees) this.drawTree(c, craft, tree);
    this.drawMeasured(c, craft, now);
    this.drawCraft(c, craft, now);
    if (!this.bare) this.drawScale(c);
  }

  /** Draw a raster of cells about the origin. */
  drawCells(c, { size, cell }, image, soft) {
    const side = size * cell * this.scale, [u, v] = this.px(0, 0);
    c.save();
    c.translate(u, v);
    c.rotate(-Math.PI / 2); // the image has x to the right
    c.imageSmoothingEnabled = soft;
    const half = (cell * this.scale) / 2; // a cell lies about its point
    c.drawImage(image, -side / 2 - half, -side / 2 - half, side, side);
    c.restore();
  }

  drawGrid(c) {
    const a = this.at(0, this.height), b = this.at(this.width, 0);
    const step = this.scale < 12 ? 5 : 1;
    c.lineWidth = 1;
    for (let x = Math.ceil(a.x / step) * step; x <= b.x; x += step) line(c, this.px(x, a.y), this.px(x, b.y), x % 5 === 0 ? this.colours.grid5 : this.colours.grid);
    for (let y = Math.ceil(b.y / step) * step; y <= a.y; y += step) line(c, this.px(a.x, y), this.px(b.x, y), y % 5 === 0 ? this.colours.grid5 : this.colours.grid);
    const [u, v] = this.px(0, 0);
    c.strokeStyle = this.colours.soft;
    c.lineWidth = 2;
    c.beginPath();
    c.moveTo(u - 9, v); c.lineTo(u + 9, v); c.moveTo(u, v - 9); c.lineTo(u, v + 9);
    c.stroke();
    const at = this.craft?.shown, near = at && Math.hypot(at.x, at.y) * this.scale < 60;
    if (!this.bare && !near) label(c, "start", u + 8, v + 16, this.colours.soft, 13, this.colours.map);
  }

  drawTrail(c, craft) {
    if (craft.trail.length < 2) return;
    c.strokeStyle = this.colours.trail;
    c.lineWidth = 3;
    c.lineJoin = "round";
    c.beginPath();
    for (const [x, y] of craft.trail) c.lineTo(...this.px(x, y));
    c.stroke();
  }

  drawCone(c, craft) {
    const at = craft.shown;
    if (!at) return;
    const [u, v] = this.px(at.x, at.y), middle = -Math.PI / 2 - at.yaw, r = CONE_M * this.scale;
    c.beginPath();
    c.moveTo(u, v);
    c.arc(u, v, r, middle - CONE_RAD / 2, middle + CONE_RAD / 2);
    c.closePath();
    c.fillStyle = this.colours.cone;
    c.fill();
    c.strokeStyle = this.colours.coneLine;
    c.lineWidth = 1.2;
    c.stroke();
  }

  drawWay(c, craft) {
    const mission = craft.view?.mission, tree = craft.trees.find((t) => t.id === mission?.target), at = craft.shown;
    if (!tree || !at || mission.map !== craft.treesMap) return;
    c.setLineDash([7, 6]);
    c.strokeStyle = this.colours.target;
    c.lineWidth = 2;
    c.beginPath();
    c.moveTo(...this.px(at.x, at.y));
    c.lineTo(...this.px(tree.x, tree.y));
    c.stroke();
    c.setLineDash([]);
  }

  drawTree(c, craft, tree) {
    const [u, v] = this.px(tree.x, tree.y);
    if (u < -60 || v < -60 || u > this.width + 60 || v > this.height + 60) return;
    const kind = craft.kind(tree), k = this.colours;
    const least = this.bare ? 2.5 : 5, r = Math.max(tree.radius * this.scale, least);
    const doubt = (tree.radius + 2 * tree.sigma) * this.scale;
    const colour = { suitable: k.tree, unsuitable: k.un, visited: k.visited, target: k.target }[kind];
    if (doubt > r + 1.5) {
      c.strokeStyle = colour;
      c.globalAlpha = 0.55;
      c.lineWidth = 1.5;
      circle(c, u, v, doubt);
      c.stroke();
      c.globalAlpha = 1;
    }
    circle(c, u, v, r);
    if (kind === "unsuitable") {
      if (r > 6) c.setLineDash([3, 2.5]);
      c.strokeStyle = colour;
      c.lineWidth = 2;
      c.fillStyle = k.map;
      c.fill();
      c.stroke();
      c.setLineDash([]);
    } else {
      c.fillStyle = kind === "target" && !tree.suitable ? k.un : colour;
      c.fill();
    }
    if (kind === "target") {
      c.strokeStyle = colour;
      c.lineWidth = this.bare ? 2 : 3.5;
      circle(c, u, v, Math.max(r, doubt) + 7);
      c.stroke();
    }
    if (kind === "visited" && !this.bare) {
      c.strokeStyle = colour;
      c.lineWidth = 3;
      c.beginPath();
      c.moveTo(u + r + 5, v - r - 4); c.lineTo(u + r + 9, v - r); c.lineTo(u + r + 17, v - r - 11);
      c.stroke();
    }
    if (tree.id === this.selected) {
      c.strokeStyle = k.ink;
      c.lineWidth = 2.5;
      circle(c, u, v, Math.max(r, doubt) + 13);
      c.stroke();
    }
    if (!this.bare && (this.scale > 14 || kind !== "unsuitable")) {
      label(c, String(tree.id), u + r + 5, v + r + 14, kind === "unsuitable" ? k.soft : k.ink, 15, this.colours.map);
    }
  }

  drawMeasured(c, craft) {
    const t = craft.view?.target;
    if (!t?.at || t.status !== "tracking") return;
    const [u, v] = this.px(t.at[0], t.at[1]);
    c.strokeStyle = this.colours.target;
    c.lineWidth = 2;
    c.beginPath();
    c.moveTo(u - 7, v - 7); c.lineTo(u + 7, v + 7); c.moveTo(u + 7, v - 7); c.lineTo(u - 7, v + 7);
    c.stroke();
  }

  drawCraft(c, craft, now) {
    const at = craft.shown;
    if (!at) return;
    const [u, v] = this.px(at.x, at.y), r = Math.max(0.32 * this.scale, this.bare ? 9 : 14);
    const fresh = craft.link(now) === "good" && craft.view.pose.status === "tracking";
    const sigma = craft.view.pose.sigma;
    if (sigma && 2 * sigma * this.scale > r) {
      circle(c, u, v, 2 * sigma * this.scale);
      c.strokeStyle = this.colours.coneLine;
      c.lineWidth = 1.5;
      c.stroke();
    }
    c.save();
    c.translate(u, v);
    c.rotate(-at.yaw);
    c.beginPath();
    c.moveTo(0, -r * 1.25); c.lineTo(r * 0.85, r * 0.95); c.lineTo(0, r * 0.5); c.lineTo(-r * 0.85, r * 0.95);
    c.closePath();
    c.fillStyle = fresh ? this.colours.craft : this.colours.map;
    c.strokeStyle = fresh ? this.colours.surface : this.colours.craft;
    c.lineWidth = fresh ? 2 : 3;
    if (!fresh) c.setLineDash([4, 3]);
    c.fill();
    c.stroke();
    c.restore();
    c.setLineDash([]);
    if (!this.bare) this.nameCraft(c, craft.uav, u, v, r, at.yaw);
  }

  /** The name stands behind the aircraft, where it flies away from: what it flies to stays readable. */
  nameCraft(c, name, u, v, r, yaw) {
    const words = name.length > 18 ? `${name.slice(0, 17)}…` : name;
    c.font = `650 15px system-ui, "DejaVu Sans", sans-serif`;
    const w = c.measureText(words).width, side = Math.sin(yaw), up = -Math.cos(yaw);
    const x = u + side * (r + 10) - w / 2 + (side * w) / 2, y = v - up * (r + 16) + 5;
    label(c, words, Math.min(Math.max(4, x), this.width - w - 4), y, this.colours.craft, 15, this.colours.map);
  }

  drawScale(c) {
    const metres = [0.5, 1, 2, 5, 10, 20, 50].find((m) => m * this.scale > 70) ?? 50, w = metres * this.scale;
    // at the bottom right above the legend; on a phone, where tools and picture lie there, at the top
    const small = this.inset.right > 0, u = small ? 12 : this.width - w - 18, v = small ? 28 : this.height - 18 - this.inset.bottom;
    c.strokeStyle = c.fillStyle = this.colours.ink;
    c.lineWidth = 3;
    c.beginPath();
    c.moveTo(u, v - 6); c.lineTo(u, v); c.lineTo(u + w, v); c.lineTo(u + w, v - 6);
    c.stroke();
    label(c, `${metres} m`, u + w / 2 - 14, v - 8, this.colours.ink, 14, this.colours.map);
  }
}

/** Return where a ray of the view cone ends, `k` of its width off the middle. */
function coneEnd(at, k) {
  return [at.x + CONE_M * Math.cos(at.yaw + k * CONE_RAD), at.y + CONE_M * Math.sin(at.yaw + k * CONE_RAD)];
}
