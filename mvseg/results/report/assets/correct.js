// The mode "Correct": two photos side by side, what the user picks and draws there, and their edits.

const KEYS = { n: "next", s: "same", d: "different", r: "reject", R: "reject-all", c: "confirm", C: "confirm-all",
  u: "undo", o: "outline", l: "split", b: "brush", e: "erase", a: "area", t: "learn" };
const TOOLS = ["outline", "split", "brush", "erase", "area"];
const PARTNER = { least: 20, best: 40, most: 60 }; // degrees between two photos that are to show one leaf
const RADIUS = { start: 12, least: 2, most: 80, step: 1.3 }; // of the brush, pixels of the screen

class Work {
  constructor(data, addresses) {
    Object.assign(this, { data, addresses, picks: [], tool: null, draft: null, doubt: null, note: "", server: null });
    this.radius = RADIUS.start;
    this.frames = data.views.map((view, index) => new Frame(view, data.correct.views[index], data.correct.lenses));
    this.edits = new Edits(data.correct, data.views);
    this.skipped = new Set(); // names of questions that were asked
    this.numAsked = 0; // of this round
    this.read();
    this.panes = [new Pane(this), new Pane(this)];
    this.active = this.panes[0];
    document.getElementById("panes").append(...this.panes.map((pane) => pane.element));
    const names = shortNames(data.views.map(({ name }) => name));
    this.thumbnails = data.views.map((view, index) => {
      const image = element("img", { src: addresses.thumbnails[index], alt: "", draggable: "false" });
      const one = element("button", { type: "button", title: view.name }, image, element("span", {}, names[index]));
      one.addEventListener("click", () => this.active.show(index));
      return one;
    });
    document.getElementById("strip").append(...this.thumbnails);
    this.panes.forEach((pane, index) => pane.show(Math.min(index, data.views.length - 1)));
    this.panel = new Panel(this);
    this.edits.listen(() => {
      this.picks = [];
      this.readEdits();
      for (const pane of this.panes) pane.draw();
      this.changed();
    });
    document.addEventListener("keydown", (event) => this.press(event));
    this.changed();
  }

  // What follows from the masks, which may have changed.
  read() {
    this.colors = new Map(this.data.leaves.map((leaf) => [leaf.id, leaf.color]));
    this.doubts = placeDoubts(this.data);
    this.readEdits();
  }

  readEdits() {
    this.places = placesOf(this.edits.list, this);
    this.gone = rejectedMasks(this.places, this.data.views);
    this.open = this.doubts.filter((doubt) => !isAnswered(doubt, this.places));
  }

  update({ views, leaves, doubts, numMasks }) {
    views.forEach(({ masks }, index) => { this.data.views[index].masks = masks; });
    Object.assign(this.data, { leaves, numMasks });
    if (!document.getElementById("correct").hidden) summarise(this.data);
    this.data.correct.doubts = doubts;
    this.read();
    this.picks = this.picks.flatMap((pick) => this.pickAgain(pick));
    this.doubt &&= this.doubts.find((doubt) => doubt.name === this.doubt.name) ?? null;
    for (const pane of this.panes) pane.draw();
    this.changed();
  }

  // What is picked when other masks come: the mask at the same point.
  pickAgain({ view, name, mask, at }) {
    if (!mask) return [{ view, name, mask, at }];
    const found = this.data.views[view].masks.findLast((one) => isOnMask(one, at));
    return found ? [{ view, name: `r${found.region}`, mask: found, at }] : [];
  }

  changed() {
    if (!this.panel) return;
    for (const pane of this.panes) {
      pane.mark();
      pane.element.classList.toggle("active", pane === this.active);
      pane.element.classList.toggle("drawing", this.tool !== null);
    }
    this.thumbnails.forEach((one, view) => {
      const isShown = this.panes.some((pane) => pane.view === view);
      if (isShown && !one.classList.contains("shown")) one.scrollIntoView({ block: "nearest", inline: "nearest" });
      one.classList.toggle("shown", isShown);
      one.classList.toggle("picked", this.picks.some((pick) => pick.view === view));
    });
    this.panel.show();
  }

