// The details of what was clicked: a point as every image saw it, an image with its residuals.
const details = $("details"), PATCH = 92, ZOOMED = 36;  // side of a patch on the page, and in pixels of the photograph in the page
let opener = null;

function showDetails(title, ...content) {
  if (details.hidden) opener = document.activeElement;
  details.hidden = false;
  if (narrow.matches) showPanel(false);
  document.body.classList.add("detailed");
  $("subject").textContent = title;
  $("matter").replaceChildren(...content);
  $("matter").scrollTop = 0;
  hideTip();
  draw();
}
function choose(camera, point, pair = null) { Object.assign(chosen, { camera, point, pair }); }
function closeDetails() {
  if (details.hidden) return;
  choose(-1, -1);
  details.hidden = true;
  document.body.classList.remove("detailed");
  const there = e => e && e != document.body && e.checkVisibility();
  if (!there(document.activeElement)) (there(opener) ? opener : canvas).focus({ preventScroll: true });
  draw();
}
$("closedetails").onclick = closeDetails;

function sharp(width, height, label) {  // a canvas as fine as the screen, in CSS pixels
  const made = element("canvas", "", { width: width * (devicePixelRatio || 1), height: height * (devicePixelRatio || 1), role: "img", ariaLabel: label });
  made.style.width = width + "px";
  made.style.height = height + "px";
  const context = made.getContext("2d");
  context.scale(made.width / width, made.height / height);
  return [made, context];
}
function ring(context, x, y, radius, color, width = 1.5) {
  context.strokeStyle = color;
  context.lineWidth = width;
  context.beginPath();
  context.arc(x, y, radius, 0, 7);
  context.stroke();
}

// ---- a point
function showPoint(point) {
  choose(-1, point);
  const seen = observationsOf(point), at = inWorld(positionOf(point)).map(v => Number((v * model.factor).toPrecision(5)));
  const text = element("p", `(${at.join(", ")}) ${model.unit || "units"}\nseen in ${many(seen.length, "image")}, mean error ${px(model.errors[point])}`, { className: "facts" });
  const centre = element("button", "Centre here", { onclick: () => centreOn(positionOf(point)) }), row = element("div", "", { className: "row" });
  row.append(centre);
  const patches = element("div", "", { id: "patches" });
  patches.append(...seen.map(patch));
  const legend = element("p", seen.length ? "cross: where the image shows it, ring: where the model puts it" : "", { className: "dim" });
  showDetails(`Point ${point}`, text, row, legend, patches);
}
function patch(o) {
  const label = `${o.image.name}: ${px(Math.hypot(...o.off))}`, made = element("button", "", { className: "patch", title: label, onclick: () => showImage(o.view, o.point) });
  const [face, context] = sharp(PATCH, PATCH, label);
  made.append(face, element("span", o.image.name, { className: "name" }), element("span", px(Math.hypot(...o.off)), { className: "dim" }));
  picture(o.image).then(photo => drawPatch(context, photo, o));
  return made;
}
function drawPatch(context, photo, o) {
  const wide = photo ? photo.naturalWidth : SMALL, zoom = PATCH / ZOOMED, middle = PATCH / 2;
  if (photo) {
    context.fillStyle = ink("--line");
    context.fillRect(0, 0, PATCH, PATCH);
    context.drawImage(photo, middle - o.at[0] * photo.naturalWidth * zoom, middle - o.at[1] * photo.naturalHeight * zoom, photo.naturalWidth * zoom, photo.naturalHeight * zoom);
  }
  const share = zoom * wide / Math.max(1, o.image.size[0]), [x, y] = [middle + o.off[0] * share, middle + o.off[1] * share];
  for (const [color, width] of [["#000a", 3], [ink("--accent"), 1.2]]) {
    for (const [a, b] of [[[-13, 0], [-5, 0]], [[5, 0], [13, 0]], [[0, -13], [0, -5]], [[0, 5], [0, 13]]]) stroke([a, b].map(p => [p[0] + middle, p[1] + middle]), color, width, context);
    ring(context, x, y, 4, color, width);
  }
}

