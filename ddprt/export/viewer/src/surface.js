// What the eye sees: radiance albedo / pi (direct + indirect), the lamps with their shadows, or a map in false colours.
import * as THREE from "three";
import { dataTexture } from "./compose.js";
import { across } from "./shadows.js";

export const MOST = 8; // lamps: 14 numbers each in uniforms
export const LIGHT = 0;
export const ERROR = 1;
export const BASIS = 2;

const VERTEX = `
in vec3 position; in vec3 normal; in vec2 uv; out vec3 place; out vec2 where; flat out vec3 facing;
uniform mat4 projectionMatrix; uniform mat4 viewMatrix;
void main() { place = position; facing = normal; where = uv; gl_Position = projectionMatrix * viewMatrix * vec4(position, 1.0); }`;

const FRAGMENT = `
precision highp float; precision highp sampler2DArray;
const float PI = 3.14159265358979;
in vec3 place; in vec2 where; flat in vec3 facing; out vec4 result;
uniform sampler2D ours; uniform sampler2D reference; uniform sampler2D paint; uniform sampler2D exitant;
uniform sampler2D laid;
uniform sampler2DArray shadows;
uniform int lamps; uniform int kinds[MOST]; uniform vec3 positions[MOST]; uniform vec3 directions[MOST]; uniform vec3 rights[MOST];
uniform vec3 ups[MOST]; uniform vec3 colours[MOST]; uniform vec2 cones[MOST];
uniform float radius; uniform float exposure; uniform float size;
uniform bool direct; uniform bool spread; uniform bool indirect; uniform bool painted; uniform bool stored; uniform bool exits; uniform int view;
HOLES
FOG
float lit(int layer, vec2 at, float depth) {
  vec2 p = at * size - 0.5; ivec2 low = ivec2(floor(p)); vec2 part = p - floor(p);
  float sum = 0.0;
  for (int y = -1; y <= 2; y++) for (int x = -1; x <= 2; x++) {  // a box of three texels, slid over four
    ivec2 t = clamp(low + ivec2(x, y), ivec2(0), ivec2(int(size) - 1));
    float w = (x == -1 ? 1.0 - part.x : x == 2 ? part.x : 1.0) * (y == -1 ? 1.0 - part.y : y == 2 ? part.y : 1.0);
    sum += w * step(depth, texelFetch(shadows, ivec3(t, layer), 0).r);
  }
  return sum / 9.0;
}
vec3 arriving(int i, vec3 n) {
  if (kinds[i] == 2) {
    float cosine = -dot(directions[i], n);
    if (cosine <= 0.0) return vec3(0.0);
    float texel = 2.0 * radius / size;
    vec3 p = place + 2.0 * texel * n;
    vec2 at = vec2(dot(p, rights[i]), dot(p, ups[i])) / radius * 0.5 + 0.5;
    return cosine * colours[i] * veil(place, -directions[i], 1e30) * lit(6 * i, at, dot(p, directions[i]) + radius - texel);
  }
  vec3 away = positions[i] - place; float d = length(away); vec3 to = away / d;
  float cosine = dot(to, n), strength = cosine / (d * d);
  if (cosine <= 0.0) return vec3(0.0);
  if (kinds[i] == 1) {
    vec3 off = to + directions[i];
    float falloff = clamp((cones[i].x - 0.5 * dot(off, off)) / cones[i].y, 0.0, 1.0);
    strength *= falloff * falloff;
  }
  if (strength == 0.0) return vec3(0.0);
  float texel = 2.0 * d / size;
  vec3 v = place + 2.0 * texel * n - positions[i], a = abs(v), f; int face;
  if (a.x >= a.y && a.x >= a.z) { face = v.x > 0.0 ? 0 : 1; f = vec3(sign(v.x), 0.0, 0.0); }
  else if (a.y >= a.z) { face = v.y > 0.0 ? 2 : 3; f = vec3(0.0, sign(v.y), 0.0); }
  else { face = v.z > 0.0 ? 4 : 5; f = vec3(0.0, 0.0, sign(v.z)); }
  vec3 r = normalize(cross(f, f.y != 0.0 ? vec3(0.0, 0.0, 1.0) : vec3(0.0, 1.0, 0.0))), u = cross(r, f);
  vec2 at = vec2(dot(v, r), dot(v, u)) / dot(v, f) * 0.5 + 0.5;
  return strength * colours[i] * veil(place, to, d) * lit(6 * i + face, at, length(v) - texel);
}
vec3 heat(float x) {  // black, blue, red, yellow, white at quarters
  x = clamp(x, 0.0, 1.0) * 4.0;
  return clamp(vec3(x - 1.0, x - 2.0, x < 2.0 ? min(x, 2.0 - x) : x - 3.0), 0.0, 1.0);
}
vec3 display(vec3 c) { c = clamp(c, 0.0, 1.0); return mix(12.92 * c, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c)); }
void main() {
  if (pierced()) discard;
  vec3 map = stored ? texture(reference, where).rgb : texture(ours, where).rgb, n = normalize(facing);
  if (view == 1) { result = vec4(heat(length(texture(ours, where).rgb - texture(reference, where).rgb) * exposure), 1.0); return; }
  if (view == 2) {
    float x = clamp(map.r * exposure, -1.0, 1.0), y = clamp(map.g * exposure, -1.0, 1.0), z = clamp(map.b * exposure, -1.0, 1.0);
    vec3 one = x > 0.0 ? mix(vec3(0.12), vec3(1.0, 0.62, 0.1), x) : mix(vec3(0.12), vec3(0.15, 0.5, 1.0), -x);
    result = vec4(x == y && y == z ? one : 0.5 + 0.5 * vec3(x, y, z), 1.0);
    return;
  }
  vec3 light = indirect ? map : vec3(0.0);
  if (direct && !(exits && texture(exitant, where).r > 0.5)) {
    if (spread) light += texture(laid, where).rgb;
    else for (int i = 0; i < MOST; i++) if (i < lamps) light += arriving(i, n);
  }
  result = vec4(display(exposure * light / PI * (painted ? texture(paint, where).rgb : vec3(1.0))), 1.0);
}`;

