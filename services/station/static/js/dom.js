// Small helpers for the page. Text from outside enters by textContent alone: nothing here makes markup of a string.

export const $ = (id) => document.getElementById(id);

/** Return a new element; `children` are nodes or texts. */
export function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) set(node, name, value);
  node.append(...children.filter((c) => c !== null && c !== undefined).map((c) => (c instanceof Node ? c : String(c))));
  return node;
}

/** Set an attribute only when it changes: the page is touched five times a second. */
export function set(node, name, value) {
  if (value === null || value === undefined || value === false) {
    if (node.hasAttribute(name)) node.removeAttribute(name);
  } else if (node.getAttribute(name) !== String(value)) {
    node.setAttribute(name, String(value));
  }
}

/** Set the text only when it changes, so that selections and screen readers are left alone. */
export function text(node, value) {
  const words = value === null || value === undefined ? "" : String(value);
  if (node.textContent !== words) node.textContent = words;
}

/** Bring the children of `parent` in line with `items`: `make(item)` builds one, `update(node, item)` fills it. */
export function keyed(parent, items, key, make, update) {
  const old = new Map([...parent.children].map((node) => [node.dataset.key, node]));
  let at = parent.firstElementChild;
  for (const item of items) {
    const name = String(key(item));
    let node = old.get(name);
    if (node) old.delete(name);
    else {
      node = make(item);
      node.dataset.key = name;
    }
    update(node, item);
    if (node === at) at = at.nextElementSibling;
    else parent.insertBefore(node, at);
  }
  while (at) { // all that was visited stands before it
    const gone = at;
    at = at.nextElementSibling;
    gone.remove();
  }
}

export const words = (name) => String(name).replaceAll("_", " ");

/** Return a duration in a few characters. */
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "never";
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 100) return `${Math.round(seconds)} s`;
  return seconds < 6000 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`;
}

export const clock = (ns) => new Date(Number(ns) / 1e6).toLocaleTimeString([], { hour12: false });
