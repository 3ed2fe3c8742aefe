// The lightmap of a frame: one pass over its texels adds up the basis, whatever number of pixels shows it.
import * as THREE from "three";

const VERTEX = `in vec3 position; void main() { gl_Position = vec4(position, 1.0); }`;

const FRAGMENT = `
precision highp float; precision highp sampler2DArray;
uniform sampler2DArray maps; uniform sampler2D weights; uniform sampler2D constant;
uniform int layers; uniform vec3 scale; uniform float power; uniform bool signed_; uniform bool glows;
out vec4 light;
void main() {
  ivec2 texel = ivec2(gl_FragCoord.xy);
  vec3 y = vec3(0.0);
  for (int layer = 0; layer < layers; layer++) {
    vec4 map = texelFetch(maps, ivec3(texel, layer), 0);
    y += vec3(dot(map, texelFetch(weights, ivec2(layer, 0), 0)), dot(map, texelFetch(weights, ivec2(layer, 1), 0)),
      dot(map, texelFetch(weights, ivec2(layer, 2), 0)));
  }
  if (!signed_) {
    y = max(y, 0.0);
    y = scale * (power == 1.0 ? y : pow(y, vec3(power)));
    if (glows) y += texelFetch(constant, texel, 0).rgb;
  }
  light = vec4(y, 1.0);
}`;

export function dataTexture(data, width, height, format, type) {
  const texture = new THREE.DataTexture(data, width, height, format, type);
  texture.needsUpdate = true;
  return texture;
}

export class Composer {
  /** maps: halves (layers, height, width, 4), the mean lightmap last where there is one; constant: floats (height, width, 4). */
  constructor(renderer, model) {
    const [layers, height, width] = model.maps.shape;
    Object.assign(this, { renderer, model, layers, height, width });
    this.mono = model.manifest.channels === "mono";
    this.means = model.manifest.mean === null ? 0 : 1;
    const maps = new THREE.DataArrayTexture(model.maps, width, height, layers);
    maps.type = THREE.HalfFloatType;
    maps.needsUpdate = true;
    this.rows = new Float32Array(3 * layers * 4);
    this.weights = dataTexture(this.rows, layers, 3, THREE.RGBAFormat, THREE.FloatType);
    const constant = model.constant && dataTexture(model.constant, width, height, THREE.RGBAFormat, THREE.FloatType);
    const filtered = renderer.extensions.has("OES_texture_float_linear");
    this.target = new THREE.WebGLRenderTarget(width, height, {
      type: filtered ? THREE.FloatType : THREE.HalfFloatType,
      depthBuffer: false,
      generateMipmaps: false,
    });
    this.material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      depthTest: false,
      depthWrite: false,
      uniforms: {
        maps: { value: maps },
        weights: { value: this.weights },
        constant: { value: constant ?? this.weights },
        layers: { value: layers },
        scale: { value: new THREE.Vector3() },
        power: { value: model.manifest.space === "gamma" ? model.manifest.gamma : 1 },
        signed_: { value: false },
        glows: { value: Boolean(constant) },
      },
    });
    const triangle = new THREE.BufferGeometry();
    triangle.setAttribute("position", new THREE.Float32BufferAttribute([-1, -1, 0, 3, -1, 0, -1, 3, 0], 3));
    this.scene = new THREE.Scene();
    const mesh = new THREE.Mesh(triangle, this.material);
    mesh.frustumCulled = false;
    this.scene.add(mesh);
    this.camera = new THREE.Camera();
  }

  /** Weights of one basis in each colour channel: channel c of a layer for mono, all colours of it for multi. */
  #put(basis, values) {
    for (let c = 0; c < 3; c++) {
      const [layer, channel] = this.mono ? [basis >> 2, basis & 3] : [basis, c];
      this.rows[4 * (c * this.layers + layer) + channel] = values[c];
    }
  }

  /** The frame of weights u (groups, bases) and scale s, by the first `count` bases. */
  compose(u, s, count) {
    const bases = this.model.manifest.bases;
    this.rows.fill(0);
    for (let b = 0; b < Math.min(count, bases); b++)
      this.#put(b, this.mono ? [u[b], u[bases + b], u[2 * bases + b]] : [u[b], u[b], u[b]]);
    if (this.means)
      for (let c = 0; c < 3; c++) this.rows[4 * (c * this.layers + this.layers - 1) + (this.mono ? 0 : c)] = 1;
    this.#draw(s, false);
  }

  /** One basis function as it is, with its sign. */
  show(basis) {
    this.rows.fill(0);
    this.#put(basis, [1, 1, 1]);
    this.#draw([1, 1, 1], true);
  }

  #draw(s, signed) {
    this.weights.needsUpdate = true;
    this.material.uniforms.scale.value.fromArray(s);
    this.material.uniforms.signed_.value = signed;
    this.renderer.setRenderTarget(this.target);
    this.renderer.render(this.scene, this.camera);
    this.renderer.setRenderTarget(null);
  }

  /** (height, width, 4) of what was composed, row 0 first. */
  read() {
    const half = this.target.texture.type === THREE.HalfFloatType;
    const pixels = new (half ? Uint16Array : Float32Array)(4 * this.width * this.height);
    this.renderer.readRenderTargetPixels(this.target, 0, 0, this.width, this.height, pixels);
    return half ? Float32Array.from(pixels, THREE.DataUtils.fromHalfFloat) : pixels;
  }
}
