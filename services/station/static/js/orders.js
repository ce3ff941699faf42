// The command bar: six large buttons that always stand in the same place, and who is in command.

import { $, el, set, text } from "./dom.js";
import { HOLD_MS, onHold } from "./hold.js";

const GROUNDED = ["idle", "landed", "failed", "released"];

const STOPPING = ["hold", "land", "abort"]; // may always be tried: perhaps the aircraft still hears us
const OLD_S = 3;

/** name, label, what it does, look, whether it must be held, and why it makes no sense now (or nothing). */
const ORDERS = [
  { name: "start", label: "START", hint: "hold 1 s", kind: "go", ms: HOLD_MS, not: (s) => (GROUNDED.includes(s) ? "" : `a mission is under way: ${s}`) },
  { name: "hold", label: "HOLD", hint: "at once", kind: "pause", ms: 0, not: (s) => (GROUNDED.includes(s) ? "nothing flies" : "") },
  { name: "resume", label: "RESUME", hint: "hold 1 s", kind: "go", ms: HOLD_MS, not: (s) => (s === "hold" ? "" : "nothing to resume") },
  { name: "next", label: "NEXT TREE", hint: "hold 1 s", kind: "", ms: HOLD_MS, not: (s) => (["face", "approach", "dock", "docked"].includes(s) ? "" : "no target to leave") },
  { name: "land", label: "LAND", hint: "hold 1 s", kind: "land", ms: HOLD_MS, not: (s) => (GROUNDED.includes(s) ? "it is on the ground" : s === "landing" ? "it is landing" : "") },
  { name: "abort", label: "ABORT", hint: "hold 1 s", kind: "stop", ms: HOLD_MS, not: (s) => (GROUNDED.includes(s) ? "no mission is under way" : "") },
];

export class OrderBar {
  constructor(page) {
    this.page = page;
    this.nodes = new Map();
    for (const order of ORDERS) {
      const node = el("button", { class: "order", id: `order-${order.name}`, "data-kind": order.kind, "aria-disabled": "true" }, el("span", {}, order.label), el("small", {}, order.hint));
      this.onHold(node, order.label, () => this.press(order), order.ms);
      this.nodes.set(order.name, node);
      $("buttons").append(node);
    }
    this.take = el("button", { class: "mini", id: "take" }, el("span", {}, "Take command"));
    this.onHold(this.take, "it", () => this.changeCommand());
    this.name = el("b", { id: "who-uav" });
    this.words = el("div", { id: "who-words" });
    $("who").append(el("div", {}, this.name, this.words), this.take);
  }

  /** Have `node`, held, act on the aircraft that is shown; on none where another was chosen since the press began. */
  onHold(node, label, action, ms = HOLD_MS) {
    const tell = (other) => this.page.toast("info", other ? "Another aircraft was chosen: nothing was sent." : `Keep ${label} pressed for one second.`);
    onHold(node, action, tell, ms, () => this.page.craft?.uav);
  }

  /** Return why an order makes no sense now; it can be sent all the same only when this is empty. */
  why(order) {
    const { craft, link } = this.page;
    if (!link.up) return "the station is out of reach";
    if (!craft?.view) return "no aircraft is heard";
    if (!craft.heard) return `${craft.uav} is not heard`;
    const commander = craft.view.commander;
    if (order.name !== "hold" && commander && commander.n !== this.page.me?.n) return `${commander.name} is in command: take command first`;
    const now = performance.now(), age = craft.age(craft.view.mission?.age, now);
    if (age === null) return "no mission is heard: is the navigator running?";
    if (age > OLD_S) return STOPPING.includes(order.name) ? "" : `the mission was last heard ${Math.round(age)} s ago`;
    return order.not(craft.view.mission.state);
  }

  /** HOLD by its key: at once, as its button does. */
  holdNow() {
    this.press(ORDERS.find((order) => order.name === "hold"));
  }

  async press(order, treeId = null) {
    const page = this.page, { craft, link } = page;
    const why = this.why(order);
    if (why) {
      page.toast("bad", `${order.label}: ${why}.`);
      return;
    }
    const node = this.nodes.get(order.name);
    node?.classList.add("waiting");
    const message = { t: "order", uav: craft.uav, name: order.name, seen: link.state?.n ?? 0 };
    if (treeId !== null) message.tree_id = treeId;
    const reply = await link.ask(message);
    node?.classList.remove("waiting");
    const what = `${order.label}${treeId === null ? "" : ` ${treeId}`} (${craft.uav})`;
    page.toast(reply.accepted ? "good" : "bad", `${what}: ${reply.accepted ? "accepted" : "refused"}: ${reply.reason}`);
  }

  async changeCommand() {
    const { craft, link, me } = this.page;
    if (!craft?.view || !craft.heard) return;
    const mine = craft.view.commander?.n === me?.n;
    const reply = await link.ask({ t: mine ? "release" : "take", uav: craft.uav });
    this.page.toast(reply.accepted ? "good" : "bad", reply.reason);
  }

  draw() {
    const { craft, me } = this.page;
    for (const order of ORDERS) set(this.nodes.get(order.name), "aria-disabled", this.why(order) ? "true" : null);
    text(this.name, craft ? craft.uav : "no aircraft");
    const commander = craft?.heard ? craft.view?.commander : null;
    const mine = commander && commander.n === me?.n;
    text(this.words, !craft ? "" : !craft.heard ? "not heard: no order reaches it" : mine ? "you are in command" : commander ? `${commander.name} is in command` : "nobody is in command");
    text(this.take.firstChild, mine ? "Give back" : "Take command");
    set(this.take, "hidden", craft?.heard ? null : "");
  }
}

export const CHOOSE = { name: "choose", label: "FLY TO TREE", not: () => "" };
