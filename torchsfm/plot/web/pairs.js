// The matrix of all pairs of images: green where they were found to belong together, grey where that was tried in vain.
const VERIFIED = ["#1c5a3c", "#4fd08f"], REFUSED = "#6b7480";  // few and many agreeing matches
const inCommon = new WeakMap();  // for each model, how many points each pair of its images shares

function pointsInCommon() {
  if (!inCommon.has(model)) {
    const counts = new Map(), n = model.images.length;
    for (let i = 0; i < model.count; i++) for (let k = model.first[i]; k < model.first[i + 1]; k++) for (let l = k + 1; l < model.first[i + 1]; l++) {
      const [a, b] = [model.views[k], model.views[l]], key = Math.min(a, b) * n + Math.max(a, b);
      counts.set(key, (counts.get(key) ?? 0) + 1);
    }
    inCommon.set(model, counts);
  }
  return inCommon.get(model);
}
function shared(a, b) { return pointsInCommon().get(Math.min(a, b) * model.images.length + Math.max(a, b)) ?? 0; }

let compared = null;
function comparedPairs() {  // of the report; without one, the pairs of the model that share points
  if (!data.pairs) {
    const n = model.images.length, cells = new Map();
    for (const [key, count] of pointsInCommon()) cells.set(key, { inliers: count, refused: false });
    return { names: model.images.map(c => c.name), cells, n };
  }
  if (!compared) {
    const { names, pairs, matches, inliers, verdict, verdicts } = data.pairs, n = names.length, cells = new Map();
    const [both, tried, agreeing] = [pairs, matches, inliers].map(text => unpack(text, Uint32Array)), found = unpack(verdict, Uint8Array);
    for (let i = 0; i < found.length; i++) {
      const [a, b] = [both[2 * i], both[2 * i + 1]];
      cells.set(Math.min(a, b) * n + Math.max(a, b), { matches: tried[i], inliers: agreeing[i], verdict: verdicts[found[i]], refused: verdicts[found[i]] == "unrelated" });
    }
    compared = { names, cells, n };
  }
  return compared;
}
const cellOf = (table, i, j) => i == j ? null : table.cells.get(Math.min(i, j) * table.n + Math.max(i, j));
function cellColor(cell, most) {
  if (!cell) return null;
  if (cell.refused) return REFUSED;
  const share = Math.sqrt(Math.min(1, cell.inliers / most)), [low, high] = VERIFIED.map(h => [1, 3, 5].map(i => parseInt(h.slice(i, i + 2), 16)));
  return `rgb(${low.map((v, k) => Math.round(v + share * (high[k] - v))).join()})`;
}
function pairText(table, i, j) {
  if (i == j) return table.names[i];
  const cell = cellOf(table, i, j), [a, b] = [i, j].map(k => model.number.get(table.names[k]));
  const common = a !== undefined && b !== undefined ? `\n${many(shared(a, b), "point")} of this model in common` : "";
  const found = !cell ? "not compared" : !cell.verdict ? "" : `${many(cell.matches, "match", "matches")}, ${cell.inliers.toLocaleString("en")} agree\n${cell.refused ? "refused: too few agree" : `verified (${cell.verdict})`}`;
  return `${table.names[i]} – ${table.names[j]}\n${found || "points in common only: this page was made without a report"}${common}`;
}

function showPairs() {
  const table = comparedPairs(), { n, cells } = table, values = [...cells.values()].filter(c => !c.refused).map(c => c.inliers).sort((a, b) => a - b);
  const most = values[Math.floor(0.95 * values.length)] || 1, refused = cells.size - values.length;
  choose(-1, -1);
  const legend = element("p", "", { className: "facts" }), says = element("p", "", { className: "facts", id: "pair", ariaLive: "polite" }), row = element("div", "", { className: "row" });
  const key = (color, text) => { const chip = element("i", "", { className: "chip" }); chip.style.background = color; legend.append(chip, ` ${text}  `); };
  key(VERIFIED[1], data.pairs ? `${values.length.toLocaleString("en")} verified` : `${values.length.toLocaleString("en")} with points in common`);
  if (data.pairs) { key(REFUSED, `${refused.toLocaleString("en")} tried, refused`); key("var(--line)", `${(n * (n - 1) / 2 - cells.size).toLocaleString("en")} not compared`); }
  const holder = element("div", "", { id: "matrix" });
  const foot = element("div", "", { className: "foot" });
  foot.append(says, row);
  showDetails(`Pairs of ${many(n, "image")}`, legend, holder, foot);
  const side = Math.max(120, holder.clientWidth), pixel = Math.max(1, Math.floor(side * (devicePixelRatio || 1) / Math.max(1, n)));
  const face = element("canvas", "", { width: Math.max(1, n * pixel), height: Math.max(1, n * pixel), tabIndex: 0, ariaLabel: "Matrix of all pairs of images; arrow keys move, Enter opens an image" });
  face.setAttribute("role", "img");
  holder.append(face);
  const context = face.getContext("2d"), gap = pixel > 5 ? 1 : 0;
  const paintCell = (i, j, color) => { if (color) { context.fillStyle = color; context.fillRect(j * pixel, i * pixel, pixel - gap, pixel - gap); } };
  for (let i = 0; i < n; i++) paintCell(i, i, ink("--panel"));
  for (const [k, cell] of cells) { const i = Math.floor(k / n), j = k % n, color = cellColor(cell, most); paintCell(i, j, color); paintCell(j, i, color); }
  let at = [0, Math.min(1, n - 1)];
  const frameMark = element("i", "", { id: "cell" });
  holder.append(frameMark);
  const go = (i, j) => {
    at = [i, j];
    says.textContent = n ? pairText(table, i, j) : "";
    for (const [side, value] of Object.entries({ left: j, top: i, width: 1, height: 1 })) frameMark.style[side] = `${100 * value / Math.max(1, n)}%`;
    const numbers = [...new Set(at)].map(k => model.number.get(table.names[k])).filter(k => k !== undefined);
    row.replaceChildren(...numbers.map(k => element("button", model.images[k].name, { onclick: () => showImage(k), className: "name" })));
    choose(-1, -1, numbers.filter(k => model.images[k].pose));
    draw();
  };
  const under = event => { const box = face.getBoundingClientRect(); return [event.clientY - box.top, event.clientX - box.left].map(v => Math.max(0, Math.min(n - 1, Math.floor(v / box.width * n)))); };
  let pinned = false;  // a click keeps the pair while the mouse goes to its buttons
  face.onpointerdown = event => { pinned = !pinned; go(...under(event)); };
  face.onpointermove = event => { if (event.pointerType == "mouse" && !pinned) go(...under(event)); };
  face.onkeydown = event => {
    const by = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
    if (by) { event.preventDefault(); go(...at.map((v, k) => Math.max(0, Math.min(n - 1, v + by[k])))); }
    if (event.key == "Enter") row.firstElementChild?.click();
  };
  if (n) go(...at);
}
$("pairs").onclick = () => showPairs();
