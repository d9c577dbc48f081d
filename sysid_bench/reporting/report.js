"use strict";
/* Table of all cells: filters, order, columns and open rows are in the address. */
const PAGE = 50, LONGEST = 160;
const get = id => document.getElementById(id);
const commands = JSON.parse(get("commands").textContent);
const parsed = new Promise(done => document.addEventListener("DOMContentLoaded", done));
let data, columns = [], order = [], chosen = [], shown = PAGE, isWhole = false;
const state = {q: "", want: new Map(), sort: "", hide: new Set(), open: new Set()};

async function unpack(id) {
  const text = atob(get(id).textContent), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  // Written to the stream itself: the stream of a Blob waits for another process.
  const stream = new DecompressionStream("gzip"), writer = stream.writable.getWriter();
  writer.write(bytes);
  writer.close();
  return JSON.parse(await new Response(stream.readable).text());
}
function make(tag, text, attributes, ...children) {
  const e = document.createElement(tag);
  if (text !== undefined && text !== null) e.textContent = text;
  for (const [key, value] of Object.entries(attributes || {})) e.setAttribute(key, value);
  e.append(...children);
  return e;
}
const number = v => v === null || v === undefined ? "–" : v === 0 ? "0"
  : Number.isInteger(v) && Math.abs(v) < 1e5 ? String(v)
  : Math.abs(v) < 1e-3 || Math.abs(v) >= 1e5 ? v.toExponential(2) : String(+v.toPrecision(3));
const word = (i, row) => data.dictionary[i][data.codes[i].length ? data.codes[i][row] : 0];

/* Columns: how each is drawn, and the key that it is sorted by. */
function columnsOf() {
  const words = data.words.map((name, i) => ({name, shown: data.shown[i], i,
    text: row => word(i, row), key: () => wordKeys(i)}));
  const scores = data.scores.map((name, i) => ({name, shown: true, title: data.titles[i], score: true,
    text: row => number(data.values[i][row]), key: () => data.values[i].map(v => v === null ? NaN : v)}));
  const link = {name: "recording", shown: data.hasLinks, link: true,
    text: row => data.links[row] ? "open" : "", key: () => data.ids.map((_, row) => data.links[row] ? 0 : NaN)};
  const reason = words.pop();
  return [...words, ...scores, link, reason];
}
function wordKeys(i) {
  const words = data.dictionary[i], sorted = words.map((w, k) => k);
  sorted.sort((a, b) => words[a].localeCompare(words[b], undefined, {numeric: true}));
  const place = new Array(words.length);
  sorted.forEach((k, at) => { place[k] = words[k] === "" ? NaN : at; });
  return data.codes[i].length ? data.codes[i].map(code => place[code]) : data.ids.map(() => place[0]);
}
const column = name => columns.find(c => c.name === name);
function setOrder() {
  const down = state.sort.startsWith("-"), found = column(state.sort.replace(/^-/, ""));
  order = data.ids.map((_, row) => row);
  if (!found) return;
  const key = found.key(), sign = down ? -1 : 1;
  order.sort((a, b) => {
    const x = key[a], y = key[b];
    return x !== x || y !== y ? (x !== x) - (y !== y) || a - b : sign * (x - y) || a - b;
  });
}
function select() {
  const n = data.ids.length, keep = new Uint8Array(n).fill(1);
  for (const [name, wanted] of state.want) {
    const i = data.words.indexOf(name), codes = data.codes[i], code = data.dictionary[i].indexOf(wanted);
    if (!codes.length) { if (code !== 0) keep.fill(0); continue; }
    for (let row = 0; row < n; row++) if (codes[row] !== code) keep[row] = 0;
  }
  for (const part of state.q.toLowerCase().split(/\s+/).filter(Boolean)) keepMatches(keep, part);
  chosen = order.filter(row => keep[row]);
}
/* A word of a filter stands in the id of a row or in one of its words. */
function keepMatches(keep, part) {
  const hits = data.dictionary.map(words => words.map(w => w.toLowerCase().includes(part)));
  if (hits.some((hit, i) => !data.codes[i].length && hit[0])) return;
  const found = new Uint8Array(keep.length);
  hits.forEach((hit, i) => {
    if (!hit.includes(true)) return;
    const codes = data.codes[i];
    for (let row = 0; row < keep.length; row++) if (hit[codes[row]]) found[row] = 1;
  });
  for (let row = 0; row < keep.length; row++) if (keep[row] && !found[row] && !data.ids[row].includes(part)) keep[row] = 0;
}

