// All aircraft: the chips above the page, and the tiles that show them side by side.

import { $, duration, el, keyed, set, text, words } from "./dom.js";
import { TITLES } from "./cards.js";
import { MapView } from "./map.js";

/** By name, whoever was heard first: an operator finds each aircraft in its place again. */
function inOrder(page) {
  return [...page.crafts.values()].sort((a, b) => a.uav.localeCompare(b.uav, "en", { numeric: true }));
}

export function drawFleet(page, now) {
  const items = inOrder(page).map((craft) => ({ key: craft.uav, craft }));
  if (items.length > 1) items.unshift({ key: "*", craft: null });
  keyed($("fleet"), items, (i) => i.key, (i) => {
    const node = el("button", { class: "chip" }, el("i", { class: "dot" }), el("div", {}, el("b"), el("small")));
    node.onclick = () => page.choose(i.craft ? i.craft.uav : null);
    return node;
  }, (node, { craft }) => {
    const [dot, box] = node.children, link = craft?.link(now) ?? "none";
    set(dot, "data-level", link);
    set(dot, "hidden", craft ? null : "");
    text(box.firstChild, craft ? craft.uav : "All");
    text(box.lastChild, craft ? (link === "lost" ? craft.silence : words(craft.view?.mission?.state ?? "no mission")) : `${page.crafts.size} aircraft`);
    set(node, "title", craft ? craft.uav : null);
    set(node, "aria-pressed", craft ? !page.grid && craft === page.craft : page.grid);
  });
  const up = page.link.up;
  text($("station-link"), up ? "connected" : page.link.everUp ? "station lost" : "connecting");
  set($("station-link"), "data-level", up ? "good" : page.link.everUp ? "lost" : "none");
}

export function drawTiles(page, now) {
  keyed($("grid"), inOrder(page), (c) => c.uav, (c) => {
    const canvas = el("canvas"), node = el("button", { class: "tile" }, el("header", {}, el("i", { class: "dot" }), el("b"), el("span"), el("small")), canvas);
    const map = new MapView(canvas, { bare: true });
    map.show(c);
    page.tiles.set(c.uav, { node, map });
    node.onclick = () => page.choose(c.uav);
    return node;
  }, (node, c) => {
    const [dot, name, right, reason] = node.firstChild.children, link = c.link(now), v = c.view;
    set(dot, "data-level", link);
    set(node, "data-level", link);
    set(node, "aria-current", c === page.craft ? "true" : null);
    text(name, c.uav);
    text(right, v?.vehicle?.battery == null ? "" : `${Math.round(v.vehicle.battery * 100)} %`);
    text(reason, link === "lost" ? `${c.silence}, ${duration(c.linkAge(now))}` : v?.mission ? `${TITLES[v.mission.state] ?? words(v.mission.state)}: ${v.mission.reason}` : "no mission is heard");
    page.tiles.get(c.uav).map.dirty = true;
  });
  for (const uav of page.tiles.keys()) if (!page.crafts.has(uav)) page.tiles.delete(uav);
}
