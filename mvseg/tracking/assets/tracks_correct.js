// Where `mvseg correct` serves the page: a leaf on one date and a leaf on another are the same, a link is wrong.

const SURE = 0.9; // probability of a link: below this it is drawn as doubtful

class TrackWork {
  constructor() {
    Object.assign(this, { data, panes: [], panel: null, sight: null, note: "", skipped: new Set(), server: null });
    this.edits = new Edits(data.correct, []);
    onClick = (leaf) => this.click(leaf);
    onDraw = () => this.drawLinks();
    this.links = drawing("svg", { id: "links", "aria-label": "links" });
    find("dates").append(this.links);
    new ResizeObserver(() => this.drawLinks()).observe(find("dates"));
    this.edits.listen(() => {
      this.sight = null;
      this.changed();
    });
    this.server = new Server(this);
    this.note = window.sessionStorage.getItem("mvseg-whole") ?? ""; // said before the page was loaded anew
    window.sessionStorage.removeItem("mvseg-whole");
    document.addEventListener("keydown", (event) => this.press(event));
    this.markTable();
    this.changed();
    drawDates();
  }

  // --- what the server finds

  update(news) {
    const pictures = new Map(data.leaves.map(({ date, leaf, crop, place }) => [`${date} ${leaf}`, { crop, place }]));
    Object.assign(data, news);
    for (const leaf of data.leaves) Object.assign(leaf, pictures.get(`${leaf.date} ${leaf.leaf}`));
    this.sight &&= this.leafAt(this.sight.date, this.sight.leaf);
    show();
    this.markTable();
    this.changed();
  }

  leafAt(date, leaf) {
    return data.leaves.find((one) => one.date === date && one.leaf === leaf) ?? null;
  }

  nameOf(leaf) {
    const { written } = data.dates[leaf.date];
    return `leaf ${leaf.track} of ${/^[\d.+-]+$/.test(written) && !/^\d{4}-/.test(written) ? "day " : ""}${written}`;
  }

  placeOf(leaf) {
    return [data.dates[leaf.date].scene, ...leaf.place];
  }

  // [earlier leaf, later leaf] of each two that follow each other in a track.
  pairs() {
    return tracks.flatMap((track) => {
      const seen = data.leaves.filter((leaf) => leaf.track === track).sort((one, other) => one.date - other.date);
      return seen.slice(1).map((leaf, n) => [seen[n], leaf]);
    });
  }

  // --- what the user says

  click(leaf) {
    const { sight } = this;
    if (!leaf || !sight || leaf.date === sight.date || leaf.track === sight.track) {
      this.look(leaf);
    } else if (leaf.shape.length && leaf.place && sight.place) {
      this.say("same_track", sight, leaf);
    }
  }

  look(leaf) {
    this.sight = leaf && leaf.shape.length && leaf.place ? leaf : null;
    this.note = leaf && !this.sight ? `${this.nameOf(leaf)} has no shape, so nothing can be linked with it.` : "";
    pick(leaf ? leaf.track : 0);
    this.changed();
  }

  say(op, one, other) {
    const edit = { op, at: [this.placeOf(one), this.placeOf(other)] };
    this.note = edit; // tracks may get other numbers: its words are those of the list
    pick(0);
    this.edits.add(edit);
  }

  undo() {
    this.note = this.edits.earlier.length ? "Undone." : "";
    this.edits.undo();
  }

  // --- questions

  question() {
    const open = (data.questions ?? []).filter((one) => !this.skipped.has(this.keyOf(one)));
    const [asked] = open;
    if (!asked) return null;
    const [before, after] = [asked.before, asked.after].map(([date, leaf]) => this.leafAt(date, leaf));
    return { ...asked, before, after, left: open.length };
  }

  keyOf({ before, after }) {
    return JSON.stringify([before, after]);
  }

  answer(op) {
    const asked = this.sight ? null : this.question();
    if (asked) this.say(op, asked.before, asked.after);
  }