  say(text) {
    this.note = text;
    this.changed();
  }

  activate(pane) {
    if (this.active === pane) return;
    this.active = pane;
    this.changed();
  }

  // --- picking

  pick(pane, path, at) {
    if (!path) return this.offer(pane.view, at);
    const isDrawn = path.dataset.edit !== undefined;
    const name = isDrawn ? `e${path.dataset.edit}` : `r${path.dataset.region}`;
    const mask = isDrawn ? null : this.data.views[pane.view].masks.find((one) => `r${one.region}` === name);
    if (this.doubt) [this.doubt, this.picks] = [null, []];
    const others = this.picks.filter((pick) => pick.name !== name);
    this.picks = others.length < this.picks.length ? others : [...others, this.pickOf(pane.view, name, mask, at)];
    this.note = "";
    this.changed();
  }

  // Where no mask is: ask the first question about this place.
  offer(view, at) {
    const here = this.open.filter((doubt) => doubt.outlines.some((one) => one.view === view && isInside(at, one.outline)));
    if (here.length) this.ask(here[0]);
  }

  // A mask is named by the middle of its thickest place, unless another mask lies there.
  pickOf(view, name, mask, at) {
    const top = mask && this.data.views[view].masks.findLast((one) => isOnMask(one, mask.at));
    return { view, name, mask, at: mask && (top === mask || !at) ? mask.at : at };
  }

  placeOf({ view, at }) {
    return [this.data.views[view].name, ...this.frames[view].toPhoto(at)];
  }

  // --- the queue

  next() {
    if (this.doubt) this.skipped.add(this.doubt.name);
    const { left } = this;
    this.drop();
    if (left.length && this.numAsked < MOST_ASKED) {
      this.numAsked += 1;
      return this.ask(left[0]);
    }
    this.numAsked = 0;
    if (!left.length) this.skipped.clear();
    this.say(this.open.length ? "These were the questions; those that are left can be asked." : "Nothing doubtful is left.");
  }

  // Open questions that were not asked yet, and the one that is asked now.
  get left() {
    return this.open.filter((doubt) => !this.skipped.has(doubt.name));
  }

  // An answered question may stay open until the masks that follow are known.
  goOn(answered) {
    if (!answered) return;
    this.skipped.add(answered.name);
    this.next();
  }

  ask(doubt) {
    this.doubt = doubt;
    const [first, second] = this.panes;
    first.show(doubt.view);
    first.lookAt(doubt.mask ? doubt.mask.box : boxAround(doubt.outlines[0].outline));
    if (doubt.otherView !== undefined) {
      second.show(doubt.otherView);
      second.lookAt(doubt.otherBox);
    }
    this.active = first;
    this.picks = [[doubt.view, doubt.mask], [doubt.otherView, doubt.otherMask]]
      .filter(([, mask]) => mask)
      .map(([view, mask]) => this.pickOf(view, `r${mask.region}`, mask));
    this.note = "";
    this.changed();
  }

  // --- edits

  act(name) {
    const [op, all] = name.split("-");
    const wasAsked = this.doubt;
    if (op === "next") return this.next();
    if (op === "undo") return this.undo();
    if (op === "learn") return this.server?.learn();
    if (TOOLS.includes(op)) return this.take(op);
    const found = this.editsOf(op, all !== undefined);
    if (!found.length) return;
    this.note = "";
    this.add(found);
    this.goOn(wasAsked);
  }

  editsOf(op, everywhere) {
    if (op === "same" || op === "different") return this.linkEdits(op);
    if (this.doubt?.kind === "stem") return [{ ...this.noLeafIn(this.doubt.outlines[0]), op, stem: true }];
    if (this.doubt?.isOffered) return this.offeredEdits(op, this.doubt.outlines);
    if (this.doubt?.kind === "place") {
      const [first] = this.doubt.outlines;
      return op === "reject" ? [this.noLeafIn(first)] : this.outlineEdits(first.view, first.outline);
    }
    return this.markEdits(op, everywhere);
  }

