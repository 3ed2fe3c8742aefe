// A lightmap for three.js that follows the light: textures, one pass over the texels, and a texture for `material.lightMap`.
import { Model } from "./model.js";

const VERTEX = "in vec3 position; out vec2 lightmap; void main() { lightmap = 0.5 + 0.5 * position.xy; gl_Position = vec4(position, 1.0); }";

export class Lightmap {
  /** THREE: the module; model: a `Model`; source: the text of compose.frag. */
  constructor(THREE, renderer, model, source) {
    const data = (array, width, height) => {
      const texture = new THREE.DataTexture(array, width, height, THREE.RGBAFormat, THREE.FloatType);
      texture.needsUpdate = true;
      return texture;
    };
    const { width, height, layers } = model;
    const textures = new THREE.DataArrayTexture(model.texels, width, height, layers);
    Object.assign(textures, { type: THREE.HalfFloatType, minFilter: THREE.LinearFilter, magFilter: THREE.LinearFilter });
    textures.needsUpdate = true;
    this.rows = data(new Float32Array(4 * model.rowCount), model.rowCount, 1);
    const uniforms = { layers: { value: textures }, rows: { value: this.rows } };
    if (model.constant) {
      const four = Float32Array.from({ length: 4 * width * height }, (_, i) => (i & 3) < 3 ? model.constant[3 * (i >> 2) + (i & 3)] : 0);
      uniforms.constant = { value: data(four, width, height) };
    }
    this.target = new THREE.WebGLRenderTarget(width, height, { type: THREE.FloatType, depthBuffer: false });
    if (!renderer.extensions.has("OES_texture_float_linear")) this.target.texture.type = THREE.HalfFloatType;
    this.target.texture.channel = 1; // TEXCOORD_1, which a GLTFLoader calls uv1
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: VERTEX,
      fragmentShader: source.replace(/^#version.*\n/, ""),
      depthTest: false,
      depthWrite: false,
      uniforms,
    });
    const triangle = new THREE.BufferGeometry();
    triangle.setAttribute("position", new THREE.Float32BufferAttribute([-1, -1, 0, 3, -1, 0, -1, 3, 0], 3));
    this.scene = new THREE.Scene();
    this.scene.add(Object.assign(new THREE.Mesh(triangle, material), { frustumCulled: false }));
    Object.assign(this, { renderer, model, camera: new THREE.Camera() });
  }

  /** From the folder that ddprt wrote. */
  static async load(THREE, renderer, folder) {
    const [bytes, text] = await Promise.all(["model.bin", "compose.frag"].map((name) => fetch(new URL(name, folder))));
    return new Lightmap(THREE, renderer, new Model(await bytes.arrayBuffer()), await text.text());
  }

  /** For `material.lightMap`: irradiance in W/m², which is what three.js expects there. */
  get texture() {
    return this.target.texture;
  }

  /** shaded: irradiance at model.position with model.normal, (samples, 3), W/m², by your own lamps and shadows. */
  relight(shaded) {
    this.rows.image.data.set(this.model.rows(this.model.average(shaded)));
    this.rows.needsUpdate = true;
    const before = this.renderer.getRenderTarget();
    this.renderer.setRenderTarget(this.target);
    this.renderer.render(this.scene, this.camera);
    this.renderer.setRenderTarget(before);
  }
}
