// Buttons that must be held: what makes an aircraft move is never set off by a touch in passing.

export const HOLD_MS = 1000;

/**
 * Have `node` call `action` after it was held (finger, mouse, Space or Enter); `tell(false)` explains a press that was too short.
 * With `ms` 0 it acts at once. `aim()` is what the press is for: where that is another at its end, `tell(true)` and no action.
 */
export function onHold(node, action, tell, ms = HOLD_MS, aim = () => null) {
  let timer = null;
  const blocked = () => node.getAttribute("aria-disabled") === "true";
  const begin = () => {
    if (timer !== null) return;
    if (blocked() || ms === 0) {
      action();
      return;
    }
    const meant = aim();
    node.style.setProperty("--hold", `${ms}ms`);
    node.classList.add("held");
    timer = setTimeout(() => {
      stop();
      if (aim() !== meant) {
        tell?.(true);
        return;
      }
      navigator.vibrate?.(60);
      action();
    }, ms);
  };
  const stop = () => {
    clearTimeout(timer);
    timer = null;
    node.classList.remove("held");
  };
  const end = () => {
    if (timer === null) return;
    stop();
    tell?.(false);
  };
  node.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    node.setPointerCapture?.(event.pointerId);
    begin();
  });
  node.addEventListener("pointerup", end);
  node.addEventListener("pointercancel", () => timer !== null && stop());
  node.addEventListener("lostpointercapture", end);
  node.addEventListener("contextmenu", (event) => event.preventDefault());
  node.addEventListener("keydown", (event) => {
    if (event.key !== " " && event.key !== "Enter") return;
    event.preventDefault();
    if (!event.repeat) begin();
  });
  node.addEventListener("keyup", (event) => (event.key === " " || event.key === "Enter") && end());
  node.addEventListener("blur", () => timer !== null && stop());
  return { begin, end };
}
