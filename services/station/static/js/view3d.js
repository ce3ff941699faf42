// The view in three dimensions: trunks as cylinders of true radius, aircraft, trail, and the point cloud where it reaches here.
// Drawn only when something changed. Axes are the map's: x ahead, y left, z up, metres.

import {
  AmbientLight, BufferAttribute, BufferGeometry, Color, ConeGeometry, CylinderGeometry, DirectionalLight, DynamicDrawUsage, GridHelper, Group, InstancedMesh,
  Line, LineBasicMaterial, Matrix4, Mesh, MeshLambertMaterial, OrbitControls, PerspectiveCamera, Points, PointsMaterial, Raycaster, Scene, TorusGeometry, Vector2,
  Vector3, WebGLRenderer,
} from "../vendor/three.js";
import { palette } from "./paint.js";

const TRUNK_M = 3, TRUNKS_MAX = 2000, TRAIL_MAX = 4000;
const SLOW_MS = 60, FAST_MS = 38, REST_MS = 300, POINTS_MIN = 10000;

/** Whether this browser draws by the processor alone: then smoothed edges would cost more than all points. */
function drawsInSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2"), about = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = gl && about ? String(gl.getParameter(about.UNMASKED_RENDERER_WEBGL)) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

export class View3d {
  constructor(box, page) {
    this.box = box;
    this.page = page;
    this.on = false;
    this.share = this.smooth = 1; // of the points that is drawn: now, and while it moves
    const software = drawsInSoftware();
    this.renderer = new WebGLRenderer({ antialias: !software, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio || 1, software ? 1 : 1.5));
    box.append(this.renderer.domElement);
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(55, 1, 0.1, 300);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    this.controls.maxPolarAngle = Math.PI * 0.495;
    this.controls.addEventListener("change", () => (this.dirty = true));
    const sun = new DirectionalLight(0xffffff, 2.2);
    sun.position.set(-4, -6, 12);
    this.scene.add(new AmbientLight(0xffffff, 1.6), sun);
    this.makeTrunks();
    this.makeCraft();
    this.makeCloud();
    this.theme(palette());
    new ResizeObserver(() => this.resize()).observe(box);
    this.listen();
    this.show(page.craft);
  }

  makeTrunks() {
    const trunk = new CylinderGeometry(1, 1, 1, 20);
    trunk.rotateX(Math.PI / 2);
    trunk.translate(0, 0, 0.5);
    this.trunks = new InstancedMesh(trunk, new MeshLambertMaterial(), TRUNKS_MAX);
    this.trunks.frustumCulled = false;
    this.ring = new Mesh(new TorusGeometry(1, 0.06, 10, 48), new MeshLambertMaterial());
    this.scene.add(this.trunks, this.ring);
  }

  makeCraft() {
    const body = new ConeGeometry(0.22, 0.7, 4);
    body.rotateZ(-Math.PI / 2); // the tip looks along x
    body.scale(1, 1, 0.4);
    this.craftMaterial = new MeshLambertMaterial();
    this.body = new Group();
    this.body.add(new Mesh(body, this.craftMaterial));
    this.trail = new Line(new BufferGeometry(), new LineBasicMaterial());
    this.trail.geometry.setAttribute("position", new BufferAttribute(new Float32Array(TRAIL_MAX * 3), 3).setUsage(DynamicDrawUsage));
    this.trail.frustumCulled = false;
    this.scene.add(this.body, this.trail);
  }

  makeCloud() {
    this.cloudMaterial = new PointsMaterial({ size: 2, sizeAttenuation: false, vertexColors: true });
    this.submaps = new Map();
    this.points = 0;
    this.page.cloud.listen((number, submap) => this.put(number, submap));
  }

  theme(colours) {
    this.colours = colours;
    this.scene.background = new Color(colours.map);
    if (this.grid) this.scene.remove(this.grid);
    this.grid = new GridHelper(60, 60, colours.grid5, colours.grid);
    this.grid.rotation.x = Math.PI / 2;
    this.scene.add(this.grid);
    this.craftMaterial.color.set(colours.craft);
    this.trail.material.color.set(colours.craft);
    this.ring.material.color.set(colours.target);
    this.changed();
  }

  set(on) {
    this.on = on;
    if (on) {
      this.fit();
      requestAnimationFrame(() => this.resize());
    }
  }

  show(craft) {
    this.craft = craft;
    this.fit();
  }

  /** Take what the cloud has of a submap: points, another place, or (null) nothing any more. */
  put(number, submap) {
    const shown = this.submaps.get(number);
    if (shown && shown.source !== submap?.points) this.drop(number);
    if (submap && shown?.source !== submap.points) this.add(number, submap);
    const cloud = this.submaps.get(number);
    if (cloud) {
      cloud.matrix.set(...submap.place, 0, 0, 0, 1);
      cloud.matrixWorldNeedsUpdate = true;
    }
    this.dirty = true;
  }

  drop(number) {
    const cloud = this.submaps.get(number);
    this.submaps.delete(number);
    this.points -= cloud.count;
    this.scene.remove(cloud);
    cloud.geometry.dispose();
  }

