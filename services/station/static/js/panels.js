// The panels beside the map: vitals, trees, log, systems.

import { $, clock, duration, el, keyed, set, text, words } from "./dom.js";

const LATE_S = { "slam/pose": 0.5, "mission/state": 1.0, "vehicle/state": 0.5, "trees/target": 0.5 };

/** Return a value's level by its age on our own clock: what stopped coming grows late here too. */
export function levelOf(craft, topic, now) {
  const row = craft?.view?.topics.find((t) => t[0] === topic);
  if (!row) return "none";
  const age = craft.age(row[1], now);
  if (craft.link(now) === "lost") return "lost";
  return LATE_S[topic] && age > LATE_S[topic] + 0.25 ? "late" : row[2];
}

// -- vitals

const VITALS = [
  { id: "battery", name: "Battery", topic: "vehicle/state", of: (v) => (v.vehicle?.battery == null ? null : [`${Math.round(v.vehicle.battery * 100)} %`, v.vehicle.battery < 0.2 ? "bad" : v.vehicle.battery < 0.35 ? "warn" : ""]) },
  { id: "mode", name: "Mode", topic: "vehicle/state", of: (v) => (v.vehicle ? [v.vehicle.override ? "pilot" : words(v.vehicle.mode), v.vehicle.override ? "bad" : "", v.vehicle.armed ? "armed" : "disarmed"] : null) },
  { id: "link", name: "Link", topic: null, of: (v, c, now) => [{ good: "good", late: "late", lost: "LOST", none: "none" }[c.link(now)], { good: "good", late: "warn", lost: "bad", none: "" }[c.link(now)], duration(c.linkAge(now))] },
  { id: "height", name: "Height", topic: "slam/pose", of: (v) => (v.pose?.at ? [`${v.pose.at[2].toFixed(1)} m`, "", "over start"] : null) },
  { id: "pose", name: "Position", topic: "slam/pose", of: (v) => (v.pose ? [words(v.pose.status), v.pose.status === "tracking" ? "" : "bad", v.pose.status !== "tracking" && v.fusion && v.fusion.carrier !== "none" ? `by ${v.fusion.carrier}` : v.pose.sigma == null ? "" : `± ${(v.pose.sigma * 100).toFixed(0)} cm`] : null) },
  { id: "distance", name: "To target", topic: "mission/state", of: (v) => (v.mission?.distance == null ? ["—", ""] : [`${v.mission.distance.toFixed(2)} m`, "", `tree ${v.mission.target ?? "—"}`]) },
];

export function drawVitals(craft, now) {
  keyed($("vitals"), VITALS, (v) => v.id, (v) => el("div", { class: "vital", id: `vital-${v.id}` }, el("dt", {}, v.name), el("dd", {}, el("span"), " ", el("small"))), (node, v) => {
    const value = craft?.view ? v.of(craft.view, craft, now) : null;
    const level = v.topic === null ? "" : levelOf(craft, v.topic, now);
    const age = craft?.view?.topics.find((t) => t[0] === v.topic)?.[1];
    const old = level === "late" || level === "lost";
    const [span, small] = node.querySelector("dd").children;
    text(span, value ? value[0] : "—");
    text(small, old ? `${duration(craft.age(age, now))} old` : value?.[2] ?? "");
    set(node, "data-level", level || null);
    set(node, "data-tone", old ? null : value?.[1] || null);
    if (v.id === "battery") drawGauge(node, craft?.view?.vehicle?.battery ?? null);
  });
}

function drawGauge(node, share) {
  const gauge = node.querySelector("meter") ?? node.appendChild(el("meter", { min: 0, max: 1, low: 0.35, high: 0.36, optimum: 1, "aria-hidden": "true" }));
  gauge.hidden = share === null;
  gauge.value = share ?? 0;
}

// -- trees

const KIND_WORDS = { target: "target", visited: "visited", suitable: "suitable", unsuitable: "not suitable" };

export function drawTrees(craft, page) {
  const panel = $("panel-trees"), trees = craft?.trees ?? [];
  text($("tree-count"), trees.length || "");
  if (!trees.length) {
    panel.replaceChildren(el("p", { class: "empty", "data-key": "empty" }, craft ? "No trees yet. They appear here as the scan finds them." : "No aircraft."));
    return;
  }
  const from = craft.shown ?? { x: 0, y: 0 };
  const rank = { target: 0, suitable: 1, visited: 2, unsuitable: 3 };
  const rows = trees.map((t) => ({ t, kind: craft.kind(t), far: Math.hypot(t.x - from.x, t.y - from.y) }));
  const moving = craft.view?.mission && !["idle", "landed", "docked", "hold"].includes(craft.view.mission.state);
  rows.sort((a, b) => rank[a.kind] - rank[b.kind] || (moving ? a.t.id - b.t.id : a.far - b.far));
  if (rows.length > 300) rows.length = 300;
  keyed(panel, rows, (r) => `${craft.uav}/${r.t.id}`, () => treeItem(page), (node, r) => fillTree(node, r, page));
}

function treeItem(page) {
  const row = el("button", { class: "tree-row" }, el("div", { class: "tree-mark" }), el("div", {}, el("b"), el("span")), el("div", { class: "far" }));
  const item = el("div", { class: "tree-item" }, row);
  row.addEventListener("click", () => page.select(page.selected === item.tree.id ? null : item.tree.id));
  return item;
}

