"use strict";
const $ = id => document.getElementById(id);
const data = JSON.parse($("data").textContent);
const canvas = $("view"), tip = $("tip");
const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
if (!gl) { $("fail").style.display = "block"; throw new Error("no WebGL 2"); }

// ---- small algebra: vectors are arrays of 3, quaternions (x, y, z, w), matrices column-major as WebGL wants them
const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const unit = a => scale(a, 1 / (Math.hypot(...a) || 1));
const turn = (q, v) => { const t = scale(cross(q, v), 2); return add(add(v, t, q[3]), cross(q, t)); };
const qmul = (a, b) => [...add(add(scale(b, a[3]), a, b[3]), cross(a, b)), a[3] * b[3] - dot(a, b)];
const qaxis = (axis, angle) => [...scale(axis, Math.sin(angle / 2)), Math.cos(angle / 2)];
const qunit = q => { const n = Math.hypot(...q) || 1; return q.map(v => v / n); };
function qaxes(x, y, z) {  // the rotation whose columns are x, y, z
  const w = 1 + x[0] + y[1] + z[2];
  if (w > 0.1) return qunit([y[2] - z[1], z[0] - x[2], x[1] - y[0], w]);
  if (x[0] >= y[1] && x[0] >= z[2]) return qunit([1 + x[0] - y[1] - z[2], x[1] + y[0], z[0] + x[2], y[2] - z[1]]);
  if (y[1] >= z[2]) return qunit([x[1] + y[0], 1 - x[0] + y[1] - z[2], y[2] + z[1], z[0] - x[2]]);
  return qunit([z[0] + x[2], y[2] + z[1], 1 - x[0] - y[1] + z[2], x[1] - y[0]]);
}
function qblend(a, b, s) {
  if (a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] < 0) b = b.map(v => -v);
  return qunit(a.map((v, i) => v * (1 - s) + b[i] * s));
}

// ---- programs
function program(vertex, fragment) {
  const p = gl.createProgram();
  for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, "#version 300 es\nprecision highp float;\n" + text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(p, shader);
  }
  gl.linkProgram(p);
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(p, gl.ACTIVE_UNIFORMS); i++) {
    const name = gl.getActiveUniform(p, i).name;
    uniforms[name] = gl.getUniformLocation(p, name);
  }
  return { p, ...uniforms };
}
const dots = program(`
layout(location=0) in vec3 position; layout(location=1) in vec3 color; layout(location=2) in float track; layout(location=3) in float error; layout(location=4) in float mark;
uniform mat4 view; uniform float size, reference, minTrack, maxError, dimming; uniform int mode; uniform vec4 range; uniform vec3 back;
out vec3 shade;
vec3 turbo(float x) {  // Mikhailov's polynomial for the Turbo colour map
  x = clamp(x, 0., 1.);
  vec4 a = vec4(1., x, x * x, x * x * x); vec2 b = a.zw * a.z;
  return vec3(dot(a, vec4(.13572138, 4.61539260, -42.66032258, 132.13108234)) + dot(b, vec2(-152.94239396, 59.28637943)),
              dot(a, vec4(.09140261, 2.19418839, 4.84296658, -14.18503333)) + dot(b, vec2(4.27729857, 2.82956604)),
              dot(a, vec4(.10667330, 12.64194608, -60.58204836, 110.36276771)) + dot(b, vec2(-89.90310912, 27.34824973)));
}
void main() {
  gl_Position = view * vec4(position, 1.);
  if (track < minTrack || error > maxError) gl_Position = vec4(2., 2., 2., 1.);
  gl_PointSize = clamp(size * clamp(reference / gl_Position.w, .7, 3.), 1., 60.);
  shade = mode == 0 ? color : mode == 1 ? turbo((track - range.x) / (range.y - range.x)) : turbo((error - range.z) / (range.w - range.z));
  if (dimming > 0.) { if (mark > 0.) gl_PointSize *= 1.4; else shade = mix(shade, back, dimming); }
}`, `
in vec3 shade; out vec4 result;
void main() { vec2 c = gl_PointCoord - .5; if (dot(c, c) > .25) discard; result = vec4(shade, 1.); }`);
const strokes = program(`
layout(location=0) in vec3 start; layout(location=1) in vec3 end; layout(location=2) in vec4 color;
uniform mat4 view; uniform vec2 pixels; uniform float width;
out vec4 shade;
void main() {
  vec4 a = view * vec4(start, 1.), b = view * vec4(end, 1.);
  float near = 1e-5 * max(abs(a.w), abs(b.w));
  if (a.w < near) a = mix(a, b, (near - a.w) / (b.w - a.w)); else if (b.w < near) b = mix(b, a, (near - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) * pixels; float n = length(along);
  vec2 side = n > 0. ? vec2(-along.y, along.x) / n : vec2(0.);
  vec4 p = gl_VertexID % 2 == 0 ? a : b;
  p.xy += side * (gl_VertexID < 2 ? width : -width) / pixels * p.w;
  gl_Position = a.w < near && b.w < near ? vec4(2., 2., 2., 1.) : p;
  shade = color;
}`, `in vec4 shade; out vec4 result; void main() { result = shade; }`);
const sheets = program(`
layout(location=0) in vec3 position; uniform mat4 view; out vec2 uv;
void main() { gl_Position = view * vec4(position, 1.); uv = vec2(gl_VertexID % 2, gl_VertexID / 2); }`, `
in vec2 uv; uniform sampler2D photo; out vec4 result;
void main() { result = vec4(texture(photo, uv).rgb, 1.); }`);

