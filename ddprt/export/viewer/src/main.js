// The viewer: a model's light as an engine would show it, lamps that can be dragged, and a panel. See docs/viewer.md.
import { unpack } from "./data.js";
import { Frame } from "./frame.js";
import { isLamp, parsed, written } from "./state.js";
import { missing, refuse, warn } from "./support.js";
import { MOST } from "./surface.js";
import { Panel } from "./panel.js";
import { View } from "./view.js";
import { listen } from "./keys.js";

function start() {
  const lacking = missing();
  if (lacking) return refuse(lacking);
  try {
    window.ddprt = new App(unpack(JSON.parse(document.getElementById("model").textContent))); // for scripts and tests
  } catch (error) {
    refuse(`this page could not start: ${error.message}`);
    throw error;
  }
}

class App {
  constructor(model) {
    this.model = model;
    this.view = new View(model, document.getElementById("picture"), {
      changed: (index, lamp) => this.lamp(index, lamp),
      picked: (index) => this.set({ chosen: index }),
      moved: () => this.#link(),
    });
    this.frame = new Frame(model, this.view.renderer);
    this.view.show(this.frame);
    this.initial = {
      eye: model.camera.eye,
      target: model.camera.target,
      lamps: model.lights,
      chosen: 0,
      show: "both",
      source: "ours",
      basis: 0,
      bases: model.manifest.bases,
      exposure: 0,
      albedo: true,
      lighting: model.stored.length > 0 ? 0 : null,
    };
    this.state = { ...this.initial };
    this.panel = new Panel(this, document);
    document.getElementById("warning").addEventListener("click", () => warn(""));
    listen(this);
    window.addEventListener("hashchange", () => this.restore(location.hash));
    this.set(this.initial, { link: false });
    this.expose({ link: false });
    this.initial = this.state;
    this.restore(location.hash);
  }

  /** Takes over entries of a state. */
  set(changes, { link = true } = {}) {
    const before = this.state;
    const next = { ...before, ...changes };
    if ("lamps" in changes && !("lighting" in changes)) next.lighting = null;
    const stored = this.model.stored[next.lighting];
    if (next.lighting !== null && !stored) next.lighting = null;
    if (next.lighting !== null) next.lamps = stored.lights;
    if (next.lighting === null && ["reference", "error"].includes(next.source)) next.source = "ours";
    next.basis = Math.min(next.basis, this.model.manifest.bases - 1);
    next.bases = Math.min(next.bases, this.model.manifest.bases);
    next.chosen = Math.min(next.chosen, next.lamps.length - 1);
    this.state = next;
    this.frame.update(next);
    this.view.update(next);
    this.panel.update(next, this.frame);
    if (link) this.#link();
  }

  /** Replaces one lamp. */
  lamp(index, lamp) {
    if (!isLamp(lamp)) return;
    this.set({ lamps: this.state.lamps.map((old, i) => (i === index ? lamp : old)) });
  }

  add(type) {
    if (this.state.lamps.length >= MOST) return this.panel.say(`got ${MOST} lamps, which is the most; remove one first`);
    this.set({ lamps: [...this.state.lamps, this.view.newLamp(type, this.model)], chosen: this.state.lamps.length });
  }

  remove(index = this.state.chosen) {
    if (index < 0) return;
    this.set({ lamps: this.state.lamps.filter((_, i) => i !== index), chosen: Math.min(index, this.state.lamps.length - 2) });
  }

  /** Exposure at which the measured light is of middle brightness. */
  expose({ link = true } = {}) {
    const mean = this.frame.values.reduce((sum, x) => sum + x, 0) / this.frame.values.length;
    const albedo = this.model.manifest.quantity === "radiosity" ? 1 : 0.5;
    if (mean > 0) this.set({ exposure: Math.round(20 * Math.log2((0.25 * Math.PI) / (albedo * mean))) / 20 }, { link });
  }

  /** Where a link leads; false if it says nothing or cannot be read. */
  restore(hash) {
    const same = hash === this.linked;
    const state = same ? null : parsed(hash, MOST);
    warn(state instanceof Error ? `link: got one that cannot be followed (${state.message}); nothing of it is taken` : "");
    if (state === null || state instanceof Error) return same;
    this.linked = hash;
    this.view.look(state.eye ?? this.initial.eye, state.target ?? this.initial.target);
    this.set({ ...this.initial, ...(state.lamps ? { lighting: null } : {}), ...state }, { link: false });
    return true;
  }

  /** The link to what is shown. */
  link() {
    const { lighting, lamps, ...rest } = { ...this.state, ...this.view.looking() };
    return written({ ...rest, ...(lighting === null ? { lamps } : { lighting }) });
  }

  #link() {
    clearTimeout(this.linking);
    this.linking = setTimeout(() => {
      this.linked = this.link();
      warn("");
      try {
        history.replaceState(null, "", this.linked);
      } catch {
        location.replace(this.linked); // where pages from disk have no history
      }
    }, 250);
  }

  /** The light of another packed model, apart from what is shown. */
  framed(packed) {
    return new Frame(unpack(packed), this.view.renderer);
  }

  reset() {
    this.view.look(this.initial.eye, this.initial.target);
    this.#link();
  }
}

start();
