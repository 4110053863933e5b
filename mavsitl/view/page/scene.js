// The vehicles in 3D over a grid of metres: trail, reference, true place where it differs, wind.

import * as three from "./vendor/three.min.js";
import { length, toScene, toSceneQuaternion } from "./frames.js";
import { colour, ownColourName } from "./theme.js";

const TRAIL_POINTS = 1200;
const TRAIL_STEP_M = 0.02;
const TRAIL_S = 60;
const ARM_M = 0.22;
const ROTOR_M = 0.13;
// The true place is drawn where it is so far from what the vehicle believes.
const TRUTH_APART_M = 0.25;
const WIND_M_PER_M_S = 0.22;
const SMOOTHING_S = 0.05;

/** Places of rotors 1 rear, 2 right, 3 front, 4 left, in the model's axes: x right, z back. */
const ROTORS = [[0, 1], [1, 0], [0, -1], [-1, 0]];

export class Scene {
  /** `onSelect(number)`: a vehicle is clicked. */
  constructor(place, labels, store, onSelect) {
    this.store = store;
    this.labels = labels;
    this.onSelect = onSelect;
    this.crafts = new Map();
    this.view = "follow";
    this.framed = false;
    this.last = 0;
    this.scene = new three.Scene();
    this.camera = new three.PerspectiveCamera(45, 1, 0.05, 2000);
    this.camera.position.set(1.4, 1.9, 2.6);
    try {
      this.renderer = new three.WebGLRenderer({ antialias: true, alpha: true });
    } catch {
      place.textContent = "No 3D here: this browser has no WebGL.";
      return;
    }
    const canvas = this.renderer.domElement;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "The vehicles in 3D. Drag to turn, scroll to come nearer, arrow keys to move.");
    place.append(canvas);
    this.orbit = new three.OrbitControls(this.camera, canvas);
    this.orbit.target.set(0, 0.9, 0);
    this.orbit.maxPolarAngle = 0.495 * Math.PI;
    this.orbit.minDistance = 0.6;
    this.orbit.maxDistance = 400;
    this.orbit.listenToKeyEvents(canvas);
    this.addPicking(canvas);
    this.scene.add(new three.HemisphereLight(0xffffff, 0x667788, 2.2));
    const sun = new three.DirectionalLight(0xffffff, 1.6);
    sun.position.set(3, 8, 2);
    this.scene.add(sun);
    this.wind = new Wind();
    this.scene.add(this.wind.group);
    this.ground = new three.Group();
    this.scene.add(this.ground);
    this.repaint();
    new ResizeObserver(() => this.resize(place)).observe(place);
    this.resize(place);
  }

  resize(place) {
    const { clientWidth: width, clientHeight: height } = place;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    [this.width, this.height] = [width, height];
  }

  /** Colours of now. */
  repaint() {
    if (!this.renderer) return;
    this.ground.clear();
    this.ground.add(grid(), north());
    this.wind.repaint();
    for (const craft of this.crafts.values()) craft.repaint();
  }

  setView(view) {
    this.view = view;
    this.framed = false;
  }

  /** Once a picture; `now` in ms. */
  draw(now) {
    if (!this.renderer) return;
    const seconds = Math.min((now - this.last) / 1000, 0.2);
    this.last = now;
    for (const [number, craft] of this.crafts) {
      if (!this.store.vehicles.has(number)) {
        craft.remove(this.scene);
        this.crafts.delete(number);
        this.framed = false;
      }
    }
    const near = this.camera.position.distanceTo(this.orbit.target);
    for (const values of this.store.vehicles.values()) {
      let craft = this.crafts.get(values.number);
      if (!craft) {
        craft = new Craft(values.number, this.scene, this.labels);
        this.crafts.set(values.number, craft);
        if (this.view === "all") this.framed = false;
      }
      const begins = craft.begin(values);
      if (begins && this.store.rowsOf === values.number) craft.trail.fill(this.store.rows);
      craft.show(values, this.origin(values), seconds, near, values.number === this.store.selected);
    }
    this.moveCamera(seconds);
    const selected = this.crafts.get(this.store.selected);
    this.wind.show(selected, this.store.vehicle?.wind ?? null, near);
    this.orbit.update();
    this.renderer.render(this.scene, this.camera);
    this.placeLabels();
  }

  /** Where a vehicle's own origin is seen from the first one's, NED: vehicles of PX4 have one each. */
  origin(values) {
    const first = this.store.sorted[0]?.origin;
    const own = values.origin;
    if (!first || !own || first === own) return [0, 0, 0];
    const metres = 6371000 * (Math.PI / 180) * 1e-7;
    const east = metres * Math.cos((first[0] * 1e-7 * Math.PI) / 180);
    return [(own[0] - first[0]) * metres, (own[1] - first[1]) * east, (first[2] - own[2]) * 1e-3];
  }

  moveCamera(seconds) {
    const placed = [...this.crafts.values()].filter((craft) => craft.placed);
    if (!placed.length) return;
    const selected = this.crafts.get(this.store.selected);
    if (this.view === "follow" && selected?.placed) {
      const share = this.framed ? 1 - Math.exp(-seconds / 0.25) : 1;
      const move = selected.body.position.clone().sub(this.orbit.target).multiplyScalar(share);
      this.orbit.target.add(move);
      this.camera.position.add(move);
      this.framed = true;
    } else if (this.view !== "free" && !this.framed) {
      this.frame(placed);
      this.framed = true;
    }
  }

  /** All vehicles in the picture, from the side or from above. */
  frame(placed) {
    const low = new three.Vector3(Infinity, Infinity, Infinity);
    const high = low.clone().negate();
    for (const craft of placed) {
      low.min(craft.body.position);
      high.max(craft.body.position);
    }
    const middle = low.clone().add(high).multiplyScalar(0.5);
    const size = Math.max(high.distanceTo(low), 2);
    const away = this.view === "top" ? new three.Vector3(0, 1, 0.001) : new three.Vector3(0.45, 0.5, 0.85).normalize();
    const distance = (0.62 * size) / Math.tan((this.camera.fov * Math.PI) / 360) / Math.min(1, this.camera.aspect) + 1.5;
    this.orbit.target.copy(middle);
    this.camera.position.copy(middle).addScaledVector(away, distance);
  }

  placeLabels() {
    const many = this.crafts.size > 1;
    for (const craft of this.crafts.values()) {
      const at = craft.body.position.clone();
      at.y += 0.24 * craft.scale;
      at.project(this.camera);
      const seen = many && craft.placed && at.z < 1;
      craft.label.hidden = !seen;
      craft.screen = seen || craft.placed ? [((at.x + 1) / 2) * this.width, ((1 - at.y) / 2) * this.height] : null;
      if (seen) craft.label.style.transform = `translate(${craft.screen[0]}px, ${craft.screen[1]}px) translate(-50%, -100%)`;
    }
  }

  /** A click near a vehicle selects it; the end of a drag does not. */
  addPicking(canvas) {
    let down = [0, 0];
    canvas.addEventListener("pointerdown", (event) => (down = [event.clientX, event.clientY]));
    canvas.addEventListener("click", (event) => {
      if (Math.hypot(event.clientX - down[0], event.clientY - down[1]) > 5) return;
      const nearest = [...this.crafts.values()]
        .filter((craft) => craft.screen)
        .map((craft) => [Math.hypot(craft.screen[0] - event.offsetX, craft.screen[1] - event.offsetY), craft.number])
        .sort((one, other) => one[0] - other[0])[0];
      if (nearest && nearest[0] < 45) this.onSelect(nearest[1]);
    });
  }
}