/* Drawing. */
const visible = () => columns.filter(c => !state.hide.has(c.name));
function cellOf(row, c) {
  if (c.score) return make("td", c.text(row), {class: "n"});
  if (c.link) return make("td", "", {}, ...(data.links[row] ? [make("a", "open", {href: data.links[row]})] : []));
  const text = c.text(row), cut = text.length > LONGEST ? text.slice(0, LONGEST - 1) + "…" : text;
  const cls = c.name === "reason" ? "reason" : c.name === "status" && text !== "ok" ? "bad" : "";
  return make("td", cut, cls ? {class: cls} : {});
}
function rowsOf(row, drawn) {
  const id = data.ids[row], isOpen = state.open.has(id);
  const button = make("button", id, {type: "button", "aria-expanded": isOpen, "aria-controls": "row-" + id});
  const tr = make("tr", "", {}, make("th", "", {scope: "row", class: "code"}, button), ...drawn.map(c => cellOf(row, c)));
  button.onclick = () => {
    if (state.open.delete(id)) get("row-" + id).remove();
    else { state.open.add(id); tr.after(opened(row, drawn.length + 1)); }
    button.setAttribute("aria-expanded", state.open.has(id));
    writeAddress();
  };
  return isOpen ? [tr, opened(row, drawn.length + 1)] : [tr];
}
function draw() {
  document.querySelector("#cells tbody").replaceChildren();
  drawRows(0);
}
/* Rows from a place on: more of them as the reader goes down. */
function drawRows(from) {
  const drawn = visible();
  document.querySelector("#cells tbody").append(...chosen.slice(from, shown).flatMap(row => rowsOf(row, drawn)));
  showCount();
}
function showCount() {
  const found = isWhole ? chosen.length : data.count;
  get("count").textContent = `${found} of ${data.count} cells` + (found > shown ? `, the first ${shown} shown` : "");
  get("more").hidden = chosen.length <= shown;
}
function drawHead() {
  const heads = visible().map(c => {
    const button = make("button", c.name, {type: "button"}), th = make("th", "", {scope: "col"}, button);
    if (c.score) th.className = "n";
    if (c.title) button.title = c.title;
    if (state.sort.replace(/^-/, "") === c.name) th.setAttribute("aria-sort", state.sort[0] === "-" ? "descending" : "ascending");
    button.onclick = () => {
      state.sort = state.sort === c.name ? "-" + c.name : c.name;
      setOrder(); update(); drawHead();
      [...document.querySelectorAll("#cells thead button")].find(b => b.textContent === c.name).focus();
    };
    return th;
  });
  document.querySelector("#cells thead").replaceChildren(make("tr", "", {}, make("th", "id", {scope: "col"}), ...heads));
}
/* Before all cells are read the choice waits in the address. */
function update() {
  writeAddress();
  if (!isWhole) return;
  shown = PAGE; select(); draw();
}

