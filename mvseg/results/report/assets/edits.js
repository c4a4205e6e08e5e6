// The list of edits, as in corrections.json. The browser keeps it over a reload.

const FORMAT = "mvseg-corrections/1";
const MOST_EDITS = 10000;
const MOST_POINTS = 10000;
const MOST_BYTES = 64 * 2 ** 20;
const OPS = {
  outline: ["view", "polygon"], reject: ["view", "at"], confirm: ["view", "at"], split: ["view", "at", "line"],
  same: ["at"], different: ["at"], same_track: ["at"], different_track: ["at"],
};

class Edits {
  constructor({ key, edits, photos, isServed }, views) {
    this.place = isServed ? null : `mvseg-corrections:${key}`; // what is served is kept by the server
    this.list = edits;
    [this.photos, this.views] = [photos, views]; // what tells this plant's photos from others', and their names
    this.earlier = []; // lists before the last changes, for "undo"
    this.listeners = [];
    this.problem = "";
    try {
      const kept = this.place && window.localStorage.getItem(this.place);
      if (kept !== null) this.list = readEdits(kept, this.photos);
    } catch (error) {
      this.problem = `What this browser kept of earlier edits cannot be read: ${error.message}`;
    }
  }

  listen(listener) {
    this.listeners.push(listener);
  }

  add(...edits) {
    this.change([...this.list, ...edits]);
  }

  remove(index) {
    this.change(this.list.filter((_, at) => at !== index));
  }

  change(list) {
    this.earlier.push(this.list);
    this.put(list);
  }

  undo() {
    if (this.earlier.length) this.put(this.earlier.pop());
  }

  put(list) {
    this.list = list;
    this.problem = "";
    try {
      if (this.place) window.localStorage.setItem(this.place, this.text());
    } catch {
      this.problem = "This browser keeps nothing for this page: save corrections.json before you close it.";
    }
    for (const listener of this.listeners) listener(list);
  }

  text() {
    const lines = this.list.map((edit) => `  ${JSON.stringify(edit)}`);
    const named = this.list.filter((edit) => !edit.op.endsWith("_track"))
      .flatMap((edit) => edit.view ?? edit.at.map(([view]) => view));
    const found = [...new Set(named.map((name) => viewNamed(name, this.views)))].filter((view) => view >= 0);
    const photos = found.map((view) => this.views[view].name).map((name) => [name, this.photos[name]]);
    const marks = photos.length ? `\n "photos": ${JSON.stringify(Object.fromEntries(photos))},` : "";
    return `{"format": "${FORMAT}",${marks}\n "edits": [\n${lines.join(",\n")}\n ]}\n`;
  }

  save() {
    saveFile("corrections.json", this.text(), "application/json");
  }
}

// The edits in a corrections.json. Throws an Error of one sentence.
// `photos`: of this plant; a file that names others was made for another one.
function readEdits(text, photos) {
  if (text.length > MOST_BYTES) throw new Error(`the file has ${text.length} bytes, expected at most ${MOST_BYTES}`);
  let content;
  try {
    content = JSON.parse(text);
  } catch {
    throw new Error("the file is no whole JSON file");
  }
  if (content?.format !== FORMAT) throw new Error(`the file is none of corrections, expected "format": "${FORMAT}"`);
  if (!Array.isArray(content.edits)) throw new Error('"edits" is no list');
  const other = Object.entries(content.photos ?? {}).find(([name, mark]) => Object.hasOwn(photos, name) &&
    ["width", "height", "sha256"].some((key) => mark?.[key] !== undefined && photos[name][key] !== undefined &&
      mark[key] !== photos[name][key]));
  if (other) throw new Error(`it was made for another scene (photo ${other[0]} is another one here)`);
  if (content.edits.length > MOST_EDITS) {
    throw new Error(`the file has ${content.edits.length} edits, expected at most ${MOST_EDITS}`);
  }
  content.edits.forEach((edit, index) => {
    const problem = problemOf(edit);
    if (problem) throw new Error(`edit ${index + 1}: ${problem}`);
  });
  return content.edits;
}

function problemOf(edit) {
  const keys = typeof edit?.op === "string" && Object.hasOwn(OPS, edit.op) ? OPS[edit.op] : null;
  if (keys === null) return `op is none of ${Object.keys(OPS).join(", ")}`;
  const isPoint = (point) => Array.isArray(point) && point.length === 2 && point.every(Number.isFinite);
  const isPlace = (place) => Array.isArray(place) && place.length >= 3 && place.slice(-2).every(Number.isFinite) &&
    place.slice(0, -2).every((name) => typeof name === "string");
  const isList = (list, isItem, least) =>
    Array.isArray(list) && list.length >= least && list.length <= MOST_POINTS && list.every(isItem);
  if (keys.includes("view")) {
    if (typeof edit.view !== "string") return "view is no text";
    if (edit.op !== "outline" && !isPoint(edit.at)) return "at is not two numbers";
    if (edit.op === "outline" && !isList(edit.polygon, isPoint, 3)) return "polygon is no list of three or more points";
    if (edit.op === "split" && !isList(edit.line, isPoint, 2)) return "line is no list of two or more points";
    if (edit.leaf !== undefined && edit.leaf !== null && typeof edit.leaf !== "string") return "leaf is no text";
    return "";
  }
  return isList(edit.at, isPlace, 2) ? "" : "at is no list of two or more places";
}

// The index of the view that an edit names; -1 for one that this result does not have.
function viewNamed(name, views) {
  const bare = (text) => text.replace(/\.[^./]+$/, "");
  for (const fits of [(view) => view.name === name, (view) => view.name === bare(name),
    (view) => view.name === bare(name.split("/").pop())]) {
    const found = views.findIndex(fits);
    if (found >= 0) return found;
  }
  return -1;
}

// {view, at, symbol} of all places of edits, in units of the pictures; view -1 for photos that are not here.
function placesOf(list, { data, frames }) {
  const symbols = {
    outline: "\u270e", reject: "\u2715", confirm: "\u2713", same: "=", different: "\u2260", split: "\u2702",
  };
  return list.filter((edit) => Object.hasOwn(symbols, edit.op)).flatMap((edit) => {
    const places = edit.view === undefined ? edit.at : [[edit.view, ...(edit.at ?? insidePoint(edit.polygon))]];
    return places.map(([name, ...point]) => {
      const view = viewNamed(name, data.views);
      return { edit, view, symbol: symbols[edit.op], at: view < 0 ? null : frames[view].toPicture(point) };
    });
  });
}

function describeEdit(edit) {
  const names = (list) => [...new Set(list)].join(", ");
  if (edit.stem) return `${edit.op === "confirm" ? "the stem" : "no stem"}, in ${edit.view}`;
  const all = edit.everywhere ? ", the leaf in all photos" : "";
  switch (edit.op) {
    case "outline": return `outline drawn in ${edit.view}${edit.leaf ? `, leaf \u201c${edit.leaf}\u201d` : ""}`;
    case "reject": return `no leaf, in ${edit.view}${all}`;
    case "confirm": return `right, in ${edit.view}${all}`;
    case "split": return `two leaves, cut in ${edit.view}`;
    case "same": return `the same leaf in ${names(edit.at.map(([view]) => view))}`;
    case "different": return `different leaves in ${names(edit.at.map(([view]) => view))}`;
    default: return `${edit.op === "same_track" ? "the same leaf" : "different leaves"} on several dates`;
  }
}