/** The ground: lines each metre, stronger ones each five, drawn by the pixel, so that they stay fine and fade far away. */
function grid() {
  const material = new three.ShaderMaterial({
    transparent: true,
    depthWrite: false,
    uniforms: {
      fine: { value: new three.Color(colour("--grid")) },
      strong: { value: new three.Color(colour("--grid-strong")) },
    },
    vertexShader: `
      varying vec2 place;
      varying float away;
      void main() {
        place = position.xz;
        vec4 seen = modelViewMatrix * vec4(position, 1.0);
        away = length(seen.xyz);
        gl_Position = projectionMatrix * seen;
      }`,
    fragmentShader: `
      uniform vec3 fine, strong;
      varying vec2 place;
      varying float away;
      float lines(float spacing, float pixels) {
        vec2 at = place / spacing;
        vec2 near = abs(fract(at - 0.5) - 0.5) / fwidth(at);
        return 1.0 - smoothstep(pixels - 0.5, pixels + 0.5, min(near.x, near.y));
      }
      void main() {
        float five = lines(5.0, 1.0) * exp(-away / 60.0);
        float one = lines(1.0, 0.7) * exp(-away / 14.0);
        gl_FragColor = vec4(mix(fine, strong, five), max(0.9 * one, five));
        #include <colorspace_fragment>
      }`,
  });
  const plane = new three.Mesh(new three.PlaneGeometry(600, 600, 60, 60).rotateX(-Math.PI / 2), material);
  plane.renderOrder = -1;
  return plane;
}

