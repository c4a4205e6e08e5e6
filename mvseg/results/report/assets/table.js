// The table of leaves. A click on a header sorts, missing numbers last; columns are chosen, and saved as CSV.

const FIRST = ["area", "length", "width", "insertion_height"]; // beside leaf, use and doubts: what most people need

function buildTable(data) {
  const columns = listColumns(data);
  const table = document.getElementById("table");
  const [head, body] = [table.tHead, table.tBodies[0]];
  const rows = data.leaves.map((leaf) => makeRow(leaf, columns));
  body.append(...rows.map((row) => row.element));
  const order = { column: 0, isDescending: false };
  const headers = columns.map((column, index) => makeHeader(column, () => sort(index)));
  head.append(element("tr", {}, ...headers));
  headers[0].setAttribute("aria-sort", "ascending");
  const choices = columns.map((column, index) => makeChoice(column, [head.rows[0], ...body.rows], index));
  document.getElementById("table-columns").append(...choices.slice(1).map((box) => box.parentElement));
  document.getElementById("save-table").addEventListener("click", () => {
    const shown = columns.filter((_, index) => choices[index].checked);
    saveFile(`${data.plant}.csv`, writeTable(shown, rows.map((row) => data.leaves.find((leaf) => leaf.id === row.leaf))),
      "text/csv");
  });
  const unmatched = data.views.flatMap((view) => view.masks).filter((mask) => mask.leaf < 1).length;
  document.getElementById("table-caption").textContent = describeTable(data, unmatched);

  function sort(index) {
    order.isDescending = order.column === index && !order.isDescending;
    order.column = index;
    const sign = order.isDescending ? -1 : 1;
    rows.sort((a, b) => compare(a.keys[index], b.keys[index], sign) || a.leaf - b.leaf);
    body.append(...rows.map((row) => row.element));
    headers.forEach((header, at) => {
      if (at === index) header.setAttribute("aria-sort", order.isDescending ? "descending" : "ascending");
      else header.removeAttribute("aria-sort");
    });
  }

  const leafOf = (event) => Number(event.target.closest("tr")?.dataset.leaf) || null;
  body.addEventListener("pointerover", (event) => selection.hover(leafOf(event)));
  body.addEventListener("pointerleave", () => selection.hover(null));
  body.addEventListener("click", (event) => selection.select(leafOf(event)));
  body.addEventListener("focusin", (event) => selection.hover(leafOf(event)));
  body.addEventListener("focusout", () => selection.hover(null));
  body.addEventListener("keydown", (event) => {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    const at = rows.findIndex((row) => row.element.contains(document.activeElement));
    const next = rows[at + step];
    if (step === undefined || next === undefined) return;
    event.preventDefault();
    next.element.querySelector("button").focus();
    selection.select(next.leaf);
  });
  selection.listen((selected) => {
    for (const row of rows) {
      selection.mark(row.element, row.leaf);
      row.element.setAttribute("aria-selected", row.leaf === selected);
    }
    const row = rows.find((one) => one.leaf === selected);
    if (row) scrollInside(document.getElementById("table-frame"), row.element, head.offsetHeight);
  });
}

// Only the table moves, never the page.
function scrollInside(frame, row, above) {
  if (row.offsetTop - above < frame.scrollTop) frame.scrollTop = row.offsetTop - above;
  const below = row.offsetTop + row.offsetHeight - frame.clientHeight;
  if (below > frame.scrollTop) frame.scrollTop = below;
}

function compare(a, b, sign) {
  if (a === null || b === null) return (a === null) - (b === null);
  return sign * (typeof a === "string" ? a.localeCompare(b) : a - b);
}

// A checkbox that shows a column; it hides at once one that nobody asked for.
function makeChoice(column, rows, index) {
  const box = element("input", { type: "checkbox" });
  const show = () => rows.forEach((row) => { row.cells[index].hidden = !box.checked; });
  box.checked = column.isShown;
  box.addEventListener("change", show);
  show();
  element("label", {}, box, column.name);
  return box;
}

// CSV with the names of traits_wide.csv; numbers are those of the data, not rounded further.
function writeTable(columns, leaves) {
  const fields = columns.flatMap((column) => column.fields);
  const lines = [fields.map(([name]) => name), ...leaves.map((leaf) => fields.map(([, value]) => value(leaf)))];
  return lines.map((line) => `${line.map(writeCell).join(",")}\n`).join("");
}

