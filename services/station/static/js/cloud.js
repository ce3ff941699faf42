// The point cloud of the aircraft that is shown, submap by submap as the station sends it while we look; who draws it listens.

const POINTS = 0, REMOVED = 1; // kinds of a frame; the third, a new place alone, is what is left
const HEAD_BYTES = 12 + 48; // number, kind, count; the top three rows of the submap's place

export class Cloud {
  constructor(page) {
    this.page = page;
    this.asked = null;
    this.submaps = new Map(); // number -> { points: Int16Array (centimetres), colours: Uint8Array, count, place: 12 numbers }
    this.listeners = [];
  }

  /** Have `listener(number, submap)` told of every submap, those held now too; null when it is gone. */
  listen(listener) {
    this.listeners.push(listener);
    for (const [number, submap] of this.submaps) listener(number, submap);
  }

  /** Look at this aircraft, at none with null: the radio carries it only while we do. */
  look(uav) {
    const wanted = this.page.cloudAllowed ? uav : null;
    if (wanted === this.asked || !this.page.link.up) return;
    if (this.asked) this.page.link.ask({ t: "cloud", uav: this.asked, on: false });
    this.clear();
    this.asked = wanted;
    if (wanted) this.page.link.ask({ t: "cloud", uav: wanted, on: true });
  }

  /** After a reconnect the station knows nothing of our wish. */
  reconnected() {
    this.asked = null;
    this.clear();
  }

  clear() {
    for (const number of [...this.submaps.keys()]) this.put(number, null);
  }

  put(number, submap) {
    if (submap) this.submaps.set(number, submap);
    else if (!this.submaps.delete(number)) return;
    for (const listener of this.listeners) listener(number, submap);
  }

  take(uav, data, at) {
    if (uav !== this.asked) return;
    const head = new DataView(data, at), number = head.getUint32(0, true), kind = head.getUint32(4, true), count = head.getUint32(8, true);
    const place = Array.from({ length: 12 }, (_, k) => head.getFloat32(12 + 4 * k, true)), from = at + HEAD_BYTES;
    const held = this.submaps.get(number);
    if (kind === REMOVED) this.put(number, null);
    else if (kind === POINTS) this.put(number, { count, place, points: new Int16Array(data.slice(from, from + count * 6)), colours: new Uint8Array(data, from + count * 6, count * 3) });
    else if (held) this.put(number, { ...held, place });
  }
}
