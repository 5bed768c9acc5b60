// Drawn flat over the picture: the axes, the scale bar, the distance being measured.
const over = $("over"), pen = over.getContext("2d");
const measure = { on: false, ends: [] };
const AXES = [["x", "--x"], ["y", "--y"], ["z", "--z"]];

function projector() {  // from the world to CSS pixels and depth; null behind the eye
  const m = matrix(view), w = canvas.clientWidth, h = canvas.clientHeight;
  return (x, y, z) => {
    const d = m[3] * x + m[7] * y + m[11] * z + m[15];
    return d <= 0 ? null : [(1 + (m[0] * x + m[4] * y + m[8] * z + m[12]) / d) * w / 2, (1 - (m[1] * x + m[5] * y + m[9] * z + m[13]) / d) * h / 2, d];
  };
}
const ink = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
function stroke(ends, color, width, target = pen) {
  target.strokeStyle = color;
  target.lineWidth = width;
  target.beginPath();
  ends.forEach(([x, y], i) => i ? target.lineTo(x, y) : target.moveTo(x, y));
  target.stroke();
}
function write(text, x, y, color, align = "center") {  // legible over anything
  pen.textAlign = align;
  pen.textBaseline = "middle";
  pen.lineWidth = 4;
  pen.lineJoin = "round";
  pen.strokeStyle = ink("--back");
  pen.strokeText(text, x, y);
  pen.fillStyle = color;
  pen.fillText(text, x, y);
}
function drawAxes(x, y) {  // those of the model's own frame, as they lie to the eye
  const right = turn(view.q, [1, 0, 0]), up = turn(view.q, [0, 1, 0]), back = turn(view.q, [0, 0, 1]), reach = 30;
  const ends = model.axes.map((axis, i) => ({ at: [x + reach * dot(axis, right), y - reach * dot(axis, up)], depth: dot(axis, back), i }));
  for (const { at, depth, i } of ends.sort((a, b) => a.depth - b.depth)) {
    const color = ink(AXES[i][1]);
    pen.globalAlpha = depth < -0.3 ? 0.6 : 1;  // into the picture
    stroke([[x, y], at], color, 2.5);
    pen.globalAlpha = 1;
    const n = Math.hypot(at[0] - x, at[1] - y), far = (n + 9) / (n || 1);
    write(AXES[i][0], x + (at[0] - x) * far, y + (at[1] - y) * far, color);
  }
}
const perPixel = () => 2 * Math.tan(view.fov / 2) * view.distance / canvas.clientHeight;  // at the distance of the pivot
function drawScale(x, y) {
  const size = nice(130 * perPixel() * model.factor), wide = size / perPixel() / model.factor, color = ink("--text");
  for (const [shade, width] of [[ink("--back"), 5], [color, 1.5]]) stroke([[x - wide, y - 5], [x - wide, y], [x, y], [x, y - 5]], shade, width);
  write(length(size / model.factor), x - wide / 2, y - 12, color);
}
function drawMeasure() {
  const project = projector(), at = measure.ends.map(p => project(...p)), accent = ink("--accent");
  if (at.length == 2 && at[0] && at[1]) for (const [shade, width] of [[ink("--back"), 5], [accent, 2]]) stroke(at, shade, width);
  for (const p of at) if (p) {
    pen.beginPath();
    pen.arc(p[0], p[1], 5, 0, 7);
    pen.fillStyle = ink("--back");
    pen.fill();
    stroke([], accent, 2);
    pen.beginPath();
    pen.arc(p[0], p[1], 5, 0, 7);
    pen.stroke();
  }
  if (at.length == 2 && at[0] && at[1]) write(length(measured()), (at[0][0] + at[1][0]) / 2, (at[0][1] + at[1][1]) / 2 - 13, accent);
}
const measured = () => Math.hypot(...add(measure.ends[1], measure.ends[0], -1));
function drawOverlay(m, ratio) {
  const w = canvas.clientWidth, h = canvas.clientHeight;
  if (over.width != canvas.width || over.height != canvas.height) { over.width = canvas.width; over.height = canvas.height; }
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, w, h);
  pen.font = "12px system-ui, sans-serif";
  if (set.axes) {
    drawAxes(w - 62, h - 92);
    drawScale(w - 16, h - 16);
  }
  drawMeasure();
  if (document.activeElement == canvas && canvas.matches(":focus-visible")) {  // where Enter clicks
    const cross = [[[w / 2 - 9, h / 2], [w / 2 + 9, h / 2]], [[w / 2, h / 2 - 9], [w / 2, h / 2 + 9]]];
    for (const ends of cross) stroke(ends, ink("--accent"), 1);
  }
}

// ---- measuring
function showMeasure() {
  $("measure").setAttribute("aria-pressed", measure.on);
  $("measuring").hidden = !measure.on;
  const both = measure.ends.length == 2;
  $("distance").textContent = both ? length(measured()) : measure.ends.length ? "click the other point" : "click two points or cameras";
  $("rescale").hidden = !both;
  draw();
}
function startMeasuring(on) {
  measure.on = on;
  if (on && narrow.matches) { showPanel(false); closeDetails(); }
  measure.ends = [];
  showMeasure();
}
function measureTo(position) {
  measure.ends = [...(measure.ends.length == 2 ? [] : measure.ends), position];
  showMeasure();
}
$("measure").onclick = () => startMeasuring(!measure.on);
$("endmeasure").onclick = () => startMeasuring(false);
$("rescale").onsubmit = event => {  // "this is 3.2 m": all lengths follow
  event.preventDefault();
  const found = /^\s*([0-9]*[.,]?[0-9]+(?:e[-+]?[0-9]+)?)\s*(.*?)\s*$/i.exec($("true").value), value = found ? Number(found[1].replace(",", ".")) : 0;
  if (!(value > 0 && measured() > 0)) { $("true").focus(); return; }
  model.factor = value / measured();
  if (found[2]) model.unit = found[2];
  $("true").value = "";
  showMeasure();
};