function attribute(location, array, size, type, normalized = false, divisor = 0) {
  const buffer = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, array, gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(location);
  gl.vertexAttribPointer(location, size, type, normalized, 0, 0);
  gl.vertexAttribDivisor(location, divisor);
  return buffer;
}
function unpack(text, Type) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return new Type(bytes.buffer);
}

// ---- the model shown, and how
let model = null, view = null, home = null, flight = null, looking = -1, hovered = -1, pointed = -1, wanted = false;
const set = { mode: 0, size: 2.5, track: 2, error: Infinity, frustum: 1, photos: false, lines: true };
const cssColor = name => { const h = getComputedStyle(document.documentElement).getPropertyValue(name).trim(); return [1, 3, 5].map(i => parseInt(h.slice(i, i + 2), 16) / 255); };
const eye = v => add(v.pivot, turn(v.q, [0, 0, 1]), v.distance);

function load(index) {
  const source = data.models[index];
  if (!source.ready) {
    const m = source.ready = { ...source };
    m.positions = unpack(source.positions, Float32Array);
    m.colors = unpack(source.colors, Uint8Array);
    const Index = source.large ? Uint32Array : Uint16Array;
    m.tracks = unpack(source.tracks, Index);
    m.errors = unpack(source.errors, Float32Array);
    m.views = unpack(source.views, Index);
    m.count = m.tracks.length;
    m.first = new Uint32Array(m.count + 1);
    for (let i = 0; i < m.count; i++) m.first[i + 1] = m.first[i] + m.tracks[i];
    m.vao = gl.createVertexArray();
    gl.bindVertexArray(m.vao);
    attribute(0, m.positions, 3, gl.FLOAT);
    attribute(1, m.colors, 3, gl.UNSIGNED_BYTE, true);
    attribute(2, m.tracks, 1, source.large ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT);
    attribute(3, m.errors, 1, gl.FLOAT);
    m.marks = attribute(4, new Uint8Array(m.count), 1, gl.UNSIGNED_BYTE);
    const ends = unpack(source.lineEnds, Float32Array), shades = unpack(source.lineColors, Uint8Array), count = ends.length / 6;
    m.lines = { count, arrays: [new Float32Array(3 * count), new Float32Array(3 * count), new Float32Array(4 * count).fill(1)] };
    for (let i = 0; i < count; i++) for (let k = 0; k < 3; k++) {
      m.lines.arrays[0][3 * i + k] = ends[6 * i + k];
      m.lines.arrays[1][3 * i + k] = ends[6 * i + 3 + k];
      m.lines.arrays[2][4 * i + k] = shades[3 * i + k] / 255;
    }
    for (const c of m.images) if (c.pose) {
      c.axes = [c.pose.slice(3, 6), c.pose.slice(6, 9), c.pose.slice(9, 12)];
      c.centre = c.pose.slice(0, 3);
    }
  }
  model = source.ready;
  looking = hovered = pointed = -1;
  flight = null;
  tip.style.display = $("through").style.display = "none";
  $("summary").textContent = model.summary;
  $("lines").style.display = model.lines.count ? "" : "none";
  const [low, high] = model.trackRange, [, worst] = model.errorRange;
  set.size = Math.round(4 * Math.min(4, Math.max(1.5, 2.75 * Math.pow(3e4 / Math.max(model.count, 1), 0.2)))) / 4;
  $("size").value = set.size;
  $("track").min = low; $("track").max = high; $("track").value = set.track = low;
  $("error").max = Math.max(worst, 0.02); $("error").step = Math.max(worst, 0.02) / 50; $("error").min = Math.max(worst, 0.02) / 50;
  $("error").value = $("error").max; set.error = Infinity;
  home = overview();
  view = { ...home };
  fillTable();
  refreshControls();
  mark(-1);
  draw();
}
function overview() {  // from the proposed side, as near as the bulk of the points and the cameras fit in
  const back = unit(model.viewFrom), right = unit(cross([0, 0, 1], back)), up = cross(back, right);
  const fov = 50 * Math.PI / 180, tall = Math.tan(fov / 2), wide = tall * Math.max(0.3, (canvas.clientWidth || 1) / (canvas.clientHeight || 1));
  const local = p => [dot(p, right) / wide, dot(p, up) / tall, dot(p, back)];
  const points = [], step = Math.max(1, Math.floor(model.count / 4000));
  for (let i = 0; i < model.count; i += step) points.push(local(model.positions.subarray(3 * i, 3 * i + 3)));
  const cameras = model.images.filter(c => c.pose && Math.hypot(...c.centre) < 6 * model.radius).map(c => local(c.centre));
  const extent = (list, axis, distance, share) => {  // where most of the list is on the screen, along one axis
    const at = list.map(p => p[2] < distance ? p[axis] / (distance - p[2]) : Math.sign(p[axis]) * 1e3).sort((x, y) => x - y), cut = Math.floor(share * at.length);
    return at.length ? [at[cut], at[at.length - 1 - cut]] : [Infinity, -Infinity];
  };
  const box = distance => [0, 1].map(axis => {
    const a = extent(points, axis, distance, 0.08), b = extent(cameras, axis, distance, 0.02);
    return [Math.min(a[0], b[0]), Math.max(a[1], b[1])];
  });
  let near = 0.5 * model.radius, far = 20 * model.radius;
  for (let i = 0; i < 24; i++) {
    const distance = Math.sqrt(near * far);
    if (box(distance).every(([low, high]) => high - low < 1.7)) far = distance; else near = distance;
  }
  const offset = box(far).map(([low, high]) => low <= high ? -(low + high) / 2 : 0);
  return { pivot: [0, 0, 0], q: qaxes(right, up, back), distance: far, fov, offset };
}

