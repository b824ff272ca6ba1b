// Shows a map of Gaussian splats (page.py packs it) with WebGL2: no library, nothing is fetched.
// World: metres, y up. Camera: x right, y down, z forward, as in SigmaSplat's own renderer, whose formulas these are.
"use strict";
const byId = (id) => document.getElementById(id);
const scene = JSON.parse(byId("scene").textContent);
const view = byId("view"), overlay = byId("overlay"), ink = overlay.getContext("2d");
const NEAR_M = 0.05, SWAY_RAD = Math.PI / 90, SWAY_MS = 9000, FLIGHT_MS = 900, TAP_PX = 8, TAP_MS = 350;
const BYTES = 20, SPLATS_PER_ROW = 400; // of four bytes: 2000 texels, where WebGL2 promises 2048

const add = (a, b, k = 1) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const pressed = (id) => byId(id).getAttribute("aria-pressed") === "true";
const shownCount = () => (pressed("uncertain") ? scene.count : scene.shown);

// ---- Drawing splats ----

const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D splats;
uniform mat3 R_world_camera;
uniform vec3 eye, low, palette[9];
uniform vec2 size, scale, deviation, legend;
uniform float unit, focal, low_pass;
uniform bool by_deviation;
in uint splat;
out vec2 at; out vec4 colour;
uvec4 bytes(int k) {
  return texelFetch(splats, ivec2(int(splat) % ${SPLATS_PER_ROW} * 5 + k, int(splat) / ${SPLATS_PER_ROW}), 0);
}
vec3 to_own_axes(vec4 q, vec3 p) {
  vec3 t = cross(p, q.yzw);
  return p + 2.0 * (q.x * t + cross(t, q.yzw));
}
void main() {
  uvec4 high = bytes(0), fine = bytes(1), sizes = bytes(2), turned = bytes(3);
  vec3 p = (low + vec3(high.xyz * 256u + fine.xyz) * unit - eye) * R_world_camera;
  gl_Position = vec4(0, 0, 2, 1); // outside: behind the camera nothing is drawn
  if (p.z < ${NEAR_M}) return;
  vec3 o = (vec3(turned.xyz) / 127.5 - 1.0) * ${Math.SQRT1_2};
  uint k = sizes.w;
  vec4 q = k < 2u ? o.xxyz : k == 2u ? o.xyyz : o.xyzz; // w, x, y, z; the largest comes from the others
  q[k] = sqrt(max(0.0, 1.0 - dot(o, o)));
  // The derivative of the pinhole is taken no farther outside than the edge of a larger image, as it is steep there.
  vec2 slope = clamp(p.xy / p.z, -0.65 * size / focal, 0.65 * size / focal);
  vec3 s = exp(scale.x + vec3(sizes.xyz) * scale.y) * focal / p.z;
  if (any(greaterThan(abs(focal * p.xy / p.z), 0.5 * size + 5.0 * max(s.x, max(s.y, s.z))))) return; // not in sight
  vec3 u = s * to_own_axes(q, R_world_camera * vec3(1, 0, -slope.x));
  vec3 v = s * to_own_axes(q, R_world_camera * vec3(0, 1, -slope.y)), n = cross(u, v);
  // Covariance of the footprint, px². Its determinant is a sum of positive terms: ca cc − cb² cancels on needles.
  float ca = dot(u, u) + low_pass, cc = dot(v, v) + low_pass, cb = dot(u, v);
  float det = dot(n, n) + low_pass * (ca + cc - low_pass);
  float larger = 0.5 * (ca + cc) + length(vec2(0.5 * (ca - cc), cb)), smaller = det / larger;
  vec2 along = ca > cc ? vec2(larger - cc, cb) : vec2(cb, larger - ca);
  along = dot(along, along) > 0.0 ? normalize(along) : vec2(1, 0);
  float opacity = float(high.w) / 255.0;
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  at = corner * sqrt(2.0 * log(255.0 * opacity) + 1e-4); // outside, alpha is below 1/255
  vec2 pixel = focal * p.xy / p.z + along * sqrt(larger) * at.x + vec2(-along.y, along.x) * sqrt(smaller) * at.y;
  gl_Position = vec4(pixel * vec2(2, -2) / size, 0, 1);
  colour = vec4(vec3(bytes(4).xyz) / 255.0, opacity);
  if (by_deviation) {
    float share = (deviation.x + float(fine.w) * deviation.y - legend.x) / (legend.y - legend.x);
    float place = 8.0 * clamp(share, 0.0, 0.999);
    colour.rgb = mix(palette[int(place)], palette[int(place) + 1], fract(place));
  }
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec2 at; in vec4 colour; out vec4 light;
void main() {
  float alpha = min(0.99, colour.a * exp(-0.5 * dot(at, at)));
  if (alpha < 1.0 / 255.0) discard;
  light = vec4(colour.rgb * alpha, alpha);
}`;

function makeRenderer(gl, splats) {
  const program = gl.createProgram(), place = (name) => gl.getUniformLocation(program, name);
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  const width = (SPLATS_PER_ROW * BYTES) / 4, height = splats.length / BYTES / SPLATS_PER_ROW;
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8UI, width, height, 0, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE, splats);
  gl.uniform3fv(place("low"), scene.low);
  gl.uniform1f(place("unit"), scene.step);
  gl.uniform2fv(place("scale"), scene.scale);
  gl.uniform2fv(place("deviation"), scene.std || [0, 0]);
  gl.uniform2fv(place("legend"), scene.legend.map(Math.log));
  gl.uniform3fv(place("palette"), scene.palette.flat().map((c) => c / 255));
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.enableVertexAttribArray(0); // the only attribute: the number of the splat
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(0, 1);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA); // far to near, light already times its alpha
  gl.clearColor(16 / 255, 18 / 255, 20 / 255, 1);
  let uploaded = null;
  return (order, pixelsPerCss) => {
    const focal = cam.focal * pixelsPerCss, shrunk = Math.min(1, focal / (scene.refined_fx || focal));
    gl.viewport(0, 0, view.width, view.height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniformMatrix3fv(place("R_world_camera"), false, axesOf(cam).flat());
    gl.uniform3fv(place("eye"), cam.eye);
    gl.uniform2f(place("size"), view.width, view.height);
    gl.uniform1f(place("focal"), focal);
    gl.uniform1f(place("low_pass"), 0.3 * shrunk * shrunk);
    gl.uniform1i(place("by_deviation"), pressed("colour"));
    if (order !== uploaded) gl.bufferData(gl.ARRAY_BUFFER, (uploaded = order), gl.STREAM_DRAW);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, order.length);
  };
}

// Runs in a worker: answers each viewing direction with the order of the first `count` splats, far to near.
function sortAsAsked() {
  let planes, n;
  onmessage = ({ data }) => {
    if (data.planes) return void ({ planes, n } = data);
    const { forward: [x, y, z], count } = data, keys = new Uint16Array(count), order = new Uint32Array(count);
    const nearest = 65535 * (Math.min(x, 0) + Math.min(y, 0) + Math.min(z, 0)); // of the cube's corners
    const starts = new Uint32Array(65537), step = 1 / (Math.abs(x) + Math.abs(y) + Math.abs(z));
    for (let i = 0; i < count; i++) {
      const high = x * planes[i] + y * planes[n + i] + z * planes[2 * n + i];
      const fine = x * planes[4 * n + i] + y * planes[5 * n + i] + z * planes[6 * n + i];
      keys[i] = 65535 - (256 * high + fine - nearest) * step;
      starts[keys[i] + 1]++;
    }
    for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
    for (let i = 0; i < count; i++) order[starts[keys[i]]++] = i;
    postMessage({ order, asked: data.asked }, [order.buffer]);
  };
}

// ---- The camera: eye, yaw (0 looks along −z), pitch, distance of the point looked at, focal length in CSS px ----

const cam = { eye: [0, 0, 0], yaw: 0, pitch: 0, distance: 2, focal: 500 };
const anglesOf = ([x, y, z]) => ({ yaw: Math.atan2(x, -z), pitch: Math.asin(clamp(y, -1, 1)) });
const poseOf = (T) => ({ eye: [T[3], T[7], T[11]], ...anglesOf([T[2], T[6], T[10]]) }); // level, whatever T's roll

function axesOf({ yaw, pitch }) {
  const forward = [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), -Math.cos(yaw) * Math.cos(pitch)];
  const right = [Math.cos(yaw), 0, Math.sin(yaw)];
  return [right, cross(forward, right), forward];
}

function place(changes) {
  Object.assign(cam, changes);
  cam.eye = cam.eye.map((x, k) => clamp(x, scene.bounds[0][k], scene.bounds[1][k]));
  changed = true;
}

function turned(pose, yaw, pitch) { // about the point looked at
  const after = { ...pose, yaw: pose.yaw + yaw, pitch: clamp(pose.pitch + pitch, -1.5, 1.5) };
  const center = add(pose.eye, axesOf(pose)[2], pose.distance);
  return { ...after, eye: add(center, axesOf(after)[2], -pose.distance) };
}

function project(point) {
  const [x, y, z] = axesOf(cam).map((axis) => dot(axis, add(point, cam.eye, -1)));
  return z < NEAR_M ? null : [innerWidth / 2 + (cam.focal * x) / z, innerHeight / 2 + (cam.focal * y) / z, z];
}

// The surface that a ray meets: where half of its light is absorbed. Each splat counts where it is densest on the ray.
function pick(x, y) {
  const [right, down, forward] = axesOf(cam), { focal, eye } = cam, found = [];
  const through = add(add(forward, right, (x - innerWidth / 2) / focal), down, (y - innerHeight / 2) / focal);
  const ray = through.map((k) => k / Math.sqrt(dot(through, through))), origin = add(scene.low, eye, -1);
  const sizes = Array.from({ length: 256 }, (_, byte) => Math.exp(scene.scale[0] + byte * scene.scale[1]));
  for (let i = 0, b = 0; i < shownCount(); i++, b += BYTES) {
    const to = [0, 1, 2].map((k) => origin[k] + (256 * splats[b + k] + splats[b + 4 + k]) * scene.step);
    const along = dot(to, ray), pixel = (0.55 * along) / focal; // the low-pass: no splat is drawn smaller
    const reach = 3.4 * Math.max(sizes[Math.max(splats[b + 8], splats[b + 9], splats[b + 10])], pixel);
    if (along < NEAR_M || dot(to, to) - along * along > reach * reach) continue;
    const o = [12, 13, 14].map((k) => (splats[b + k] / 127.5 - 1) * Math.SQRT1_2), q = [...o];
    q.splice(splats[b + 11], 0, Math.sqrt(Math.max(0, 1 - dot(o, o))));
    const whitened = (p) => { // in the splat's own axes, divided by its scales: there it is a unit sphere
      const [w, ...v] = q, t = cross(p, v), own = add(p, add(cross(t, v), t, w), 2);
      return own.map((value, k) => value / Math.max(sizes[splats[b + 8 + k]], pixel));
    };
    const m = whitened(to), r = whitened(ray), t = dot(m, r) / dot(r, r);
    const alpha = Math.min(0.99, (splats[b + 3] / 255) * Math.exp(-0.5 * (dot(m, m) - t * dot(m, r))));
    if (alpha > 1 / 255 && t > NEAR_M) found.push([t, alpha, splats[b + 7]]);
  }
  found.sort((a, b) => a[0] - b[0]);
  let light = 1, sum = 0;
  for (const [distance, alpha, byte] of found) {
    if (scene.std) sum += light * alpha * Math.exp(scene.std[0] + byte * scene.std[1]);
    light *= 1 - alpha;
    if (light < 0.5) return { point: add(eye, ray, distance), distance, std: scene.std && sum / (1 - light) };
  }
  return null;
}

// ---- Motion and hands ----

let splats, draw, sorter, order = new Uint32Array(0), sorted = "", sorting = false;
let flight = null, sway = null, changed = true, sharp = false, quality = 1, movedAt = 0, drawnAt = 0;
let ends = [], lastTap = { at: 0, x: 0, y: 0 }, began = null, wheeledAt = 0;
const held = new Set(), pointers = new Map();
const say = (text) => Object.assign(byId("hint"), { textContent: text, hidden: !text });
const wanted = () => `${axesOf(cam)[2]} ${shownCount()}`;

// A wide window shows the whole width of a keyframe's image, a tall one something between the image and a full window.
const fit = () => {
  const [x, y] = [innerWidth / scene.width, innerHeight / scene.height];
  place({ focal: scene.focal * Math.max(x, Math.sqrt(x * y)) });
};

function aim() { // turn about the surface in the middle, and come nearer to it
  const hit = pick(innerWidth / 2, innerHeight / 2);
  if (hit) cam.distance = clamp(hit.distance, 0.3, 20);
}

function touched() {
  sway = flight = null;
  if (!pressed("measure")) say("");
}

function fly(to) {
  sway = null;
  const yaw = cam.yaw + Math.atan2(Math.sin(to.yaw - cam.yaw), Math.cos(to.yaw - cam.yaw)); // the shorter way round
  flight = { from: { ...cam }, to: { ...cam, ...to, yaw }, began: performance.now() };
}

function step(now) {
  requestAnimationFrame(step);
  if (flight) {
    const t = clamp((now - flight.began) / FLIGHT_MS, 0, 1), k = t * t * (3 - 2 * t), { from, to } = flight;
    const between = (name) => from[name] + k * (to[name] - from[name]);
    const angles = { yaw: between("yaw"), pitch: between("pitch"), distance: between("distance") };
    place({ eye: add(from.eye, add(to.eye, from.eye, -1), k), ...angles });
    if (t === 1) flight = null;
  } else if (sway) {
    const phase = (2 * Math.PI * (now - sway.began)) / SWAY_MS;
    place(turned(sway.pose, SWAY_RAD * Math.sin(phase), 0.25 * SWAY_RAD * Math.sin(2 * phase)));
  } else if (held.size) {
    const [right, , forward] = axesOf(cam), is = (plus, minus) => held.has(plus) - held.has(minus);
    const way_m = (clamp(cam.distance, 0.4, 2) * Math.min(now - drawnAt, 100)) / 1000;
    const eye = add(cam.eye, right, way_m * is("KeyD", "KeyA"));
    place({ eye: add(eye, forward, way_m * is("KeyW", "KeyS")) });
  }
  if (changed) movedAt = now;
  const still = now - movedAt > 200;
  if (!changed && (sharp || !still)) return;
  // A slow device draws fewer pixels while it moves, and all of them when it stands still.
  const took = now - drawnAt, most = Math.min(devicePixelRatio, 2);
  if (!still && took < 1000) quality = clamp(quality * (took > 45 ? 0.85 : took < 22 ? 1.05 : 1), 0.35, 1);
  const scale = most * (still ? 1 : quality);
  const [width, height] = [innerWidth, innerHeight].map((side) => Math.round(side * scale));
  if (view.width !== width || view.height !== height) Object.assign(view, { width, height });
  [changed, sharp, drawnAt] = [false, still, now];
  if (!sorting && wanted() !== sorted) {
    sorting = true;
    sorter.postMessage({ forward: axesOf(cam)[2], count: shownCount(), asked: wanted() });
  }
  draw(order, width / innerWidth);
  drawOverlay(most);
}

const spoken = (m) => (m < 1 ? `${(100 * m).toFixed(1)} cm` : `${m.toFixed(2)} m`);

// The two ends err independently. In which direction is unknown, so each error counts in full along the line.
function measured([a, b]) {
  const way = add(a.point, b.point, -1), length = Math.sqrt(dot(way, way)), std = scene.std && Math.hypot(a.std, b.std);
  return spoken(length) + (std ? ` ± ${spoken(std)}` : "");
}

function drawOverlay(scale) {
  Object.assign(overlay, { width: innerWidth * scale, height: innerHeight * scale }); // clears it, too
  ink.scale(scale, scale);
  const mark = (line, dots, colour) => {
    const places = line.map(project);
    Object.assign(ink, { strokeStyle: colour, fillStyle: colour, lineWidth: 2 }).beginPath();
    places.forEach((p, i) => p && ink[i && places[i - 1] ? "lineTo" : "moveTo"](p[0], p[1]));
    ink.stroke();
    for (const p of dots.map(project).filter((p) => p)) {
      ink.beginPath();
      ink.arc(p[0], p[1], clamp(8 / p[2], 4, 8), 0, 7);
      ink.fill();
    }
  };
  if (pressed("path")) mark(scene.path, scene.keyframes.map((T) => poseOf(T).eye), "#ffa640");
  mark(ends.map((end) => end.point), ends.map((end) => end.point), "#7ab7ff");
}

function tap(x, y, at) {
  const twice = at - lastTap.at < TAP_MS && Math.hypot(x - lastTap.x, y - lastTap.y) < 30;
  lastTap = { at: twice ? 0 : at, x, y };
  changed = true;
  if (pressed("measure")) {
    const hit = pick(x, y);
    if (!hit) return say("No surface there. Tap another point.");
    ends = ends.length === 2 ? [hit] : [...ends, hit];
    return say(ends.length === 2 ? measured(ends) : "Tap the other end.");
  }
  const near = ({ eye }) => (([px, py]) => Math.hypot(px - x, py - y) < 18)(project(eye) || [NaN, NaN]);
  const keyframe = pressed("path") && scene.keyframes.map(poseOf).find(near);
  const hit = twice && !keyframe && pick(x, y);
  if (keyframe) fly(keyframe);
  if (!hit) return;
  const way = add(hit.point, cam.eye, -1), distance = Math.min(hit.distance / 2, 1.2); // half way, or to 1.2 m
  fly({ eye: add(hit.point, way, -distance / hit.distance), ...anglesOf(way.map((x) => x / hit.distance)), distance });
}

function zoom(by) { // above 1: nearer
  const way = cam.distance * (1 - 1 / by);
  place({ eye: add(cam.eye, axesOf(cam)[2], way), distance: Math.max(cam.distance - way, 0.15) });
}

function pan(dx, dy) {
  const [right, down] = axesOf(cam), k = -cam.distance / cam.focal;
  place({ eye: add(add(cam.eye, right, k * dx), down, k * dy) });
}

function drag(event) {
  const last = pointers.get(event.pointerId), here = { x: event.clientX, y: event.clientY };
  if (!last) return;
  began.moved ||= Math.hypot(here.x - began.x, here.y - began.y) > TAP_PX;
  if (!began.moved) return;
  pointers.set(event.pointerId, here);
  const dx = here.x - last.x, dy = here.y - last.y;
  if (pointers.size === 2) {
    const [, other] = [...pointers].find(([id]) => id !== event.pointerId);
    const apart = (p) => Math.max(Math.hypot(p.x - other.x, p.y - other.y), 1);
    zoom(apart(here) / apart(last));
    pan(dx / 2, dy / 2);
  } else if (event.buttons & 6 || event.shiftKey) pan(dx, dy);
  else place(turned(cam, dx * 0.005, -dy * 0.005));
}

function listen() {
  const on = (what, then, where = view) => where.addEventListener(what, then, { passive: false });
  on("contextmenu", (event) => event.preventDefault());
  on("pointerdown", (event) => {
    view.setPointerCapture(event.pointerId);
    const here = { x: event.clientX, y: event.clientY };
    began = { ...here, moved: pointers.size > 0 };
    pointers.set(event.pointerId, here);
    touched();
    aim();
  });
  on("pointermove", drag);
  on("pointercancel", (event) => pointers.delete(event.pointerId));
  on("pointerup", (event) => {
    const alone = pointers.size === 1 && event.button === 0;
    pointers.delete(event.pointerId);
    if (alone && !began.moved) tap(event.clientX, event.clientY, event.timeStamp);
  });
  on("wheel", (event) => {
    event.preventDefault();
    touched();
    if (event.timeStamp - wheeledAt > 300) aim();
    wheeledAt = event.timeStamp;
    zoom(Math.exp(-clamp(event.deltaY * (event.deltaMode ? 30 : 1), -200, 200) * 0.0015));
  });
  on("keydown", ({ code, ctrlKey, metaKey }) => {
    if (ctrlKey || metaKey || !/^Key[WASD]$/.test(code)) return;
    touched();
    held.add(code);
  }, window);
  on("keyup", ({ code }) => held.delete(code), window);
  on("blur", () => held.clear(), window);
  on("resize", fit, window);
  const toggle = (id, then) => on("click", () => {
    byId(id).setAttribute("aria-pressed", String(!pressed(id)));
    then(pressed(id));
    changed = true;
  }, byId(id));
  toggle("uncertain", () => {});
  toggle("colour", (on) => (byId("legend").hidden = !on));
  toggle("measure", (on) => {
    ends = [];
    say(on ? "Tap two points." : "");
  });
  toggle("path", (on) => {
    say(on ? "Tap a dot to look from there." : "");
    if (on) fly({ eye: add(cam.eye, axesOf(cam)[2], -2), yaw: cam.yaw }); // steps back, as the path is behind it
  });
  on("click", () => fly(poseOf(scene.keyframes[scene.start])), byId("back"));
}

async function unpack() {
  const packed = Uint8Array.from(atob(byId("splats").textContent), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip")), n = scene.count;
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  splats = new Uint8Array(Math.ceil(n / SPLATS_PER_ROW) * SPLATS_PER_ROW * BYTES);
  for (let k = 0; k < BYTES; k++) for (let i = 0; i < n; i++) splats[i * BYTES + k] = planes[k * n + i];
  return planes;
}

async function begin() {
  const gl = view.getContext("webgl2", { alpha: false, antialias: false, powerPreference: "high-performance" });
  if (!gl || !window.DecompressionStream) return say("This browser has no WebGL 2: it shows only this picture.");
  view.addEventListener("webglcontextlost", () => say("The browser took the memory back. Load the page again."));
  const planes = await unpack();
  draw = makeRenderer(gl, splats);
  sorter = new Worker(URL.createObjectURL(new Blob([`(${sortAsAsked})()`])));
  sorter.postMessage({ planes, n: scene.count });
  sorter.onmessage = ({ data }) => {
    ({ order, asked: sorted } = data);
    [sorting, changed] = [false, true];
    document.body.classList.add("ready");
  };
  const [low, high] = byId("legend").querySelectorAll("span");
  [low.textContent, high.textContent] = scene.legend.map(spoken);
  const colours = scene.palette.map((c) => `rgb(${c})`);
  byId("legend").querySelector("i").style.background = `linear-gradient(90deg, ${colours})`;
  byId("uncertain").hidden = scene.shown === scene.count;
  byId("colour").hidden = !scene.std;
  byId("buttons").hidden = false;
  const [come, go] = matchMedia("(pointer: coarse)").matches ? ["pinch", "tap twice"] : ["scroll", "double-click"];
  say(`Drag to look around, ${come} to come nearer, ${go} to go there.`);
  fit();
  place(poseOf(scene.keyframes[scene.start]));
  aim();
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) sway = { pose: { ...cam }, began: performance.now() };
  listen();
  requestAnimationFrame(step);
}

// For tests and for the curious. T: T_world_camera, 16 numbers by rows; its roll is left out.
window.sigmasplat = {
  scene, cam, axesOf, pick, project,
  ready: () => sharp && !changed && !flight && sorted === wanted(),
  setPose(T) {
    touched();
    place(poseOf(T));
  },
};
begin();
