// From where the model is seen, and drawing it from there.
const cssColor = name => { const h = getComputedStyle(document.documentElement).getPropertyValue(name).trim(); return [1, 3, 5].map(i => parseInt(h.slice(i, i + 2), 16) / 255); };
const eye = v => add(v.pivot, turn(v.q, [0, 0, 1]), v.distance);
function overview() {  // from the proposed side, as near as the bulk of the points and all cameras fit in
  const back = unit(model.viewFrom), right = unit(cross([0, 0, 1], back)), up = cross(back, right);
  const fov = 50 * Math.PI / 180, tall = Math.tan(fov / 2), wide = tall * Math.max(0.3, (canvas.clientWidth || 1) / (canvas.clientHeight || 1));
  const local = p => [dot(p, right) / wide, dot(p, up) / tall, dot(p, back)];
  const points = [], step = Math.max(1, Math.floor(model.count / 4000));
  for (let i = 0; i < model.count; i += step) points.push(local(model.positions.subarray(3 * i, 3 * i + 3)));
  const cameras = model.images.filter(c => c.pose).flatMap(c => [c.centre, ...corners(c)].map(local));
  const extent = (list, axis, distance, share) => {  // where most of the list is on the screen, along one axis
    const at = list.map(p => p[2] < distance ? p[axis] / (distance - p[2]) : (p[axis] < 0 ? -1e3 : 1e3)).sort((x, y) => x - y), cut = Math.floor(share * at.length);
    return at.length ? [at[cut], at[at.length - 1 - cut]] : [Infinity, -Infinity];
  };
  const box = distance => [0, 1].map(axis => {
    const a = extent(points, axis, distance, 0.08), b = extent(cameras, axis, distance, 0);
    return [Math.min(a[0], b[0]), Math.max(a[1], b[1])];
  });
  const reach = cameras.reduce((most, p) => Math.max(most, Math.hypot(...p)), model.radius);
  let near = 0.5 * model.radius, far = 20 * reach;
  for (let i = 0; i < 32; i++) {
    const distance = Math.sqrt(near * far);
    if (box(distance).every(([low, high]) => high - low < 1.7)) far = distance; else near = distance;
  }
  const offset = box(far).map(([low, high]) => low <= high ? -(low + high) / 2 : 0);
  return { pivot: [0, 0, 0], q: qaxes(right, up, back), distance: far, fov, offset };
}