  add(number, { points, colours, count }) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(Float32Array.from(points, (v) => v / 100), 3));
    geometry.setAttribute("color", new BufferAttribute(colours, 3, true));
    const cloud = Object.assign(new Points(geometry, this.cloudMaterial), { source: points, count, matrixAutoUpdate: false });
    this.points += count;
    this.submaps.set(number, cloud);
    this.scene.add(cloud);
  }

  changed() {
    this.treesDirty = this.dirty = true;
  }

  placeTrunks() {
    const trees = (this.craft?.trees ?? []).slice(0, TRUNKS_MAX), m = new Matrix4(), k = this.colours, colour = new Color();
    this.ring.visible = false;
    trees.forEach((tree, i) => {
      const kind = this.craft.kind(tree);
      m.makeScale(tree.radius, tree.radius, TRUNK_M).setPosition(tree.x, tree.y, tree.z);
      this.trunks.setMatrixAt(i, m);
      this.trunks.setColorAt(i, colour.set(tree.id === this.page.selected ? k.ink : { suitable: k.tree, unsuitable: k.un, visited: k.visited, target: k.target }[kind]));
      if (kind === "target") {
        this.ring.visible = true;
        this.ring.position.set(tree.x, tree.y, tree.z + 0.05);
        this.ring.scale.setScalar(tree.radius + 2 * tree.sigma + 0.12);
      }
    });
    this.trunks.count = trees.length;
    this.trunks.instanceMatrix.needsUpdate = true;
    if (this.trunks.instanceColor) this.trunks.instanceColor.needsUpdate = true;
    this.trunks.boundingSphere = null;
    this.treesDirty = false;
  }

  placeCraft() {
    const at = this.craft?.shown, z = this.craft?.view?.pose?.at?.[2] ?? 0;
    this.body.visible = Boolean(at);
    if (at) {
      this.body.position.set(at.x, at.y, z);
      this.body.rotation.z = at.yaw;
    }
    const line = this.trail.geometry.attributes.position, points = (this.craft?.trail ?? []).slice(-TRAIL_MAX);
    points.forEach((p, i) => line.setXYZ(i, p[0], p[1], p[3] ?? z));
    this.trail.geometry.setDrawRange(0, points.length);
    line.needsUpdate = true;
  }

  resize() {
    const w = this.box.clientWidth, h = this.box.clientHeight;
    if (!w || !h) return;
    this.renderer.setSize(w, h, false);
    this.camera.aspect = w / h;
    this.camera.updateProjectionMatrix();
    this.dirty = true;
  }

  fit() {
    const trees = (this.craft?.trees ?? []).filter((t) => Math.hypot(t.x, t.y) < 60);
    const reach = Math.max(5, ...trees.map((t) => Math.hypot(t.x, t.y)));
    this.controls.target.set(0, 0, 0.8);
    this.camera.position.set(-reach * 1.5, 0, reach * 0.95);
    this.controls.update();
    this.dirty = true;
  }

  zoom(by) {
    this.camera.position.sub(this.controls.target).divideScalar(by).add(this.controls.target);
    this.controls.update();
    this.dirty = true;
  }

  listen() {
    const canvas = this.renderer.domElement, ray = new Raycaster(), at = new Vector2(), down = new Vector3();
    canvas.addEventListener("pointerdown", (e) => down.set(e.clientX, e.clientY, 0));
    canvas.addEventListener("pointerup", (e) => {
      if (Math.hypot(e.clientX - down.x, e.clientY - down.y) > 6) return;
      const box = canvas.getBoundingClientRect();
      at.set(((e.clientX - box.left) / box.width) * 2 - 1, 1 - ((e.clientY - box.top) / box.height) * 2);
      ray.setFromCamera(at, this.camera);
      const hit = ray.intersectObject(this.trunks)[0];
      this.page.select(hit ? this.craft.trees[hit.instanceId].id : null);
    });
  }

  draw(now, moving) {
    if (this.treesDirty) this.placeTrunks();
    if (!moving && !this.dirty) return;
    this.placeCraft();
    this.pace(now);
    // the points of a submap come in such an order that the first so many are an even sample of it
    for (const cloud of this.submaps.values()) cloud.geometry.setDrawRange(0, Math.ceil(cloud.count * this.share));
    this.renderer.render(this.scene, this.camera);
    this.dirty = this.share < 1; // once it rests, one more frame with every point
  }

  /** Draw as many points as the machine shows smoothly while the view moves, all of them when it rests. */
  pace(now) {
    const took = now - (this.drawnAt ?? 0);
    this.drawnAt = now;
    this.pose ??= new Matrix4();
    const still = this.pose.equals(this.camera.matrixWorld);
    this.pose.copy(this.camera.matrixWorld);
    if (still) {
      this.stillSince ??= now;
      if (now - this.stillSince > REST_MS) this.share = 1;
      return;
    }
    this.stillSince = null;
    const least = Math.min(1, POINTS_MIN / Math.max(1, this.points));
    if (took < 1000) this.smooth = took > SLOW_MS ? Math.max(least, this.smooth * 0.7) : took < FAST_MS ? Math.min(1, this.smooth * 1.1) : this.smooth;
    this.share = this.smooth;
  }
}
