// Holes of leaves and fences in shaders: the same lookup that shadow rays make.
import * as THREE from "three";
import { dataTexture } from "./compose.js";

const NONE = { vertex: (text) => text, fragment: "bool pierced() { return false; }", uniforms: {}, attributes: () => {} };

const FRAGMENT = `
uniform highp sampler2D opacity; in vec2 mask_uv; flat in vec4 mask;  // first pixel, height, width, cutoff; height 0: no holes
float pixel(ivec2 at) {
  int index = int(mask.x) + at.y * int(mask.z) + at.x, width = textureSize(opacity, 0).x;
  return texelFetch(opacity, ivec2(index % width, index / width), 0).r;
}
bool pierced() {
  if (mask.y == 0.0) return false;
  vec2 size = mask.zy, at = mask_uv * size - 0.5, low = floor(at), part = at - low;
  ivec2 a = ivec2(mod(low, size)), b = ivec2(mod(low + 1.0, size));
  float above = mix(pixel(a), pixel(ivec2(b.x, a.y)), part.x), below = mix(pixel(ivec2(a.x, b.y)), pixel(b), part.x);
  return mix(above, below, part.y) < mask.w;
}`;

/** Shader parts for a scene's holes; parts that do nothing where there are none. */
export function pierced(holes) {
  if (!holes) return NONE;
  const width = 2048;
  const height = Math.ceil(holes.opacity.length / width);
  const pixels = new Float32Array(width * height);
  pixels.set(holes.opacity);
  const head = "in vec2 hole_uv; in vec4 hole; out vec2 mask_uv; flat out vec4 mask;\n";
  return {
    vertex: (text) => head + text.replace("void main() {", "void main() { mask_uv = hole_uv; mask = hole;"),
    fragment: FRAGMENT,
    uniforms: { opacity: { value: dataTexture(pixels, width, height, THREE.RedFormat, THREE.FloatType) } },
    attributes: (geometry) => attach(geometry, holes),
  };
}

function attach(geometry, holes) {
  const uv = new Float32Array(6 * holes.row.length);
  const mask = new Float32Array(12 * holes.row.length);
  const starts = [0];
  holes.cutoff.forEach((_, i) => starts.push(starts[i] + holes.size[2 * i] * holes.size[2 * i + 1]));
  holes.row.forEach((row, triangle) => {
    if (row < 0) return;
    const image = holes.image[row];
    uv.set(holes.uv.subarray(6 * row, 6 * row + 6), 6 * triangle);
    for (let corner = 0; corner < 3; corner++)
      mask.set([starts[image], holes.size[2 * image], holes.size[2 * image + 1], holes.cutoff[image]], 12 * triangle + 4 * corner);
  });
  geometry.setAttribute("hole_uv", new THREE.BufferAttribute(uv, 2));
  geometry.setAttribute("hole", new THREE.BufferAttribute(mask, 4));
}
