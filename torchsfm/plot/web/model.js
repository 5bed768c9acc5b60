// The model shown and how it is shown: unpacked from the page once, its points kept on the graphics card.
const data = JSON.parse($("data").textContent);
let model = null, view = null, home = null, flight = null;
let looking = -1, hovered = -1, pointed = -1;  // the camera looked through, the camera and the point under the pointer
const chosen = { camera: -1, point: -1, pair: null };  // what the details are about
const set = { mode: 0, size: 2.5, track: 2, error: Infinity, frustum: 1, points: true, cameras: true, photos: true, axes: true, lines: true, ellipses: true, curves: true };

function unpack(text, Type) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return new Type(bytes.buffer);
}
function unpackStrokes(source) {  // by kind, in the order of the counts
  const ends = unpack(source.lineEnds, Float32Array), shades = unpack(source.lineColors, Uint8Array), kinds = {};
  let first = 0;
  for (const [kind, count] of Object.entries(source.lineCounts)) {
    const arrays = [new Float32Array(3 * count), new Float32Array(3 * count), new Float32Array(4 * count).fill(1)];
    for (let i = 0; i < count; i++) for (let k = 0; k < 3; k++) {
      arrays[0][3 * i + k] = ends[6 * (first + i) + k];
      arrays[1][3 * i + k] = ends[6 * (first + i) + 3 + k];
      arrays[2][4 * i + k] = shades[3 * (first + i) + k] / 255;
    }
    kinds[kind] = { count, arrays };
    first += count;
  }
  return kinds;
}
function prepared(source) {
  if (source.ready) return source.ready;
  const m = source.ready = { ...source, factor: 1, unit: data.unit }, Index = source.large ? Uint32Array : Uint16Array;
  for (const [name, Type] of Object.entries({ positions: Float32Array, colors: Uint8Array, tracks: Index, errors: Float32Array, views: Index, places: Uint16Array, residuals: Uint16Array })) m[name] = unpack(source[name], Type);
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
  m.strokes = unpackStrokes(source);
  m.number = new Map(m.images.map((c, i) => [c.name, i]));
  for (const c of m.images) {
    c.photo = Object.hasOwn(data.photos, c.name) ? data.photos[c.name] : null;
    if (!c.pose) continue;
    c.axes = [c.pose.slice(3, 6), c.pose.slice(6, 9), c.pose.slice(9, 12)];
    c.centre = c.pose.slice(0, 3);
  }
  return m;
}
const positionOf = point => Array.from(model.positions.subarray(3 * point, 3 * point + 3));
const inWorld = p => model.axes.map(axis => dot(add(p, model.origin, -1), axis));  // in the frame of the model's file
const isShown = point => set.points && model.tracks[point] >= set.track && model.errors[point] <= set.error;
function observation(k) {  // where an image saw a point, as a share of its size, and from there to the projection, in pixels
  const image = model.images[model.views[k]];
  return { view: model.views[k], image, at: [model.places[2 * k] / 65535, model.places[2 * k + 1] / 65535], off: [half(model.residuals[2 * k]), half(model.residuals[2 * k + 1])] };
}
function observationsOf(point) {
  const list = [];
  for (let k = model.first[point]; k < model.first[point + 1]; k++) list.push({ point, ...observation(k) });
  return list;
}
function observationsIn(camera) {
  const list = [];
  for (let i = 0; i < model.count; i++) for (let k = model.first[i]; k < model.first[i + 1]; k++) if (model.views[k] == camera) list.push({ point: i, ...observation(k) });
  return list;
}
function mark(index) {  // the points that a camera sees
  const marks = new Uint8Array(model.count);
  if (index >= 0) for (let i = 0; i < model.count; i++) for (let k = model.first[i]; k < model.first[i + 1]; k++) if (model.views[k] == index) marks[i] = 1;
  gl.bindBuffer(gl.ARRAY_BUFFER, model.marks);
  gl.bufferSubData(gl.ARRAY_BUFFER, 0, marks);
}

// ---- numbers for people
const brief = v => v < 10 ? v.toFixed(2) : v < 1e4 ? v.toFixed(0) : v.toExponential(0);
const px = v => brief(v) + " px";
const many = (count, one, more = one + "s") => `${count.toLocaleString("en")} ${count == 1 ? one : more}`;
const length = v => `${Number((v * model.factor).toPrecision(4)).toString()} ${model.unit || "units"}`.replace(/^1 units$/, "1 unit");