function fillTree(item, { t, kind, far }, page) {
  item.tree = t;
  const [row] = item.children, [mark, middle, distance] = row.children;
  text(mark, t.id);
  set(mark, "data-kind", kind);
  text(middle.firstChild, `⌀ ${(t.radius * 200).toFixed(1)} cm`);
  text(middle.lastChild, `${KIND_WORDS[kind]} · ± ${(t.sigma * 100).toFixed(t.sigma < 0.0095 ? 1 : 0)} cm · ${Math.round(t.confidence * 100)} %`);
  text(distance, `${far.toFixed(1)} m`);
  const open = page.selected === t.id;
  set(row, "aria-expanded", open);
  if (open && item.children.length === 1) item.append(page.treeActions(t));
  if (!open && item.children.length > 1) item.lastElementChild.remove();
  if (open) item.lastElementChild.refresh?.(t, kind);
}

// -- log

export function drawLog(events, uav, several) {
  const panel = $("panel-log");
  const mine = events.filter((e) => !uav || e.uav === uav || e.uav === "").slice(-200).reverse();
  if (!mine.length) {
    panel.replaceChildren(el("p", { class: "empty", "data-key": "empty" }, "Nothing has happened yet."));
    return;
  }
  // a restarted station numbers from 1 again
  keyed(panel, mine, (e) => `${e.number}/${e.time_ns}`, (e) => el("div", { class: "event", "data-level": e.level }, el("time", {}, clock(e.time_ns)), el("p", {}, several && e.uav ? el("b", {}, `${e.uav} `) : null, e.text)), () => {});
}

// -- systems

/** Who holds what, by the arbiter's book. */
function fleetRows({ leases, visited, waits }) {
  const rows = [{ key: "g3", group: `Claims of the fleet: ${visited} trees visited${waits ? `, none granted for ${duration(waits)}` : ""}` }];
  for (const { id, uav, kind, tree, left } of leases) {
    const what = kind === "tree" ? `tree ${tree}` : kind === "way" ? "way home" : "its place";
    rows.push({ key: `c/${uav}/${id}`, name: uav, level: left < 15 ? "late" : "good", right: what, note: `${Math.round(left)} s left` });
  }
  return rows;
}

/** By what the pose stands beside the camera, and how the GPS is trusted. */
function fusionRows(craft, fusion, now) {
  const group = { key: "g4", group: "Fusion of IMU, GPS, second camera" };
  if (!fusion) return [group, { key: "f/pose", name: "pose", level: "none", right: "off", note: "slam alone gives the pose" }];
  const age = craft.age(fusion.age, now), late = age > 3, own = fusion.carrier === "camera";
  const carried = own ? "" : `, ${fusion.carried.toFixed(1)} s without the first camera`;
  const rows = [group, { key: "f/pose", name: "pose", level: late || fusion.carrier === "none" ? "lost" : own ? "good" : "late", age, right: own ? "on" : fusion.carrier, note: fusion.word + carried }];
  if (fusion.gps === "off") return rows;
  const place = fusion.place ? `${fusion.place[0].toFixed(6)}° ${fusion.place[1].toFixed(6)}° ± ${fusion.place[2].toFixed(1)} m` : "not on the earth yet";
  return [...rows, { key: "f/gps", name: "GPS", level: late ? "lost" : fusion.gps === "trusted" ? "good" : "late", age, right: fusion.gps, note: fusion.gps_word || place }];
}

export function drawSystems(craft, now, fleet) {
  const panel = $("panel-systems"), view = craft?.view;
  if (!view) {
    panel.replaceChildren(el("p", { class: "empty", "data-key": "empty" }, "Nothing is heard yet."));
    set($("systems-dot"), "data-level", "none");
    return;
  }
  const lost = craft.link(now) === "lost";
  const rows = [{ key: "g1", group: "Services aboard" }];
  for (const [name, state, level, age, live, note] of view.services) {
    const at = craft.age(age, now);
    const bad = !live || lost || level === "late" || (at !== null && at > 3.25);
    rows.push({ key: `s/${name}`, name, level: bad ? "lost" : state === "ready" ? "good" : "late", age: at, right: live ? words(state) : "gone", note: note });
  }
  rows.push({ key: "g2", group: "Topics: how old, how often" });
  for (const [name, age, , rate] of view.topics) {
    rows.push({ key: `t/${name}`, name, level: levelOf(craft, name, now), age: craft.age(age, now), right: lost ? "" : `${rate.toFixed(rate < 10 ? 1 : 0)} Hz`, note: "" });
  }
  rows.push(...fusionRows(craft, view.fusion, now));
  if (fleet) rows.push(...fleetRows(fleet));
  keyed(panel, rows, (r) => r.key, (r) => (r.group ? el("div", { class: "group" }, r.group) : el("div", { class: "sys" }, el("i", { class: "dot" }), el("b"), el("span", { class: "rate" }), el("span", { class: "age" }), el("div", { class: "note" }))), (node, r) => {
    if (r.group) return;
    const [dot, name, rate, age, note] = node.children;
    set(node, "data-level", r.level);
    set(dot, "data-level", r.level);
    text(name, r.name);
    text(rate, r.right);
    text(age, r.age === undefined ? "" : r.age === null ? "never" : `${duration(r.age)}${r.level === "late" || r.level === "lost" ? " late" : ""}`);
    text(note, r.note);
    set(note, "hidden", r.note ? null : "");
  });
  const worst = rows.some((r) => r.level === "lost") ? "lost" : rows.some((r) => r.level === "late") ? "late" : "good";
  set($("systems-dot"), "data-level", worst);
}
