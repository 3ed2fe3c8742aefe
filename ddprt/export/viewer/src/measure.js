// Light at the measurement points, as docs/export.md says: with shadow rays, and from behind the surface where `depth` is not 0.
import { within } from "./fog.js";

export const DRAWN = ["point", "spot", "directional"];
const radians = (degrees) => (degrees * Math.PI) / 180;
const drop = (degrees) => 2 * Math.sin(radians(degrees) / 2) ** 2; // 1 - cosine

export const colour = (light) => (light.type === "directional" ? light.irradiance : light.intensity);

export function unit(vector) {
  const length = Math.hypot(...vector);
  return vector.map((x) => x / length);
}

/** Prepares a light record for the frame that triangles are in. */
export function placed(light, centre) {
  const ready = { type: light.type, colour: colour(light) };
  if (light.type !== "directional") ready.position = light.position.map((x, axis) => x - centre[axis]);
  if (light.type !== "point") ready.direction = unit(light.direction);
  if (light.type === "spot") {
    ready.outer = drop(light.outer_deg ?? 45);
    ready.width = Math.max(ready.outer - drop(light.inner_deg ?? 0), 1e-300);
  }
  return ready;
}

// Cosine times what arrives of a unit of light; writes the direction and distance of the lamp into `ray`.
function arriving(light, x, y, z, normal, at, ray) {
  if (light.type === "directional") {
    [ray.x, ray.y, ray.z] = light.direction.map((part) => -part);
    ray.distance = Infinity;
    return Math.max(0, ray.x * normal[at] + ray.y * normal[at + 1] + ray.z * normal[at + 2]);
  }
  const [px, py, pz] = light.position;
  const distance = Math.hypot(px - x, py - y, pz - z);
  if (distance === 0) return 0;
  ray.x = (px - x) / distance;
  ray.y = (py - y) / distance;
  ray.z = (pz - z) / distance;
  ray.distance = distance;
  const cosine = ray.x * normal[at] + ray.y * normal[at + 1] + ray.z * normal[at + 2];
  if (cosine <= 0) return 0;
  let strength = cosine / (distance * distance);
  if (light.type === "spot") {
    const [ax, ay, az] = light.direction;
    const away = 0.5 * ((ray.x + ax) ** 2 + (ray.y + ay) ** 2 + (ray.z + az) ** 2);
    strength *= Math.min(Math.max((light.outer - away) / light.width, 0), 1) ** 2;
  }
  return strength;
}

export class Measuring {
  /** points: position, normal, albedo, home; scene: centre, lift (metres that rays start above the surface), bvh, fog or null. */
  constructor(points, count, quantity, depth, scene) {
    Object.assign(this, { points, count, depth, scene });
    this.weighted = quantity === "radiosity";
    this.sizes = new Float64Array(count);
    for (const home of points.home) this.sizes[home]++;
    this.rays = 0;
  }

  // Cosine times what arrives of a unit of light so deep behind a sample, per channel, whatever is on the way but fog.
  #at(light, at, depth) {
    const { position, normal } = this.points;
    const { centre, lift, fog } = this.scene;
    const place = [0, 1, 2].map((axis) => position[at + axis] - centre[axis] + (lift - depth) * normal[at + axis]);
    const ray = {};
    const strength = arriving(light, ...place, normal, at, ray);
    if (!fog || strength === 0) return [strength, strength, strength];
    const length = within(fog.half, place, ray);
    return fog.extinction.map((x) => strength * Math.exp(-x * length));
  }

  // The same as it is measured: from behind the surface where there is a depth.
  #measured(light, at) {
    if (this.depth === 0) return this.#at(light, at, 0);
    const far = this.#at(light, at, 2 * this.depth);
    return this.#at(light, at, this.depth).map((near, c) => Math.max(0, 2 * near - far[c]));
  }

  /** (points, 3) W/m² of light records. */
  measure(lights) {
    const { position, normal, albedo, home } = this.points;
    const { centre, lift, bvh, fog } = this.scene;
    const values = new Float64Array(3 * this.count);
    const ready = lights.map((light) => placed(light, centre));
    const ray = {};
    this.rays = 0;
    for (let i = 0; i < home.length; i++) {
      const at = 3 * i;
      const [x, y, z] = [0, 1, 2].map((axis) => position[at + axis] - centre[axis] + lift * normal[at + axis]);
      for (const light of ready) {
        const bare = light.type === "spot" && this.depth > 0 ? { ...light, type: "point" } : light; // a cone casts no shadow
        const strength = arriving(bare, x, y, z, normal, at, ray);
        if (strength <= 0) continue;
        const plain = !fog && (this.depth === 0 || light.type === "directional");
        const shone = plain ? null : this.#measured(light, at);
        if (shone?.every((part) => part === 0)) continue;
        this.rays++;
        if (bvh.occluded(x, y, z, ray.x, ray.y, ray.z, Math.max(ray.distance - lift, 0))) continue;
        const share = 1 / this.sizes[home[i]];
        for (let c = 0; c < 3; c++)
          values[3 * home[i] + c] += (shone?.[c] ?? strength) * share * light.colour[c] * (this.weighted ? albedo[at + c] : 1);
      }
    }
    return values;
  }
}
