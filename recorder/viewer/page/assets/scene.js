"use strict";
// The 3D view: the shapes of a log in their coordinate frames, and a camera that follows the vehicle.

const UNIT = {
  box: new libraries.BoxGeometry(1, 1, 1),
  sphere: new libraries.SphereGeometry(0.5, 20, 14),
  cylinder: new libraries.CylinderGeometry(0.5, 0.5, 1, 20).rotateX(Math.PI / 2),
  cone: new libraries.ConeGeometry(0.5, 1, 20).rotateX(Math.PI / 2),
  dot: new libraries.SphereGeometry(0.5, 8, 6),
  pointer: new libraries.ConeGeometry(0.5, 1, 4),
};
const MARKER = "#e3242b", MARKER_SHARE = 0.03;
// Lines thinner than this are drawn with a least width on the screen, so that they stay visible.
const THIN_M = 0.25, THIN_PX = 1.5;

class SceneView {
  /** Create a view; throws if the browser has no WebGL. */
  constructor(canvas, log) {
    this.log = log;
    this.renderer = new libraries.WebGLRenderer({ canvas, antialias: true });
    this.scene = new libraries.Scene();
    this.camera = new libraries.PerspectiveCamera(50, 1, 0.2, 5000);
    this.camera.up.set(0, 0, 1);
    this.controls = new libraries.OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.render());
    this.controls.addEventListener("end", () => { this.isTurned = true; });
    const sun = new libraries.DirectionalLight(0xffffff, 1.8);
    sun.position.set(-0.4, -0.6, 1);
    this.scene.add(new libraries.HemisphereLight(0xffffff, 0x8a8f94, 1.7), sun);
    this.following = true;
    this.setColors();
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  /** Take the background from the style sheet. */
  setColors() {
    const sky = getComputedStyle(document.documentElement).getPropertyValue("--sky").trim();
    this.scene.background = new libraries.Color(sky);
    this.render();
  }

  /** Replace the scene by that of another episode. */
  load(data) {
    this.objects?.forEach(dispose);
    if (this.root) this.scene.remove(this.root);
    this.root = new libraries.Group();
    this.marker = mesh(UNIT.pointer, { color: new libraries.Color(MARKER), opacity: 1 });
    this.isAbove = false;
    this.scene.add(this.root);
    this.data = data;
    this.groups = new Map();
    this.objects = new Map();
    this.moment = undefined;
    for (const frame of data.frames) this.attach(this.group(frame.name), this.group(frame.parent));
    this.show([...data.static]);
    this.root.add(this.marker);
    this.anchor = null;
    this.draw(0);
    this.placeCamera();
  }

  /** Return the group of a coordinate frame. */
  group(name) {
    if (!this.groups.has(name)) {
      const made = new libraries.Group();
      this.groups.set(name, made);
      this.root.add(made);
    }
    return this.groups.get(name);
  }

  /** Attach a frame to its parent, unless the parent depends on the frame. */
  attach(child, parent) {
    for (let above = parent; above; above = above.parent) if (above === child) return;
    parent.add(child);
  }

  /** Show the shapes with these indexes, and remove all others. */
  show(indexes) {
    const wanted = new Set(indexes);
    for (const [index, object] of this.objects) {
      if (!wanted.has(index)) {
        dispose(object);
        this.objects.delete(index);
      }
    }
    for (const index of wanted) {
      const object = this.objects.get(index) ?? shapeObject(this.data.shapes, index);
      if (!object) continue;
      this.objects.set(index, object);
      if (!object.parent) this.group(this.data.shapes.frames[index]).add(object);
    }
  }

  /** Show the scene at a time in seconds. */
  draw(time) {
    const { moments, frames } = this.data;
    this.time = time;
    const moment = Math.max(0, indexAt(moments.times, time));
    if (moment !== this.moment) {
      this.moment = moment;
      const range = moments.indexes.subarray(moments.starts[moment], moments.starts[moment + 1]);
      this.show([...this.data.static, ...range]);
    }
    for (const frame of frames) setPose(this.groups.get(frame.name), frame, time);
    this.root.updateMatrixWorld(true);
    this.marker.visible = this.isAbove && Boolean(this.vehicle());
    if (this.marker.visible) {
      const { position, heading } = this.vehicle();
      this.marker.position.copy(position);
      this.marker.rotation.z = heading - Math.PI / 2;
    }
    if (this.following && !this.isAbove) this.moveCamera();
    this.render();
  }