/* An open row is as wide as what is seen of the table, also after the window has changed. */
function fit(box) { box.style.width = get("all-cells").clientWidth + "px"; }
/* An open row: what it is, what it scored, how it is computed again. */
function opened(row, span) {
  const id = data.ids[row], box = make("div", "", {class: "opened"});
  fit(box);
  const list = pairs => make("dl", "", {}, ...pairs.flatMap(([name, text]) => [make("dt", name), make("dd", text)]));
  const about = data.words.map((name, i) => [name, word(i, row)]).filter(([name, text]) => name !== "reason" && text !== "" && text !== "none");
  const scores = data.scores.map((_, i) => [data.titles[i], number(data.values[i][row])]);
  const part = (title, ...children) => make("section", "", {}, make("h3", title), ...children);
  box.append(part("Specification", list(about)), part("Scores", make("div", "", {class: "scores"}, list(scores))));
  const reason = word(data.words.indexOf("reason"), row);
  if (reason) box.append(part("Reason", make("p", reason)));
  const more = [["run it again", commands.run.replace("ID", id)], ["whole row", commands.cell + id], ["recording", commands.view + id]];
  const reproduce = part("Reproduce", ...more.map(([what, text]) => make("p", "", {}, make("span", what + ": ", {class: "soft"}), make("code", text))));
  if (data.links[row]) reproduce.append(make("p", "", {}, make("a", "recording of this cell", {href: data.links[row]})));
  box.append(reproduce);
  const joints = part("Scores per joint", make("p", "…", {class: "soft"}));
  joints.className = "wide";
  box.append(joints);
  drawJoints(row, joints);
  parsed.then(() => { if (get("torques-" + id)) drawTorques(id, box); });
  const cell = make("td", "", {colspan: span}, box);
  return make("tr", "", {class: "detail", id: "row-" + id}, cell);
}
const unpacked = new Map();
const chunk = id => { if (!unpacked.has(id)) unpacked.set(id, unpack(id)); return unpacked.get(id); };
async function drawJoints(row, section) {
  const name = "joints-" + Math.floor(row / data.chunk), note = section.querySelector("p");
  await parsed;
  if (!get(name)) { note.textContent = data.hasJoints ? "Not in this page, to keep it small: " + commands.cell + data.ids[row] : "This row has none."; return; }
  const all = await chunk(name), at = row % data.chunk, size = k => k < 0 ? 0 : all.names[k].length;
  const start = all.which.slice(0, at).reduce((sum, k) => sum + size(k), 0);
  if (all.which[at] < 0) { note.textContent = "This row has none."; return; }
  const heads = ["joint", "relative error", "held-out RMSE", "RMS torque"];
  const rows = all.names[all.which[at]].map((joint, j) => {
    const error = all.relative[start + j], rmse = all.rmse_test[start + j];
    const rms = error && rmse !== null ? rmse / error : null;
    return make("tr", "", {}, make("th", joint, {scope: "row"}), ...[error, rmse, rms].map(v => make("td", number(v), {class: "n"})));
  });
  const head = make("tr", "", {}, ...heads.map((text, i) => make("th", text, {scope: "col", class: i ? "n" : ""})));
  note.replaceWith(make("table", "", {"aria-label": "Scores per joint"}, make("thead", "", {}, head), make("tbody", "", {}, ...rows)));
}

/* Torques and residuals of a row that stored them; residuals have an axis of their own. */
const SVG = "http://www.w3.org/2000/svg";
function shape(tag, attributes, text) {
  const e = document.createElementNS(SVG, tag);
  for (const [key, value] of Object.entries(attributes)) e.setAttribute(key, value);
  if (text !== undefined) e.textContent = text;
  return e;
}
function panel(svg, box, t, curves, label) {
  const [x, y, w, h] = box, all = curves.flatMap(([values]) => values).filter(v => v !== null);
  const low = Math.min(...all), high = Math.max(...all), span = high - low || 1, length = t[t.length - 1] - t[0] || 1;
  svg.append(shape("path", {class: "axis", d: `M${x} ${y}V${y + h}H${x + w}`}));
  for (const [v, place] of [[high, y + 9], [low, y + h]]) svg.append(shape("text", {x: x - 4, y: place, "text-anchor": "end"}, number(+v.toPrecision(2))));
  svg.append(shape("text", {x: x + 4, y: y - 3}, label));
  for (const [values, cls] of curves) {
    const points = values.map((v, i) => v === null ? "" : `${(x + w * (t[i] - t[0]) / length).toFixed(1)},${(y + h * (high - v) / span).toFixed(1)}`);
    svg.append(shape("polyline", {class: cls, points: points.filter(Boolean).join(" ")}));
  }
}
async function drawTorques(id, box) {
  const d = await chunk("torques-" + id), high = 74, svg = shape("svg", {viewBox: `0 0 900 ${high * d.rows.length + 34}`, role: "img"});
  svg.setAttribute("aria-label", `Measured and predicted torques and their residuals: ${d.title}`);
  svg.append(shape("text", {class: "one", x: 60, y: 12}, "measured"), shape("text", {class: "two", x: 130, y: 12}, "predicted (dashed)"));
  d.rows.forEach((name, j) => {
    const y = 30 + high * j, rest = d.measured[j].map((v, i) => v === null || d.predicted[j][i] === null ? null : v - d.predicted[j][i]);
    panel(svg, [60, y, 370, high - 22], d.t, [[d.measured[j], "one"], [d.predicted[j], "two"]], `${name} [${d.units[j]}]`);
    panel(svg, [510, y, 370, high - 22], d.t, [[rest, "rest"]], `residual of ${name} [${d.units[j]}]`);
  });
  const every = d.step > 1 ? `, one of ${d.step} samples` : "";
  const figure = make("section", "", {class: "wide"}, make("h3", "Torques and residuals"), svg, make("p", `${d.title}: ${number(d.t[0])} to ${number(d.t[d.t.length - 1])} s${every}.`, {class: "soft"}));
  box.append(figure);
}

