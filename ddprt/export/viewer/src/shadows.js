// Shadow maps: distances from each lamp in layers of one texture, six faces of a cube for lamps that stand, one for the sun.
import * as THREE from "three";
import { unit } from "./measure.js";

export const FACES = 6;
const FORWARD = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]];

const VERTEX = `
in vec3 position; out vec3 place; uniform mat4 projectionMatrix; uniform mat4 viewMatrix;
void main() { place = position; gl_Position = projectionMatrix * viewMatrix * vec4(position, 1.0); }`;

const FRAGMENT = `
precision highp float; in vec3 place; out vec4 result; uniform vec3 lamp; uniform vec3 sun; uniform bool far; uniform float radius;
HOLES
void main() {
  if (pierced()) discard;
  result = vec4(far ? dot(place, sun) + radius : distance(place, lamp), 0.0, 0.0, 1.0);
}`;

/** The axes of a picture that looks forward: right and up, with the rule that the surface shader uses too. */
export function across(forward) {
  const up = Math.abs(forward[1]) > 0.9 ? [0, 0, 1] : [0, 1, 0];
  const right = unit(cross(forward, up));
  return [right, cross(right, forward)];
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

export class Shadows {
  constructor(renderer, geometry, radius, pierced, size) {
    Object.assign(this, { renderer, radius, size });
    this.material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: pierced.vertex(VERTEX),
      fragmentShader: FRAGMENT.replace("HOLES", pierced.fragment),
      side: THREE.DoubleSide,
      uniforms: {
        ...pierced.uniforms,
        lamp: { value: new THREE.Vector3() },
        sun: { value: new THREE.Vector3() },
        far: { value: false },
        radius: { value: radius },
      },
    });
    this.scene = new THREE.Scene();
    const mesh = new THREE.Mesh(geometry, this.material);
    mesh.frustumCulled = false;
    this.scene.add(mesh);
    this.target = null;
    this.drawn = [];
  }

  /** Room for so many lamps. */
  #reserve(lamps) {
    if (this.target && this.target.depth >= lamps * FACES) return;
    this.target?.dispose();
    this.target = new THREE.WebGLArrayRenderTarget(this.size, this.size, lamps * FACES, {
      format: THREE.RedFormat,
      type: THREE.FloatType,
      minFilter: THREE.NearestFilter,
      magFilter: THREE.NearestFilter,
      depthBuffer: true,
    });
    this.drawn = [];
  }

  /** Draws the maps of the lamps that have moved; `lamps` are placed records. */
  update(lamps) {
    if (lamps.length === 0) return;
    this.#reserve(lamps.length);
    lamps.forEach((lamp, index) => {
      const key = JSON.stringify([lamp.type === "directional", lamp.type === "directional" ? lamp.direction : lamp.position]);
      if (this.drawn[index] === key) return;
      this.drawn[index] = key;
      if (lamp.type === "directional") this.#face(index * FACES, this.#sun(lamp.direction), lamp);
      else FORWARD.forEach((forward, face) => this.#face(index * FACES + face, this.#cube(lamp.position, forward), lamp));
    });
    this.renderer.setRenderTarget(null);
  }

  #cube(position, forward) {
    const camera = new THREE.PerspectiveCamera(90, 1, this.radius * 1e-3, this.radius * 1e3);
    return aimed(camera, position, forward);
  }

  #sun(direction) {
    const r = this.radius;
    return aimed(new THREE.OrthographicCamera(-r, r, r, -r, -r * 1.01, r * 1.01), [0, 0, 0], direction);
  }

  #face(layer, camera, lamp) {
    const { uniforms } = this.material;
    uniforms.far.value = lamp.type === "directional";
    uniforms.lamp.value.fromArray(lamp.position ?? [0, 0, 0]);
    uniforms.sun.value.fromArray(lamp.direction ?? [0, 0, 0]);
    this.renderer.setRenderTarget(this.target, layer);
    this.renderer.setClearColor(0xffffff, 1);
    this.#clear();
    this.renderer.render(this.scene, camera);
  }

  #clear() {
    const gl = this.renderer.getContext();
    this.renderer.state.buffers.depth.setMask(true);
    this.renderer.state.buffers.depth.setClear(1);
    gl.clearBufferfv(gl.COLOR, 0, [3e38, 0, 0, 0]); // nothing there: as far as floats go
    this.renderer.clearDepth();
  }
}

function aimed(camera, position, forward) {
  const [right, up] = across(forward);
  const axes = new THREE.Matrix4().makeBasis(
    new THREE.Vector3(...right),
    new THREE.Vector3(...up),
    new THREE.Vector3(...forward).negate(),
  );
  camera.matrixAutoUpdate = false;
  camera.matrix.copy(axes).setPosition(...position);
  camera.matrixWorld.copy(camera.matrix);
  camera.matrixWorldInverse.copy(camera.matrixWorld).invert();
  camera.matrixWorldAutoUpdate = false;
  camera.updateProjectionMatrix();
  return camera;
}