/** An arrow on the ground that points north. */
function north() {
  const points = [[0, 0, -1], [0, 0, -2], [-0.12, 0, -1.8], [0, 0, -2], [0.12, 0, -1.8], [0, 0, -2]];
  const letter = [[-0.1, 0, -2.2], [-0.1, 0, -2.5], [0.1, 0, -2.2], [0.1, 0, -2.5]];
  const group = new three.Group();
  const material = new three.LineBasicMaterial({ color: colour("--soft") });
  for (const line of [points, letter]) {
    const geometry = new three.BufferGeometry().setFromPoints(line.map((point) => new three.Vector3(...point)));
    group.add(new three.Line(geometry, material));
  }
  return group;
}

/** One vehicle: its model, trail, reference, shadow and true place. */
class Craft {
  constructor(number, scene, labels) {
    this.number = number;
    this.placed = false;
    this.scale = 1;
    this.chapter = null;
    this.materials = {
      body: new three.MeshStandardMaterial({ roughness: 0.6 }),
      dark: new three.MeshStandardMaterial({ roughness: 0.8 }),
      nose: new three.MeshStandardMaterial({ roughness: 0.6 }),
      rotor: new three.MeshBasicMaterial({ transparent: true, opacity: 0.32, side: three.DoubleSide, depthWrite: false }),
      blade: new three.MeshBasicMaterial({}),
      broken: new three.MeshBasicMaterial({}),
      reference: new three.MeshBasicMaterial({ transparent: true, opacity: 0.95 }),
      shadow: new three.MeshBasicMaterial({ color: 0x000000, transparent: true, opacity: 0.22, depthWrite: false }),
      ghost: new three.MeshBasicMaterial({ wireframe: true, transparent: true, opacity: 0.6 }),
      drop: new three.LineBasicMaterial({ transparent: true, opacity: 0.5 }),
      lead: new three.LineBasicMaterial({ transparent: true, opacity: 0.8 }),
    };
    this.body = this.makeBody();
    this.reference = this.makeReference();
    this.shadow = new three.Mesh(new three.CircleGeometry(0.2, 32).rotateX(-Math.PI / 2), this.materials.shadow);
    this.ghost = new three.Mesh(new three.BoxGeometry(2 * ARM_M, 0.1, 2 * ARM_M), this.materials.ghost);
    this.drop = segment(this.materials.drop);
    this.lead = segment(this.materials.lead);
    this.trail = new Trail();
    this.all = [this.body, this.reference, this.shadow, this.ghost, this.drop, this.lead, this.trail.line];
    for (const each of this.all) each.visible = false;
    scene.add(...this.all);
    this.label = document.createElement("span");
    this.label.textContent = String(number);
    labels.append(this.label);
    this.repaint();
  }

  makeBody() {
    const { body, dark, nose, rotor, blade, broken } = this.materials;
    const group = new three.Group();
    group.add(new three.Mesh(new three.CylinderGeometry(0.07, 0.08, 0.06, 24), body));
    const front = new three.Mesh(new three.ConeGeometry(0.028, 0.09, 16).rotateX(-Math.PI / 2), nose);
    front.position.set(0, 0.035, -0.1);
    group.add(front);
    this.rotors = ROTORS.map(([x, z]) => {
      const arm = new three.Mesh(new three.BoxGeometry(x ? ARM_M : 0.028, 0.022, z ? ARM_M : 0.028), z < 0 ? nose : dark);
      arm.position.set((x * ARM_M) / 2, 0, (z * ARM_M) / 2);
      const hub = new three.Group();
      hub.position.set(x * ARM_M, 0.035, z * ARM_M);
      const disc = new three.Mesh(new three.CircleGeometry(ROTOR_M, 32).rotateX(-Math.PI / 2), rotor);
      const blades = new three.Mesh(new three.BoxGeometry(2 * ROTOR_M, 0.006, 0.018), blade);
      const cross = new three.Group();
      for (const angle of [0.25, 0.75]) {
        const bar = new three.Mesh(new three.BoxGeometry(2 * ROTOR_M, 0.015, 0.03).rotateY(angle * Math.PI), broken);
        bar.position.y = 0.012;
        cross.add(bar);
      }
      hub.add(disc, blades, cross);
      group.add(arm, hub);
      return { disc, blades, cross };
    });
    return group;
  }

