"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const find = (id) => document.getElementById(id);
const WIDE = Math.max(150, Math.min(420, Math.floor((Math.min(1330, innerWidth) - 30) / data.dates.length) - 10)), HIGH = WIDE;
const DOWN = 25 * Math.PI / 180; // how steeply the plants are looked at
let tracks = [];
let picked = 0;
// `mvseg correct` has others of these.
let onClick = (leaf) => pick(leaf ? leaf.track : 0), onDraw = () => {};

function make(name, text, parent, kind) {
  const element = document.createElement(name);
  if (text !== undefined) element.textContent = text;
  if (kind) element.className = kind;
  if (parent) parent.append(element);
  return element;
}

function project(shape, turn) {
  const cos = Math.cos(turn), sin = Math.sin(turn), up = Math.cos(DOWN), near = Math.sin(DOWN), out = [];
  for (let at = 0; at < shape.length; at += 3) {
    const [x, y, z] = shape.slice(at, at + 3), back = x * sin + y * cos;
    out.push([WIDE / 2 + (x * cos - y * sin) * WIDE / 2500, HIGH / 2 - (z * up + back * near) * HIGH / 2500, back * up - z * near]);
  }
  return out;
}

function drawDate(canvas, date) {
  const pen = canvas.getContext("2d"), turn = find("turn").value * Math.PI / 180;
  pen.setTransform(2, 0, 0, 2, 0, 0);
  pen.clearRect(0, 0, WIDE, HIGH);
  const leaves = data.leaves.filter((leaf) => leaf.date === date && leaf.shape.length)
    .map((leaf) => ({ leaf, line: project(leaf.shape, turn) }));
  for (const item of leaves) item.depth = item.line.reduce((sum, point) => sum + point[2], 0) / item.line.length;
  leaves.sort((one, other) => other.depth - one.depth);
  canvas.leaves = leaves.map(({ leaf, line }) => {
    const path = new Path2D();
    line.forEach(([x, y], n) => (n ? path.lineTo(x, y) : path.moveTo(x, y)));
    pen.globalAlpha = picked && leaf.track !== picked ? 0.15 : 0.9;
    pen.fillStyle = pen.strokeStyle = data.colors[leaf.track];
    if (leaf.flat) { path.closePath(); pen.fill(path); pen.strokeStyle = "#0008"; pen.lineWidth = 0.5; pen.stroke(path); }
    else { pen.lineWidth = 4; pen.stroke(path); }
    return { leaf, path, middle: middleOf(line) };
  });
  pen.globalAlpha = 1;
  drawAxes(pen, date, turn);
  pen.font = "bold 11px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.lineWidth = 3;
  for (const { leaf, middle: [x, y] } of canvas.leaves) {
    if (picked && leaf.track !== picked) continue;
    pen.strokeStyle = "#fffc"; pen.fillStyle = "#000";
    pen.strokeText(leaf.track, x, y); pen.fillText(leaf.track, x, y);
  }
}