/* The address: q, a field and its word, sort, hide, open. */
function writeAddress() {
  const parts = new URLSearchParams();
  if (state.q) parts.set("q", state.q);
  for (const [name, wanted] of state.want) parts.set("is." + name, wanted);
  if (state.sort) parts.set("sort", state.sort);
  const hidden = [...state.hide].join(","), usual = columns.filter(c => !c.shown).map(c => c.name).join(",");
  if (hidden !== usual) parts.set("hide", hidden);
  if (state.open.size) parts.set("open", [...state.open].join(","));
  const text = parts.toString();
  history.replaceState(null, "", text ? "#" + text : location.pathname + location.search);
}
function readAddress() {
  const parts = new URLSearchParams(location.hash.includes("=") ? location.hash.slice(1) : "");
  const list = (name, usual) => parts.has(name) ? parts.get(name).split(",").filter(Boolean) : usual;
  state.q = parts.get("q") || "";
  state.sort = column((parts.get("sort") || "").replace(/^-/, "")) ? parts.get("sort") : "";
  state.want = new Map([...parts].filter(([k]) => k.startsWith("is.") && data.words.includes(k.slice(3))).map(([k, v]) => [k.slice(3), v]));
  state.hide = new Set(list("hide", columns.filter(c => !c.shown).map(c => c.name)));
  state.open = new Set(list("open", []));
  get("search").value = state.q;
  for (const menu of document.querySelectorAll("#controls select")) menu.value = state.want.has(menu.name) ? "=" + state.want.get(menu.name) : "";
  for (const box of document.querySelectorAll("#columns input")) box.checked = !state.hide.has(box.name);
  setOrder(); drawHead(); shown = PAGE; select(); draw();
}
function addMenus() {
  for (const c of columns.filter(c => c.i !== undefined && c.name !== "reason" && data.dictionary[c.i].length > 1 && data.dictionary[c.i].length <= 500)) {
    const menu = make("select", "", {name: c.name, "aria-label": c.name}, make("option", "any " + c.name, {value: ""}));
    for (const w of data.dictionary[c.i]) menu.append(make("option", w || "none", {value: "=" + w}));
    menu.onchange = () => { if (menu.value) state.want.set(c.name, menu.value.slice(1)); else state.want.delete(c.name); update(); };
    get("controls").append(menu);
  }
}
function addControls() {
  const boxes = columns.map(c => {
    const box = make("input", "", {type: "checkbox", name: c.name});
    box.onchange = () => { if (box.checked) state.hide.delete(c.name); else state.hide.add(c.name); drawHead(); draw(); writeAddress(); };
    return make("label", "", {}, box, " " + c.name);
  });
  get("columns").append(...boxes);
  get("search").oninput = () => { state.q = get("search").value; update(); };
  const more = () => { if (chosen.length > shown) { shown += PAGE; drawRows(shown - PAGE); } }, box = get("all-cells");
  get("more").onclick = more;
  box.onscroll = () => { if (box.scrollTop + 2 * box.clientHeight > box.scrollHeight) more(); };
  window.addEventListener("resize", () => document.querySelectorAll(".opened").forEach(fit));
  window.addEventListener("hashchange", () => { if (location.hash.includes("=")) readAddress(); });
}
const mark = what => { document.documentElement.dataset[what] = Math.round(performance.now()); };
/* The first rows stand in the page as they are: they are drawn before all cells are read. */
async function start() {
  const hasAddress = () => location.hash.includes("="), isAddressed = hasAddress();
  const isEarly = get("first") && !isAddressed;
  if (isEarly) {
    data = JSON.parse(get("first").textContent);
    columns = columnsOf(); addControls(); readAddress(); mark("ready");
  }
  await parsed;
  if (typeof DecompressionStream === "undefined") {
    get("count").textContent = "This browser cannot read the compressed cells; cells.parquet beside this page holds the same rows.";
    return;
  }
  data = await unpack("data");
  isWhole = true;
  columns = columnsOf(); addMenus();
  if (!isEarly) addControls();
  if (isEarly && !hasAddress()) { setOrder(); select(); showCount(); } else readAddress();
  if (!isEarly) mark("ready");
  mark("whole");
  if (isAddressed) { get("main").className = "laid-out"; get("all").scrollIntoView(); }
}
start();