  makeReference() {
    const group = new three.Group();
    const { reference } = this.materials;
    group.add(new three.Mesh(new three.TorusGeometry(0.14, 0.007, 8, 40).rotateX(Math.PI / 2), reference));
    group.add(new three.Mesh(new three.SphereGeometry(0.022, 16, 12), reference));
    return group;
  }

  repaint() {
    const own = colour(ownColourName(this.number));
    const { body, dark, nose, rotor, blade, broken, reference, ghost, drop, lead } = this.materials;
    body.color.set(own);
    rotor.color.set(own);
    dark.color.set(colour("--ink"));
    nose.color.set(colour("--orange"));
    blade.color.set(colour("--ink"));
    broken.color.set(colour("--bad"));
    reference.color.set(colour("--amber"));
    lead.color.set(colour("--amber"));
    drop.color.set(own);
    ghost.color.set(colour("--text"));
    this.trail.repaint(own, colour("--sky"));
    this.label.style.border = `1.5px solid ${own}`;
  }

  remove(scene) {
    scene.remove(...this.all);
    this.label.remove();
    for (const each of this.all) each.traverse((part) => part.geometry?.dispose());
    for (const material of Object.values(this.materials)) material.dispose();
    this.trail.dispose();
  }

  /** Whether the vehicle's rows have begun anew: it restarted, or a replay was moved. */
  begin({ chapter }) {
    if (chapter === this.chapter) return false;
    this.chapter = chapter;
    this.trail.clear();
    this.placed = false;
    return true;
  }

  show(values, origin, seconds, near, selected) {
    if (!values.position || !values.attitude) return;
    const place = (ned) => new three.Vector3(...toScene(ned.map((each, k) => each + origin[k])));
    const position = place(values.position);
    const attitude = new three.Quaternion(...toSceneQuaternion(values.attitude));
    const share = this.placed && this.body.position.distanceTo(position) < 1.5 ? 1 - Math.exp(-seconds / SMOOTHING_S) : 1;
    this.body.position.lerp(position, share);
    this.body.quaternion.slerp(attitude, share);
    this.placed = true;
    // Far away a vehicle stays as large as a thumbnail.
    this.scale = Math.max(1, near / 7) * (selected ? 1.08 : 1);
    this.body.scale.setScalar(this.scale);
    this.body.visible = true;
    const height = Math.max(position.y, 0);
    this.shadow.visible = true;
    this.shadow.position.set(this.body.position.x, 0.003, this.body.position.z);
    this.shadow.scale.setScalar(this.scale * (1 + 0.08 * height));
    this.setSegment(this.drop, this.body.position, this.shadow.position, height > 0.15);
    const reference = values.reference && place(values.reference);
    this.reference.visible = Boolean(reference);
    if (reference) {
      this.reference.position.lerp(reference, this.reference.position.distanceTo(reference) < 1.5 ? share : 1);
      this.reference.scale.setScalar(this.scale);
    }
    this.setSegment(this.lead, this.body.position, this.reference.position, Boolean(reference));
    this.trail.add(position, values.time_s ?? 0);
    this.turnRotors(values, seconds);
    const truth = values.truth && values.truth.position && place(values.truth.position);
    this.ghost.visible = Boolean(truth) && truth.distanceTo(position) > TRUTH_APART_M;
    if (this.ghost.visible) {
      this.ghost.position.copy(truth);
      this.ghost.quaternion.set(...toSceneQuaternion(values.truth.attitude));
      this.ghost.scale.setScalar(this.scale);
    }
    this.label.style.opacity = values.online ? 1 : 0.5;
    this.label.style.fontWeight = selected ? 800 : 500;
  }

  setSegment(line, from, to, visible) {
    line.visible = visible;
    if (!visible) return;
    const points = line.geometry.attributes.position;
    points.setXYZ(0, from.x, from.y, from.z);
    points.setXYZ(1, to.x, to.y, to.z);
    points.needsUpdate = true;
  }