  /** Return the position and heading of the followed frame; null if there is none. */
  vehicle() {
    const group = this.data.follow && this.groups.get(this.data.follow);
    if (!group) return null;
    const forward = new libraries.Vector3(1, 0, 0).transformDirection(group.matrixWorld);
    const position = new libraries.Vector3().setFromMatrixPosition(group.matrixWorld);
    return { position, heading: Math.atan2(forward.y, forward.x) };
  }

  /** Move the camera as the vehicle has moved since the last call. */
  moveCamera() {
    const now = this.vehicle();
    if (now && this.anchor) {
      const up = new libraries.Vector3(0, 0, 1), turn = now.heading - this.anchor.heading;
      for (const point of [this.camera.position, this.controls.target]) {
        point.sub(this.anchor.position).applyAxisAngle(up, turn).add(now.position);
      }
      this.camera.lookAt(this.controls.target);
    }
    this.anchor = now;
  }

  /** Place the camera behind the vehicle; without a vehicle, in front of all shapes. */
  placeCamera() {
    this.isTurned = false;
    const now = this.vehicle(), tilt = this.log.tilt_deg * Math.PI / 180;
    let distance = this.log.distance_m, heading = 0;
    if (now) {
      heading = now.heading;
      this.controls.target.copy(now.position);
    } else {
      const box = new libraries.Box3().setFromObject(this.root);
      if (!box.isEmpty()) {
        box.getCenter(this.controls.target);
        distance = 0.8 * box.getSize(new libraries.Vector3()).length();
      }
    }
    const backward = distance * Math.sin(tilt);
    this.camera.position.copy(this.controls.target).add(new libraries.Vector3(
      -backward * Math.cos(heading), -backward * Math.sin(heading), distance * Math.cos(tilt)));
    this.camera.lookAt(this.controls.target);
    this.anchor = now;
    this.render();
  }

  /** Follow the vehicle again, or leave the camera where it is. */
  follow(following) {
    this.following = following;
    if (following) this.placeCamera();
  }

  /** Show the world and a marker of the vehicle from above, or the view behind the vehicle. */
  fromAbove(isAbove) {
    this.isAbove = isAbove;
    if (isAbove) {
      const { camera, controls } = this, box = new libraries.Box3().setFromObject(this.root);
      const size = box.getSize(new libraries.Vector3());
      box.getCenter(controls.target);
      const height = Math.max(size.y, size.x / camera.aspect, 1);
      const distance = height / (2 * Math.tan(camera.fov * Math.PI / 360)) + size.z / 2;
      // A camera exactly above its target has no direction of up.
      camera.position.copy(controls.target).add(new libraries.Vector3(0, -1e-3 * distance, distance));
      camera.lookAt(controls.target);
      this.marker.scale.setScalar(MARKER_SHARE * height);
    } else {
      this.placeCamera();
    }
    this.draw(this.time);
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.render();
  }

  render() {
    this.renderer.render(this.scene, this.camera);
  }
}

/** Interpolate the pose of a frame; outside the range of times, take the nearest pose. */
function setPose(group, { times, poses }, time) {
  const before = Math.max(0, indexAt(times, time)), after = Math.min(before + 1, times.length - 1);
  const gap = times[after] - times[before];
  const share = gap > 0 ? Math.min(Math.max((time - times[before]) / gap, 0), 1) : 0;
  const [a, b] = [row(poses, before), row(poses, after)];
  group.position.fromArray(a).lerp(new libraries.Vector3().fromArray(b), share);
  group.quaternion.fromArray(a, 3).slerp(new libraries.Quaternion().fromArray(b, 3), share).normalize();
}

/** Create the object of a shape; null if it has nothing to show. */
function shapeObject(shapes, index) {
  const numbers = [...row(shapes.numbers, index)];
  const kind = shapes.kinds[index], parts = { segments: 2, triangles: 3 }[kind] ?? 1;
  const count = shapes.starts[index + 1] - shapes.starts[index];
  const points = shapes.points.subarray(3 * shapes.starts[index], 3 * (shapes.starts[index + 1] - (count % parts)));
  if (![...numbers, ...points].every(Number.isFinite)) return null;
  const [red, green, blue, opacity, ...rest] = numbers;
  const [size, position, yaw] = [rest.slice(0, 3), rest.slice(3, 6), rest[6]];
  const color = new libraries.Color().setRGB(red, green, blue, "srgb");
  const look = { color, opacity, transparent: opacity < 1 };
  const object = kind === "text" ? textObject(shapes.texts[index], look, size[2])
    : kind in UNIT ? mesh(UNIT[kind], look)
    : kind === "arrow" ? arrowObject(points, look, size)
    : kind === "triangles" ? trianglesObject(points, look)
    : kind === "line" || kind === "segments" ? linesObject(kind, points, look, size[0])
    : dotsObject(points, look, size);
  if (!object) return null;
  if (kind in UNIT) object.scale.fromArray(size.map((length) => length || 1e-6));
  object.position.fromArray(position);
  object.rotation.z = yaw;
  return object;
}

