// Light at the measurement points, as docs/export.md says: with shadow rays, and from behind the surface where `depth` is not 0.

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
  /** points: position, normal, albedo, home; scene: centre, lift (metres that rays start above the surface), bvh. */
  constructor(points, count, quantity, depth, scene) {
    Object.assign(this, { points, count, depth, scene });
    this.weighted = quantity === "radiosity";
    this.sizes = new Float64Array(count);
    for (const home of points.home) this.sizes[home]++;
    this.rays = 0;
  }

  /** (points, 3) W/m² of light records. */
  measure(lights) {
    const { position, normal, albedo, home } = this.points;
    const { centre, lift } = this.scene;
    const values = new Float64Array(3 * this.count);
    const ready = lights.map((light) => placed(light, centre));
    const ray = {};
    this.rays = 0;
    for (let i = 0; i < home.length; i++) {
      const at = 3 * i;
      const place = (depth, axis) => position[at + axis] - centre[axis] + (lift - depth) * normal[at + axis];
      const x = place(0, 0);
      const y = place(0, 1);
      const z = place(0, 2);
      for (const light of ready) {
        const bare = light.type === "spot" ? { ...light, type: "point" } : light; // a cone casts no shadow
        let strength = arriving(this.depth > 0 ? bare : light, x, y, z, normal, at, ray);
        if (strength <= 0) continue;
        const { x: dx, y: dy, z: dz, distance } = ray;
        if (this.depth > 0 && light.type !== "directional") {
          const sunk = (depth) => arriving(light, place(depth, 0), place(depth, 1), place(depth, 2), normal, at, ray);
          strength = Math.max(0, 2 * sunk(this.depth) - sunk(2 * this.depth));
          if (strength === 0) continue;
        }
        this.rays++;
        if (this.scene.bvh.occluded(x, y, z, dx, dy, dz, Math.max(distance - lift, 0))) continue;
        const share = strength / this.sizes[home[i]];
        for (let c = 0; c < 3; c++)
          values[3 * home[i] + c] += share * light.colour[c] * (this.weighted ? albedo[at + c] : 1);
      }
    }
    return values;
  }
}