  turnRotors(values, seconds) {
    const turning = values.armed && values.online;
    this.rotors.forEach(({ disc, blades, cross }, index) => {
      const broken = Boolean(values.parameters?.[`SIM_FAIL_MOT${index + 1}`]);
      cross.visible = broken;
      disc.visible = turning && !broken;
      if (turning && !broken) blades.rotation.y += (index % 2 ? 1 : -1) * 38 * seconds;
    });
  }
}

function segment(material) {
  const geometry = new three.BufferGeometry();
  geometry.setAttribute("position", new three.BufferAttribute(new Float32Array(6), 3));
  const line = new three.Line(geometry, material);
  line.frustumCulled = false;
  return line;
}

/** The way of the last minute, fading: a line in memory of a fixed size. */
class Trail {
  constructor() {
    this.points = [];
    const geometry = new three.BufferGeometry();
    for (const name of ["position", "color"]) {
      const attribute = new three.BufferAttribute(new Float32Array(3 * TRAIL_POINTS), 3);
      attribute.setUsage(three.DynamicDrawUsage);
      geometry.setAttribute(name, attribute);
    }
    // Lines are a pixel wide everywhere: dots on them make the way seen from the back row.
    this.line = new three.Line(geometry, new three.LineBasicMaterial({ vertexColors: true }));
    this.dots = new three.Points(geometry, new three.PointsMaterial({ vertexColors: true, size: 2.6, sizeAttenuation: false }));
    this.line.add(this.dots);
    this.line.frustumCulled = this.dots.frustumCulled = false;
    this.own = new three.Color();
    this.back = new three.Color();
  }

  dispose() {
    this.line.material.dispose();
    this.dots.material.dispose();
  }

  repaint(own, back) {
    this.own.set(own);
    this.back.set(back);
  }

  clear() {
    this.points = [];
    this.line.visible = false;
  }

  /** The way that rows tell. */
  fill({ time, north, east, down }) {
    time.forEach((each, k) => {
      if (north[k] !== null) this.add(new three.Vector3(...toScene([north[k], east[k], down[k]])), each, false);
    });
    this.paint();
  }

  add(position, time, visible = true) {
    const last = this.points.at(-1);
    if (last && last.position.distanceTo(position) < TRAIL_STEP_M) return;
    if (last && (position.distanceTo(last.position) > 5 || time < last.time)) this.points = [];
    this.points.push({ position, time });
    while (this.points.length > TRAIL_POINTS || this.points[0].time < time - TRAIL_S) this.points.shift();
    if (visible) this.paint();
  }

  paint() {
    const { position: places, color: colours } = this.line.geometry.attributes;
    const shade = new three.Color();
    this.points.forEach((point, k) => {
      places.setXYZ(k, point.position.x, point.position.y, point.position.z);
      shade.lerpColors(this.back, this.own, (k + 1) / this.points.length);
      colours.setXYZ(k, shade.r, shade.g, shade.b);
    });
    places.needsUpdate = true;
    colours.needsUpdate = true;
    this.line.geometry.setDrawRange(0, this.points.length);
    this.line.visible = this.points.length > 1;
  }
}

/** The wind at the selected vehicle: an arrow the way it blows, a quarter of a metre for each metre a second. */
class Wind {
  constructor() {
    this.material = new three.MeshBasicMaterial({});
    this.shaft = new three.Mesh(new three.CylinderGeometry(0.014, 0.014, 1, 12).translate(0, 0.5, 0), this.material);
    this.head = new three.Mesh(new three.ConeGeometry(0.045, 0.12, 16).translate(0, 0.06, 0), this.material);
    this.group = new three.Group();
    this.group.add(this.shaft, this.head);
    this.group.visible = false;
  }

  repaint() {
    this.material.color.set(colour("--purple"));
  }

  show(craft, wind, near) {
    const speed = wind ? length(wind.velocity) : 0;
    this.group.visible = Boolean(craft?.placed) && speed > 0.05;
    if (!this.group.visible) return;
    const scale = Math.max(1, near / 7);
    const way = new three.Vector3(...toScene(wind.velocity)).normalize();
    const size = WIND_M_PER_M_S * speed * scale;
    this.group.quaternion.setFromUnitVectors(new three.Vector3(0, 1, 0), way);
    // It ends above the vehicle.
    this.group.position.copy(craft.body.position).addScaledVector(way, -size - 0.12 * scale);
    this.group.position.y += 0.32 * scale;
    this.shaft.scale.set(scale, Math.max(size, 0.01), scale);
    this.head.scale.setScalar(scale);
    this.head.position.y = size;
  }
}
