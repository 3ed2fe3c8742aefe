// The panel: what is shown, the lamps, and how far to trust it.
import { WHITE } from "./frame.js";
import { KEYS } from "./keys.js";
import { hue } from "./lamps.js";
import { colour, unit } from "./measure.js";

const number = (x, digits = 3) => Number(x.toPrecision(digits)).toString();
const percent = (x) => `${number(100 * x, 2)}\u00a0%`;

export class Panel {
  constructor(app, document) {
    this.app = app;
    this.at = (id) => document.getElementById(id);
    this.document = document;
    const { model } = app;
    this.at("title").textContent = model.name;
    this.at("notes").replaceChildren(...model.notes.map((note) => this.#make("li", note)));
    this.#choices();
    this.#sliders();
    this.#buttons();
    for (const [keys, does] of KEYS) this.at("keys").append(this.#make("dt", keys), this.#make("dd", does));
    const stored = model.stored.map((lighting, i) => this.#make("option", `lighting ${lighting.index}`, { value: i }));
    this.at("lighting").append(...stored);
    this.at("held-out").hidden = stored.length === 0;
    this.at("lighting").addEventListener("change", (event) =>
      app.set({ lighting: event.target.value === "" ? null : Number(event.target.value), chosen: 0 }),
    );
  }

  #make(name, text, attributes = {}) {
    const node = this.document.createElement(name);
    node.textContent = text;
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    return node;
  }

  #choices() {
    for (const group of ["show", "source"])
      for (const input of this.document.querySelectorAll(`input[name=${group}]`))
        input.addEventListener("change", () => this.app.set({ [group]: input.value }));
    this.at("albedo").addEventListener("change", (event) => this.app.set({ albedo: event.target.checked }));
  }

  #sliders() {
    const { bases } = this.app.model.manifest;
    this.at("bases").max = bases;
    this.at("basis").max = bases - 1;
    for (const name of ["bases", "basis", "exposure"])
      this.at(name).addEventListener("input", (event) => this.app.set({ [name]: Number(event.target.value) }));
    this.at("tint").addEventListener("input", () => this.#coloured());
    this.at("strength").addEventListener("input", () => this.#coloured());
    for (const name of ["inner", "outer"]) this.at(name).addEventListener("input", () => this.#cone(name));
    for (const name of ["x", "y", "z"]) this.at(name).addEventListener("change", () => this.#placed());
  }

  #buttons() {
    const { app } = this;
    for (const type of ["point", "spot", "directional"]) this.at(`add-${type}`).addEventListener("click", () => app.add(type));
    this.at("remove").addEventListener("click", () => app.remove());
    this.at("expose").addEventListener("click", () => app.expose());
    this.at("reset").addEventListener("click", () => app.reset());
    this.at("hide").addEventListener("click", () => this.toggle());
    this.at("lamps").addEventListener("change", (event) => app.set({ chosen: Number(event.target.value) }));
    this.at("screenshot").addEventListener("click", () => {
      const link = this.#make("a", "", { href: app.view.screenshot(), download: `${app.model.name}.png` });
      link.click();
    });
    this.at("copy-link").addEventListener("click", () => this.#copy(location.href.split("#")[0] + app.link(), "link"));
    this.at("copy-lights").addEventListener("click", () => this.#copy(JSON.stringify(app.state.lamps), "lighting"));
  }

  async #copy(text, what) {
    try {
      await navigator.clipboard.writeText(text);
      this.say(`${what} copied`);
    } catch {
      window.prompt(`Copy the ${what}:`, text); // browsers keep the clipboard from pages that come from disk
    }
  }

  #lamp() {
    return this.app.state.lamps[this.app.state.chosen];
  }

  #coloured() {
    const lamp = this.#lamp();
    const strength = 10 ** Number(this.at("strength").value);
    const rgb = hue([0, 0, 0]).setStyle(this.at("tint").value).toArray(); // of a linear working space
    const key = lamp.type === "directional" ? "irradiance" : "intensity";
    this.app.lamp(this.app.state.chosen, { ...lamp, [key]: rgb.map((x) => strength * x) });
  }

  #cone(name) {
    let [inner, outer] = [Number(this.at("inner").value), Number(this.at("outer").value)];
    if (name === "inner") outer = Math.max(outer, inner + 1);
    else inner = Math.min(inner, outer - 1);
    this.app.lamp(this.app.state.chosen, { ...this.#lamp(), inner_deg: Math.max(inner, 0), outer_deg: Math.min(outer, 90) });
  }

  #placed() {
    const lamp = this.#lamp();
    const vector = ["x", "y", "z"].map((name) => Number(this.at(name).value));
    this.app.lamp(this.app.state.chosen, { ...lamp, [lamp.type === "directional" ? "direction" : "position"]: vector });
  }

  say(text) {
    this.at("said").textContent = text;
    clearTimeout(this.saying);
    this.saying = setTimeout(() => (this.at("said").textContent = ""), 6000);
  }

  /** Whether a source can be chosen now. */
  offers(name) {
    return !this.document.querySelector(`input[name=source][value=${name}]`).disabled;
  }

  toggle() {
    this.document.body.classList.toggle("bare");
    this.at("hide").setAttribute("aria-expanded", !this.document.body.classList.contains("bare"));
  }

  update(state, frame) {
    for (const group of ["show", "source"])
      for (const input of this.document.querySelectorAll(`input[name=${group}]`)) {
        input.checked = input.value === state[group];
        if (["reference", "error"].includes(input.value)) input.disabled = state.lighting === null;
      }
    this.at("albedo").checked = state.albedo;
    this.at("lighting").value = state.lighting ?? "";
    for (const name of ["bases", "basis", "exposure"]) this.at(name).value = state[name];
    this.at("bases-value").textContent = `${state.bases} of ${this.app.model.manifest.bases}`;
    this.at("basis-value").textContent = state.basis;
    this.at("exposure-value").textContent = `${state.exposure >= 0 ? "+" : ""}${state.exposure.toFixed(2)} EV`;
    this.at("basis-row").hidden = state.source !== "basis";
    this.#told(state, frame);
    this.#list(state);
  }

  #omitted({ omitted }) {
    const kinds = Object.entries(omitted).map(([kind, count]) => `${count} ${kind}`);
    return kinds.length ? `; lamps without a mark: ${kinds.join(", ")}; direct light from the dataset's lightmap` : "";
  }

  #told(state, frame) {
    const { trust, milliseconds } = frame;
    const dark = frame.scale.every((x) => x === 0);
    const score = dark ? 1 : trust?.score;
    this.at("trust").textContent = !trust
      ? "unknown: a model of an older version"
      : dark
        ? "no light reaches the points"
        : `${number(score, 2)}, an expected error of ${percent(1 - score)}${trust.extrapolating ? "; extrapolating" : ""}`;
    this.at("trust").classList.toggle("low", Boolean(trust?.extrapolating) && !dark);
    this.at("meter").value = score ?? 0;
    const lighting = this.app.model.stored[state.lighting];
    this.at("error-told").textContent = lighting
      ? `relative error ${percent(lighting.error)} with all bases${this.#omitted(lighting)}` +
        (state.source === "error" ? `; white: an error of ${number(WHITE * lighting.rms)} W/m²` : "")
      : "";
    const spent = milliseconds.measure + milliseconds.weigh;
    const frameTime = this.app.view.frameTime();
    this.at("times").textContent =
      `light ${number(spent, 2)} ms (${frame.measuring.rays} shadow rays)` + (frameTime ? `, frame ${number(frameTime, 3)} ms` : "");
  }

  #list(state) {
    const list = this.at("lamps");
    list.replaceChildren(...state.lamps.map((lamp, i) => this.#make("option", `${i + 1}: ${lamp.type}`, { value: i })));
    list.value = state.chosen;
    const lamp = state.lamps[state.chosen];
    this.at("lamp").hidden = !lamp;
    this.at("remove").disabled = !lamp;
    if (!lamp) return;
    const rgb = colour(lamp);
    const peak = Math.max(...rgb);
    if (this.document.activeElement !== this.at("tint")) this.at("tint").value = `#${hue(rgb).getHexString()}`;
    if (peak > 0) this.at("strength").value = Math.log10(peak);
    this.at("strength-value").textContent = `${number(peak)} ${lamp.type === "directional" ? "W/m²" : "W/sr"}`;
    this.at("cone").hidden = lamp.type !== "spot";
    if (lamp.type === "spot") {
      this.at("inner").value = lamp.inner_deg ?? 0;
      this.at("outer").value = lamp.outer_deg ?? 45;
      this.at("cone-value").textContent = `${number(lamp.inner_deg ?? 0)}° to ${number(lamp.outer_deg ?? 45)}°`;
    }
    this.at("place").textContent = lamp.type === "directional" ? "direction" : "position, m";
    const vector = lamp.type === "directional" ? unit(lamp.direction) : lamp.position;
    ["x", "y", "z"].forEach((name, axis) => {
      if (this.document.activeElement !== this.at(name)) this.at(name).value = number(vector[axis], 4);
    });
  }
}
