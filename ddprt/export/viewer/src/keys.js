// The keyboard: everything that the panel does most.

export const KEYS = [
  ["1 2 3", "both, direct, indirect"],
  ["O R E B", "ours, reference, error, basis"],
  ["← →", "basis before and after"],
  ["[ ]", "exposure"],
  ["X", "exposure by itself"],
  ["P S D", "add a point, spot, directional lamp"],
  ["Tab", "next lamp"],
  ["M T", "move or turn the lamp"],
  ["Del", "remove the lamp"],
  ["V", "view from the start"],
  ["H", "hide the panel"],
];

export function listen(app) {
  const step = (by) => app.set({ basis: Math.max(0, app.state.basis + by), source: "basis" });
  const source = (name) => () => app.panel.offers(name) && app.set({ source: name });
  const actions = {
    1: () => app.set({ show: "both" }),
    2: () => app.set({ show: "direct" }),
    3: () => app.set({ show: "indirect" }),
    o: source("ours"),
    r: source("reference"),
    e: source("error"),
    b: source("basis"),
    arrowleft: () => app.state.source === "basis" && (step(-1), true),
    arrowright: () => app.state.source === "basis" && (step(1), true),
    "[": () => app.set({ exposure: app.state.exposure - 0.25 }),
    "]": () => app.set({ exposure: app.state.exposure + 0.25 }),
    x: () => app.expose(),
    p: () => app.add("point"),
    s: () => app.add("spot"),
    d: () => app.add("directional"),
    tab: () => app.state.lamps.length > 1 && app.set({ chosen: (app.state.chosen + 1) % app.state.lamps.length }),
    m: () => app.view.lamps.mode("translate"),
    t: () => app.view.lamps.mode("rotate"),
    delete: () => app.remove(),
    backspace: () => app.remove(),
    v: () => app.reset(),
    h: () => app.panel.toggle(),
  };
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.toLowerCase();
    const typing = event.target.closest?.("input, select, textarea, button, summary");
    if (typing && (key === "tab" || key.startsWith("arrow") || typing.matches("input[type=number]"))) return;
    if (key === "tab" && event.target !== app.view.canvas) return; // elsewhere it goes through the panel
    if (!actions[key]) return;
    if (actions[key]() !== false) event.preventDefault();
  });
}
