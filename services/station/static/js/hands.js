// Fingers, mouse and keys on the map: drag, pinch, wheel, arrows, a tap that picks a tree.

/** Have a map follow fingers, mouse and keys. */
export function listen(map) {
  const pointers = new Map();
  let moved = 0, spread = 0;
  const c = map.canvas;
  const local = (e) => ({ u: e.clientX - c.getBoundingClientRect().left, v: e.clientY - c.getBoundingClientRect().top });
  c.addEventListener("pointerdown", (e) => {
    c.setPointerCapture(e.pointerId);
    pointers.set(e.pointerId, local(e));
    moved = pointers.size > 1 ? 99 : 0;
    spread = 0;
  });
  c.addEventListener("pointermove", (e) => {
    const from = pointers.get(e.pointerId);
    if (!from) return;
    const to = local(e);
    pointers.set(e.pointerId, to);
    moved += Math.abs(to.u - from.u) + Math.abs(to.v - from.v);
    if (moved < 6) return;
    const share = 1 / pointers.size;
    map.move((to.u - from.u) * share, (to.v - from.v) * share);
    if (pointers.size === 2) {
      const [a, b] = [...pointers.values()], now = Math.hypot(a.u - b.u, a.v - b.v);
      if (spread) map.zoom(now / spread, (a.u + b.u) / 2, (a.v + b.v) / 2);
      spread = now;
    }
  });
  const up = (e) => {
    if (!pointers.delete(e.pointerId)) return;
    spread = 0;
    if (e.type === "pointerup" && moved < 6) map.pick(local(e));
  };
  c.addEventListener("pointerup", up);
  c.addEventListener("pointercancel", up);
  c.addEventListener("wheel", (e) => {
    e.preventDefault();
    const { u, v } = local(e);
    map.zoom(Math.exp(-e.deltaY * 0.0015), u, v);
  }, { passive: false });
  c.addEventListener("keydown", (e) => {
    const step = { ArrowUp: [0, 60], ArrowDown: [0, -60], ArrowLeft: [60, 0], ArrowRight: [-60, 0] }[e.key];
    if (step) map.move(...step);
    else if (e.key === "+" || e.key === "=") map.zoom(1.3);
    else if (e.key === "-") map.zoom(1 / 1.3);
    else if (e.key === "f" || e.key === "F") map.fit();
    else return;
    e.preventDefault();
  });
}
