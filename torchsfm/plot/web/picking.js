// What is under the pointer, and what a click there does.
function cameraAt(x, y, reach = 14) {
  if (!set.cameras) return -1;
  const project = projector();
  let best = -1, nearest = reach;
  model.images.forEach((c, i) => {
    if (!c.pose || i == looking) return;
    const k = corners(c), middle = scale(add(add(k[0], k[1]), add(k[2], k[3])), 0.25);
    for (const p of [c.centre, middle]) {
      const at = project(...p);
      const far = at ? Math.hypot(at[0] - x, at[1] - y) : Infinity;
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
    if (d <= 0 || !isShown(i)) continue;
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
function pick(x, y, coarse = false) {  // a click; fingers and keys aim less well than a mouse
  const camera = cameraAt(x, y, coarse ? 22 : 14), point = camera >= 0 ? -1 : pointAt(x, y, coarse ? 18 : 7);
  if (measure.on) {
    if (camera >= 0) measureTo(model.images[camera].centre);
    else if (point >= 0) measureTo(positionOf(point));
  } else if (camera >= 0) showImage(camera);
  else if (point >= 0) showPoint(point);
}
function hover(camera, point) {
  if (camera == hovered && point == pointed) return;
  if (camera != hovered) {
    hovered = camera;
    mark(camera);
    for (const row of $("list").querySelectorAll("tbody tr")) row.classList.toggle("on", +row.dataset.index == camera);
  }
  pointed = point;
  canvas.classList.toggle("pointing", camera >= 0 || point >= 0);
  draw();
}

// ---- the words beside the pointer
const tip = $("tip");
const focalText = c => `focal length ${c.focal.toFixed(1)} ${c.focalDeviation ? `± ${c.focalDeviation} ` : ""}px`;
const cameraText = c => [`${many(c.points, "point")}, mean error ${px(c.mean)}`, focalText(c), ...(c.doubts ?? []), ...(c.standing ? [c.standing] : [])].join("\n");
function element(name, text = "", properties = {}) {
  const made = document.createElement(name);
  made.textContent = text;
  return Object.assign(made, properties);
}
function hideTip() { tip.style.display = "none"; }
function showTip(x, y) {
  tip.replaceChildren();
  if (hovered >= 0) {
    const c = model.images[hovered];
    tip.append(element("b", c.name), "\n" + cameraText(c));
  } else if (pointed >= 0) {
    const names = observationsOf(pointed).slice(0, 8).map(o => o.image.name), count = model.tracks[pointed];
    tip.append(`point ${pointed}: ${many(count, "image")}, mean error ${px(model.errors[pointed])}\n`);
    tip.append(element("span", names.join(", ") + (count > 8 ? ", ..." : ""), { className: "dim" }));
  }
  tip.style.display = tip.childNodes.length ? "block" : "none";
  tip.style.left = Math.max(8, Math.min(x + 16, canvas.clientWidth - tip.offsetWidth - 8)) + "px";
  tip.style.top = Math.max(8, Math.min(y + 14, canvas.clientHeight - tip.offsetHeight - 8)) + "px";
}