// Stems from node to node, a dot for each node.
function drawAxes(pen, date, turn) {
  const sitting = data.leaves.filter((leaf) => leaf.date === date && leaf.node).sort((one, other) => one.node.height - other.node.height);
  pen.strokeStyle = pen.fillStyle = "#4a3a28"; pen.lineWidth = 2;
  for (const stem of new Set(sitting.map(({ node }) => node.stem))) {
    const places = project(sitting.filter(({ node }) => node.stem === stem).flatMap(({ at }) => at), turn);
    pen.beginPath();
    places.forEach(([x, y], n) => (n ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    pen.stroke();
    for (const [x, y] of places) { pen.beginPath(); pen.arc(x, y, 3, 0, 2 * Math.PI); pen.fill(); }
  }
}

function pickAt(canvas, event) {
  const pen = canvas.getContext("2d"), box = canvas.getBoundingClientRect();
  const x = (event.clientX - box.left) * 2, y = (event.clientY - box.top) * 2;
  pen.lineWidth = 6;
  const hit = [...canvas.leaves].reverse().find(({ path }) => pen.isPointInPath(path, x, y) || pen.isPointInStroke(path, x, y));
  onClick(hit ? hit.leaf : null);
}

function middleOf(line) {
  return [0, 1].map((axis) => line.reduce((sum, point) => sum + point[axis], 0) / line.length);
}

function drawDates() {
  for (const [date, canvas] of [...document.querySelectorAll("#dates canvas")].entries()) drawDate(canvas, date);
  for (const canvas of document.querySelectorAll("canvas.alone")) drawAlone(canvas);
  onDraw();
}

// One leaf of a date, as large as fits.
function drawAlone(canvas) {
  const { leaf } = canvas, line = project(leaf.shape, find("turn").value * Math.PI / 180), pen = canvas.getContext("2d");
  const [x, y] = [0, 1].map((axis) => line.map((point) => point[axis]));
  const side = canvas.width, scale = 0.85 * side / Math.max(Math.max(...x) - Math.min(...x), Math.max(...y) - Math.min(...y), 1e-9);
  const place = (values, at) => side / 2 + (at - (Math.max(...values) + Math.min(...values)) / 2) * scale;
  pen.clearRect(0, 0, side, side);
  pen.beginPath();
  line.forEach((point) => pen.lineTo(place(x, point[0]), place(y, point[1])));
  pen.fillStyle = pen.strokeStyle = data.colors[leaf.track];
  pen.lineWidth = 4;
  if (leaf.flat) { pen.closePath(); pen.fill(); } else pen.stroke();
}

// The history of a leaf: its picture and its shape on each date, and where it has none, why.
function buildHistory(track, parent) {
  const seen = new Map(data.leaves.filter((leaf) => leaf.track === track).map((leaf) => [leaf.date, leaf]));
  const gaps = new Map(data.gaps.filter((gap) => gap[1] === track).map(([date, , state]) => [date, state]));
  const strip = make("div", undefined, parent, "history");
  data.dates.forEach(({ written }, date) => {
    const leaf = seen.get(date), figure = make("figure", undefined, strip);
    if (leaf && leaf.crop) {
      const image = make("img", undefined, figure);
      image.src = `data:image/jpeg;base64,${leaf.crop}`;
      image.alt = `leaf ${track} on ${written}`;
    }
    if (leaf && leaf.shape.length) {
      const canvas = make("canvas", undefined, figure, "alone");
      canvas.width = canvas.height = 144;
      canvas.leaf = leaf;
    }
    const p = leaf && leaf.p !== null ? `, probability ${leaf.p}` : "";
    make("figcaption", leaf ? `${written}${leaf.state === "born" ? ", born" : ""}${p}` : `${written}: ${gaps.get(date) || "not there"}`, figure);
  });
  return strip;
}

function buildDates() {
  data.dates.forEach((date) => {
    const figure = make("figure", undefined, find("dates")), canvas = make("canvas", undefined, figure);
    canvas.width = 2 * WIDE; canvas.height = 2 * HIGH; canvas.style.width = `${WIDE}px`;
    figure.style.width = `${WIDE + 2}px`;
    canvas.addEventListener("click", (event) => pickAt(canvas, event));
    make("figcaption", undefined, figure);
    make("div", undefined, figure, "stems");
  });
}

// Under each date what the plant did.
function captionDates() {
  const area = data.whole["total area"];
  document.querySelectorAll("#dates > figure > figcaption").forEach((caption, index) => {
    const date = data.dates[index], of = area.tracks[0].find((point) => point[0] === index);
    caption.textContent = `${dayOf(date)} · ${date.scene}`;
    const events = [`${date.leaves} leaves`, of && `${withUnit(Number(of[1].toPrecision(3)), area.unit)}`,
      index && date.born && `${date.born} new`, date.gone && `${date.gone} gone`];
    make("span", events.filter(Boolean).join(" · "), caption, "events");
  });
}

// The nodes of each stem on each date, all dates up to one height; leaves as they are tracked.
function drawStems() {
  const all = data.leaves.filter(({ node }) => node).map(({ date, track, node }) => ({ ...node, date, leaf: track }));
  const highest = Math.max(...all.map(({ height }) => height), 1e-12);
  const colors = new Map(Object.entries(data.colors).map(([track, color]) => [Number(track), color]));
  document.querySelectorAll("#dates .stems").forEach((place, date) => {
    const here = all.filter((node) => node.date === date);
    place.replaceChildren(...[...new Set(here.map(({ stem }) => stem))].sort((one, other) => one - other).map((number) => {
      const title = `Stem ${number} on ${dayOf(data.dates[date])}: height against azimuth`;
      return drawNodes(here.filter(({ stem }) => stem === number), { title, unit: data.unit, colors, choose: pick, highest });
    }));
  });
}

function isNumber(date) { return Number(date.written) === date.time; }

function dayOf(date) { return isNumber(date) ? `day ${date.written}` : date.written; }

function withUnit(value, unit) { return value + (unit ? ` ${unit.replace("^2", "\u00b2").replace("^3", "\u00b3")}` : ""); }

function buildTable() {
  find("tracks").replaceChildren();
  const table = make("table", undefined, find("tracks")), head = make("tr", undefined, make("thead", undefined, table));
  make("th", "leaf", head);
  data.dates.forEach((date) => make("th", date.written, head));
  const body = make("tbody", undefined, table), rows = {};
  find("ranks").textContent = data.correct ? "leaves keep their numbers while links are corrected; written tables number them anew"
    : data.knows_up ? "leaves are numbered from below, by the mean height of the base; tables and CSV have the same numbers (track)"
    : "leaves are numbered in the order of appearance (track), as up is unknown";
  for (const track of tracks) {
    rows[track] = make("tr", undefined, body);
    rows[track].dataset.track = track;
    rows[track].addEventListener("click", () => pick(track));
    make("td", track, rows[track]);
    data.dates.forEach(() => make("td", "", rows[track]));
  }
  for (const leaf of data.leaves) {
    const cell = make("span", undefined, rows[leaf.track].children[leaf.date + 1], `cell ${leaf.state}`);
    cell.leaf = leaf;
    cell.style.background = data.colors[leaf.track];
    cell.style.opacity = leaf.p === null ? 1 : 0.25 + 0.75 * leaf.p;
    cell.title = `leaf ${leaf.leaf}, ${leaf.state}` + (leaf.p === null ? "" : `, probability ${leaf.p}`);
  }
  for (const [date, track, state] of data.gaps) make("span", undefined, rows[track].children[date + 1], `cell ${state}`).title = state;
}

function svg(name, settings, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(settings)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  find("chart").append(element);
  return element;
}

function drawChart() {
  const trait = find("trait").value, of = data.numbers[trait] || data.whole[trait], chart = find("chart");
  const wide = Math.max(300, Math.min(900, chart.clientWidth || 720)), right = wide - 16, left = 62;
  chart.replaceChildren();
  chart.setAttribute("viewBox", `0 0 ${wide} 336`);
  find("model").textContent = "";
  if (!of) return;
  const shown = Object.entries(of.tracks).filter(([track]) => !picked || track === "0" || Number(track) === picked);
  const values = shown.flatMap(([, points]) => points.flatMap(([, value, sd]) => [value - sd, value + sd]));
  if (!values.length) { find("model").textContent = "not measured on any date"; return; }
  const low = Math.min(0, ...values), high = Math.max(...values, low + 1e-9), first = data.dates[0].time;
  const span = Math.max(data.dates.at(-1).time - first, 1e-9);
  const x = (time) => left + 28 + (time - first) / span * (right - left - 56), y = (value) => 290 - (value - low) / (high - low) * 265;
  const decade = 10 ** Math.floor(Math.log10((high - low) / 4));
  const step = decade * [1, 2, 5, 10].find((factor) => factor * decade >= (high - low) / 6);
  for (let tick = Math.ceil(low / step); tick * step <= high; tick += 1) {
    svg("line", { x1: left, x2: right, y1: y(tick * step), y2: y(tick * step), stroke: "#8884" });
    svg("text", { x: left - 8, y: y(tick * step) + 4, "text-anchor": "end" }, Number((tick * step).toPrecision(6)));
  }
  drawDays(x, [left, right], wide);
  svg("text", { x: left, y: 12 }, trait.replaceAll("_", " ") + (of.unit ? ` (${withUnit("", of.unit).trim()})` : "") + " \u00b1 1 sd");
  const ends = [];
  for (const [track, points] of shown) {
    const at = points.map(([date, value, sd]) => [x(data.dates[date].time), y(value - sd), y(value + sd), y(value)]);
    const color = data.colors[track] ? inkOf(data.colors[track]) : "currentColor";
    if (at.length && track !== "0") ends.push({ track, x: at.at(-1)[0] + 9, y: at.at(-1)[3] + 4, color });
    const band = [...at.map((p) => `${p[0]},${p[1]}`), ...[...at].reverse().map((p) => `${p[0]},${p[2]}`)];
    svg("polygon", { points: band.join(" "), fill: color, opacity: picked ? 0.25 : 0.15, class: "band" });
    svg("polyline", { points: at.map((p) => `${p[0]},${p[3]}`).join(" "), fill: "none", stroke: color, "stroke-width": 2 });
    const born = data.leaves.find((leaf) => leaf.track === Number(track) && leaf.state === "born");
    at.forEach((p, n) => {
      const isNew = born && born.date === points[n][0] && born.date > 0;
      svg("circle", { cx: p[0], cy: p[3], r: isNew ? 5 : 3, fill: isNew ? "none" : color, stroke: color, "stroke-width": 2, class: isNew ? "born" : "seen" });
    });
    const gone = data.gaps.find((gap) => gap[1] === Number(track) && gap[2] === "gone");
    if (gone && at.length) {
      const px = x(data.dates[gone[0]].time), py = at.at(-1)[3];
      svg("path", { d: `M${at.at(-1)[0]},${py}L${px},${py}`, stroke: color, "stroke-dasharray": "2 4" });
      svg("path", { d: `M${px - 4},${py - 4}l8,8m0,-8l-8,8`, stroke: color, "stroke-width": 2, class: "gone" });
    }
  }
  writeEnds(ends);
}

// The number of each leaf at the end of its line; none over another.
function writeEnds(ends) {
  ends.sort((one, other) => other.y - one.y);
  ends.forEach((end, n) => {
    const below = ends.slice(0, n).filter((one) => Math.abs(one.x - end.x) < 16);
    end.y = Math.min(end.y, ...below.map((one) => one.y - 11));
    svg("text", { x: end.x, y: end.y, class: "end", style: `fill: ${end.color}` }, end.track);
  });
}

// The axis of days, and under it a photo of each date that has room.
function drawDays(x, [left, right], wide) {
  const first = data.dates[0], photos = data.dates.some((date) => date.photo);
  const gaps = data.dates.slice(1).map((date, n) => x(date.time) - x(data.dates[n].time));
  const side = Math.max(44, Math.min(120, Math.floor((right - left) / 3) - 4, ...gaps.map((gap) => gap - 4)));
  let free = -Infinity, freePhoto = -Infinity;
  for (const date of data.dates) {
    const written = isNumber(date) ? date.written : String(Number((date.time - first.time).toFixed(2)));
    svg("line", { x1: x(date.time), x2: x(date.time), y1: 290, y2: 295, stroke: "#888" });
    const half = 3.5 * written.length + 4;
    if (x(date.time) - half >= free) {
      svg("text", { x: x(date.time), y: 309, "text-anchor": "middle" }, written);
      free = x(date.time) + half;
    }
    const at = Math.max(2, Math.min(wide - side - 2, x(date.time) - side / 2));
    if (!date.photo || at < freePhoto) continue;
    const image = svg("image", { x: at, y: 336, width: side, height: side, href: `data:image/jpeg;base64,${date.photo}` });
    image.setAttribute("aria-label", `the plant on ${dayOf(date)}`);
    freePhoto = at + side;
  }
  svg("text", { x: (left + right) / 2, y: 327, "text-anchor": "middle" }, isNumber(first) ? "days" : `days since ${first.written}`);
  if (photos) find("chart").setAttribute("viewBox", `0 0 ${wide} ${340 + side}`);
}

function pick(track) {
  picked = track;
  find("leaf").textContent = track ? `Leaf ${track}` : "All leaves";
  for (const row of document.querySelectorAll("tbody tr")) row.classList.toggle("picked", Number(row.dataset.track) === track);
  find("crops").replaceChildren();
  if (track) buildHistory(track, find("crops"));
  drawDates();
  drawChart();
}

function press(event) {
  if (event.target.tagName === "SELECT") return;
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key], turn = { ArrowUp: 10, ArrowDown: -10 }[event.key];
  if (step) pick((picked + step + tracks.length + 1) % (tracks.length + 1));
  else if (turn) { find("turn").value = (Number(find("turn").value) + turn + 360) % 360; drawDates(); }
  else if (event.key === "Escape") pick(0);
  else return;
  event.preventDefault();
}

// All that follows from the tracks.
function show() {
  tracks = Object.keys(data.colors).map(Number);
  find("summary").textContent = `${tracks.length} leaves on ${data.dates.length} dates`;
  find("warnings").replaceChildren();
  for (const sentence of data.warnings) make("li", sentence, find("warnings"));
  captionDates();
  drawStems();
  buildTable();
  pick(tracks.includes(picked) ? picked : 0);
}

find("plant").textContent = data.plant;
for (const [label, of] of [["leaves", data.numbers], ["the whole plant", data.whole]]) {
  const group = make("optgroup", undefined, find("trait"));
  group.label = label;
  for (const trait of Object.keys(of)) make("option", trait.replaceAll("_", " "), group).value = trait;
}
find("chart-save").append(...exportButtons(() => `${data.plant}_${find("trait").value.replaceAll(" ", "_")}`, () => find("chart")));
addEventListener("resize", drawChart);
find("trait").addEventListener("change", drawChart);
find("turn").addEventListener("input", drawDates);
document.addEventListener("keydown", press);
buildDates();
show();
