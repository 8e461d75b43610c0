// The table in 3-D: furniture, arm, what is simulated, and marks of what is about to be done.
import {FlatShadows} from "./shadows.js";
import * as T from "./three.js";

const EYE = [1.5, -0.8, 1.0], LOOK_AT = [0.42, -0.03, 0.14];
const FIELD = 0.73, WIDE = 1.25; // rad from top to bottom, where a view is so much wider than high
const LAMP = [0.9, -1.0, 2.4], LIT = [0.4, 0, 0], BRIGHT = 2.0, SKY = 1.5;
const LATE = 1 / 15, LEAST = 0.4, LESS = 0.75; // s a frame that is too long, share of the pixels' edge, its steps
const FINGER = 0.015; // m: a particle so near to the ray is what the person means

const tint = rgb => new T.Color().setRGB(rgb[0] / 255, rgb[1] / 255, rgb[2] / 255, T.SRGBColorSpace);
const matt = (rgb, more = {}) => new T.MeshLambertMaterial({color: tint(rgb), fog: false, ...more});
const glow = (color, more = {}) => new T.MeshBasicMaterial({color, transparent: true, opacity: 0.9, depthTest: false, ...more});

/** A 3-D view, or null where the browser has no WebGL. */
export function openScene(canvas) {
  try { return new Scene(canvas); } catch (error) {
    if (!/WebGL/.test(String(error))) throw error;
    return null;
  }
}

class Scene {
  constructor(canvas) {
    const probe = document.createElement("canvas").getContext("webgl2");
    if (!probe) throw new Error("no WebGL");
    const info = probe.getExtension("WEBGL_debug_renderer_info");
    const by = info ? probe.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
    // drawn by the processor: shadows and smooth edges would cost most of the frames
    this.slow = /swiftshader|llvmpipe|software/i.test(by) && !location.search.includes("fine");
    this.canvas = canvas;
    this.renderer = new T.WebGLRenderer({canvas, antialias: !this.slow});
    this.renderer.shadowMap.enabled = !this.slow;
    this.renderer.shadowMap.type = T.PCFShadowMap;
    this.scene = new T.Scene();
    this.camera = new T.PerspectiveCamera(50, 1, 0.05, 20);
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(...EYE);
    this.orbit = new T.OrbitControls(this.camera, canvas);
    this.orbit.target.set(...LOOK_AT);
    this.orbit.maxPolarAngle = 1.5;
    this.orbit.minDistance = 0.3; this.orbit.maxDistance = 4;
    this.orbit.update();
    this.orbit.addEventListener("change", () => { this.dirty = true; });
    this.drawn = this.late = 0;
    this.share = this.kept = 1;
    this.dirty = true;
    this.ray = new T.Raycaster();
    this.table = new T.Plane(new T.Vector3(0, 0, 1), 0);
    this.arm = []; this.things = new T.Group(); this.scene.add(this.things);
    this.light();
    this.marks();
  }