  next() {
    if (this.sight) return this.look(null);
    const asked = (data.questions ?? []).find((one) => !this.skipped.has(this.keyOf(one)));
    if (asked) this.skipped.add(this.keyOf(asked));
    else this.skipped.clear();
    this.note = "";
    pick(0);
    return this.changed();
  }

  press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("select, input")) return;
    if (event.key === "s") this.answer("same_track");
    else if (event.key === "d") this.answer("different_track");
    else if (event.key === "n") this.next();
    else if (event.key === "u") this.undo();
    else if (event.key === "Escape") this.look(null);
    else return;
    event.preventDefault();
  }

  // --- what is shown

  changed() {
    if (!this.server) return;
    this.showQuestion();
    this.showEdits();
    const { problem, state, isStale, isComputing } = this.server;
    const note = typeof this.note === "string" ? this.note : `${this.describe(this.note)}.`;
    const said = problem || [note, isComputing || !note ? state : ""].filter(Boolean).join(" ");
    find("note").classList.toggle("problem", Boolean(problem) || isStale);
    const reload = isStale ? [element("button", { type: "button" }, "Reload")] : [];
    reload.forEach((button) => button.addEventListener("click", () => window.location.reload()));
    find("note").replaceChildren(isStale ? `${state} This one saves nothing any more. ` : said, ...reload);
    for (const cell of document.querySelectorAll("#tracks .cell")) {
      cell.classList.toggle("sight", Boolean(this.sight) && cell.leaf === this.sight);
    }
    drawDates();
  }

  button(text, key, action, { disabled = false } = {}) {
    const hint = key ? [element("kbd", {}, key)] : [];
    const one = element("button", { type: "button", disabled: disabled ? "" : null, "aria-keyshortcuts": key }, text, ...hint);
    one.addEventListener("click", action);
    return one;
  }

  showQuestion() {
    const asked = this.question();
    if (this.sight) {
      const dates = "Click the same leaf on another date, or a link that is wrong. Esc lets it go.";
      find("ask").replaceChildren(element("h2", {}, this.nameOf(this.sight)), element("p", { class: "note" }, dates));
      buildHistory(this.sight.track, find("ask"));
      return;
    }
    const how = "Click a leaf on one date, then a leaf on another: they are the same. Click a link: it is not the same leaf.";
    if (!asked) {
      const skipped = this.skipped.size ? [this.button("Ask again", "n", () => this.next())] : [];
      find("ask").replaceChildren(element("h2", {}, "Nothing doubtful is left"), element("p", { class: "note" }, how),
        element("div", { class: "answers" }, ...skipped));
      return;
    }
    const { before, after, isLinked, doubt, changes, left } = asked;
    const chance = Math.round(100 * (isLinked ? 1 - doubt : doubt));
    const otherwise = isLinked ? "If not" : "If so";
    const what = changes === null ? [element("p", { class: "note" }, "Finding out what that would change\u2026")]
      : changes.length ? [element("p", {}, `${otherwise}:`), element("ul", {}, ...changes.map((text) => element("li", {}, text)))]
        : [element("p", { class: "note" }, `${otherwise}, nothing else changes.`)];
    const sides = element("div", { class: "sides" });
    const title = `Are ${this.nameOf(before)} and ${this.nameOf(after)} the same?`;
    find("ask").replaceChildren(
      element("h2", {}, title), element("p", { class: "note" }, `${chance} % likely; ${count(left, "question")} left.`),
      sides, ...what,
      element("div", { class: "answers" }, this.button("The same", "s", () => this.answer("same_track")),
        this.button("Not the same", "d", () => this.answer("different_track")),
        this.button("I cannot tell", "n", () => this.next()),
        this.button("Show it", null, () => pick(before.track))),
      element("p", { class: "note" }, how),
    );
    for (const track of new Set([before.track, after.track])) buildHistory(track, sides);
  }

  showEdits() {
    const { edits, server } = this;
    const rows = edits.list.map((edit, index) => {
      const remove = element("button", { type: "button", class: "plain", title: "delete it", "aria-label": `delete edit ${index + 1}` }, "\u2715");
      remove.addEventListener("click", () => edits.remove(index));
      const problem = server.outcomes[index] ? [element("div", { class: "problem" }, server.outcomes[index])] : [];
      return element("li", {}, this.describe(edit), remove, ...problem);
    });
    find("said").replaceChildren(
      element("h2", {}, count(edits.list.length, "edit")), element("ol", {}, ...rows),
      element("div", { class: "answers" },
        this.button("Undo", "u", () => this.undo(), { disabled: !edits.earlier.length }),
        this.button("Write the tables", null, () => { this.note = ""; server.whole(); })),
    );
    find("said").querySelector("ol").scrollTop = 1e6;
  }

  // An edit in words: leaves that it names by points of this page have numbers.
  describe(edit) {
    if (!edit.op.endsWith("_track")) return describeEdit(edit);
    const names = edit.at.map((place) => {
      const leaf = data.leaves.find((one) => one.place && JSON.stringify(this.placeOf(one)) === JSON.stringify(place));
      return leaf ? this.nameOf(leaf) : `a leaf of ${place[0]}`;
    });
    return names.join(edit.op === "same_track" ? " = " : " \u2260 ");
  }

  // Links as lines from date to date, and rings around the leaf that is picked, or those of the question.
  drawLinks() {
    const canvases = [...document.querySelectorAll("#dates canvas")];
    const placed = new Map(canvases.flatMap((canvas) => (canvas.leaves ?? []).map(({ leaf, middle }) =>
      [leaf, [canvas.offsetLeft + middle[0], canvas.offsetTop + middle[1]]])));
    const lines = this.pairs().filter((pair) => pair.every((leaf) => placed.has(leaf))).map(([one, other]) => {
      const [[x, y], [u, v]] = [placed.get(one), placed.get(other)];
      const d = `M${x} ${y} C${(x + u) / 2} ${y} ${(x + u) / 2} ${v} ${u} ${v}`;
      const kind = [one.track === picked && "picked", other.p !== null && other.p < SURE && "doubtful"].filter(Boolean).join(" ");
      const group = drawing("g", { class: kind }, drawing("title", {}, this.describeLink(one, other)),
        drawing("path", { d, class: "reach" }), drawing("path", { d, class: "line", stroke: data.colors[one.track] }));
      group.addEventListener("click", () => this.say("different_track", one, other));
      return group;
    });
    const asked = this.question();
    const meant = (this.sight ? [this.sight] : asked ? [asked.before, asked.after] : []).map((leaf) => placed.get(leaf));
    const rings = meant.filter(Boolean).map(([cx, cy]) => drawing("circle", { cx, cy, r: 10 }));
    this.links.setAttribute("width", find("dates").scrollWidth);
    this.links.setAttribute("height", find("dates").clientHeight);
    this.links.replaceChildren(...lines, ...rings);
  }

  describeLink(one, other) {
    const days = [one, other].map((leaf) => data.dates[leaf.date].written).join(" to ");
    return `leaf ${one.track}, ${days}, probability ${other.p ?? "unknown"}: click if it is not the same`;
  }

  // In the table, each leaf and each link is a button, for the keyboard.
  markTable() {
    for (const cell of document.querySelectorAll("#tracks .cell")) {
      if (!cell.leaf) continue;
      cell.tabIndex = 0;
      cell.setAttribute("role", "button");
      cell.setAttribute("aria-label", this.nameOf(cell.leaf));
      cell.addEventListener("click", (event) => {
        event.stopPropagation();
        this.click(cell.leaf);
      });
      cell.addEventListener("keydown", (event) => {
        if (event.key === "Enter" || event.key === " ") cell.click();
      });
    }
    const cells = new Map([...document.querySelectorAll("#tracks .cell")].map((cell) => [cell.leaf, cell]));
    for (const [one, other] of this.pairs()) {
      const kind = `link${other.p !== null && other.p < SURE ? " doubtful" : ""}`;
      const link = element("button", { type: "button", class: kind, title: this.describeLink(one, other) }, "\u2013");
      link.addEventListener("click", (event) => {
        event.stopPropagation();
        this.say("different_track", one, other);
      });
      cells.get(other).before(link);
    }
  }
}

const work = new TrackWork();