  add(edits) {
    const when = new Date().toISOString();
    this.drop();
    this.edits.add(...edits.map((edit) => ({ ...edit, when })));
  }

  linkEdits(op) {
    if (this.picks.length < 2) this.say("Click two masks first, in one photo or in two.");
    return this.picks.length < 2 ? [] : [{ op, at: this.picks.map((pick) => this.placeOf(pick)) }];
  }

  markEdits(op, everywhere) {
    if (!this.picks.length) this.say("Click a mask first.");
    const picks = this.doubt ? this.picks.slice(0, 1) : this.picks; // the second one is only there to compare
    return picks.map((pick) => {
      const [view, ...at] = this.placeOf(pick);
      return { op, view, at, ...(everywhere ? { everywhere } : {}) };
    });
  }

  // An outline shows the leaf of the masks that are picked in other photos.
  outlineEdits(view, points, leaf = "") {
    const polygon = points.map((point) => this.frames[view].toPhoto(point));
    const name = this.data.views[view].name;
    const others = this.picks.filter((pick) => pick.view !== view);
    const here = [name, ...this.frames[view].toPhoto(insidePoint(points))];
    const link = { op: "same", at: [here, ...others.map((pick) => this.placeOf(pick))] };
    return [{ op: "outline", view: name, polygon, ...(leaf ? { leaf } : {}) }, ...(others.length ? [link] : [])];
  }

  // Make a candidate a leaf, by outlines of its masks under one new name; or reject it.
  offeredEdits(op, outlines) {
    if (op === "reject") return [{ ...this.noLeafIn(outlines[0]), everywhere: true }];
    const name = this.freeName("offered");
    return outlines.flatMap(({ view, outline }) => this.outlineEdits(view, outline, name));
  }

  freeName(word) {
    const used = new Set(this.edits.list.map((edit) => edit.leaf));
    let number = 1;
    while (used.has(`${word} ${number}`)) number += 1;
    return `${word} ${number}`;
  }

  // The name in the field: that of an outline just drawn in another photo, else a new one.
  nameOf(view) {
    const { name } = this.data.views[view];
    if (this.doubt && !this.doubt.isOfMany) return ""; // an answer shows what was asked about
    return this.partner && this.partner.view !== name ? this.partner.leaf : this.freeName("new");
  }

  // An outline that the user draws, perhaps as an answer: then it shows the leaf in question.
  drawnEdits(view, points, leaf) {
    const { doubt } = this;
    if (doubt?.isOffered && !leaf) {
      const others = doubt.outlines.filter((one) => one.view !== view);
      return this.offeredEdits("confirm", [{ view, outline: points }, ...others]);
    }
    if (doubt?.otherMask && !leaf && !this.picks.some((pick) => pick.view !== view)) {
      this.picks = [this.pickOf(doubt.otherView, `r${doubt.otherMask.region}`, doubt.otherMask)];
    }
    return this.outlineEdits(view, points, leaf);
  }

  noLeafIn({ view, outline }) {
    return { op: "reject", view: this.data.views[view].name, at: this.frames[view].toPhoto(insidePoint(outline)) };
  }

  undo() {
    this.drop();
    if (this.edits.earlier.length) this.edits.undo();
    else this.say("There is nothing to undo.");
  }

  // --- drawing

  take(tool) {
    const isPaint = (one) => one === "brush" || one === "erase";
    if (!isPaint(tool) || !this.draft?.paint) this.draft = null; // brush and eraser work on one mask
    this.tool = this.tool === tool ? null : tool;
    this.changed();
  }

  resize(factor) {
    this.radius = clamp(this.radius * factor, RADIUS.least, RADIUS.most);
    this.changed();
  }