  light() {
    const lamp = new T.DirectionalLight(0xffffff, BRIGHT);
    lamp.position.set(...LAMP);
    lamp.target.position.set(...LIT);
    lamp.castShadow = true;
    lamp.shadow.mapSize.set(2048, 2048);
    Object.assign(lamp.shadow.camera, {left: -1, right: 1, top: 1, bottom: -1, near: 1, far: 5});
    lamp.shadow.bias = -0.0008;
    lamp.shadow.radius = 3;
    this.scene.add(lamp, lamp.target, new T.HemisphereLight(0xffffff, 0xb8b4ae, SKY));
    // the processor would spend a third of a frame on lighting a floor that is bright alike everywhere
    const Floor = this.slow ? T.MeshBasicMaterial : T.MeshLambertMaterial, light = new T.Vector3(...LAMP).sub(new T.Vector3(...LIT)).normalize();
    const lit = this.slow ? (BRIGHT * light.z + SKY) / Math.PI : 1;
    this.floor = new T.Mesh(new T.PlaneGeometry(30, 30), new Floor());
    this.floor.position.z = -0.031;
    this.floor.receiveShadow = true;
    this.scene.add(this.floor);
    this.scene.fog = new T.Fog(0xffffff, 3, 9);
    const recolor = () => {
      const style = getComputedStyle(document.documentElement);
      this.scene.background = new T.Color(style.getPropertyValue("--air").trim());
      this.scene.fog.color.copy(this.scene.background);
      this.floor.material.color.set(style.getPropertyValue("--floor").trim()).multiplyScalar(lit);
      this.dirty = true;
    };
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolor);
    recolor();
  }

  /** What lies over the table for the person alone: what is picked, where it goes, overlays. */
  marks() {
    const put = mesh => { mesh.visible = false; mesh.renderOrder = 2; this.scene.add(mesh); return mesh; };
    this.pickMark = put(new T.Mesh(new T.SphereGeometry(0.007, 20, 14), glow(0xffffff)));
    this.ring = put(new T.Group());
    this.ring.add(new T.Mesh(new T.TorusGeometry(0.05, 0.0016, 8, 48), glow(0xffffff)));
    this.knob = new T.Mesh(new T.SphereGeometry(0.009, 16, 12), glow(0xedc948));
    this.knob.position.x = 0.05;
    this.ring.add(this.knob);
    this.halo = put(new T.Mesh(new T.SphereGeometry(1, 20, 14), glow(0xedc948, {opacity: 0.75})));
    this.way = put(arrow(0xedc948));
    this.pull = put(arrow(0xff5759));
    this.fault = put(new T.Mesh(new T.SphereGeometry(0.022, 24, 16), glow(0xff2020, {opacity: 0.6})));
    this.sheets = {};
  }

  /** A translucent picture over the part of the table that `grid` covers; null takes it away. */
  overlay(name, picture, grid, height) {
    const old = this.sheets[name];
    if (old) { this.scene.remove(old); old.material.map.dispose(); old.material.dispose(); old.geometry.dispose(); delete this.sheets[name]; }
    this.dirty = true;
    if (!picture) return;
    const wide = grid.columns * grid.pixel, deep = grid.rows * grid.pixel;
    const map = new T.CanvasTexture(picture);
    map.colorSpace = T.SRGBColorSpace;
    map.magFilter = T.LinearFilter;
    // a picture's rows go along y and its first row is the top of a texture: turn it over
    map.flipY = false;
    const sheet = new T.Mesh(new T.PlaneGeometry(wide, deep), new T.MeshBasicMaterial({map, transparent: true, depthWrite: false, depthTest: name === "goal", side: T.DoubleSide}));
    sheet.position.set(grid.origin[0] + (wide - grid.pixel) / 2, grid.origin[1] + (deep - grid.pixel) / 2, height);
    sheet.renderOrder = 1;
    this.sheets[name] = sheet;
    this.scene.add(sheet);
  }

  /** The arm's meshes and the furniture, once. */
  furnish(hello) {
    if (this.slow && !this.flat) {
      this.renderer.localClippingEnabled = true;
      this.flat = new FlatShadows(this.scene, LIT.map((x, k) => x - LAMP[k]), hello.bounds);
    }
    for (const mesh of this.arm) { this.scene.remove(mesh); mesh.geometry.dispose(); mesh.userData.outline.dispose(); }
    if (!this.slab) {
      const add = (size, at, rgb) => {
        const mesh = new T.Mesh(new T.BoxGeometry(...size), matt(rgb));
        mesh.position.set(...at);
        mesh.castShadow = mesh.receiveShadow = true;
        this.scene.add(mesh);
        return mesh;
      };
      this.slab = add([0.5, 1, 0.03], [0.5, 0, -0.0155], hello.grid.table);
      add([0.24, 0.24, 0.03], [0, 0, -0.0155], [120, 122, 126]);
    }
    let v = 0, f = 0;
    this.arm = hello.parts.map(part => {
      const geometry = new T.BufferGeometry();
      geometry.setAttribute("position", new T.BufferAttribute(hello.arm_vertices.slice(3 * v, 3 * (v + part.vertices)), 3));
      geometry.setIndex(new T.BufferAttribute(hello.arm_faces.slice(3 * f, 3 * (f + part.faces)), 1));
      v += part.vertices; f += part.faces;
      const flat = geometry.toNonIndexed();
      flat.computeVertexNormals();
      const mesh = new T.Mesh(flat, matt(part.color));
      mesh.userData.outline = geometry;
      mesh.matrixAutoUpdate = false;
      mesh.castShadow = mesh.receiveShadow = true;
      this.scene.add(mesh);
      return mesh;
    });
    this.flat?.cast("arm", this.arm);
  }

  /** What is simulated, of one episode. */
  build(m) {
    this.things.traverse(each => { if (each.geometry) { each.geometry.dispose(); each.material.dispose(); } });
    this.things.clear();
    this.m = m;
    const color = segment => m.palette.subarray(3 * segment, 3 * segment + 3);
    for (let k = 0; k < m.quad_segment.length; k++) {
      const geometry = new T.BufferGeometry();
      geometry.setAttribute("position", new T.BufferAttribute(m.quad_corners.slice(12 * k, 12 * k + 12), 3));
      geometry.setIndex([0, 1, 2, 0, 2, 3]);
      geometry.computeVertexNormals();
      const mark = new T.Mesh(geometry, matt(color(m.quad_segment[k]), {side: T.DoubleSide}));
      mark.position.z = 0.0006;
      mark.receiveShadow = true;
      this.things.add(mark);
    }
    const many = (geometry, segments) => {
      const mesh = new T.InstancedMesh(geometry, new T.MeshLambertMaterial(), segments.length);
      segments.forEach((segment, k) => mesh.setColorAt(k, tint(color(segment))));
      mesh.castShadow = mesh.receiveShadow = true;
      mesh.frustumCulled = false;
      mesh.visible = segments.length > 0;
      this.things.add(mesh);
      return mesh;
    };
    this.balls = many(this.slow ? new T.SphereGeometry(1, 12, 8) : new T.SphereGeometry(1, 18, 12), m.sphere_segment);
    if (this.flat) this.balls.userData.outline = this.flat.disc;
    this.rods = many(new T.CylinderGeometry(1, 1, 1, 10, 1, true).rotateX(Math.PI / 2), m.link_segment);
    this.buildCloths(m, color);
    this.boxes = Array.from(m.box_segment, (segment, k) => {
      const box = new T.Mesh(new T.BoxGeometry(...m.box_half.slice(3 * k, 3 * k + 3).map(half => 2 * half)), matt(color(segment)));
      box.castShadow = box.receiveShadow = true;
      this.things.add(box);
      return box;
    });
    this.flat?.cast("things", [this.balls, this.rods, ...this.cloths, ...this.boxes]);
  }

  /** One mesh a colour of sheet; vertices are shared by particle. */
  buildCloths(m, color) {
    const of = new Map();
    m.triangle_segment.forEach((segment, k) => {
      if (!of.has(segment)) of.set(segment, []);
      of.get(segment).push(m.triangle_particle[3 * k], m.triangle_particle[3 * k + 1], m.triangle_particle[3 * k + 2]);
    });
    this.cloths = Array.from(of, ([segment, particles]) => {
      const used = [...new Set(particles)], place = new Map(used.map((p, k) => [p, k]));
      const geometry = new T.BufferGeometry();
      geometry.setAttribute("position", new T.BufferAttribute(new Float32Array(3 * used.length), 3));
      geometry.setIndex(particles.map(p => place.get(p)));
      const mesh = new T.Mesh(geometry, matt(color(segment), {side: T.DoubleSide}));
      mesh.castShadow = mesh.receiveShadow = true;
      mesh.frustumCulled = false;
      mesh.userData.particles = used;
      this.things.add(mesh);
      return mesh;
    });
  }

  /** Where everything is: positions of particles, poses of bodies, matrices of the arm's parts. */
  put({q, body, links}) {
    const m = this.m;
    this.q = q;
    this.arm.forEach((mesh, k) => { mesh.matrix.fromArray(links, 16 * k).transpose(); mesh.matrixWorldNeedsUpdate = true; });
    const at = new T.Vector3(), along = new T.Vector3(), turn = new T.Quaternion(), up = new T.Vector3(0, 0, 1);
    const matrix = new T.Matrix4(), size = new T.Vector3();
    m.sphere_particle.forEach((p, k) => {
      const r = m.sphere_radius[k];
      this.balls.setMatrixAt(k, matrix.makeScale(r, r, r).setPosition(q[3 * p], q[3 * p + 1], q[3 * p + 2]));
    });
    this.balls.instanceMatrix.needsUpdate = true;
    for (let k = 0; k < m.link_segment.length; k++) {
      at.fromArray(q, 3 * m.link_particle[2 * k]);
      along.fromArray(q, 3 * m.link_particle[2 * k + 1]).sub(at);
      const length = along.length() || 1e-9;
      at.addScaledVector(along, 0.5);
      turn.setFromUnitVectors(up, along.divideScalar(length));
      this.rods.setMatrixAt(k, matrix.compose(at, turn, size.set(m.link_radius[k], m.link_radius[k], length)));
    }
    this.rods.instanceMatrix.needsUpdate = true;
    for (const mesh of this.cloths) {
      const position = mesh.geometry.attributes.position;
      mesh.userData.particles.forEach((p, k) => position.array.set(q.subarray(3 * p, 3 * p + 3), 3 * k));
      position.needsUpdate = true;
      mesh.geometry.computeVertexNormals();
      mesh.geometry.boundingSphere = null;
    }
    this.boxes.forEach((box, k) => {
      const b = 7 * m.box_body[k], pose = m.box_pose.subarray(7 * k, 7 * k + 7);
      turn.fromArray(body, b + 3);
      box.position.fromArray(pose).applyQuaternion(turn).add(at.fromArray(body, b));
      box.quaternion.copy(turn).multiply(new T.Quaternion().fromArray(pose, 3));
    });
    this.flat?.follow();
    this.dirty = true;
  }

  aim(event) {
    const box = this.canvas.getBoundingClientRect();
    this.ray.setFromCamera(new T.Vector2((event.clientX - box.left) / box.width * 2 - 1, 1 - (event.clientY - box.top) / box.height * 2), this.camera);
    return this.ray.ray;
  }

  /** Where a pointer meets the table [x, y], or null. */
  onTable(event) {
    const hit = this.aim(event).intersectPlane(this.table, new T.Vector3());
    return hit && [hit.x, hit.y];
  }

  /** What a pointer means: {xy, thing}; beads near the ray first, then surfaces, then the table. */
  meant(event) {
    const ray = this.aim(event), at = new T.Vector3();
    let nearest = FINGER, xy = null;
    for (const p of this.m ? this.m.sphere_particle : []) {
      const away = ray.distanceToPoint(at.fromArray(this.q, 3 * p));
      if (away < nearest) { nearest = away; xy = [at.x, at.y]; }
    }
    if (xy) return {xy, thing: true};
    const [hit] = this.m ? this.ray.intersectObjects([...this.cloths, ...this.boxes], false) : [];
    if (hit) return {xy: [hit.point.x, hit.point.y], thing: true};
    return {xy: this.onTable(event), thing: false};
  }

  /** Which ways along the table go to the right and away, as the view stands: two of its four. */
  axes() {
    const away = this.orbit.target.clone().sub(this.camera.position), snap = (x, y) => Math.abs(x) > Math.abs(y) ? [Math.sign(x), 0] : [0, Math.sign(y)];
    const up = snap(away.x, away.y);
    return [[up[1], -up[0]], up];
  }

  onKnob(event) {
    this.aim(event);
    const at = this.knob.getWorldPosition(new T.Vector3());
    return this.ring.visible && this.ray.ray.distanceToPoint(at) < 0.016;
  }

  /** Light up what the tip would take: a particle, a body, or nothing. */
  highlight(grasp) {
    const particle = grasp && grasp.particle >= 0, body = grasp && grasp.body >= 0;
    this.halo.visible = Boolean(particle);
    if (particle) {
      const ball = this.m.sphere_particle.indexOf(grasp.particle);
      this.halo.scale.setScalar(ball >= 0 ? this.m.sphere_radius[ball] * 1.35 : 0.009);
      this.halo.position.fromArray(this.q, 3 * grasp.particle);
    }
    this.boxes?.forEach((box, k) => box.material.emissive.set(body && this.m.box_body[k] === grasp.body ? 0x665200 : 0));
    this.dirty = true;
  }

  /** Show what is about to be done: {pick, place, turn}; null hides it. */
  plan(plan) {
    this.pickMark.visible = this.ring.visible = Boolean(plan);
    this.way.visible = Boolean(plan && plan.place);
    if (plan) {
      this.pickMark.position.set(...plan.pick, 0.012);
      this.ring.position.set(...plan.pick, 0.012);
      this.ring.rotation.z = plan.turn;
      if (plan.place) point(this.way, plan.pick, plan.place, 0.02);
    }
    this.dirty = true;
  }

  /** An arrow on the table from a place along a direction, lengths in metres; null hides it. */
  gradient(from, to) {
    this.pull.visible = Boolean(from);
    if (from) point(this.pull, from, to, 0.03);
    this.dirty = true;
  }

  /** Where a guard of the physics fired [x, y, z]; null hides it. */
  mark(at) {
    this.fault.visible = Boolean(at);
    if (at) this.fault.position.set(...at);
    this.dirty = true;
  }

  /** A frame later: fewer pixels while things move and frames are late, all of them at rest. */
  pace(seconds, moving) {
    if (moving && !this.moving) this.kept = Math.min(1, this.kept / LESS);
    this.moving = moving;
    this.late = moving && seconds > LATE ? this.late + 1 : 0;
    if (this.late > 1 && this.kept * LESS > LEAST) { this.kept *= LESS; this.late = 0; }
    this.share = moving ? this.kept : 1;
  }

  draw() {
    const {clientWidth: w, clientHeight: h} = this.canvas, size = `${w}x${h}x${this.share}`;
    if (size !== this.size && w && h) {
      this.size = size;
      this.renderer.setPixelRatio(this.share * (this.slow ? 1 : Math.min(devicePixelRatio, 2)));
      this.renderer.setSize(w, h, false);
      this.camera.aspect = w / h;
      this.camera.fov = 360 / Math.PI * Math.atan(Math.tan(FIELD / 2) * Math.max(1, WIDE * h / w));
      this.camera.updateProjectionMatrix();
      this.dirty = true;
    }
    if (!this.dirty) return;
    this.dirty = false;
    this.renderer.render(this.scene, this.camera);
    this.drawn++;
  }
}

function arrow(color) {
  const group = new T.Group(), material = glow(color);
  const shaft = new T.Mesh(new T.CylinderGeometry(0.0022, 0.0022, 1, 10), material);
  const tip = new T.Mesh(new T.ConeGeometry(0.009, 0.024, 16), material);
  shaft.renderOrder = tip.renderOrder = 2;
  group.add(shaft, tip);
  return group;
}

function point(group, from, to, height) {
  const a = new T.Vector3(...from, height), along = new T.Vector3(...to, height).sub(a), length = along.length();
  group.position.copy(a);
  if (length > 1e-6) group.quaternion.setFromUnitVectors(new T.Vector3(0, 1, 0), along.divideScalar(length));
  const [shaft, tip] = group.children;
  shaft.scale.y = Math.max(length - 0.02, 1e-4);
  shaft.position.y = shaft.scale.y / 2;
  tip.position.y = Math.max(length - 0.012, 0);
}