/** The walls of a closed shape are not drawn from inside, so that a camera in a building sees out. */
function material(look) {
  return new libraries.MeshLambertMaterial({ ...look, flatShading: true });
}

function mesh(geometry, look) {
  return new libraries.Mesh(geometry, material(look));
}

function trianglesObject(points, look) {
  const geometry = new libraries.BufferGeometry();
  geometry.setAttribute("position", new libraries.BufferAttribute(points, 3));
  geometry.computeVertexNormals();
  return mesh(geometry, { ...look, side: libraries.DoubleSide });
}

function linesObject(kind, points, look, width) {
  if (points.length < 6) return null;
  let ends = points;
  if (kind === "line") {
    ends = [];
    for (let k = 3; k < points.length; k += 3) ends.push(...points.subarray(k - 3, k + 3));
  }
  const geometry = new libraries.LineSegmentsGeometry().setPositions(ends);
  const lines = (options) => new libraries.LineSegments2(geometry, new libraries.LineMaterial({ ...look, ...options }));
  const wide = lines({ worldUnits: true, linewidth: width });
  if (width >= THIN_M) return wide;
  return new libraries.Group().add(wide, lines({ worldUnits: false, linewidth: THIN_PX }));
}

function dotsObject(points, look, size) {
  const dots = new libraries.InstancedMesh(UNIT.dot, material(look), points.length / 3);
  const matrix = new libraries.Matrix4();
  for (let k = 0; k < dots.count; k++) {
    matrix.makeScale(size[0], size[0], size[0]).setPosition(...points.subarray(3 * k, 3 * k + 3));
    dots.setMatrixAt(k, matrix);
  }
  return dots;
}

/** An arrow along x, or between two points; the sizes are those of a ROS marker. */
function arrowObject(points, look, size) {
  const start = new libraries.Vector3(), end = new libraries.Vector3(size[0], 0, 0);
  let [shaft, head] = [size[1] / 2, size[1]];
  if (points.length >= 6) {
    start.fromArray(points);
    end.fromArray(points, 3);
    [shaft, head] = size;
  }
  const length = start.distanceTo(end), tip = Math.min(1.5 * head, length);
  if (!length) return null;
  const [rod, point] = [mesh(UNIT.cylinder, look), mesh(UNIT.cone, look)];
  rod.scale.set(shaft, shaft, length - tip || 1e-6);
  rod.position.z = (length - tip) / 2;
  point.scale.set(head, head, tip);
  point.position.z = length - tip / 2;
  const arrow = new libraries.Group().add(rod, point);
  arrow.quaternion.setFromUnitVectors(new libraries.Vector3(0, 0, 1), end.clone().sub(start).normalize());
  arrow.position.copy(start);
  return new libraries.Group().add(arrow);
}

function textObject(text, { color, opacity }, height) {
  const canvas = document.createElement("canvas"), context = canvas.getContext("2d");
  const font = "48px system-ui, sans-serif", shown = text.slice(0, 200);
  context.font = font;
  canvas.width = Math.ceil(context.measureText(shown).width) + 8;
  canvas.height = 64;
  context.font = font;
  context.fillStyle = color.getStyle();
  context.strokeStyle = "#0009";
  context.lineWidth = 6;
  context.textBaseline = "middle";
  context.strokeText(shown, 4, 32);
  context.fillText(shown, 4, 32);
  const map = new libraries.CanvasTexture(canvas);
  map.colorSpace = "srgb";
  const sprite = new libraries.Sprite(new libraries.SpriteMaterial({ map, opacity, depthTest: false }));
  // The size of a text is the height of its capital letters.
  const scale = height / (0.72 * 48);
  sprite.scale.set(scale * canvas.width, scale * canvas.height, 1);
  return sprite;
}

/** Remove an object and free its memory on the graphics card. */
function dispose(object) {
  object.removeFromParent();
  object.traverse((part) => {
    if (part.geometry && !Object.values(UNIT).includes(part.geometry)) part.geometry.dispose();
    part.material?.map?.dispose();
    part.material?.dispose();
    if (part.isInstancedMesh) part.dispose();
  });
}