// ---- drawing
function matrix(v) {  // world to clip; depth planes follow the distance
  const w = canvas.width, h = canvas.height, f = 1 / Math.tan(v.fov / 2), e = eye(v);
  const near = Math.max(v.distance, model.radius * 1e-3) * 0.01, far = near * 2e5;
  const x = turn(v.q, [1, 0, 0]), y = turn(v.q, [0, 1, 0]), z = turn(v.q, [0, 0, 1]);
  const rows = [[...scale(x, f * h / w), 0], [...scale(y, f), 0], [...scale(z, -(far + near) / (far - near)), 0], [...scale(z, -1), 0]];
  rows.forEach(r => { r[3] = -dot(r, e); });
  rows[0] = rows[0].map((value, i) => value + v.offset[0] * rows[3][i]);
  rows[1] = rows[1].map((value, i) => value + v.offset[1] * rows[3][i]);
  rows[2][3] -= 2 * far * near / (far - near);
  return new Float32Array([0, 1, 2, 3].flatMap(c => rows.map(r => r[c])));
}
function corners(c) {
  const s = Math.max(set.frustum, 0.05) * model.frustum;
  return c.corners.map(([u, v]) => add(add(add(c.centre, c.axes[0], u * s), c.axes[1], v * s), c.axes[2], s));
}
const strokeArray = gl.createVertexArray(); gl.bindVertexArray(strokeArray);
const strokeBuffers = [0, 1, 2].map(i => attribute(i, new Float32Array(4), i == 2 ? 4 : 3, gl.FLOAT, false, 1));
const sheetArray = gl.createVertexArray(); gl.bindVertexArray(sheetArray);
const sheetBuffer = attribute(0, new Float32Array(12), 3, gl.FLOAT);
const packStrokes = list => ({ count: list.length, arrays: [0, 1, 2].map(i => new Float32Array(list.flatMap(s => s[i]))) });
let frusta = { key: "" };
function allFrusta(line) {  // packed anew only when something about them changes
  const key = [line, set.frustum, looking, hovered].join();
  if (frusta.model != model || frusta.key != key) {
    const list = [];
    model.images.forEach((c, i) => { if (c.pose && i != looking && i != hovered) list.push(...frustumStrokes(c, [...line, 1])); });
    frusta = { model, key, ...packStrokes(list) };
  }
  return frusta;
}
function drawStrokes({ count, arrays }, width, m) {
  if (!count) return;
  gl.useProgram(strokes.p);
  gl.bindVertexArray(strokeArray);
  [0, 1, 2].forEach(i => { gl.bindBuffer(gl.ARRAY_BUFFER, strokeBuffers[i]); gl.bufferData(gl.ARRAY_BUFFER, arrays[i], gl.DYNAMIC_DRAW); });
  gl.uniformMatrix4fv(strokes.view, false, m);
  gl.uniform2f(strokes.pixels, canvas.width, canvas.height);
  gl.uniform1f(strokes.width, width * (devicePixelRatio || 1));
  gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
}
function frustumStrokes(c, color) {
  const k = corners(c), s = [];
  for (let i = 0; i < 4; i++) s.push([c.centre, k[i], color], [k[i], k[(i + 1) % 4], color]);
  const top = scale(add(k[0], k[1]), 0.5), tick = scale(add(k[0], k[3], -1), 0.18);  // a peak on the upper edge
  s.push([add(top, add(k[1], k[0], -1), -0.16), add(top, tick), color], [add(top, add(k[1], k[0], -1), 0.16), add(top, tick), color]);
  return s;
}
function photograph(c) {
  if (c.photo && !c.texture) {
    c.texture = gl.createTexture();
    const image = new Image();
    image.onload = () => {
      gl.bindTexture(gl.TEXTURE_2D, c.texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
      gl.generateMipmap(gl.TEXTURE_2D);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
      c.loaded = true;
      draw();
    };
    image.src = c.photo;
  }
  return c.loaded ? c.texture : null;
}
function drawPhotograph(c, m) {
  const texture = c.pose && photograph(c);
  if (!texture) return;
  const k = corners(c);
  gl.useProgram(sheets.p);
  gl.bindVertexArray(sheetArray);
  gl.bindBuffer(gl.ARRAY_BUFFER, sheetBuffer);
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([k[0], k[1], k[3], k[2]].flat()), gl.DYNAMIC_DRAW);
  gl.uniformMatrix4fv(sheets.view, false, m);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
}
function draw() { if (!wanted) { wanted = true; requestAnimationFrame(paint); } }
function paint(now) {
  wanted = false;
  if (flight) {
    const s = Math.min(1, (now - flight.start) / 600), e = s * s * (3 - 2 * s), { from, to } = flight;
    const mix = (a, b) => a.map((v, i) => v * (1 - e) + b[i] * e);
    view = { q: qblend(from.q, to.q, e), distance: from.distance * (1 - e) + to.distance * e, fov: from.fov * (1 - e) + to.fov * e, offset: mix(from.offset, to.offset) };
    const at = mix(eye(from), eye(to));
    view.pivot = add(at, turn(view.q, [0, 0, 1]), -view.distance);
    if (s < 1) draw(); else flight = null;
  }
  const ratio = devicePixelRatio || 1, w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
  if (canvas.width != w || canvas.height != h) { canvas.width = w; canvas.height = h; }
  const back = cssColor("--back"), accent = cssColor("--accent"), line = cssColor("--dim"), m = matrix(view);
  gl.viewport(0, 0, w, h);
  gl.clearColor(...back, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.disable(gl.DEPTH_TEST);
  if (set.photos && looking >= 0) drawPhotograph(model.images[looking], m);  // behind the points, to compare
  gl.enable(gl.DEPTH_TEST);
  gl.useProgram(dots.p);
  gl.bindVertexArray(model.vao);
  gl.uniformMatrix4fv(dots.view, false, m);
  gl.uniform1f(dots.size, set.size * ratio);
  gl.uniform1f(dots.reference, looking >= 0 ? 1.2 * view.distance : home.distance);
  gl.uniform1f(dots.minTrack, set.track);
  gl.uniform1f(dots.maxError, Math.min(set.error, 3e38));
  gl.uniform1f(dots.dimming, hovered >= 0 ? 0.75 : 0);
  gl.uniform1i(dots.mode, set.mode);
  gl.uniform4f(dots.range, ...model.trackRange, ...model.errorRange);
  gl.uniform3f(dots.back, ...back);
  gl.drawArrays(gl.POINTS, 0, model.count);
  if (set.lines) drawStrokes(model.lines, 1.2, m);
  if (set.frustum > 0) {
    drawStrokes(allFrusta(line), 0.6, m);
    if (hovered >= 0 && hovered != looking) drawStrokes(packStrokes(frustumStrokes(model.images[hovered], [...accent, 1])), 1.4, m);
  }
  if (pointed >= 0) {
    const p = Array.from(model.positions.subarray(3 * pointed, 3 * pointed + 3)), list = [];
    for (let k = model.first[pointed]; k < model.first[pointed + 1]; k++) list.push([p, model.images[model.views[k]].centre, [...accent, 1]]);
    drawStrokes(packStrokes(list), 0.6, m);
  }
  if (set.photos && set.frustum > 0 && looking < 0) for (const c of model.images) drawPhotograph(c, m);
}

// ---- what is under the pointer
function projector() {
  const m = matrix(view), w = canvas.clientWidth, h = canvas.clientHeight;
  return (x, y, z) => {
    const d = m[3] * x + m[7] * y + m[11] * z + m[15];
    return d <= 0 ? null : [(1 + (m[0] * x + m[4] * y + m[8] * z + m[12]) / d) * w / 2, (1 - (m[1] * x + m[5] * y + m[9] * z + m[13]) / d) * h / 2, d];
  };
}
function cameraAt(px, py) {
  if (set.frustum <= 0) return -1;
  const project = projector();
  let best = -1, nearest = 14;
  model.images.forEach((c, i) => {
    if (!c.pose || i == looking) return;
    const k = corners(c), middle = scale(add(add(k[0], k[1]), add(k[2], k[3])), 0.25);
    for (const p of [c.centre, middle]) {
      const at = project(...p);
      const far = at ? Math.hypot(at[0] - px, at[1] - py) : Infinity;
      if (far < nearest) { nearest = far; best = i; }
    }
  });
  return best;
}
function pointAt(px, py, reach = 7) {
  const m = matrix(view), w = canvas.clientWidth / 2, h = canvas.clientHeight / 2, P = model.positions;
  let best = -1, score = Infinity;
  for (let i = 0, k = 0; i < model.count; i++, k += 3) {
    const x = P[k], y = P[k + 1], z = P[k + 2], d = m[3] * x + m[7] * y + m[11] * z + m[15];
    if (d <= 0 || model.tracks[i] < set.track || model.errors[i] > set.error) continue;
    const dx = (1 + (m[0] * x + m[4] * y + m[8] * z + m[12]) / d) * w - px;
    if (dx > reach || dx < -reach) continue;
    const dy = (1 - (m[1] * x + m[5] * y + m[9] * z + m[13]) / d) * h - py;
    const r = dx * dx + dy * dy;
    if (r > reach * reach) continue;
    const value = d * (1 + 0.05 * r);  // in front first, then close to the pointer
    if (value < score) { score = value; best = i; }
  }
  return best;
}
function mark(index) {
  const marks = new Uint8Array(model.count);
  if (index >= 0) for (let i = 0; i < model.count; i++) for (let k = model.first[i]; k < model.first[i + 1]; k++) if (model.views[k] == index) marks[i] = 1;
  gl.bindBuffer(gl.ARRAY_BUFFER, model.marks);
  gl.bufferSubData(gl.ARRAY_BUFFER, 0, marks);
}
function hover(camera, point) {
  if (camera == hovered && point == pointed) return;
  if (camera != hovered) {
    hovered = camera;
    mark(camera);
    for (const row of $("list").querySelectorAll("tbody tr")) row.classList.toggle("on", +row.dataset.index == camera);
  }
  pointed = point;
  canvas.classList.toggle("pointing", camera >= 0);
  draw();
}
const brief = v => v < 10 ? v.toFixed(2) : v < 1e4 ? v.toFixed(0) : v.toExponential(0);
const px = v => brief(v) + " px";
function showTip(x, y) {
  tip.replaceChildren();
  if (hovered >= 0) {
    const c = model.images[hovered];
    const name = document.createElement("b");
    name.textContent = c.name;
    tip.append(name, `\n${c.points.toLocaleString("en")} points, mean error ${px(c.mean)}\nfocal length ${c.focal.toFixed(1)} ${c.focalDeviation ? `± ${c.focalDeviation} ` : ""}px`, ...(c.doubts ?? []).map(text => `\n${text}`));
    if (c.photo) { const image = new Image(); image.src = c.photo; tip.append(image); }
  } else if (pointed >= 0) {
    const views = Array.from(model.views.subarray(model.first[pointed], model.first[pointed + 1])), names = views.slice(0, 8).map(i => model.images[i].name);
    tip.append(`point ${pointed}: ${views.length} images, mean error ${px(model.errors[pointed])}\n`);
    const list = document.createElement("span");
    list.className = "dim";
    list.textContent = names.join(", ") + (views.length > 8 ? ", ..." : "");
    tip.append(list);
  }
  tip.style.display = tip.childNodes.length ? "block" : "none";
  tip.style.left = Math.min(x + 16, canvas.clientWidth - tip.offsetWidth - 8) + "px";
  tip.style.top = Math.min(y + 14, canvas.clientHeight - tip.offsetHeight - 8) + "px";
}

// ---- moving about
function flyTo(to) { flight = { from: { ...view }, to, start: performance.now() }; draw(); }
function lookThrough(index) {
  const c = model.images[index];
  if (!c.pose) return;
  const back = scale(c.axes[2], -1), u = c.corners.map(k => k[0]), v = c.corners.map(k => k[1]);
  const wide = Math.max(...u) - Math.min(...u), tall = Math.max(...v) - Math.min(...v), aspect = canvas.clientWidth / canvas.clientHeight;
  const half = Math.max(tall, wide / aspect) / 2 * 1.02;
  const offset = [(Math.max(...u) + Math.min(...u)) / 2 / half / aspect, -(Math.max(...v) + Math.min(...v)) / 2 / half].map(x => -x);
  looking = index;
  hover(-1, -1);
  tip.style.display = "none";
  $("through").style.display = "flex";
  $("through").firstElementChild.textContent = c.name;
  flyTo({ pivot: add(c.centre, back, -c.depth), q: qaxes(c.axes[0], scale(c.axes[1], -1), back), distance: c.depth, fov: 2 * Math.atan(half), offset });
}
function leave(goHome) {
  looking = -1;
  $("through").style.display = "none";
  if (goHome) { home = overview(); flyTo(home); }
  draw();
}
const fingers = new Map();
let last = null, moved = 0;
function gesture() {
  const p = [...fingers.values()], x = p.reduce((s, f) => s + f.x, 0) / p.length, y = p.reduce((s, f) => s + f.y, 0) / p.length;
  return { x, y, spread: p.length > 1 ? Math.hypot(p[0].x - p[1].x, p[0].y - p[1].y) : 0 };
}
const place = event => { const box = canvas.getBoundingClientRect(); return { x: event.clientX - box.left, y: event.clientY - box.top }; };
function freeView() {  // leave a camera's place without a jump; its angle of view stays until the next overview
  if (looking >= 0) leave(false);
  flight = null;
}
function zoom(factor) {
  freeView();
  view.distance = Math.min(Math.max(view.distance * factor, model.radius * 1e-3), model.radius * 300);
  draw();
}
canvas.addEventListener("pointerdown", event => {
  canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, place(event));
  last = gesture();
  moved = fingers.size > 1 ? 99 : 0;
  canvas.focus();
});
canvas.addEventListener("pointermove", event => {
  const at = place(event);
  if (!fingers.size) {
    const camera = cameraAt(at.x, at.y);
    hover(camera, camera >= 0 ? -1 : pointAt(at.x, at.y));
    showTip(at.x, at.y);
    return;
  }
  if (!fingers.has(event.pointerId)) return;
  fingers.set(event.pointerId, at);
  const now = gesture(), dx = now.x - last.x, dy = now.y - last.y;
  moved += Math.abs(dx) + Math.abs(dy) + Math.abs(now.spread - last.spread);
  if (moved > 4) {
    freeView();
    tip.style.display = "none";
    hover(-1, -1);
    canvas.classList.add("dragging");
    if (fingers.size > 1 || event.buttons == 2 || event.buttons == 4 || event.shiftKey) {
      const step = 2 * Math.tan(view.fov / 2) * view.distance / canvas.clientHeight;
      view.pivot = add(add(view.pivot, turn(view.q, [1, 0, 0]), -dx * step), turn(view.q, [0, 1, 0]), dy * step);
      if (now.spread && last.spread) zoom(last.spread / now.spread);
    } else {
      const right = turn(view.q, [1, 0, 0]), tall = canvas.clientHeight;
      view.q = qunit(qmul(qaxis([0, 0, 1], -dx / tall * 4), qmul(qaxis(right, -dy / tall * 4), view.q)));
    }
    draw();
  }
  last = now;
});
function lift(event) {
  const at = fingers.get(event.pointerId);
  fingers.delete(event.pointerId);
  canvas.classList.remove("dragging");
  if (fingers.size) { last = gesture(); return; }
  if (at && moved <= 4 && event.type == "pointerup" && event.button == 0) {
    const camera = cameraAt(at.x, at.y);
    if (camera >= 0) lookThrough(camera);
  }
}
canvas.addEventListener("pointerup", lift);
canvas.addEventListener("pointercancel", lift);
canvas.addEventListener("pointerleave", () => { if (!fingers.size) { hover(-1, -1); tip.style.display = "none"; } });
canvas.addEventListener("contextmenu", event => event.preventDefault());
canvas.addEventListener("wheel", event => { event.preventDefault(); zoom(Math.exp(Math.max(-80, Math.min(80, event.deltaY * (event.deltaMode ? 30 : 1))) * 0.002)); }, { passive: false });
canvas.addEventListener("dblclick", event => {
  const at = place(event), point = pointAt(at.x, at.y, 16);
  if (point < 0) return;
  const pivot = Array.from(model.positions.subarray(3 * point, 3 * point + 3));
  leave(false);
  flyTo({ ...view, pivot, distance: Math.max(view.distance * 0.6, model.radius * 0.02), offset: [0, 0], fov: home.fov });
});
addEventListener("keydown", event => {
  if (event.target.tagName == "INPUT" || event.target.tagName == "SELECT") return;
  if (event.key == "Escape" || event.key == "r" || event.key == "R") leave(true);
  const order = model.images.map((c, i) => i).filter(i => model.images[i].pose);
  if (looking >= 0 && order.length && (event.key == "ArrowRight" || event.key == "ArrowLeft")) {
    lookThrough(order[(order.indexOf(looking) + (event.key == "ArrowRight" ? 1 : order.length - 1)) % order.length]);
  }
});

