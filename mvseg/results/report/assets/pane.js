// One photo to work on: zoom, move, pick masks, draw; by mouse, pen or fingers.

const CLICK = 6; // pixels of the screen that a click may move
const NEAR = 14; // pixels to the first corner, to close an outline
const LARGEST_NUMBER = 24; // pixels of the screen, of a leaf's number
const STEP = 5; // pixels between the points of a line that is drawn in one go

class Pane {
  constructor(work) {
    this.work = work; // what the panes share: data, frames, addresses, edits, picks, draft
    this.pointers = new Map();
    this.name = element("span", { class: "view-name" });
    const button = (text, title, act) => {
      const one = element("button", { type: "button", title, "aria-label": title }, text);
      one.addEventListener("click", act);
      return one;
    };
    const bar = element("div", { class: "pane-bar" },
      button("\u2039", "photo before", () => this.show((this.view + this.count - 1) % this.count)), this.name,
      button("\u203a", "next photo", () => this.show((this.view + 1) % this.count)),
      element("span", { class: "gap" }),
      button("\u25d0", "masks or none", () => this.picture.classList.toggle("bare")),
      button("\u2212", "smaller", () => this.zoom(1.4)), button("+", "larger", () => this.zoom(1 / 1.4)),
      button("\u2922", "whole plant", () => this.fit()));
    this.picture = drawing("svg", { class: "photo work", role: "application", tabindex: "0" });
    this.element = element("div", { class: "pane" }, bar, this.picture);
    this.listen();
  }

  get count() {
    return this.work.data.views.length;
  }

  get frame() {
    return this.work.frames[this.view];
  }

  show(view) {
    this.view = view;
    this.fit();
    this.draw();
    this.work.changed();
  }

  // Everything in the photo, from what is known now.
  draw() {
    const { data, addresses, colors, edits } = this.work;
    const view = data.views[this.view];
    this.name.textContent = view.name;
    this.picture.setAttribute("aria-label", `Photo ${view.name}: click masks to pick them`);
    const image = (href, box) => drawing("image", { href, ...box, preserveAspectRatio: "none" });
    const around = image(addresses.thumbnails[this.view], this.frame.whole);
    const sharp = image(addresses.pictures[this.view], { x: 0, y: 0, width: UNITS, height: this.frame.height });
    const paths = view.masks.map((mask) => drawing("path", {
      d: mask.path, fill: colors.get(mask.leaf) ?? "#969696", stroke: colors.get(mask.leaf) ?? "#969696",
      class: `mask${mask.leaf > 0 ? "" : " unmatched"}${this.work.gone.has(mask) ? " gone" : ""}`,
      "data-region": mask.region,
    }));
    const numbers = view.masks.filter((mask) => mask.leaf > 0 && !this.work.gone.has(mask)).map((mask) => drawing(
      "text", { x: mask.at[0], y: mask.at[1], "data-height": mask.height }, `${mask.leaf}${mask.is_sure ? "" : "?"}`));
    this.layer = drawing("g", {});
    this.numbers = numbers;
    this.picture.replaceChildren(around, sharp, ...paths, ...this.drawOutlines(edits.list), ...numbers, this.layer);
    this.mark();
  }

  // Outlines that are no masks yet: where the page is served, they soon are.
  drawOutlines(list) {
    const { data, server } = this.work;
    return list.flatMap((edit, index) => {
      if (edit.op !== "outline" || viewNamed(edit.view, data.views) !== this.view) return [];
      const points = edit.polygon.map((point) => this.frame.toPicture(point).map(Math.round));
      const middle = insidePoint(points);
      if (server && !server.isComputing && data.views[this.view].masks.some((mask) => isOnMask(mask, middle))) return [];
      const d = `M${points.map((point) => point.join(" ")).join("L")}z`;
      return [drawing("path", { d, class: "mask drawn", "data-edit": index })];
    });
  }

