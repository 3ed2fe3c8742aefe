// Lamps in the picture: marks that can be picked, and a gizmo that moves or turns the chosen one.
import * as THREE from "three";
import { TransformControls } from "three/examples/jsm/controls/TransformControls.js";
import { colour, unit } from "./measure.js";

const DOWN = new THREE.Vector3(0, -1, 0);

/** The display colour of linear light: its hue at full strength. */
export function hue(rgb) {
  const peak = Math.max(...rgb, 1e-30);
  return new THREE.Color().setRGB(...rgb.map((x) => x / peak), THREE.LinearSRGBColorSpace);
}

export class Lamps {
  /** changed(index, record) is called while a lamp is dragged. */
  constructor(view, centre, radius, changed) {
    Object.assign(this, { view, centre, radius, changed });
    this.group = new THREE.Group();
    view.scene.add(this.group);
    this.records = [];
    this.chosen = -1;
    this.gizmo = new TransformControls(view.camera, view.canvas);
    this.gizmo.setSize(0.7);
    this.gizmo.addEventListener("dragging-changed", (event) => view.dragging(event.value));
    this.gizmo.addEventListener("change", () => view.redraw());
    this.gizmo.addEventListener("objectChange", () => this.#moved());
    view.scene.add(this.gizmo.getHelper());
  }

  /** Shows these light records; -1 chooses none. */
  set(records, chosen) {
    this.records = records;
    while (this.group.children.length > records.length) dispose(this.group, this.group.children[records.length]);
    records.forEach((record, index) => this.#mark(record, index));
    this.choose(chosen);
  }

  choose(index) {
    this.chosen = index < this.records.length ? index : -1;
    const mark = this.group.children[this.chosen];
    if (!mark) this.gizmo.detach();
    else if (this.gizmo.object !== mark) this.gizmo.attach(mark);
    this.#mode();
  }

  /** "translate" or "rotate", as far as the chosen lamp has it. */
  mode(name) {
    this.wanted = name;
    this.#mode();
  }

  #mode() {
    const kind = this.records[this.chosen]?.type;
    const only = { point: "translate", directional: "rotate" }[kind];
    this.gizmo.setMode(only ?? this.wanted ?? "translate");
  }

  visible(on) {
    this.group.visible = on;
    this.gizmo.getHelper().visible = on && this.chosen >= 0;
  }

  /** The lamp under a place of the picture, -1 for none. */
  at(raycaster) {
    const hits = raycaster.intersectObjects(this.group.children, true);
    return hits.length === 0 ? -1 : this.group.children.findIndex((mark) => mark === hits[0].object || mark === hits[0].object.parent);
  }

  #mark(record, index) {
    const old = this.group.children[index];
    const kept = old && old.userData.type === record.type;
    const mark = kept ? old : made(record.type, this.radius);
    if (!kept) {
      if (old) {
        if (this.gizmo.object === old) this.gizmo.detach();
        this.group.children[index] = mark;
        mark.parent = this.group;
      } else this.group.add(mark);
    }
    if (this.gizmo.dragging && this.gizmo.object === mark) return paint(mark, record);
    if (record.type === "directional") mark.position.fromArray(unit(record.direction).map((x) => -1.15 * this.radius * x));
    else mark.position.fromArray(record.position.map((x, axis) => x - this.centre[axis]));
    if (record.direction) mark.quaternion.setFromUnitVectors(DOWN, new THREE.Vector3(...unit(record.direction)));
    paint(mark, record);
  }

  #moved() {
    const record = this.records[this.chosen];
    const mark = this.group.children[this.chosen];
    if (!record || !mark) return;
    const next = { ...record };
    if (record.type !== "directional") next.position = mark.position.toArray().map((x, axis) => x + this.centre[axis]);
    if (record.type !== "point") next.direction = DOWN.clone().applyQuaternion(mark.quaternion).toArray();
    this.records[this.chosen] = next;
    this.changed(this.chosen, next);
  }
}

function made(type, radius) {
  const mark = new THREE.Group();
  mark.userData.type = type;
  const material = new THREE.MeshBasicMaterial({ toneMapped: false });
  mark.add(new THREE.Mesh(new THREE.SphereGeometry(0.025 * radius, 20, 12), material));
  if (type !== "point") {
    const length = (type === "spot" ? 0.12 : 0.3) * radius;
    const cone = new THREE.Mesh(new THREE.ConeGeometry(0.04 * radius, length, 20, 1, true), material);
    cone.position.y = -length / 2;
    if (type === "directional") cone.rotation.x = Math.PI;
    cone.material.side = THREE.DoubleSide;
    mark.add(cone);
  }
  return mark;
}

function paint(mark, record) {
  mark.children.forEach((part) => part.material.color.copy(hue(colour(record))));
}

function dispose(group, mark) {
  group.remove(mark);
  mark.traverse((part) => {
    part.geometry?.dispose();
    part.material?.dispose();
  });
}
