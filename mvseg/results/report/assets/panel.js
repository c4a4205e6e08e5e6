// The column beside the photos: the question, what is picked, the tools, and the list of edits.

const SHOWN_EDITS = 200;
const HINTS = {
  pick: "Click a mask: it may be no leaf, or right. Click two, in one photo or in two: they show the same leaf, or " +
    "different ones.",
  draw: "A leaf that was missed, drawn in two photos, is found in the others.",
  outline: "Draw around the leaf in one go; or click its corners, and the first one again (or Enter) to end. " +
    "Esc: not now.",
  area: "Draw around masks: none of those whose middle lies inside is a leaf. Esc: not now.",
  brush: "Paint a leaf, or add to the mask that is picked here. [ and ]: size of the brush. Enter keeps it.",
  erase: "Take away from what is painted, or from the mask that is picked here. [ and ]: size of the eraser.",
  split: "Draw a line across the mask, from edge to edge, where the two leaves meet. Esc: not now.",
  word: "Outlines with the same name, in several photos, show the same leaf.",
  learned: "The detector has learned from these leaves. It is kept by the whole result.",
  near: "no photo shows the leaf from another side, so outline it in as many photos as you can.",
  saved: "Saved where your browser saves files. To have every photo follow: " +
    "mvseg infer SCENE --corrections corrections.json",
};

class Panel {
  constructor(work) {
    this.work = work;
    this.word = element("input", {
      id: "leaf-word", maxlength: "100", placeholder: "name, if you like", autocomplete: "off",
    });
    this.file = element("input", { type: "file", accept: ".json,application/json", hidden: "" });
    this.file.addEventListener("change", () => this.load());
    this.progress = element("p", { class: "note" });
    const names = ["ask", "picked", "tools", "list", "learn", "note", "state"];
    this.parts = Object.fromEntries(names.map((name) => [name, document.getElementById(`correct-${name}`)]));
    document.getElementById("correct").append(this.file);
    const { edits, outcomes } = work.data.correct;
    this.outcomes = new Map(edits.map((edit, index) => [JSON.stringify(edit), outcomes[index]]));
  }

  button(text, key, act, { disabled = false, pressed = null, main = false } = {}) {
    const one = element("button", {
      type: "button", disabled: disabled ? "" : null, "aria-pressed": pressed, class: main ? "main" : null,
    }, text, key ? element("kbd", {}, key) : null);
    one.addEventListener("click", act);
    return one;
  }

  action(name, text, state) {
    const key = Object.keys(KEYS).find((one) => KEYS[one] === name);
    return this.button(text, key, () => this.work.act(name), state);
  }

  // Everything anew; what had the keyboard's attention keeps it.
  show() {
    const { work, parts } = this;
    const focused = document.activeElement;
    parts.ask.replaceChildren(...this.question());
    parts.picked.replaceChildren(...this.picked());
    parts.tools.replaceChildren(...this.tools());
    parts.list.replaceChildren(...this.list());
    parts.learn.replaceChildren(...this.learning());
    const notes = [work.note, work.edits.problem, work.server?.problem];
    parts.note.replaceChildren(...notes.filter(Boolean).map((note) => element("span", {}, note)),
      ...(work.server?.isStale ? this.reload() : []));
    parts.state.textContent = work.server?.state ?? "";
    if (focused === this.word) this.word.focus();
    else if (!focused.isConnected) {
      const all = [...document.querySelectorAll("#correct-side button")];
      all.find((one) => one.textContent === focused.textContent)?.focus();
    }
  }

  reload() {
    const text = "This one saves nothing any more: reload it, and go on from what is saved.";
    return [element("span", {}, text), this.button("Reload", null, () => window.location.reload())];
  }

  question() {
    const { doubt, open, left, numAsked, draft } = this.work;
    if (!doubt) {
      const asked = Math.min(left.length || open.length, MOST_ASKED);
      const text = open.length
        ? `${count(asked, "question")} about what may be wrong, those first whose answers change most.`
        : "Nothing doubtful is left.";
      const ask = this.action("next", "Ask me", { disabled: !open.length, main: true });
      return [element("h2", {}, "Questions"), element("p", {}, text), ask];
    }
    const last = Math.max(numAsked, Math.min(MOST_ASKED, numAsked + left.length - 1));
    const answers = answersTo(doubt).map(([name, text], n) => this.action(name, text, { main: n === 0 && !draft }));
    const title = numAsked ? `Question ${numAsked} of ${last}` : "Question";
    return [element("h2", {}, title), element("p", {}, askAbout(doubt, this.work)),
      element("div", { class: "answers" }, ...answers)];
  }