  // Picks, edits, what is proposed and what is being drawn, over the masks.
  mark() {
    const { picks, draft, doubt } = this.work;
    for (const path of this.picture.querySelectorAll("path.mask")) {
      const name = path.dataset.edit === undefined ? `r${path.dataset.region}` : `e${path.dataset.edit}`;
      path.classList.toggle("picked", picks.some((pick) => pick.name === name));
    }
    for (const text of this.numbers) {
      text.setAttribute("font-size", Math.min(text.dataset.height, LARGEST_NUMBER * this.unit));
    }
    const parts = [];
    for (const { outline } of doubt?.outlines.filter((one) => one.view === this.view) ?? []) {
      const d = `M${outline.map((point) => point.join(" ")).join("L")}z`;
      parts.push(drawing("path", { d, class: "proposed" }));
    }
    const size = 15 * this.unit;
    for (const { at: [x, y], symbol } of this.work.places.filter((place) => place.view === this.view).slice(-300)) {
      const above = y - 1.5 * size; // the leaf's number stays to be seen
      parts.push(drawing("circle", { cx: x, cy: above, r: 0.62 * size, class: "badge" }));
      parts.push(drawing("text", { x, y: above, "font-size": size, class: "badge" }, symbol));
    }
    if (this.paints && this.pointer) {
      const [cx, cy] = this.pointer;
      parts.push(drawing("circle", { cx, cy, r: this.work.radius * this.unit, class: "brush" }));
    }
    if (draft?.pane === this) {
      const points = draft.points.map((point) => point.map((value) => value.toFixed(1)).join(" "));
      const end = draft.isClosed ? "z" : "";
      if (points.length > 1) {
        const d = `M${points.join("L")}${end}`;
        parts.push(...["halo", "line"].map((kind) => drawing("path", { d, class: `draft ${kind}` })));
      }
      if (points.length && !draft.isClosed) {
        const [x, y] = draft.points[0];
        parts.push(drawing("circle", { cx: x, cy: y, r: 5 * this.unit, class: "draft corner" }));
      }
    }
    this.layer.replaceChildren(...parts);
  }

  // --- what part of the photo is shown; a box in units

  get unit() {
    const { clientWidth, clientHeight } = this.picture;
    return Math.max(this.box.width / (clientWidth || 600), this.box.height / (clientHeight || 450)); // units per pixel
  }

  // The picture, and the masks around it, if any.
  fit() {
    const boxes = this.work.data.views[this.view].masks.map((mask) => mask.box);
    const [x, y, right, bottom] = boxAround([[0, 0], [UNITS, this.frame.height],
      ...boxes.flatMap(([x1, y1, x2, y2]) => [[x1, y1], [x2, y2]])]);
    this.look({ x, y, width: right - x, height: bottom - y });
  }

  // The surroundings of a box (xyxy), so that one sees what is next to it.
  lookAt([x1, y1, x2, y2]) {
    const side = Math.max(x2 - x1, y2 - y1, 160) * 2.8;
    this.look({ x: (x1 + x2 - side) / 2, y: (y1 + y2 - side) / 2, width: side, height: side });
  }

  look(box) {
    const { width } = this.frame.whole;
    const share = clamp(box.width, 40, 2 * width) / box.width;
    this.box = { ...box, width: box.width * share, height: box.height * share };
    const numbers = [box.x, box.y, this.box.width, this.box.height].map((one) => one.toFixed(2));
    this.picture.setAttribute("viewBox", numbers.join(" "));
    if (this.layer) this.mark();
  }

  zoom(factor, [x, y] = [this.box.x + this.box.width / 2, this.box.y + this.box.height / 2]) {
    const { box } = this;
    const scale = clamp(box.width * factor, 40, 2 * this.frame.whole.width) / box.width;
    this.look({
      x: x - (x - box.x) * scale, y: y - (y - box.y) * scale, width: box.width * scale, height: box.height * scale,
    });
  }

  unitsAt({ clientX, clientY }) {
    const { x, y } = new DOMPoint(clientX, clientY).matrixTransform(this.picture.getScreenCTM().inverse());
    return [x, y];
  }

  get paints() {
    return this.work.tool === "brush" || this.work.tool === "erase";
  }

  // --- pointers