// ---- an image
const GAINS = [1, 2, 5, 10, 20, 50, 100, 200, 500];
let gain = null;  // how much longer than they are the residuals are drawn; null: as the image asks for
function showImage(index, point = -1) {
  const c = model.images[index];
  choose(c.pose ? index : -1, point);
  const row = element("div", "", { className: "row" });
  const text = element("p", c.pose ? cameraText(c) : c.status, { className: c.doubtful || !c.pose ? "facts bad" : "facts" });
  const holder = element("div", "", { id: "image" }), note = element("p", "", { className: "dim", ariaLive: "polite" });
  if (c.pose) {
    row.append(element("button", "Look through", { onclick: () => lookThrough(index) }), element("button", "‹", { ariaLabel: "Previous image", title: "Previous image (Page up)", onclick: () => step(-1) }), element("button", "›", { ariaLabel: "Next image", title: "Next image (Page down)", onclick: () => step(1) }));
    row.append(gainChoice(index, point));
  }
  showDetails(c.name, row, text, holder, note);
  const [width, height] = c.size ?? [4, 3], wide = Math.max(120, holder.clientWidth), tall = Math.max(1, wide * height / Math.max(1, width));
  const [face, context] = sharp(wide, tall, `${c.name} with its residuals`), seen = c.pose ? observationsIn(index) : [];
  holder.append(face);
  picture(c).then(photo => drawResiduals(context, photo, wide, tall, c, seen, point));
  note.textContent = seen.length ? "from where the image shows each point towards where the model puts it; click one to see its patches" : "";
  const near = event => {
    const box = face.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    return seen.reduce((best, o) => { const far = Math.hypot(o.at[0] * wide - x, o.at[1] * tall - y); return far < best.far ? { far, point: o.point } : best; }, { far: 12, point: -1 }).point;
  };
  face.onpointermove = event => { const at = near(event); face.style.cursor = at >= 0 ? "pointer" : ""; hover(-1, at); };
  face.onpointerleave = () => hover(-1, -1);
  face.onclick = event => { const at = near(event); if (at >= 0) showPoint(at); };
}
function chosenGain(c) {  // large residuals become a fortieth of the image's width
  const fitting = 0.025 * c.size[0] / Math.max(c.high, 1e-9);
  return gain ?? GAINS.findLast(g => g <= fitting) ?? 1;
}
function gainChoice(index, point) {
  const choice = element("select", "", { ariaLabel: "Residuals drawn longer", title: "Residuals drawn longer", onchange: () => { gain = +choice.value; showImage(index, point); $("matter").querySelector("select").focus(); } });
  choice.append(...GAINS.map(g => element("option", `residuals × ${g}`, { value: g })));
  choice.value = chosenGain(model.images[index]);
  return choice;
}
function drawResiduals(context, photo, wide, tall, c, seen, point) {
  context.fillStyle = ink("--line");
  context.fillRect(0, 0, wide, tall);
  if (photo) {
    context.drawImage(photo, 0, 0, wide, tall);
    context.fillStyle = "#0005";  // so that the strokes stand out
    context.fillRect(0, 0, wide, tall);
  }
  const share = chosenGain(c) * wide / Math.max(1, c.size[0]);
  for (const o of seen) {
    const [x, y] = [o.at[0] * wide, o.at[1] * tall];
    stroke([[x, y], [x + o.off[0] * share, y + o.off[1] * share]], "#ffb020", 0.8, context);
    context.fillStyle = "#5fd3ff";
    context.fillRect(x - 0.75, y - 0.75, 1.5, 1.5);
  }
  for (const o of seen) if (o.point == point) ring(context, o.at[0] * wide, o.at[1] * tall, 8, "#ffffff", 2);
}
function step(by) {  // to the next image that has a camera, in the details or looking through it
  const order = model.images.map((c, i) => i).filter(i => model.images[i].pose), from = looking >= 0 ? looking : chosen.camera;
  if (!order.length || from < 0) return;
  const next = order[(order.indexOf(from) + by + order.length) % order.length];
  if (looking >= 0) lookThrough(next);
  if (!details.hidden && chosen.camera >= 0) showImage(next);
}
