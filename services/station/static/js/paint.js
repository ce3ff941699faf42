// Strokes that the map's drawing is made of.

/** The colours of the present theme. */
export function palette() {
  const style = getComputedStyle(document.documentElement);
  const of = (name) => style.getPropertyValue(`--${name}`).trim();
  return {
    map: of("map"), grid: of("map-grid"), grid5: of("map-grid-5"), ink: of("map-ink"), seen: of("seen"), solid: of("solid"), cone: of("cone"), coneLine: of("cone-line"), craft: of("craft"),
    trail: of("trail"), tree: of("tree"), treeInk: of("tree-ink"), un: of("tree-un"), visited: of("tree-visited"), target: of("tree-target"), soft: of("soft"), surface: of("surface"),
  };
}

export function circle(c, u, v, r) {
  c.beginPath();
  c.arc(u, v, r, 0, 2 * Math.PI);
}

export function line(c, [u0, v0], [u1, v1], colour) {
  c.strokeStyle = colour;
  c.beginPath();
  c.moveTo(Math.round(u0) + 0.5, Math.round(v0) + 0.5);
  c.lineTo(Math.round(u1) + 0.5, Math.round(v1) + 0.5);
  c.stroke();
}

/** Write `words` with a halo of `ground`, so that they are read on anything. */
export function label(c, words, u, v, colour, size, ground) {
  c.font = `650 ${size}px system-ui, "DejaVu Sans", sans-serif`;
  c.lineWidth = 4;
  c.lineJoin = "round";
  c.strokeStyle = ground;
  c.strokeText(words, u, v);
  c.fillStyle = colour;
  c.fillText(words, u, v);
}