// ---- drawing
function covered() {  // how much of the picture's height a sheet hides from below; the rest shows the middle
  return narrow.matches ? Math.max(details.offsetHeight, $("panel").offsetHeight) / canvas.clientHeight : 0;
}
function matrix(v) {  // world to clip; depth planes follow the distance
  const w = canvas.width, h = canvas.height, f = 1 / Math.tan(v.fov / 2), e = eye(v);
  const near = Math.max(v.distance, model.radius * 1e-3) * 0.01, far = near * 2e5;
  const x = turn(v.q, [1, 0, 0]), y = turn(v.q, [0, 1, 0]), z = turn(v.q, [0, 0, 1]);
  const rows = [[...scale(x, f * h / w), 0], [...scale(y, f), 0], [...scale(z, -(far + near) / (far - near)), 0], [...scale(z, -1), 0]];
  rows.forEach(r => { r[3] = -dot(r, e); });
  rows[0] = rows[0].map((value, i) => value + v.offset[0] * rows[3][i]);
  rows[1] = rows[1].map((value, i) => value + (v.offset[1] + covered()) * rows[3][i]);
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
function allFrusta(line, bad) {  // packed anew only when something about them changes
  const key = [line, set.frustum, looking, hovered].join();
  if (frusta.model != model || frusta.key != key) {
    const list = [];
    model.images.forEach((c, i) => { if (c.pose && i != looking && i != hovered) list.push(...frustumStrokes(c, [...(c.doubtful ? bad : line), 1])); });
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
const pictures = new Map();
function picture(c) {  // the photograph, decoded; null where the page holds none
  if (!c.photo) return Promise.resolve(null);
  if (!pictures.has(c.photo)) {
    const image = new Image();
    image.src = c.photo;
    pictures.set(c.photo, image.decode().then(() => image, () => null));
  }
  return pictures.get(c.photo);
}
const SMALL = 384;  // pixels along the longer side of a photograph at its camera
function photograph(c, full) {  // its texture, in full where it fills the screen; null as long as it is not there
  if (!c.photo) return null;
  c.textures ??= {};
  if (!(full in c.textures)) {
    c.textures[full] = null;
    picture(c).then(async image => {
      if (!image) return;
      const share = full ? 1 : Math.min(1, SMALL / Math.max(image.naturalWidth, image.naturalHeight));
      const [resizeWidth, resizeHeight] = [image.naturalWidth, image.naturalHeight].map(n => Math.max(1, Math.round(share * n)));
      const bitmap = await createImageBitmap(image, { resizeWidth, resizeHeight, resizeQuality: "high" });
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
      gl.generateMipmap(gl.TEXTURE_2D);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
      c.textures[full] = texture;
      draw();
    });
  }
  return c.textures[full] ?? c.textures[false] ?? null;
}
function drawPhotograph(c, m) {
  const texture = c.pose && photograph(c, model.images[looking] == c);
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
let wanted = false, painted = 0;
function draw() { if (!wanted) { wanted = true; requestAnimationFrame(paint); } }
function advance(now) {  // along the flight
  const s = Math.min(1, (now - flight.start) / 600), e = s * s * (3 - 2 * s), { from, to } = flight;
  const mix = (a, b) => a.map((v, i) => v * (1 - e) + b[i] * e);
  view = { q: qblend(from.q, to.q, e), distance: from.distance * (1 - e) + to.distance * e, fov: from.fov * (1 - e) + to.fov * e, offset: mix(from.offset, to.offset) };
  const at = mix(eye(from), eye(to));
  view.pivot = add(at, turn(view.q, [0, 0, 1]), -view.distance);
  if (s < 1) draw(); else flight = null;
}
function drawPoints(m, back, ratio) {
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
}
function drawCameras(m, line, accent) {
  drawStrokes(allFrusta(line, cssColor("--bad")), 0.6, m);
  const marked = new Set([hovered, chosen.camera, ...(chosen.pair ?? [])].filter(i => i >= 0 && i != looking && model.images[i].pose));
  for (const i of marked) drawStrokes(packStrokes(frustumStrokes(model.images[i], [...accent, 1])), 1.4, m);
  if (set.photos && looking < 0) for (const c of model.images) drawPhotograph(c, m);
}
function paint(now) {
  wanted = false;
  painted++;
  if (flight) advance(now);
  const ratio = devicePixelRatio || 1, w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
  if (canvas.width != w || canvas.height != h) { canvas.width = w; canvas.height = h; }
  const back = cssColor("--back"), accent = cssColor("--accent"), m = matrix(view);
  gl.viewport(0, 0, w, h);
  gl.clearColor(...back, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.disable(gl.DEPTH_TEST);
  if (set.photos && looking >= 0) drawPhotograph(model.images[looking], m);  // behind the points, to compare
  gl.enable(gl.DEPTH_TEST);
  if (set.points) drawPoints(m, back, ratio);
  for (const [kind, strokes] of Object.entries(model.strokes)) if (set[kind]) drawStrokes(strokes, 1.2, m);
  if (set.cameras) drawCameras(m, cssColor("--dim"), accent);
  const point = pointed >= 0 ? pointed : chosen.point;
  if (point >= 0) drawStrokes(packStrokes(observationsOf(point).filter(o => o.image.pose).map(o => [positionOf(point), o.image.centre, [...accent, 1]])), 0.6, m);
  drawOverlay(m, ratio);
}