  picked() {
    const { picks, doubt } = this.work;
    if (doubt) return [];
    const title = element("h2", {}, "Picked");
    if (!picks.length) return [title, element("p", { class: "note" }, HINTS.pick)];
    const pair = [this.action("same", "The same leaf"), this.action("different", "Different leaves")];
    return [title, element("div", { class: "crops" }, ...picks.map((pick) => this.crop(pick))),
      element("div", { class: "answers" }, ...(picks.length > 1 ? pair : []),
        this.action("reject", "No leaf"), this.action("reject-all", "No leaf, in all photos"),
        this.action("confirm", "Right"), this.action("confirm-all", "Right, in all photos"))];
  }

  crop({ view, mask, name }) {
    const { data, addresses, colors } = this.work;
    const leaf = mask ? (mask.leaf > 0 ? `leaf ${mask.leaf}` : "no leaf yet") : "drawn";
    const color = colors.get(mask?.leaf) ?? "#969696";
    const picture = mask ? drawCrop(data.views[view], mask, addresses.pictures[view], color) : null;
    const one = element("button", { type: "button", title: "do not pick it" }, picture,
      element("span", {}, data.views[view].name), element("span", { class: "note" }, leaf));
    one.addEventListener("click", () => {
      this.work.picks = this.work.picks.filter((pick) => pick.view !== view || pick.name !== name);
      this.work.changed();
    });
    return one;
  }

  tools() {
    const { draft, tool } = this.work;
    const brushes = [this.action("brush", "Brush", { pressed: tool === "brush" }),
      this.action("erase", "Eraser", { pressed: tool === "erase" })];
    if (draft?.isClosed) {
      const paints = draft.paint ? [element("div", { class: "answers" }, ...brushes)] : [];
      return [element("h2", {}, "Outline"), ...paints, ...this.draftTools()];
    }
    return [element("h2", {}, "Draw"), element("div", { class: "answers" },
      this.action("outline", "Outline a leaf", { pressed: tool === "outline" }), ...brushes,
      this.action("split", "Cut a mask in two", { pressed: tool === "split" }),
      this.action("area", "No leaves in an area", { pressed: tool === "area" })),
    element("p", { class: "note" }, HINTS[tool ?? "draw"]), ...this.apart()];
  }

  // How far the two photos are apart, which matters for outlines in both.
  apart() {
    const { panes, data, tool } = this.work;
    const degrees = data.correct.angles[panes[0].view][panes[1].view];
    if (tool !== "outline" || panes[0].view === panes[1].view) return [];
    const other = this.work.partnerOf(this.work.active.view);
    const most = data.correct.angles[this.work.active.view][other];
    const isGood = degrees >= Math.min(PARTNER.least, most) && degrees <= PARTNER.most;
    const advice = most < PARTNER.least ? HINTS.near : isGood ? "good for one leaf in both."
      : `best are ${PARTNER.least} to ${PARTNER.most}\u00b0.`;
    const show = this.button(`Show ${data.views[other].name} beside it`, null, () => {
      panes.find((pane) => pane !== this.work.active).show(other);
      this.work.changed();
    });
    return [element("p", { class: "note" }, `These photos are ${degrees}\u00b0 apart: ${advice}`), ...(isGood ? [] : [show])];
  }

  draftTools() {
    const { work } = this;
    const others = work.picks.filter((pick) => pick.view !== work.draft.pane.view);
    const names = others.map((pick) => work.data.views[pick.view].name).join(", ");
    if (!others.length && work.draft !== this.draft) {
      [this.draft, this.word.value] = [work.draft, work.nameOf(work.draft.pane.view)];
    }
    const same = others.length
      ? [element("p", {}, `It shows the same leaf as what is picked in ${names}.`)]
      : [element("label", {}, "Its leaf: ", this.word), element("p", { class: "note" }, HINTS.word)];
    return [...same, element("div", { class: "answers" },
      this.button("Keep it", "Enter", () => this.keep(), { main: true }),
      ...(work.server ? [this.button("Fit it to the leaf", null, () => work.server.fit())] : []),
      ...(work.draft.drawn ? [this.button("As I drew it", null, () => work.unfit())] : []),
      this.button("Discard", "Esc", () => work.discard()))];
  }