// ---- the panel
let sortKey = null, sortSign = 1;
function fillTable() {
  const body = $("list").querySelector("tbody"), order = model.images.map((c, i) => i);
  if (sortKey) order.sort((a, b) => { const x = model.images[a][sortKey], y = model.images[b][sortKey]; return sortSign * (x < y ? -1 : x > y ? 1 : a - b); });
  body.replaceChildren(...order.map(i => {
    const c = model.images[i], row = document.createElement("tr"), name = document.createElement("td"), plain = document.createElement("bdi");
    row.dataset.index = i;
    plain.textContent = name.title = c.name;
    if (c.standing) name.title += "\n" + c.standing;
    if (c.doubtful) row.className = "doubtful";
    name.append(plain);
    row.append(name);
    if (c.pose) {
      for (const text of [c.points.toLocaleString("en"), brief(c.mean), brief(c.high)]) { const cell = document.createElement("td"); cell.textContent = text; row.append(cell); }
      row.onclick = () => lookThrough(i);
      row.onmouseenter = () => hover(i, -1);
      row.onmouseleave = () => hover(-1, -1);
    } else {
      const why = document.createElement("td");
      why.colSpan = 3; why.className = "why"; why.textContent = c.status;
      row.className = "out";
      row.append(why);
    }
    return row;
  }));
}
for (const head of $("list").querySelectorAll("th")) head.onclick = () => {
  sortSign = sortKey == head.dataset.key ? -sortSign : head.dataset.key == "name" ? 1 : -1;
  sortKey = head.dataset.key;
  fillTable();
};
function refreshControls() {
  const show = (id, text) => { $(id).parentElement.querySelector("output").textContent = text; };
  show("size", set.size.toFixed(1));
  show("track", set.track);
  show("error", isFinite(set.error) ? set.error.toPrecision(2) + " px" : "all");
  show("frustum", set.frustum.toFixed(1));
  const ranges = [null, model.trackRange.map(v => v + " images"), model.errorRange.map(px)][set.mode], legend = $("legend");
  legend.style.display = ranges ? "grid" : "none";
  if (ranges) { legend.firstElementChild.textContent = ranges[0]; legend.lastElementChild.textContent = ranges[1]; }
}
const listen = (id, change) => { $(id).oninput = () => { change($(id)); refreshControls(); draw(); }; };
listen("mode", e => { set.mode = +e.value; });
listen("size", e => { set.size = +e.value; });
listen("track", e => { set.track = +e.value; });
listen("error", e => { set.error = +e.value >= +e.max ? Infinity : +e.value; });
listen("frustum", e => { set.frustum = +e.value; });
$("model").onchange = () => load(+$("model").value);
$("reset").onclick = () => leave(true);
$("leave").onclick = () => leave(true);
$("photos").onclick = () => { set.photos = !set.photos; $("photos").setAttribute("aria-pressed", set.photos); draw(); };
$("lines").onclick = () => { set.lines = !set.lines; $("lines").setAttribute("aria-pressed", set.lines); draw(); };
$("theme").onclick = () => { const root = document.documentElement; root.dataset.theme = root.dataset.theme == "dark" ? "light" : "dark"; draw(); };
$("bare").onclick = () => { document.body.classList.toggle("bare"); draw(); };
$("picture").onclick = () => {
  paint(performance.now());
  canvas.toBlob(blob => { const a = document.createElement("a"); a.href = URL.createObjectURL(blob); a.download = "reconstruction.png"; a.click(); setTimeout(() => URL.revokeObjectURL(a.href), 10000); });
};
canvas.addEventListener("webglcontextlost", event => event.preventDefault());
canvas.addEventListener("webglcontextrestored", () => location.reload());
new ResizeObserver(draw).observe(canvas);
document.querySelector("h1").textContent = data.title;
data.models.forEach((m, i) => { const option = document.createElement("option"); option.value = i; option.textContent = m.label; $("model").append(option); });
$("modelrow").style.display = data.models.length > 1 ? "grid" : "none";
$("photos").style.display = data.models.some(m => m.images.some(c => c.photo)) ? "" : "none";
load(0);
