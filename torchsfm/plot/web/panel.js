// The panel: which model, what of it is shown and how, the table of images; and the beginning.
function load(index) {
  model = prepared(data.models[index]);
  hovered = pointed = -1;
  flight = null;
  leave(false);
  closeDetails();
  startMeasuring(false);
  hideTip();
  $("summary").textContent = model.summary + photoText();
  const [low, high] = model.trackRange, [, worst] = model.errorRange, limit = Math.max(worst, 0.02);
  const room = Math.min(1, Math.max(0.5, Math.sqrt(canvas.clientWidth * canvas.clientHeight) / 1000));  // small screens, small dots
  set.size = Math.round(4 * room * Math.min(4, Math.max(1.5, 2.75 * Math.pow(3e4 / Math.max(model.count, 1), 0.2)))) / 4;
  $("size").value = set.size;
  Object.assign($("track"), { min: low, max: high, value: low });
  Object.assign($("error"), { min: limit / 50, max: limit, step: limit / 50, value: limit });
  set.track = low;
  set.error = Infinity;
  home = overview();
  view = { ...home };
  for (const kind of SHOWN) showSwitch(kind);
  fillTable();
  refreshControls();
  mark(-1);
  draw();
}
function photoText() {
  const held = Object.values(data.photos);
  return held.length ? `\n${many(held.length, "photograph")} in this page: ${(held.reduce((sum, text) => sum + text.length, 0) / 1e6).toFixed(1)} MB` : "";
}

// ---- the table
let sortKey = null, sortSign = 1;
function fillTable() {
  const order = model.images.map((c, i) => i);
  if (sortKey) order.sort((a, b) => { const x = model.images[a][sortKey], y = model.images[b][sortKey]; return sortSign * (x < y ? -1 : x > y ? 1 : a - b); });
  $("list").querySelector("tbody").replaceChildren(...order.map(tableRow));
  for (const head of $("list").querySelectorAll("th")) head.ariaSort = head.dataset.key != sortKey ? "none" : sortSign > 0 ? "ascending" : "descending";
}
function tableRow(i, position) {
  const c = model.images[i], row = element("tr", "", { tabIndex: position ? -1 : 0, className: c.doubtful ? "doubtful" : c.pose ? "" : "out" }), name = element("td");
  row.dataset.index = i;
  name.append(element("bdi", (c.doubtful ? "⚠ " : "") + c.name));
  name.title = [c.name, ...(c.standing ? [c.standing] : [])].join("\n");
  row.append(name);
  if (c.pose) {
    for (const text of [c.points.toLocaleString("en"), brief(c.mean), brief(c.high)]) row.append(element("td", text));
    row.onmouseenter = () => hover(i, -1);
    row.onmouseleave = () => hover(-1, -1);
  } else row.append(element("td", c.status, { colSpan: 3, className: "why" }));
  row.onclick = () => showImage(i);
  return row;
}
$("list").addEventListener("keydown", event => {  // one stop for Tab, arrows within
  const row = event.target.closest("tbody tr");
  if (!row) return;
  const next = { ArrowDown: row.nextElementSibling, ArrowUp: row.previousElementSibling }[event.key];
  if (event.key == "Enter" || event.key == " ") row.click();
  else if (next) { row.tabIndex = -1; next.tabIndex = 0; next.focus(); } else if (!event.key.startsWith("Arrow")) return;
  event.preventDefault();
});
for (const head of $("list").querySelectorAll("th")) head.firstElementChild.onclick = () => {
  sortSign = sortKey == head.dataset.key ? -sortSign : head.dataset.key == "name" ? 1 : -1;
  sortKey = head.dataset.key;
  fillTable();
};

// ---- the controls
const SHOWN = ["points", "cameras", "photos", "axes", "lines", "ellipses", "curves"];
function showSwitch(kind) {
  const there = kind == "photos" ? Object.keys(data.photos).length : ["points", "cameras", "axes"].includes(kind) || model.strokes[kind]?.count;
  $(kind).hidden = !there;
  $(kind).setAttribute("aria-pressed", set[kind]);
}
for (const kind of SHOWN) $(kind).onclick = () => { set[kind] = !set[kind]; showSwitch(kind); draw(); };
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
$("theme").onclick = () => { const root = document.documentElement; root.dataset.theme = root.dataset.theme == "dark" ? "light" : "dark"; draw(); };
const narrow = matchMedia("(max-width: 900px)");  // the panel lies over the picture
function showPanel(on) {
  document.body.classList.toggle("bare", !on);
  if (on && narrow.matches) closeDetails();
  $("bare").setAttribute("aria-expanded", on);
  draw();
}
$("bare").onclick = () => showPanel(document.body.classList.contains("bare"));
$("picture").onclick = () => {
  paint(performance.now());
  const both = element("canvas", "", { width: canvas.width, height: canvas.height }), context = both.getContext("2d");
  for (const layer of [canvas, over]) context.drawImage(layer, 0, 0);
  both.toBlob(blob => { const link = element("a", "", { href: URL.createObjectURL(blob), download: "reconstruction.png" }); link.click(); setTimeout(() => URL.revokeObjectURL(link.href), 10000); });
};

// ---- the beginning
canvas.addEventListener("webglcontextlost", event => event.preventDefault());
canvas.addEventListener("webglcontextrestored", () => location.reload());
new ResizeObserver(draw).observe(canvas);
document.querySelector("h1").textContent = data.title;
data.models.forEach((m, i) => $("model").append(element("option", m.label, { value: i })));
$("modelrow").style.display = data.models.length > 1 ? "grid" : "none";
showPanel(!narrow.matches);
load(0);