/** Flat triangles: corners relative to the scene's centre, their geometric normals, their places on the lightmap. */
export function geometryOf(model, holes) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(model.corners, 3));
  geometry.setAttribute("uv", new THREE.BufferAttribute(model.uv, 2));
  geometry.computeVertexNormals(); // not indexed: those of the triangles
  holes.attributes(geometry);
  return geometry;
}

export class Surface {
  constructor(model, geometry, composed, pierced, misty, size) {
    const [, height, width] = model.maps.shape;
    const byte = (data, format) => data && dataTexture(data, width, height, format, THREE.UnsignedByteType);
    const paint = byte(model.albedo, THREE.RGBAFormat) ?? dataTexture(new Uint8Array([188, 188, 188, 255]), 1, 1);
    paint.colorSpace = THREE.SRGBColorSpace;
    paint.minFilter = paint.magFilter = THREE.LinearFilter;
    const list = (make) => Array.from({ length: MOST }, make);
    const vectors = () => ({ value: list(() => new THREE.Vector3()) });
    this.uniforms = {
      ...pierced.uniforms,
      ...misty.uniforms,
      ours: { value: composed },
      reference: { value: composed },
      laid: { value: composed },
      spread: { value: false },
      paint: { value: paint },
      exitant: { value: byte(model.exitant, THREE.RedFormat) ?? paint },
      exits: { value: Boolean(model.exitant) },
      shadows: { value: null },
      lamps: { value: 0 },
      kinds: { value: list(() => 0) },
      positions: vectors(),
      directions: vectors(),
      rights: vectors(),
      ups: vectors(),
      colours: vectors(),
      cones: { value: list(() => new THREE.Vector2()) },
      radius: { value: model.radius },
      exposure: { value: 1 },
      size: { value: size },
      direct: { value: true },
      indirect: { value: true },
      painted: { value: true },
      stored: { value: false },
      view: { value: LIGHT },
    };
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: pierced.vertex(VERTEX),
      fragmentShader: FRAGMENT.replaceAll("MOST", MOST).replace("HOLES", pierced.fragment).replace("FOG", misty.fragment),
      side: THREE.FrontSide, // backs do not hide: a room is looked into from outside
      uniforms: this.uniforms,
    });
    this.mesh = new THREE.Mesh(geometry, material);
    this.mesh.frustumCulled = false;
  }

  set(values) {
    for (const [name, value] of Object.entries(values)) this.uniforms[name].value = value;
  }

  /** Takes over placed light records and their shadow maps. */
  light(lamps, shadows) {
    const u = this.uniforms;
    u.lamps.value = lamps.length;
    u.shadows.value = shadows;
    lamps.forEach((lamp, i) => {
      u.kinds.value[i] = ["point", "spot", "directional"].indexOf(lamp.type);
      u.colours.value[i].fromArray(lamp.colour);
      u.positions.value[i].fromArray(lamp.position ?? [0, 0, 0]);
      u.directions.value[i].fromArray(lamp.direction ?? [0, 0, 0]);
      u.cones.value[i].set(lamp.outer ?? 0, lamp.width ?? 1);
      if (lamp.type !== "directional") return;
      const [right, up] = across(lamp.direction);
      u.rights.value[i].fromArray(right);
      u.ups.value[i].fromArray(up);
    });
  }
}