  listen() {
    const on = (name, act, options) => this.picture.addEventListener(name, act, options);
    on("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(clamp(event.deltaY, -200, 200) / 400), this.unitsAt(event));
    }, { passive: false });
    on("pointerdown", (event) => this.press(event));
    on("pointermove", (event) => this.drag(event));
    on("pointerup", (event) => this.release(event));
    on("pointercancel", (event) => this.pointers.delete(event.pointerId));
    on("dblclick", (event) => {
      event.preventDefault();
      if (this.work.draft?.pane === this) this.work.finish();
    });
    new ResizeObserver(() => this.layer && this.mark()).observe(this.picture);
  }

  press(event) {
    if (event.button > 0) return;
    this.work.activate(this);
    this.picture.setPointerCapture(event.pointerId);
    const path = event.target.closest?.("path.mask");
    this.pointers.set(event.pointerId, { start: [event.clientX, event.clientY], last: event, path, moved: false });
    const { tool, draft } = this.work;
    const at = this.unitsAt(event);
    if (this.paints && this.pointers.size === 1) return this.work.paint(this, at, at);
    if (!tool || this.pointers.size > 1 || draft?.isClosed) return;
    if (draft?.pane !== this) this.work.draft = { pane: this, kind: tool, points: [], isClosed: false };
    const { points } = this.work.draft;
    const isBack = points.length > 2 && this.screenDistance(at, points[0]) < NEAR && tool !== "split";
    if (isBack) this.work.finish();
    else if (!points.length || this.screenDistance(at, points.at(-1)) > 2) points.push(at);
    this.work.changed();
  }

  screenDistance([x1, y1], [x2, y2]) {
    return Math.hypot(x1 - x2, y1 - y2) / this.unit;
  }

  drag(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (this.paints) {
      this.pointer = this.unitsAt(event);
      this.mark();
    }
    if (!pointer) return;
    const before = pointer.last;
    pointer.last = event;
    if (Math.hypot(event.clientX - pointer.start[0], event.clientY - pointer.start[1]) > CLICK) pointer.moved = true;
    if (this.pointers.size > 1) {
      this.pinch(pointer, before);
    } else if (this.paints) {
      this.work.paint(this, this.unitsAt(before), this.unitsAt(event));
    } else if (this.work.tool && this.work.draft?.pane === this && !this.work.draft.isClosed) {
      const at = this.unitsAt(event);
      const { points } = this.work.draft;
      if (pointer.moved && this.screenDistance(at, points.at(-1)) >= STEP) {
        points.push(at);
        this.mark();
      }
    } else if (pointer.moved) {
      const [from, to] = [this.unitsAt(before), this.unitsAt(event)];
      this.look({ ...this.box, x: this.box.x + from[0] - to[0], y: this.box.y + from[1] - to[1] });
    }
  }

  // Two fingers move and zoom; what the first one has drawn so far is dropped.
  pinch(pointer, before) {
    const { draft } = this.work;
    if (draft?.pane === this && !draft.isClosed) this.work.draft = null;
    const other = [...this.pointers.values()].find((one) => one !== pointer);
    const [fixed, from, to] = [other.last, before, pointer.last].map((event) => this.unitsAt(event));
    const length = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
    other.moved = true;
    this.zoom(clamp(length(fixed, from) / length(fixed, to), 0.5, 2), fixed);
  }

  release(event) {
    const pointer = this.pointers.get(event.pointerId);
    this.pointers.delete(event.pointerId);
    if (!pointer) return;
    const { tool, draft } = this.work;
    if (tool && draft?.pane === this && !draft.paint) {
      const isBack = draft.points.length > 3 && this.screenDistance(draft.points.at(-1), draft.points[0]) < NEAR;
      const inOneGo = pointer.moved && (draft.points.length > 7 || isBack);
      const isCut = tool === "split" && pointer.moved && draft.points.length > 1;
      if (!draft.isClosed && (inOneGo || isCut)) this.work.finish();
    } else if (!tool && !pointer.moved) {
      this.work.pick(this, pointer.path, this.unitsAt(event));
    }
  }
}
