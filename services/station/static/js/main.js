// The page: joins link, model, map, panels and orders. Redraws the map when something moved, the words four times a second.

import { drawAlarm, drawMission, drawPreview } from "./cards.js";
import { Cloud } from "./cloud.js";
import { $, el, set, text } from "./dom.js";
import { drawFleet, drawTiles } from "./fleet.js";
import { onHold } from "./hold.js";
import { Link } from "./link.js";
import { MapView } from "./map.js";
import { Craft } from "./model.js";
import { Obstacles } from "./obstacles.js";
import { CHOOSE, OrderBar } from "./orders.js";
import { palette } from "./paint.js";
import { drawLog, drawSystems, drawTrees, drawVitals } from "./panels.js";

const WORDS_MS = 250;

class Page {
  constructor() {
    this.crafts = new Map();
    this.craft = null;
    this.selected = null;
    this.events = [];
    this.me = null;
    this.grid = false;
    this.tiles = new Map();
    this.map = new MapView($("map"), { onPick: (tree) => this.select(tree ? tree.id : null) });
    this.map.onMoved = () => set($("follow"), "aria-pressed", this.map.follow);
    this.orders = new OrderBar(this);
    this.link = new Link({
      state: (m) => this.onState(m),
      trees: (m) => this.onTrees(m),
      trail: (m) => this.craftOf(m.uav).takeTrail(m.map, m.points),
      events: (m) => this.onEvents(m),
      welcome: (m) => this.onWelcome(m),
      binary: (data) => this.onBinary(data),
    });
    this.cloud = new Cloud(this);
    this.obstacles = this.map.obstacles = new Obstacles(this.cloud, () => (this.map.dirty = true));
    this.phone = matchMedia("(max-width: 760px)");
    this.buttons();
    this.theme(localStorage.getItem("treedock.theme") || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
    setInterval(() => this.drawWords(), WORDS_MS);
    let before = performance.now();
    this.frames = 0;
    const frame = (now) => {
      this.drawMap(now, Math.min(0.1, (now - before) / 1000));
      before = now;
      this.frames++;
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  // -- what the station says

  craftOf(uav) {
    let craft = this.crafts.get(uav);
    if (!craft) {
      craft = new Craft(uav);
      this.crafts.set(uav, craft);
      if (!this.craft) this.choose(uav);
    }
    return craft;
  }

  onWelcome(message) {
    this.me = message.you;
    this.cloudAllowed = message.cloud;
    this.inventory = message.inventory;
    this.cloud.reconnected();
    text($("operator-name"), this.me.name);
    this.events = [];
    this.crafts.forEach((craft) => (craft.treesVersion = -1));
  }

  onState(message) {
    const now = performance.now(), names = new Set(message.aircraft.map((view) => view.uav));
    for (const view of message.aircraft) this.craftOf(view.uav).take(view, now);
    for (const craft of this.crafts.values()) {
      craft.heard = names.has(craft.uav);
      // the one that is shown stays: in its place another would take the orders that are meant for it
      if (!craft.heard && craft !== this.craft) this.crafts.delete(craft.uav);
    }
    this.operators = message.operators;
    this.fleet = message.fleet;
    this.map.dirty = true;
  }

  onTrees(message) {
    this.craftOf(message.uav).takeTrees(message);
    this.map.dirty = true;
    this.view3d?.changed();
  }

  onEvents(message) {
    if (message.all) this.events = [];
    this.events.push(...message.items);
    if (this.events.length > 600) this.events.splice(0, this.events.length - 400);
  }

  onBinary(data) {
    const bytes = new Uint8Array(data), name = new TextDecoder().decode(bytes.subarray(2, 2 + bytes[1]));
    if (bytes[0] !== 80) {
      this.cloud.take(name, data, 2 + bytes[1]);
      return;
    }
    const craft = this.crafts.get(name);
    if (!craft) return;
    craft.previewAt = performance.now();
    if (craft !== this.craft) return;
    const image = $("preview-image"), url = URL.createObjectURL(new Blob([bytes.subarray(2 + bytes[1])], { type: "image/jpeg" }));
    image.onload = image.onerror = () => URL.revokeObjectURL(url);
    image.src = url;
  }

  // -- what the operator does

  buttons() {
    $("zoom-in").onclick = () => (this.view3d?.on ? this.view3d.zoom(1.35) : this.map.zoom(1.35));
    $("zoom-out").onclick = () => (this.view3d?.on ? this.view3d.zoom(1 / 1.35) : this.map.zoom(1 / 1.35));
    $("preview").onclick = () => this.enlarge(!$("preview").hasAttribute("data-big"));
    $("fit").onclick = () => (this.view3d?.on ? this.view3d.fit() : this.map.fit());
    $("follow").onclick = () => {
      this.map.follow = !this.map.follow;
      this.map.fitted = false;
      this.map.dirty = true;
      set($("follow"), "aria-pressed", this.map.follow);
    };
    $("view-3d").onclick = () => this.toggle3d();
    $("theme").onclick = () => this.theme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
    $("operator").onclick = () => {
      $("name-input").value = this.link.name;
      $("downloads").hidden = !this.inventory;
      this.drawOthers();
      $("name-dialog").showModal();
    };
    $("name-dialog").addEventListener("close", () => {
      const name = $("name-input").value.trim();
      if (name) this.link.name = name;
      text($("operator-name"), this.link.name);
    });
    text($("operator-name"), this.link.name);
    const tabs = ["trees", "log", "systems"];
    for (const name of tabs) {
      $(`tab-${name}`).onclick = () => this.tab(name);
      $(`tab-${name}`).onkeydown = (e) => {
        const step = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
        if (step) this.tab(tabs[(tabs.indexOf(name) + step + 3) % 3], true);
      };
    }
    addEventListener("keydown", (e) => {
      if (e.key.toLowerCase() === "h" && !e.repeat && !e.ctrlKey && !e.metaKey && !e.altKey && !(e.target instanceof HTMLInputElement)) this.orders.holdNow();
    });
  }

  /** The camera's picture large over the map, or small in its corner. */
  enlarge(big) {
    set($("preview"), "data-big", big ? "" : null);
    set($("preview"), "aria-expanded", big);
  }

  /** Who else is there; to each of them command of this aircraft can be handed. */
  drawOthers() {
    const others = (this.operators ?? []).filter((o) => o.n !== this.me?.n), uav = this.craft?.uav;
    const mine = this.craft?.heard && this.craft.view?.commander?.n === this.me?.n;
    $("others").replaceChildren(...others.map((o) => {
      const node = el("button", { type: "button", class: "mini" }, el("span", {}, mine ? `Hand command of ${uav} to ${o.name}` : `${o.name} is here`));
      set(node, "aria-disabled", mine ? null : "true");
      onHold(node, async () => {
        if (!mine) return;
        const reply = await this.link.ask({ t: "hand_over", uav, to: o.n });
        this.toast(reply.accepted ? "good" : "bad", reply.reason);
        $("name-dialog").close();
      }, () => this.toast("info", "Keep it pressed for one second."));
      return node;
    }));
  }

  tab(name, focus = false) {
    for (const other of ["trees", "log", "systems"]) {
      set($(`tab-${other}`), "aria-selected", other === name);
      set($(`tab-${other}`), "tabindex", other === name ? 0 : -1);
      $(`panel-${other}`).hidden = other !== name;
    }
    if (focus) $(`tab-${name}`).focus();
    this.drawWords();
  }

  theme(name) {
    document.documentElement.dataset.theme = name;
    localStorage.setItem("treedock.theme", name);
    const colours = palette();
    for (const map of [this.map, ...[...this.tiles.values()].map((t) => t.map)]) {
      map.colours = colours;
      map.dirty = true;
    }
    this.view3d?.theme(colours);
  }

  choose(uav) {
    this.grid = uav === null;
    if (uav !== null && this.craft?.uav !== uav) {
      this.craft = this.crafts.get(uav);
      this.selected = this.map.selected = null;
      this.map.show(this.craft);
      this.view3d?.show(this.craft);
      $("preview-image").removeAttribute("src");
    }
    $("grid").hidden = !this.grid;
    set(document.body, "data-grid", this.grid ? "true" : null);
    this.drawWords();
  }

  select(id) {
    this.selected = this.map.selected = id;
    this.map.dirty = true;
    this.view3d?.changed();
    if (id !== null) this.tab("trees");
    this.drawWords();
    if (id !== null) $("panel-trees").querySelector('[aria-expanded="true"]')?.scrollIntoView({ block: "nearest" });
  }

  treeActions(tree) {
    const about = el("p"), node = el("button", { class: "mini", id: "choose" }, el("span", {}, "Fly to this tree"));
    const more = el("div", { class: "tree-more" }, about, node);
    this.orders.onHold(node, "it", () => this.orders.press(CHOOSE, more.tree.id));
    more.refresh = (t, kind) => {
      more.tree = t;
      text(about, `⌀ ${(t.radius * 200).toFixed(1)} ± ${(t.sigmaRadius * 200).toFixed(1)} cm, seen ${t.observations} times, ${Math.round((t.arc * 180) / Math.PI)}° of its bark. At x ${t.x.toFixed(2)}, y ${t.y.toFixed(2)} m.`);
      const why = t.suitable ? this.orders.why(CHOOSE) : "Not suitable: too thin, too thick, forked or leaning.";
      text(node.firstChild, kind === "target" ? "This is the target" : why && !t.suitable ? why : "Fly to this tree (hold)");
      set(node, "aria-disabled", why || kind === "target" ? "true" : null);
    };
    more.refresh(tree, this.craft.kind(tree));
    return more;
  }

  toast(level, words) {
    const node = el("div", { class: "toast", "data-level": level }, words);
    $("toasts").append(node);
    while ($("toasts").children.length > 3) $("toasts").firstChild.remove();
    setTimeout(() => node.remove(), level === "bad" ? 7000 : 4000);
  }

  async toggle3d() {
    if (!this.view3d) {
      const { View3d } = await import("./view3d.js");
      this.view3d = new View3d($("three"), this);
    }
    const on = !this.view3d.on;
    this.view3d.set(on);
    $("three").hidden = !on;
    $("map").hidden = on;
    set($("view-3d"), "aria-pressed", on);
  }

  // -- drawing

  drawMap(now, dt) {
    let moving = false;
    for (const craft of this.crafts.values()) moving = craft.glide(dt) || moving;
    if (this.view3d?.on && !this.grid) {
      this.view3d.draw(now, moving);
      return;
    }
    if (this.grid) {
      for (const [uav, tile] of this.tiles) if (moving || tile.map.dirty || this.map.dirty) {
        tile.map.craft = this.crafts.get(uav);
        tile.map.draw(now);
        tile.map.dirty = false;
      }
      this.map.dirty = false;
    } else if (moving || this.map.dirty) {
      this.map.draw(now);
      this.map.dirty = false;
    }
  }

  drawWords() {
    const now = performance.now(), craft = this.craft;
    this.map.inset = this.phone.matches ? { top: 0, bottom: 0, right: 60 } : { top: Math.min($("mission").offsetHeight + 8, innerHeight * 0.25), bottom: 44, right: 0 };
    this.cloud.look(this.grid || document.hidden || !craft?.heard ? null : craft.uav);
    drawFleet(this, now);
    if (this.grid) drawTiles(this, now);
    drawMission(craft, now, this.grid);
    drawAlarm(this, craft, now);
    drawVitals(craft, now);
    if (!$("panel-trees").hidden) drawTrees(craft, this);
    if (!$("panel-log").hidden) drawLog(this.events, this.grid ? null : craft?.uav, this.crafts.size > 1);
    drawSystems(craft, now, this.fleet);
    drawPreview(this, craft, now);
    this.orders.draw();
    this.map.dirty ||= craft ? craft.link(now) !== this.linkWas : false;
    this.linkWas = craft?.link(now);
  }

}

window.treedock = new Page();
