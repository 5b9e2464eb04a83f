"use strict";

// Draws what contents.py describes. Returns {names, position, quaternion, pixel, time, playing, seek, play, pause}, for scripts and tests.
function showMechanism(contents, numbers, wholes, T) {
  const get = (id) => document.getElementById(id);
  const part = ([start, count]) => numbers.subarray(start, start + count);
  const vector = (entries, index = 0) => new T.Vector3(entries[3 * index], entries[3 * index + 1], entries[3 * index + 2]);
  const times = part(contents.times);
  const [low, high, up] = [contents.low, contents.high, contents.up].map((entries) => vector(entries));
  const extent = Math.max(...high.clone().sub(low).toArray()) || 1;
  const unit = 0.025 * extent; // size of a symbol [m]
  const centre = low.clone().add(high).multiplyScalar(0.5);
  const corners = [low, high].flatMap((x) => [low, high].flatMap((y) => [low, high].map((z) => new T.Vector3(x.x, y.y, z.z))));
  const INK = "#444444", PALE = "#f4f4f4";

  // --- The stage ---------------------------------------------------------------------------------------------------
  const stage = get("stage");
  const renderer = new T.WebGLRenderer({ antialias: true });
  renderer.setPixelRatio(window.devicePixelRatio);
  stage.prepend(renderer.domElement);
  const scene = new T.Scene();
  scene.background = new T.Color("#f7f8fa");
  const camera = new T.PerspectiveCamera(30, 1, 0.01 * extent, 100 * extent);
  camera.up.copy(up);
  scene.add(new T.HemisphereLight("#ffffff", "#b8bcc4", 2.2));
  const lamp = new T.DirectionalLight("#ffffff", 1.6);
  scene.add(lamp);
  const controls = new T.OrbitControls(camera, renderer.domElement);
  const toward = vector(contents.camera.toward), side = vector(contents.camera.up).cross(toward);
  if (Math.abs(toward.dot(up)) < 0.01) toward.addScaledVector(up, 0.2).addScaledVector(side, 0.3); // not quite in plane

  // The camera as near as all corners of the box allow.
  function home() {
    const { width, height } = stage.getBoundingClientRect();
    const tall = Math.tan(Math.PI / 12), wide = (tall * width) / Math.max(height, 1);
    const back = toward.clone().normalize(), right = up.clone().cross(back).normalize(), above = back.clone().cross(right);
    const distances = corners.map((corner) => {
      const arm = corner.clone().sub(centre), reach = (axis) => Math.abs(arm.dot(axis)) + 3 * unit;
      return arm.dot(back) + Math.max(reach(right) / wide, reach(above) / tall);
    });
    controls.target.copy(centre);
    camera.position.copy(centre).addScaledVector(back, Math.max(...distances));
    controls.update();
    redraw();
  }

  // --- What is drawn -----------------------------------------------------------------------------------------------
  const hovered = []; // meshes that tell their label
  const movers = []; // functions that place what the bodies' poses do not place
  const material = (colour, opacity = 1) =>
    new T.MeshStandardMaterial({
      color: colour, roughness: 0.6, transparent: opacity < 1, opacity, side: T.DoubleSide, depthWrite: opacity === 1,
    });
  const Y = new T.Vector3(0, 1, 0);

  function mesh(geometry, colour, label, parent, opacity = 1) {
    const made = new T.Mesh(geometry, material(colour, opacity));
    made.userData.label = label;
    if (label) hovered.push(made);
    parent.add(made);
    return made;
  }

  // A cylinder of height one along y, and where it stretches to: from one point to another.
  const stick = (radius, colour, label, parent) => mesh(new T.CylinderGeometry(radius, radius, 1, 16), colour, label, parent);
  function stretch(object, from, to) {
    const along = to.clone().sub(from), length = Math.max(along.length(), 1e-9 * extent);
    object.position.copy(from).add(to).multiplyScalar(0.5);
    object.quaternion.setFromUnitVectors(Y, along.divideScalar(length));
    object.scale.set(1, length, 1);
  }
  function rod(from, to, radius, colour, label, parent) {
    stretch(stick(radius, colour, label, parent), from, to);
    for (const end of [from, to]) mesh(new T.SphereGeometry(radius, 16, 12), colour, label, parent).position.copy(end);
  }
  function edged(geometry, colour, label, parent, opacity = 1) {
    const solid = mesh(geometry, colour, label, parent, opacity);
    solid.add(new T.LineSegments(new T.EdgesGeometry(geometry, 20), new T.LineBasicMaterial({ color: INK })));
    return solid;
  }

  const draw = {
    rod({ ends }, colour, label, group) {
      rod(vector(ends[0]), vector(ends[1]), 0.5 * unit, colour, label, group);
    },
    plate({ corners }, colour, label, group) {
      const points = corners.map((corner) => vector(corner));
      points.forEach((point, index) => rod(point, points[(index + 1) % points.length], 0.4 * unit, colour, label, group));
      const face = new T.BufferGeometry().setFromPoints(points);
      face.setIndex(points.slice(2).flatMap((_, index) => [0, index + 1, index + 2]));
      face.computeVertexNormals();
      mesh(face, colour, label, group, 0.35);
    },
    hull({ corners }, colour, label, group) {
      edged(new T.ConvexGeometry(corners.map((corner) => vector(corner))), colour, label, group, 0.6);
    },
    box({ centre: at, axes, half }, colour, label, group) {
      const size = half.map((length) => 2 * Math.max(length, 1e-3 * unit));
      const solid = edged(new T.BoxGeometry(...size), colour, label, group, 0.6); // shows joints and bodies inside
      turn(solid, axes).position.copy(vector(at));
    },
    ellipsoid({ centre: at, axes, half }, colour, label, group) {
      const solid = mesh(new T.SphereGeometry(1, 32, 24), colour, label, group, 0.6);
      turn(solid, axes).position.copy(vector(at));
      solid.scale.set(...half.map((length) => Math.max(length, 1e-3 * unit)));
    },
    ball({ centre: at }, colour, label, group) {
      mesh(new T.SphereGeometry(1.2 * unit, 24, 18), colour, label, group).position.copy(vector(at));
    },
  };

  // Meshes of files, and solids of size one; a cylinder is along z.
  const geometries = contents.meshes.map(({ low, size, points: [start, count], corners: [first, corners] }) => {
    const step = size.map((length) => length / 65535);
    const places = Float32Array.from(wholes.subarray(start, start + count), (whole, index) => low[index % 3] + step[index % 3] * whole);
    const geometry = new T.BufferGeometry().setAttribute("position", new T.BufferAttribute(places, 3));
    return geometry.setIndex(new T.BufferAttribute(wholes.slice(first, first + corners), 1));
  });
  const forms = {
    cube: new T.BoxGeometry(1, 1, 1),
    ball: new T.SphereGeometry(0.5, 40, 28),
    cylinder: new T.CylinderGeometry(0.5, 0.5, 1, 48).rotateX(Math.PI / 2),
  };
  draw.solid = ({ form, mesh: which, matrix, colour: own, opacity }, colour, label, group) => {
    const geometry = form === "mesh" ? geometries[which] : forms[form];
    const solid = mesh(geometry, own || colour, label, group, opacity);
    solid.material.flatShading = form === "mesh"; // such a mesh has no normals
    solid.matrixAutoUpdate = false;
    solid.matrix.set(...matrix.flat());
  };

  function turn(object, axes) {
    object.setRotationFromMatrix(new T.Matrix4().makeBasis(...axes.map((axis) => vector(axis))));
    return object;
  }

  const bodies = contents.bodies.map(({ name, label, colour, position, quaternion, parts }) => {
    const group = new T.Group();
    parts.forEach((shape) => draw[shape.kind](shape, colour, label, group));
    scene.add(group);
    return { name, group, position: part(position), quaternion: part(quaternion) };
  });
  const colours = contents.bodies.map((body) => body.colour);
  const placed = ([body, offset]) => vector(offset).applyQuaternion(bodies[body].group.quaternion).add(bodies[body].group.position);

  // Joint symbols have their first axis along x.
  const along = (geometry) => geometry.rotateZ(-Math.PI / 2);
  const symbols = {
    hinge: () => [along(new T.CylinderGeometry(0.75 * unit, 0.75 * unit, 2.4 * unit, 20))],
    sleeve: () => [along(new T.CylinderGeometry(1.1 * unit, 1.1 * unit, 3 * unit, 20))],
    box: () => [new T.BoxGeometry(3.2 * unit, 2 * unit, 2 * unit)],
    ball: () => [new T.SphereGeometry(0.9 * unit, 20, 14)],
    cross: () => [
      along(new T.CylinderGeometry(0.4 * unit, 0.4 * unit, 2.6 * unit, 12)),
      new T.CylinderGeometry(0.4 * unit, 0.4 * unit, 2.6 * unit, 12),
    ],
    weld: () => [new T.BoxGeometry(1.2 * unit, 1.2 * unit, 1.2 * unit)],
    plate: () => [new T.BoxGeometry(0.3 * unit, 3 * unit, 3 * unit)],
  };
  for (const { label, kind, at, axes, ground, stands, slides } of contents.joints) {
    if (!kind) continue;
    const group = turn(new T.Group(), axes);
    group.position.copy(vector(at[1]));
    group.scale.setScalar(contents.bodies[at[0]].parts.some((shape) => shape.kind === "solid") ? 0.6 : 1);
    bodies[at[0]].group.add(group);
    symbols[kind]().forEach((geometry) => edged(geometry, slides ? colours[at[0]] : PALE, label, group));
    for (const [, offset] of stands ? ground : []) {
      const foot = mesh(new T.ConeGeometry(1.6 * unit, 2.6 * unit, 4), "#c9c9c9", label, scene);
      foot.quaternion.setFromUnitVectors(Y, up);
      foot.position.copy(vector(offset)).addScaledVector(up, -1.3 * unit);
    }
  }
  for (const { at, axes, ground, slides } of contents.joints) {
    if (slides && ground.length) guide(at, vector(axes[0]));
  }

  // The guide of a slide on ground, as far as the slide goes.
  function guide([body, offset], axis) {
    const { position, quaternion } = bodies[body];
    const direction = axis.clone().applyQuaternion(new T.Quaternion(...quaternion.subarray(0, 4)));
    const turned = (index) => new T.Quaternion(...quaternion.subarray(4 * index, 4 * index + 4));
    const way = Array.from(times, (_, index) => vector(offset).applyQuaternion(turned(index)).add(vector(position, index)));
    const reach = way.map((place) => place.clone().sub(way[0]).dot(direction));
    const end = (distance) => way[0].clone().addScaledVector(direction, distance);
    rod(end(Math.min(...reach) - 2.5 * unit), end(Math.max(...reach) + 2.5 * unit), 0.2 * unit, "#8a8a8a", null, scene);
  }

  class Helix extends T.Curve {
    getPoint(part, target = new T.Vector3()) {
      const turns = Math.min(Math.max((part - 0.1) / 0.8, 0), 1), angle = 18 * Math.PI * turns;
      const radius = turns > 0 && turns < 1 ? 0.8 * unit : 0;
      return target.set(radius * Math.cos(angle), part - 0.5, radius * Math.sin(angle));
    }
  }
  const spanParts = {
    rope: (colour, label) => [[0, 1, stick(0.15 * unit, colour, label, scene)]],
    rod: (colour, label) => [[0, 1, stick(0.3 * unit, colour, label, scene)]],
    beam: (colour, label) => [[0, 1, stick(0.5 * unit, colour, label, scene)]],
    damper: (colour, label) => [
      [0, 0.55, stick(0.5 * unit, "#8d939c", label, scene)],
      [0.5, 1, stick(0.18 * unit, colour, label, scene)],
    ],
    spring: (colour, label) => [[0, 1, mesh(new T.TubeGeometry(new Helix(), 240, 0.12 * unit, 6), colour, label, scene)]],
  };
  for (const { kind, label, colour, points } of contents.spans) {
    points.slice(1).forEach((end, index) => {
      const pieces = spanParts[kind](colour, label);
      movers.push(() => {
        const from = placed(points[index]), to = placed(end);
        for (const [first, last, piece] of pieces) stretch(piece, from.clone().lerp(to, first), from.clone().lerp(to, last));
      });
    });
  }

  const tags = []; // words beside what is drawn
  function name(words, object) {
    const tag = document.createElement("div");
    tag.className = "name";
    tag.textContent = words;
    stage.append(tag);
    tags.push({ tag, object });
    return object;
  }

  for (const { name: words, position, curve } of contents.points) {
    const line = new T.BufferGeometry().setAttribute("position", new T.BufferAttribute(new Float32Array(part(curve)), 3));
    scene.add(new T.Line(line, new T.LineBasicMaterial({ color: "#8a8a8a" })));
    const dot = mesh(new T.SphereGeometry(0.55 * unit, 16, 12), INK, words, scene);
    const places = part(position);
    movers.push(({ left, share }) => dot.position.copy(vector(places, left).lerp(vector(places, left + (share > 0)), share)));
    name(words, dot);
  }

  for (const { label, unit: unitName, at, vector: where, colour } of contents.arrows) {
    const values = part(where), group = new T.Group();
    const size = (index) => vector(values, index).length();
    const largest = Math.max(...Array.from(times, (_, index) => size(index))) || 1;
    const shaft = stick(0.25 * unit, colour, label, group), head = mesh(new T.ConeGeometry(0.8 * unit, 2 * unit, 16), colour, label, group);
    scene.add(group);
    movers.push(({ left, share }) => {
      const force = vector(values, left).lerp(vector(values, left + (share > 0)), share), from = placed(at);
      const length = (0.3 * extent * force.length()) / largest;
      const words = `${label}, ${force.length().toPrecision(4)} ${unitName}`;
      [shaft, head].forEach((object) => (object.userData.label = words));
      group.visible = length > 0;
      stretch(shaft, from, from.clone().addScaledVector(force.normalize(), length));
      head.position.copy(from).addScaledVector(force, length);
      head.quaternion.setFromUnitVectors(Y, force);
    });
  }

  const floor = new T.GridHelper(2 * extent, 20, "#d5d8dd", "#e3e6ea");
  floor.quaternion.setFromUnitVectors(Y, up);
  const lowest = Math.min(...corners.map((corner) => corner.dot(up)));
  floor.position.copy(centre).addScaledVector(up, lowest - up.dot(centre) - 3 * unit);
  scene.add(floor);
  const aside = up.clone().cross(toward).normalize();
  const left = Math.min(...corners.map((corner) => corner.dot(aside))) - centre.dot(aside);
  const origin = floor.position.clone().addScaledVector(aside, Math.max(left - 5 * unit, -0.6 * extent));
  ["x", "y", "z"].forEach((axis, index) => {
    const tip = origin.clone().add(new T.Vector3().setComponent(index, 4 * unit));
    rod(origin, tip, 0.12 * unit, ["#d43d3d", "#3a9a3a", "#3d5fd4"][index], axis, scene);
    name(axis, mesh(new T.SphereGeometry(0.12 * unit), INK, axis, scene)).position.copy(tip);
  });
  if (contents.gravity) {
    const from = origin.clone().addScaledVector(up, 9 * unit), to = origin.clone().addScaledVector(up, 4.5 * unit);
    const label = `gravity, ${contents.gravity.toPrecision(3)} m/s²`;
    stretch(stick(0.15 * unit, INK, label, scene), from, to);
    const head = mesh(new T.ConeGeometry(0.5 * unit, 1.5 * unit, 12), INK, label, scene);
    head.position.copy(to);
    head.quaternion.setFromUnitVectors(Y, up.clone().negate());
  }

  // --- Time --------------------------------------------------------------------------------------------------------
  const [first, last] = [times[0], times[times.length - 1]];
  let now = first, playing = false, before = null, dirty = true, seen = true;
  const redraw = () => { dirty = true; };

  // The saved time before a time, and which share of the way to the next one has gone.
  function moment(time) {
    let [left, right] = [0, times.length - 1];
    while (right - left > 1) {
      const middle = (left + right) >> 1;
      if (times[middle] <= time) left = middle; else right = middle;
    }
    if (right === left) return { left, share: 0 };
    const share = (time - times[left]) / (times[right] - times[left]);
    return share >= 1 ? { left: right, share: 0 } : { left, share: Math.max(share, 0) };
  }

  function seek(time) {
    now = Math.min(Math.max(time, first), last);
    const { left, share } = moment(now), next = left + (share > 0);
    for (const { group, position, quaternion } of bodies) {
      group.position.copy(vector(position, left).lerp(vector(position, next), share));
      const turned = (index) => new T.Quaternion(...quaternion.subarray(4 * index, 4 * index + 4));
      group.quaternion.copy(turned(left).slerp(turned(next), share));
    }
    movers.forEach((move) => move({ left, share }));
    get("time").value = String(now);
    get("clock").textContent = `${now.toFixed(digits)} / ${last.toFixed(digits)} s`;
    redraw();
  }

  function setPlaying(on) {
    playing = on && last > first;
    before = null;
    if (playing && now >= last) seek(first);
    get("play").textContent = playing ? "Pause" : "Play";
  }

  const duration = last - first;
  const digits = duration > 0 ? Math.max(0, 3 - Math.ceil(Math.log10(duration))) : 3;
  // Real time, if that is one to twenty seconds; else the nearest power of ten to eight seconds.
  const base = duration >= 1 && duration <= 20 ? 1 : 10 ** Math.round(Math.log10(duration / 8 || 1));
  for (const factor of [0.1, 0.25, 0.5, 1, 2, 5, 10]) {
    get("speed").add(new Option(`× ${Number((factor * base).toPrecision(3))}`, factor * base, factor === 1, factor === 1));
  }
  Object.assign(get("time"), { min: first, max: last, value: first });
  get("time").addEventListener("input", () => { setPlaying(false); seek(Number(get("time").value)); });
  get("play").addEventListener("click", () => setPlaying(!playing));
  get("home").addEventListener("click", home);
  document.addEventListener("keydown", (event) => {
    if (event.code !== "Space" || event.target.closest("button, select")) return;
    event.preventDefault();
    setPlaying(!playing);
  });
  if (!(last > first)) ["play", "time", "speed"].forEach((id) => { get(id).disabled = true; });

  // --- Names on hover ----------------------------------------------------------------------------------------------
  const ray = new T.Raycaster(), tip = get("tip");
  renderer.domElement.addEventListener("pointermove", (event) => {
    const frame = renderer.domElement.getBoundingClientRect();
    const [x, y] = [event.clientX - frame.left, event.clientY - frame.top];
    [scene, camera].forEach((object) => object.updateMatrixWorld()); // they may have moved since the last frame
    ray.setFromCamera(new T.Vector2((2 * x) / frame.width - 1, 1 - (2 * y) / frame.height), camera);
    const hit = ray.intersectObjects(hovered, false)[0];
    tip.style.display = hit ? "block" : "none";
    if (!hit) return;
    tip.textContent = hit.object.userData.label;
    tip.style.left = `${Math.min(x + 12, frame.width - tip.offsetWidth - 4)}px`;
    tip.style.top = `${Math.max(y - 26, 2)}px`;
  });
  renderer.domElement.addEventListener("pointerleave", () => { tip.style.display = "none"; });

  // --- Drawing -----------------------------------------------------------------------------------------------------
  function fit() {
    const { width, height } = stage.getBoundingClientRect();
    renderer.setSize(width, height);
    camera.aspect = width / Math.max(height, 1);
    camera.updateProjectionMatrix();
    redraw();
  }

  function render(milliseconds) {
    requestAnimationFrame(render);
    if (!seen) { before = null; return; }
    if (playing) {
      const passed = before === null ? 0 : (milliseconds - before) / 1000;
      before = milliseconds;
      const time = now + passed * Number(get("speed").value);
      seek(time > last ? first : time);
    }
    if (!dirty) return;
    dirty = false;
    lamp.position.copy(camera.position).addScaledVector(up, extent);
    renderer.render(scene, camera);
    for (const { tag, object } of tags) {
      const [x, y] = pixel(object.position);
      tag.style.left = `${x + 8}px`;
      tag.style.top = `${y - 22}px`;
    }
  }

  // Where a place is seen, in pixels from the left and the top of the stage.
  function pixel(place) {
    const { width, height } = stage.getBoundingClientRect(), seen = place.clone().project(camera);
    return [((seen.x + 1) * width) / 2, ((1 - seen.y) * height) / 2];
  }

  controls.addEventListener("change", redraw);
  new ResizeObserver(fit).observe(stage);
  new IntersectionObserver(([entry]) => { seen = entry.isIntersecting; }).observe(stage);
  fit();
  seek(first);
  home();
  setPlaying(!matchMedia("(prefers-reduced-motion: reduce)").matches);
  requestAnimationFrame(render);

  const body = (name) => bodies.find((entry) => entry.name === name);
  return {
    names: bodies.map((entry) => entry.name),
    position: (name) => body(name).group.position.toArray(),
    quaternion: (name) => body(name).group.quaternion.toArray(),
    pixel: (place) => pixel(vector(place)),
    time: () => now,
    playing: () => playing,
    seek: (time) => { setPlaying(false); seek(time); },
    play: () => setPlaying(true),
    pause: () => setPlaying(false),
  };
}
