// Moving about: mouse, fingers and keys.
function flyTo(to) { flight = { from: { ...view }, to, start: performance.now() }; draw(); }
function lookThrough(index) {
  const c = model.images[index];
  if (!c.pose) return;
  const back = scale(c.axes[2], -1), u = c.corners.map(k => k[0]), v = c.corners.map(k => k[1]);
  const wide = Math.max(...u) - Math.min(...u), tall = Math.max(...v) - Math.min(...v), aspect = canvas.clientWidth / canvas.clientHeight;
  const half = Math.max(tall, wide / aspect) / 2 * 1.02;
  const offset = [(Math.max(...u) + Math.min(...u)) / 2 / half / aspect, -(Math.max(...v) + Math.min(...v)) / 2 / half].map(x => -x);
  looking = index;
  if (narrow.matches) closeDetails();
  hover(-1, -1);
  hideTip();
  $("through").hidden = false;
  $("through").firstElementChild.textContent = c.name;
  flyTo({ pivot: add(c.centre, back, -c.depth), q: qaxes(c.axes[0], scale(c.axes[1], -1), back), distance: c.depth, fov: 2 * Math.atan(half), offset });
}
function leave(goHome) {
  looking = -1;
  $("through").hidden = true;
  if (goHome) { home = overview(); flyTo(home); }
  draw();
}
function centreOn(pivot) {
  leave(false);
  flyTo({ ...view, pivot, distance: Math.max(view.distance * 0.6, model.radius * 0.02), offset: [0, 0], fov: home.fov });
}
function freeView() {  // leave a camera's place without a jump; its angle of view stays until the next overview
  if (looking >= 0) leave(false);
  flight = null;
}
function zoom(factor) {
  freeView();
  view.distance = Math.min(Math.max(view.distance * factor, model.radius * 1e-3), Math.max(model.radius * 300, 3 * home.distance));
  draw();
}
function shift(right, up) {  // by CSS pixels
  freeView();
  const size = perPixel();
  view.pivot = add(add(view.pivot, turn(view.q, [1, 0, 0]), right * size), turn(view.q, [0, 1, 0]), up * size);
  draw();
}
function orbit(aside, tilt) {  // by angles, about the vertical and about the screen's horizontal
  freeView();
  view.q = qunit(qmul(qaxis([0, 0, 1], aside), qmul(qaxis(turn(view.q, [1, 0, 0]), tilt), view.q)));
  draw();
}

// ---- mouse and fingers
const fingers = new Map();
let last = null, moved = 0;
function gesture() {
  const p = [...fingers.values()], x = p.reduce((s, f) => s + f.x, 0) / p.length, y = p.reduce((s, f) => s + f.y, 0) / p.length;
  return { x, y, spread: p.length > 1 ? Math.hypot(p[0].x - p[1].x, p[0].y - p[1].y) : 0 };
}
const place = event => { const box = canvas.getBoundingClientRect(); return { x: event.clientX - box.left, y: event.clientY - box.top }; };
const slack = event => event.pointerType == "mouse" ? 4 : 10;  // pixels that a click may slip
canvas.addEventListener("pointerdown", event => {
  canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, place(event));
  last = gesture();
  moved = fingers.size > 1 ? 99 : 0;
  canvas.focus({ preventScroll: true });
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
  if (moved > slack(event)) {
    hideTip();
    hover(-1, -1);
    canvas.classList.add("dragging");
    if (fingers.size > 1 || event.buttons == 2 || event.buttons == 4 || event.shiftKey) {
      shift(-dx, dy);
      if (now.spread && last.spread) zoom(last.spread / now.spread);
    } else orbit(-dx / canvas.clientHeight * 4, -dy / canvas.clientHeight * 4);
  }
  last = now;
});
function lift(event) {
  const at = fingers.get(event.pointerId);
  fingers.delete(event.pointerId);
  canvas.classList.remove("dragging");
  if (fingers.size) { last = gesture(); return; }
  if (at && moved <= slack(event) && event.type == "pointerup" && event.button == 0) pick(at.x, at.y, event.pointerType != "mouse");
}
canvas.addEventListener("pointerup", lift);
canvas.addEventListener("pointercancel", lift);
canvas.addEventListener("pointerleave", () => { if (!fingers.size) { hover(-1, -1); hideTip(); } });
canvas.addEventListener("contextmenu", event => event.preventDefault());
canvas.addEventListener("wheel", event => { event.preventDefault(); zoom(Math.exp(Math.max(-80, Math.min(80, event.deltaY * (event.deltaMode ? 30 : 1))) * 0.002)); }, { passive: false });
canvas.addEventListener("dblclick", event => {
  const at = place(event), point = pointAt(at.x, at.y, 16);
  if (point >= 0 && !measure.on) centreOn(positionOf(point));
});
for (const change of ["focus", "blur"]) canvas.addEventListener(change, () => draw());

// ---- keys
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
function escape() {  // closes what was opened last
  if (measure.on) startMeasuring(false);
  else if (!details.hidden) closeDetails();
  else if (looking >= 0) leave(true);
  else if (narrow.matches) showPanel(false);
}
addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key == "Escape") { escape(); return; }
  const { target } = event, free = target == canvas || target == document.body;
  if (["INPUT", "SELECT"].includes(target.tagName)) return;
  if (free && ARROWS[event.key]) {
    const [x, y] = ARROWS[event.key];
    if (event.shiftKey) shift(40 * x, 40 * y); else orbit(-0.09 * x, 0.09 * y);
  } else if (event.key == "+" || event.key == "=" || event.key == "-") zoom(event.key == "-" ? 1.15 : 1 / 1.15);
  else if (event.key == "PageDown" || event.key == "PageUp") step(event.key == "PageDown" ? 1 : -1);
  else if (target == canvas && event.key == "Enter") pick(canvas.clientWidth / 2, canvas.clientHeight / 2, true);
  else if (event.key == "r" || event.key == "R") leave(true);
  else if (event.key == "m" || event.key == "M") startMeasuring(!measure.on);
  else if (event.key == "p" || event.key == "P") showPairs();
  else return;
  event.preventDefault();
});