  keep() {
    this.work.keep(this.word.isConnected ? this.word.value.trim() : "");
  }

  list() {
    const { edits, server } = this.work;
    const from = Math.max(0, edits.list.length - SHOWN_EDITS);
    const rows = edits.list.slice(from).map((edit, n) => this.row(edit, from + n)).reverse();
    const some = edits.list.length > 0;
    const undo = this.action("undo", "Undo", { disabled: !edits.earlier.length });
    return [
      element("h2", {}, count(edits.list.length, "edit"), undo),
      ...(from ? [element("p", { class: "note" }, `The last ${SHOWN_EDITS} of them:`)] : []),
      element("ol", { reversed: "", start: edits.list.length }, ...rows),
      element("div", { class: "answers" },
        this.button("Save corrections.json", null, () => this.save(), { disabled: !some, main: some && !server }),
        this.button("Load\u2026", null, () => this.file.click()),
        ...(server ? [this.button("Make the whole result", null, () => server.whole())] : [])),
    ];
  }

  // Where a detector found the masks, and the page is served.
  learning() {
    const { server } = this.work;
    if (!server?.learning) return [];
    const { now, isLearned, seconds } = server.learning;
    this.parts.learn.classList.toggle("news", Boolean(now || server.lesson)); // then it stands on top
    const title = element("h2", {}, "A plant that the detector does not know");
    if (now) {
      this.showProgress();
      return [title, this.progress, element("div", { class: "answers" },
        this.button("Cancel", null, () => server.learn("cancel")))];
    }
    const cost = "The detector learns the leaves that the photos agree about, and your outlines, and looks again. " +
      `About ${count(Math.ceil(seconds / 60), "minute")} for ${count(this.work.data.views.length, "photo")} on two ` +
      "processor cores; your edits stay, and it can be undone.";
    return [title, ...(server.lesson ? [element("p", {}, server.lesson)] : []),
      element("p", { class: "note" }, isLearned ? HINTS.learned : cost),
      element("div", { class: "answers" }, this.action("learn", "Learn from these leaves"),
        ...(isLearned ? [this.button("Undo learning", null, () => server.learn("unlearn"))] : []))];
  }

  showStep(doing) {
    this.work.server.state = this.parts.state.textContent = `Computing: ${doing}\u2026`;
  }

  showProgress() {
    this.progress.textContent = `${this.work.server.learning.now}\u2026`;
  }

  row(edit, index) {
    const { work } = this;
    const look = element("button", { type: "button", class: "plain", title: "show it" }, describeEdit(edit));
    const places = work.places.filter((place) => place.edit === edit);
    look.addEventListener("click", () => {
      const views = [...new Set(places.map((place) => place.view))].filter((view) => view >= 0);
      views.slice(0, 2).forEach((view, n) => work.panes[n].show(view));
    });
    const remove = element("button", {
      type: "button", class: "plain", title: "delete it", "aria-label": `delete edit ${index + 1}`,
    }, "\u2715");
    remove.addEventListener("click", () => work.edits.remove(index));
    const outcome = work.server ? work.server.outcomes[index] : this.outcomes.get(JSON.stringify(edit));
    const problem = places.some((place) => place.view < 0) ? "this result has no such photo" : outcome;
    return element("li", {}, look, remove, problem ? element("div", { class: "doubt" }, problem) : null);
  }

  save() {
    this.work.edits.save();
    this.work.say(HINTS.saved);
  }

  async load() {
    const [file] = this.file.files;
    this.file.value = "";
    if (!file) return;
    try {
      if (file.size > MOST_BYTES) throw new Error(`the file has ${file.size} bytes, expected at most ${MOST_BYTES}`);
      this.work.edits.change(readEdits(await file.text(), this.work.edits.photos));
      const loaded = `${count(this.work.edits.list.length, "edit")} loaded, in place of those before`;
      this.work.say(`${file.name}: ${loaded} (Undo brings them back).`);
    } catch (error) {
      this.work.say(`${file.name}: ${error.message}.`);
    }
  }
}
