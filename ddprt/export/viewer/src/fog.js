// Fog on the way of light: Beer and Lambert's law within a box about the origin, on the CPU and in shaders.

const NONE = { fragment: "vec3 veil(vec3 place, vec3 to, float reach) { return vec3(1.0); }", uniforms: {} };

const FRAGMENT = `
uniform vec3 extinction; uniform vec3 box;
vec3 veil(vec3 place, vec3 to, float reach) {
  vec3 way = mix(to, vec3(1e-7), lessThan(abs(to), vec3(1e-7)));
  vec3 one = (-box - place) / way, other = (box - place) / way, low = min(one, other), high = max(one, other);
  float near = max(max(low.x, low.y), max(low.z, 0.0)), far = min(min(high.x, high.y), min(high.z, reach));
  return exp(-extinction * max(far - near, 0.0));
}`;

/** Shader parts for a scene's fog; parts that do nothing in clear air. */
export function misty(fog) {
  if (!fog) return NONE;
  return { fragment: FRAGMENT, uniforms: { extinction: { value: fog.extinction }, box: { value: fog.half } } };
}

/** Metres of the way from a place (centred frame) to a lamp that lie in the box; `ray` as measuring makes it. */
export function within(half, place, ray) {
  let near = 0;
  let far = ray.distance;
  const way = [ray.x, ray.y, ray.z];
  for (let axis = 0; axis < 3; axis++) {
    if (way[axis] === 0) {
      if (Math.abs(place[axis]) > half[axis]) return 0;
      continue;
    }
    const one = (-half[axis] - place[axis]) / way[axis];
    const other = (half[axis] - place[axis]) / way[axis];
    near = Math.max(near, Math.min(one, other));
    far = Math.min(far, Math.max(one, other));
  }
  return Math.max(far - near, 0);
}
