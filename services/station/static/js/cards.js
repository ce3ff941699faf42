// What lies over the map: the mission's card with its steps, the alarm, the camera's picture.

import { $, duration, el, keyed, set, text, words } from "./dom.js";

const TONES = { docked: "good", landed: "good", failed: "bad", released: "bad", hold: "warn", idle: "calm" };
export const TITLES = { idle: "Ready on the ground", preflight: "Checking before flight", take_off: "Taking off", scan: "Turning to scan", select: "Choosing a tree", face: "Turning to the tree", approach: "Approaching", dock: "Docking", docked: "Docked", undock: "Backing off", return: "Flying back", landing: "Landing", landed: "Landed", hold: "Holding", released: "Released to the pilot", failed: "Failed" };
const STEPS = [["Take off", ["preflight", "take_off"]], ["Scan", ["scan", "select"]], ["Approach", ["face", "approach"]], ["Dock", ["dock", "docked", "undock"]], ["Land", ["return", "landing", "landed"]]];
const BATTERY_LOW = 0.2;

const stepOf = (state) => STEPS.findIndex(([, states]) => states.includes(state));

export function drawMission(craft, now, hidden) {
  const mission = craft?.view?.mission;
  $("mission").hidden = hidden;
  $("mission-steps").hidden = !mission;
  if (!mission) {
    text($("mission-state"), craft ? "No mission is heard" : "No aircraft yet");
    text($("mission-for"), "");
    text($("mission-reason"), craft ? "Is the navigator running? Look under Systems." : "Listening. Switch an aircraft on; it appears here by itself once its router and this one are linked.");
    $("mission-target").hidden = true;
    set($("mission"), "data-tone", "calm");
    return;
  }
  const age = craft.age(mission.age, now), late = age > 1.25;
  text($("mission-state"), TITLES[mission.state] ?? words(mission.state));
  text($("mission-for"), late ? `told ${duration(age)} ago` : duration(mission.for + age));
  set($("mission-for"), "class", late ? "mission-for late" : "mission-for");
  const same = mission.reason.toLowerCase() === mission.state;
  text($("mission-reason"), (mission.failsafe ? `Failsafe ${words(mission.failsafe)}: ` : "") + (same ? "" : mission.reason));
  const claim = claimWords(craft.view.claim);
  $("mission-target").hidden = mission.target === null && !claim;
  text($("mission-target"), [mission.target === null ? "" : targetWords(mission), claim].filter(Boolean).join(" · "));
  set($("mission"), "data-tone", late || mission.failsafe ? "warn" : TONES[mission.state] ?? "fly");
  drawSteps(mission);
}

function targetWords({ target, distance, heading_error: off }) {
  const parts = [`Tree ${target}`], degrees = off === null ? null : Math.round((off * 180) / Math.PI);
  if (distance !== null) parts.push(`${distance.toFixed(2)} m`);
  if (degrees !== null) parts.push(degrees === 0 ? "straight ahead" : `${Math.abs(degrees)}° ${degrees > 0 ? "left" : "right"}`);
  return parts.join(" · ");
}

const CLAIMED = { place: "its place", way: "the way home" };

/** What the aircraft believes to hold among several; empty where nothing is claimed. */
export function claimWords(claim) {
  if (!claim?.kind) return "";
  return `${claim.kind === "tree" ? `tree ${claim.tree}` : CLAIMED[claim.kind]} claimed, ${Math.round(claim.left)} s`;
}

/** Where in the mission it is; a hold stands at the step that it interrupted. */
function drawSteps({ state, previous }) {
  const at = stepOf(state) >= 0 ? stepOf(state) : state === "hold" ? stepOf(previous) : -1;
  keyed($("mission-steps"), STEPS, (s) => s[0], (s) => el("li", {}, s[0]), (node, s) => {
    const k = STEPS.indexOf(s);
    set(node, "data-step", k < at || state === "landed" ? "done" : k === at ? "now" : null);
    set(node, "aria-current", k === at ? "step" : null);
  });
}

export function drawAlarm(page, craft, now) {
  const said = alarmWords(page, craft, now), alarm = $("alarm");
  text(alarm, said);
  alarm.hidden = !said;
  set(document.body, "data-old", !page.link.up || craft?.link(now) === "lost" ? "true" : null);
  set(document.body, "data-link", craft ? craft.link(now) : "none");
}

function alarmWords(page, craft, now) {
  const others = [...page.crafts.values()].filter((c) => c !== craft && c.link(now) === "lost"), vehicle = craft?.view?.vehicle;
  if (!page.link.up) return page.link.everUp ? "STATION OUT OF REACH: what you see is old, no order will arrive" : "";
  if (craft && !craft.heard) return `${craft.uav} IS NOT HEARD by this station: what you see is old, no order will arrive`;
  if (craft?.link(now) === "lost") return `LINK TO ${craft.uav} LOST for ${duration(craft.linkAge(now))}: what you see is old`;
  if (vehicle?.override) return "THE PILOT HAS THE AIRCRAFT: the mission is silent";
  if (vehicle?.armed && vehicle.battery !== null && vehicle.battery < BATTERY_LOW) return `BATTERY LOW: ${Math.round(vehicle.battery * 100)} %`;
  return others.length ? `LINK LOST to ${others.map((c) => c.uav).join(", ")}` : "";
}

export function drawPreview(page, craft, now) {
  const age = craft ? (now - craft.previewAt) / 1000 : Infinity, none = !Number.isFinite(age) || age > 60, old = age > 1.5 && !none;
  $("preview").hidden = page.grid || !craft;
  set($("preview"), "data-empty", none ? "true" : null);
  set($("preview"), "data-old", old ? "true" : null);
  $("preview-image").hidden = none || !$("preview-image").src;
  text($("preview-word"), none ? "no camera picture" : old ? `${duration(age)} old` : "live");
  if (none) page.enlarge(false);
}