// As `escape_text` of mvseg/traits/table.py: no spreadsheet takes text for a formula.
function writeCell(value) {
  if (value === null || value === undefined) return "";
  const text = String(value).split(/\s+/).filter(Boolean).join(" ");
  const safe = typeof value === "string" && /^[=+@-]/.test(text) ? `'${text}` : text;
  return /[",]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
}

// Columns: name, unit, meaning, whether shown at first, text and sort key of a leaf, and fields in CSV.
function listColumns(data) {
  const masks = data.views.flatMap((view) => view.masks);
  const mean = (leaf) => {
    const scores = masks.filter((mask) => mask.leaf === leaf.id).map((mask) => mask.match_score);
    return scores.length ? scores.reduce((sum, score) => sum + score, 0) / scores.length : null;
  };
  const numViews = (leaf) => data.views.filter((view) => showsLeaf(view, leaf.id)).length;
  const traits = [true, false].flatMap((isShown) => data.traits.filter((trait) => trait.isColumn === isShown));
  const measured = traits.map((trait) => ({
    name: trait.label,
    isShown: trait.isColumn,
    unit: trait.unit,
    meaning: trait.meaning,
    cell: (leaf) => numberCell(leaf.traits[trait.name], trait.unit),
    key: (leaf) => leaf.traits[trait.name]?.value ?? null,
    fields: [
      [trait.name, (leaf) => leaf.traits[trait.name]?.value],
      ...(trait.hasSd ? [[`${trait.name}_sd`, (leaf) => leaf.traits[trait.name]?.sd]] : []),
    ],
  }));
  const plain = (name, meaning, field, key, write = String) => ({
    name, unit: "", meaning, key, isShown: true, fields: [[field, key]], cell: (one) => element("td", {}, key(one) === null ? "\u2013" : write(key(one))),
  });
  const twoDigits = (value) => value.toFixed(2);
  const leaf = { ...plain("leaf", "number of the leaf, in all files", "leaf", (one) => one.id), cell: leafCell };
  leaf.fields = [["plant", () => data.plant], ...leaf.fields, ["unit", () => data.unit]];
  const score = plain("match score", "mean match score of the leaf's masks, 1 is best", "match_score", mean, twoDigits);
  const chance = data.leaves.some((one) => one.probability !== undefined) ? [plain("leaf probability",
    "how likely this is a leaf", "probability", (one) => one.probability ?? null, twoDigits)] : [];
  if (data.traits.length === 0) {
    return [leaf, ...chance, plain("views", "photos with a mask of the leaf", "num_views", numViews), score];
  }
  const shape = plain("shape", "what was measured", "method", (one) => one.shape);
  const use = plain("use", "whether to use the numbers: yes, look at the leaf first, or no", "use", (one) => one.use);
  const doubts = (one) => one.doubts.join("; ");
  const quality = {
    ...plain("doubts", "reasons to doubt the numbers", "quality", (one) => doubts(one) || null),
    fields: [["quality", (one) => doubts(one) || "good"]],
    cell: (one) => element("td", { class: "text" }, doubts(one)),
    kind: "text",
  };
  const first = measured.filter(({ fields: [[name]] }) => FIRST.includes(name));
  const rest = measured.filter((column) => !first.includes(column));
  return [leaf, use, ...first, quality, ...chance, ...rest, score, shape];
}

function leafCell(leaf) {
  const swatch = element("span", { class: "swatch", style: `background:${leaf.color}` });
  const name = { type: "button", "aria-label": `leaf ${leaf.id}` };
  return element("td", {}, element("button", name, swatch, ` ${leaf.id}`));
}

function numberCell(number, unit) {
  if (number?.value === undefined) return element("td", { title: number?.why }, "\u2013");
  const text = formatNumber(number.value, number.sd, unit);
  const sd = text.sd === null ? null : element("span", { class: "sd" }, ` \u00b1 ${text.sd}`);
  return element("td", { title: number.on }, text.value, sd);
}

function makeRow(leaf, columns) {
  const row = element("tr", { "data-leaf": leaf.id }, ...columns.map((column) => column.cell(leaf)));
  row.classList.toggle("doubtful", (leaf.doubts ?? []).length > 0);
  if (leaf.probability !== undefined) row.style.opacity = 0.4 + 0.6 * leaf.probability; // what is doubtful is paler
  return { leaf: leaf.id, element: row, keys: columns.map((column) => column.key(leaf)) };
}

function makeHeader(column, sort) {
  const button = element("button", { type: "button", title: column.meaning }, column.name);
  button.addEventListener("click", sort);
  const unit = column.unit ? element("small", {}, column.unit) : null;
  return element("th", { scope: "col", class: column.kind ?? null }, button, unit);
}

function describeTable(data, unmatched) {
  const others = unmatched ? ` ${count(unmatched, "mask")} matched to no leaf.` : "";
  const sd = data.traits.length ? " Numbers are given \u00b1 one standard deviation." : "";
  const grey = data.leaves.some((leaf) => leaf.doubts?.length) ? " Grey: a leaf with doubts." : "";
  const pale = data.leaves.some((leaf) => leaf.probability < 0.9) ? " Paler: less probably a leaf." : "";
  return `Click a header to sort.${sd}${grey}${pale}${others}`;
}