  // A stroke of the brush or the eraser, on a new mask or on the one that is picked in this photo.
  paint(pane, from, to) {
    const erases = this.tool === "erase";
    if (this.draft?.pane !== pane || !this.draft.paint) {
      const picked = this.picks.find((pick) => pick.view === pane.view && pick.mask);
      if (erases && !picked) return this.say("Pick the mask first that the eraser takes from.");
      const paint = new Paint(pane.frame.height, picked?.mask);
      this.draft = { pane, kind: "outline", points: [], isClosed: true, paint };
    }
    this.draft.paint.stroke(from, to, { radius: this.radius * pane.unit, erases });
    Object.assign(this.draft, { points: this.draft.paint.outline(), drawn: undefined });
    this.changed();
  }

  // The line is whole: cut at once; an outline waits for the name of its leaf.
  finish() {
    const { draft } = this;
    if (!draft || draft.isClosed) return;
    if (draft.points.length < (draft.kind === "split" ? 2 : 3)) return this.say("That is too short.");
    draft.isClosed = draft.kind === "outline";
    if (draft.kind === "outline") return this.changed();
    const { view } = draft.pane;
    if (draft.kind === "area") return this.rejectIn(view, draft.points);
    const mask = this.maskUnder(view, draft.points);
    if (!mask) return this.discard("The line crosses no mask: draw it across the mask that shows two leaves.");
    const [name, ...at] = this.placeOf({ view, at: mask.at });
    this.add([{ op: "split", view: name, at, line: draft.points.map((point) => this.frames[view].toPhoto(point)) }]);
  }

  // No mask whose thickest place lies in an area is a leaf.
  rejectIn(view, points) {
    const inside = this.data.views[view].masks.filter((mask) => !this.gone.has(mask) && isInside(mask.at, points));
    if (!inside.length) return this.discard("No mask lies in it.");
    this.add(inside.map((mask) => {
      const [name, ...at] = this.placeOf(this.pickOf(view, `r${mask.region}`, mask));
      return { op: "reject", view: name, at };
    }));
  }

  // The mask that has most of a line.
  maskUnder(view, points) {
    const steps = points.slice(1).flatMap((end, n) => [...Array(20).keys()].map((step) =>
      [0, 1].map((axis) => points[n][axis] + ((end[axis] - points[n][axis]) * step) / 20)));
    const counts = this.data.views[view].masks.map((mask) => steps.filter((point) => isOnMask(mask, point)).length);
    const most = Math.max(0, ...counts);
    return most ? this.data.views[view].masks[counts.lastIndexOf(most)] : null;
  }

  keep(leaf) {
    const { pane, points } = this.draft;
    if (points.length < 3) return this.discard("Nothing is left of it.");
    const wasAsked = this.doubt;
    const edits = this.drawnEdits(pane.view, points, leaf);
    this.add(edits);
    const [first, second] = this.panes;
    if (wasAsked?.kind === "half" && pane === first && second.view !== first.view) this.drawBeside(wasAsked);
    else if (wasAsked && !wasAsked.isOfMany) this.goOn(wasAsked); // there may be more leaves
    else if (edits.length === 1) this.offerPartner(pane, leaf);
  }

  // Two outlines say what all of a leaf is.
  drawBeside(doubt) {
    this.ask(doubt);
    [, this.active] = this.panes;
    this.take("outline");
    this.say("Now all of it in the photo on the right: the others follow.");
  }

  // A photo that likely shows the same leaf from another side.
  partnerOf(view) {
    const angles = this.data.correct.angles[view];
    return angles.map((_, other) => other).filter((other) => other !== view)
      .sort((one, other) => Math.abs(angles[one] - PARTNER.best) - Math.abs(angles[other] - PARTNER.best))[0] ?? view;
  }

