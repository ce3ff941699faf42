// The connection to the station: opened again whenever it breaks; what was said on it is told to listeners.

const RETRY_MS = [100, 250, 500, 1000];
const SILENT_MS = 1500; // the station speaks five times a second
const DEAD_MS = 4000; // a slow link has pauses too: opening anew there would only ask it to carry everything again

function secret() {
  let kept = localStorage.getItem("treedock.secret");
  if (!kept || !/^[A-Za-z0-9_-]{16,64}$/.test(kept)) {
    kept = [...crypto.getRandomValues(new Uint8Array(24))].map((b) => b.toString(16).padStart(2, "0")).join("");
    localStorage.setItem("treedock.secret", kept);
  }
  return kept;
}

export class Link {
  constructor(handlers) {
    this.handlers = handlers;
    this.state = null;
    this.heardAt = -Infinity;
    this.nextId = Date.now();
    this.waiting = new Map();
    this.tries = 0;
    this.open();
    setInterval(() => this.watch(), 250);
  }

  get name() {
    return localStorage.getItem("treedock.name") || "operator";
  }

  set name(value) {
    localStorage.setItem("treedock.name", value);
    this.hello();
  }

  /** Whether the station itself is heard. */
  get up() {
    return performance.now() - this.heardAt < SILENT_MS;
  }

  /** Whether it ever was: before that there is nothing to call old. */
  get everUp() {
    return Number.isFinite(this.heardAt);
  }

  open() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this.hello();
    socket.onmessage = (event) => this.hear(event.data);
    socket.onclose = () => {
      if (this.socket !== socket) return;
      this.socket = null;
      for (const [, done] of this.waiting) done({ accepted: false, reason: "the station was lost before it answered" });
      this.waiting.clear();
      setTimeout(() => this.open(), RETRY_MS[Math.min(this.tries++, RETRY_MS.length - 1)]);
    };
    this.socket = socket;
    this.openedAt = performance.now();
  }

  hello() {
    this.send({ t: "hello", secret: secret(), name: this.name });
  }

  hear(data) {
    this.heardAt = performance.now();
    if (typeof data !== "string") {
      this.handlers.binary(data);
      return;
    }
    const message = JSON.parse(data);
    if (message.t === "welcome") this.tries = 0;
    if (message.t === "state") {
      this.state = message;
      this.stateAt = this.heardAt;
    }
    if (message.t === "reply") {
      this.waiting.get(message.id)?.(message);
      this.waiting.delete(message.id);
    } else {
      this.handlers[message.t]?.(message);
    }
  }

  /** A half-open connection (a radio that fell silent) gives no close: drop it ourselves. */
  watch() {
    const now = performance.now();
    if (this.socket && now - this.heardAt > DEAD_MS && now - this.openedAt > DEAD_MS) {
      const dead = this.socket;
      dead.close();
      dead.onclose?.();
    }
  }

  send(message) {
    if (this.socket?.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  /** Ask for something and return the answer. */
  ask(message) {
    return new Promise((resolve) => {
      const id = this.nextId++;
      this.waiting.set(id, resolve);
      if (!this.send({ ...message, id })) {
        this.waiting.delete(id);
        resolve({ accepted: false, reason: "the station is out of reach" });
      }
    });
  }
}
