// One frame of light: measured, turned into weights, composed, with the lamps' shadows.
import * as THREE from "three";
import { Bvh } from "./bvh.js";
import { Composer, dataTexture } from "./compose.js";
import { misty } from "./fog.js";
import { opening } from "./holes.js";
import { Measuring, placed } from "./measure.js";
import { pierced } from "./pierced.js";
import { Shadows } from "./shadows.js";
import { BASIS, ERROR, LIGHT, Surface, geometryOf } from "./surface.js";
import { Transfer } from "./transfer.js";

const SHADOW = window.matchMedia("(pointer: coarse)").matches ? 512 : 1024;

/** The error that is shown as white, in units of the reference's root mean square. */
export const WHITE = 0.5;

export class Frame {
  constructor(model, renderer) {
    this.model = model;
    const scene = { centre: model.centre, lift: model.lift, fog: model.fog, bvh: new Bvh(model.corners, opening(model.holes)) };
    const { points, quantity, depth } = model.manifest;
    this.measuring = new Measuring(model.points, points, quantity, depth, scene);
    this.transfer = new Transfer(model);
    this.composer = new Composer(renderer, model);
    const { texture } = this.composer.target;
    texture.minFilter = texture.magFilter = THREE.LinearFilter;
    const parts = pierced(model.holes);
    const geometry = geometryOf(model, parts);
    this.surface = new Surface(model, geometry, texture, parts, misty(model.fog), SHADOW);
    this.shadows = new Shadows(renderer, geometry, model.radius, parts, SHADOW);
    this.stored = new Map();
    this.values = new Float64Array(3 * points);
  }

  /** Brings everything to a state; says in `milliseconds` what measuring and weighing took. */
  update(state) {
    const { model } = this;
    const lighting = model.stored[state.lighting];
    const key = JSON.stringify([state.lighting, state.lamps]);
    if (key !== this.key) {
      this.key = key;
      const before = performance.now();
      this.values = lighting ? Float64Array.from(lighting.values) : this.measuring.measure(state.lamps);
      const measured = performance.now();
      const { s, z } = this.transfer.encoded(this.values);
      this.scale = s;
      this.weights = this.transfer.weights(z);
      this.trust = this.transfer.trusted(s, z);
      this.milliseconds = { measure: measured - before, weigh: performance.now() - measured };
      const lamps = state.lamps.map((lamp) => placed(lamp, model.centre));
      this.shadows.update(lamps);
      this.surface.light(lamps, this.shadows.target?.texture ?? null);
    }
    if (state.source === "basis") this.composer.show(state.basis);
    else this.composer.compose(this.weights, this.scale, state.bases);
    const stops = 2 ** state.exposure;
    const view = { error: ERROR, basis: BASIS }[state.source] ?? LIGHT;
    this.surface.set({
      view,
      direct: state.show !== "indirect",
      indirect: state.show !== "direct",
      painted: state.albedo,
      stored: state.source === "reference",
      reference: lighting ? this.#texture(lighting.indirect) : this.composer.target.texture,
      spread: Boolean(lighting?.direct),
      laid: lighting?.direct ? this.#texture(lighting.direct) : this.composer.target.texture,
      exposure: view === ERROR ? 1 / (WHITE * lighting.rms) : view === BASIS ? 1 : stops,
    });
  }

  /** Of a stored map, made when it is first seen. */
  #texture(map) {
    const made = this.stored.get(map);
    if (made) return made;
    const [height, width] = map.shape;
    const texture = dataTexture(map, width, height, THREE.RGBAFormat, THREE.HalfFloatType);
    texture.minFilter = texture.magFilter = THREE.LinearFilter;
    this.stored.set(map, texture);
    return texture;
  }
}
