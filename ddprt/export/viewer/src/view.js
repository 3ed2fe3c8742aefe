// The picture: camera, controls, and drawing when something has changed.
import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { Lamps } from "./lamps.js";
import { colour } from "./measure.js";

export class View {
  /** told: changed(index, lamp) and picked(index) of lamps, moved() of the camera. */
  constructor(model, canvas, told) {
    Object.assign(this, { model, canvas, told });
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.autoClear = false;
    this.scene = new THREE.Scene();
    const radius = model.radius;
    this.camera = new THREE.PerspectiveCamera(model.camera.fov, 1, 0.01 * radius, 100 * radius);
    this.camera.up.fromArray(model.camera.up);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.redraw());
    this.controls.addEventListener("end", () => told.moved());
    this.controls.listenToKeyEvents(canvas);
    this.lamps = new Lamps(this, model.centre, radius, told.changed);
    this.look(model.camera.eye, model.camera.target);
    this.#picking();
    new ResizeObserver(() => this.#resize()).observe(canvas.parentElement);
    this.#resize();
    this.times = [];
  }

  show(frame) {
    this.frame = frame;
    this.scene.add(frame.surface.mesh);
  }

  update(state) {
    this.lamps.set(state.lamps, state.chosen);
    this.redraw();
  }

  /** World space, metres. */
  look(eye, target) {
    const { centre } = this.model;
    this.camera.position.fromArray(eye.map((x, axis) => x - centre[axis]));
    this.controls.target.fromArray(target.map((x, axis) => x - centre[axis]));
    this.controls.update();
    this.redraw();
  }

  looking() {
    const world = (place) => place.toArray().map((x, axis) => x + this.model.centre[axis]);
    return { eye: world(this.camera.position), target: world(this.controls.target) };
  }

  dragging(on) {
    this.controls.enabled = !on;
    this.held = on;
  }

  /** Draws with the next frame of the browser, however often it is asked for. */
  redraw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame((now) => {
      this.asked = false;
      this.draw();
      if (this.last && now - this.last < 250) this.times = [...this.times.slice(-29), now - this.last];
      this.last = now;
    });
  }

  draw(lamps = true) {
    if (!this.frame) return;
    this.lamps.visible(lamps);
    this.renderer.setClearColor(0x16181c, 1);
    this.renderer.clear();
    this.renderer.render(this.scene, this.camera);
    this.lamps.visible(true);
  }

  /** Milliseconds between the last frames that followed each other; null before there were any. */
  frameTime() {
    return this.times.length < 3 ? null : this.times.reduce((sum, x) => sum + x, 0) / this.times.length;
  }

  /** A PNG without the lamps' marks, as a data URL. */
  screenshot() {
    this.draw(false);
    const url = this.canvas.toDataURL("image/png");
    this.draw();
    return url;
  }

  /** A lamp in front of what is looked at, as bright as the first one of the page. */
  newLamp(type, model) {
    const { eye, target } = this.looking();
    const position = target.map((x, axis) => x + 0.1 * (eye[axis] - x) + 0.2 * model.radius * model.camera.up[axis]);
    const first = model.lights[0];
    const power = first ? Math.max(...colour(first)) : model.radius ** 2;
    const near = first?.type === "directional" ? power * model.radius ** 2 : power;
    const direction = [-0.3, -1, -0.4];
    if (type === "directional") return { type, direction, irradiance: Array(3).fill(near / model.radius ** 2) };
    const lamp = { type, position, intensity: Array(3).fill(near) };
    return type === "point" ? lamp : { ...lamp, direction: [0, -1, 0], inner_deg: 20, outer_deg: 35 };
  }

  #resize() {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    const width = Math.max(clientWidth, 1);
    const height = Math.max(clientHeight, 1);
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    // Upright pictures keep the width that the camera was made for.
    const wide = this.camera.aspect / 1.2;
    this.camera.fov = (2 * Math.atan(Math.tan((this.model.camera.fov * Math.PI) / 360) / Math.min(1, wide)) * 180) / Math.PI;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  #picking() {
    let down = null;
    const ray = new THREE.Raycaster();
    this.canvas.addEventListener("pointerdown", (event) => (down = event.isPrimary ? [event.clientX, event.clientY] : null));
    this.canvas.addEventListener("pointerup", (event) => {
      if (!down || this.held || Math.hypot(event.clientX - down[0], event.clientY - down[1]) > 5) return;
      const box = this.canvas.getBoundingClientRect();
      const x = (2 * (event.clientX - box.left)) / box.width - 1;
      const y = 1 - (2 * (event.clientY - box.top)) / box.height;
      ray.setFromCamera(new THREE.Vector2(x, y), this.camera);
      const index = this.lamps.at(ray);
      if (index >= 0) this.told.picked(index);
    });
  }
}