  // After the first outline of a leaf: where to draw it again.
  offerPartner(pane, leaf) {
    const isFirst = this.edits.list.filter((edit) => edit.op === "outline" && edit.leaf === leaf).length === 1;
    this.partner = leaf && isFirst ? { view: this.data.views[pane.view].name, leaf } : null;
    if (leaf && !isFirst) return;
    const other = this.panes.find((one) => one !== pane);
    const apart = this.data.correct.angles[pane.view][other.view];
    if (apart < PARTNER.least || apart > PARTNER.most) other.show(this.partnerOf(pane.view));
    const degrees = this.data.correct.angles[pane.view][other.view];
    const how = leaf ? `as "${leaf}"; the name is in the field already` : "and pick this outline first, or give both one name";
    const { name } = this.data.views[other.view];
    this.say(`Now the same leaf in photo ${name}, ${degrees}\u00b0 away, ${how}. The other photos follow.`);
  }

  // The outline as it was before it was fitted to the leaf.
  unfit() {
    Object.assign(this.draft, { points: this.draft.drawn, drawn: undefined });
    this.changed();
  }

  discard(text = "") {
    [this.draft, this.note] = [null, text];
    this.changed();
  }

  drop() {
    Object.assign(this, { picks: [], tool: null, draft: null, doubt: null, note: "" });
    this.changed();
  }

  press(event) {
    if (document.getElementById("correct").hidden || event.ctrlKey || event.metaKey || event.altKey) return;
    const isTyping = event.target.matches?.("input, textarea, select");
    if (event.key === "Escape") {
      if (this.draft) this.discard();
      else this.drop();
    } else if (event.key === "Enter" && this.draft && (isTyping || !event.target.matches?.("button"))) {
      if (this.draft.isClosed) this.panel.keep();
      else this.finish();
    } else if ((event.key === "[" || event.key === "]") && !isTyping) {
      this.resize(event.key === "]" ? RADIUS.step : 1 / RADIUS.step);
    } else if (event.key in KEYS && !isTyping) {
      this.act(KEYS[event.key]);
    } else return;
    event.preventDefault();
  }
}

function boxAround(points) {
  const [xs, ys] = [0, 1].map((axis) => points.map((point) => point[axis]));
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}

// Whether a point, in units of the picture, is on a mask.
const brush = document.createElement("canvas").getContext("2d");
function isOnMask(mask, [x, y]) {
  mask.shape ??= new Path2D(mask.path);
  return brush.isPointInPath(mask.shape, x, y, "evenodd");
}

// Masks that edits reject: they are struck out at once.
function rejectedMasks(places, views) {
  const gone = new Set();
  for (const { edit, view, at } of places) {
    const mask = view < 0 || edit.stem ? null : views[view].masks.findLast((one) => isOnMask(one, at));
    if (!mask) continue;
    const isAll = edit.everywhere && mask.leaf > 0;
    const all = isAll ? views.flatMap((one) => one.masks.filter(({ leaf }) => leaf === mask.leaf)) : [mask];
    for (const one of all) {
      if (edit.op === "reject") gone.add(one);
      else gone.delete(one); // the later edit wins
    }
  }
  return gone;
}

// Changes between looking at the result and correcting it.
function buildModes(data, addresses) {
  const parts = { look: document.querySelectorAll("main, #card, #run"), correct: document.querySelectorAll("#correct") };
  const buttons = { look: document.getElementById("mode-look"), correct: document.getElementById("mode-correct") };
  const modes = { work: null, show };
  function show(mode) {
    if (data.correct.isServed) window.history.replaceState(null, "", `#${mode}`); // a reload stays in the mode
    for (const [name, button] of Object.entries(buttons)) {
      button.setAttribute("aria-pressed", name === mode);
      for (const part of parts[name]) part.hidden = name !== mode;
    }
    if (mode === "correct") {
      modes.work ??= new Work({ ...data, views: data.views.map((view) => ({ ...view })) }, addresses); // "Look" keeps its data
      if (data.correct.isServed && !modes.work.server) modes.work.server = new Server(modes.work);
    } else buildCard(data, modes.work);
    summarise(mode === "look" ? data : modes.work.data);
  }
  for (const [name, button] of Object.entries(buttons)) button.addEventListener("click", () => show(name));
  const { hash } = window.location;
  show(hash === "#correct" || (data.correct.isServed && hash !== "#look") ? "correct" : "look");
  return modes;
}
