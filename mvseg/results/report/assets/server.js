// Where `mvseg correct` serves the page: save every edit, and show what changes.

const AGAIN = 2000; // milliseconds until what failed is tried again

class Server {
  constructor(work) {
    this.work = work;
    this.outcomes = []; // of each edit, what hinders it; "" for nothing
    this.number = -1; // of the newest state that is known
    this.messages = {}; // problems, by what they are of
    this.state = "";
    this.unsaved = false;
    this.sent = null; // ends when nothing is on its way
    this.isComputing = true; // the masks do not follow from all edits yet
    this.base = work.data.correct.revision; // name of the edits that are saved, as far as this page knows
    this.own = new Set([this.base]); // names of all lists that it started from or saved
    this.learning = null; // {now: what is done, "" for nothing; isLearned, seconds}; null: nothing can learn
    this.before = null; // ids of the leaves before the detector learned, until the outcome is there
    this.lesson = ""; // that outcome, until the next edit
    this.isLost = false; // it does not answer
    this.isStale = false; // another page has changed the edits: this one must not save over them
    work.edits.listen(() => {
      [this.unsaved, this.isComputing] = [true, true];
      Object.assign(this.messages, { fit: "", whole: "", learning: "" }); // of what was done before
      this.lesson = "";
      for (const pane of work.panes) pane.draw();
      this.send();
    });
    this.listen();
  }

  get problem() {
    return Object.values(this.messages).filter(Boolean).join(" ");
  }

  async ask(path, options) {
    const answer = await fetch(path, options);
    const content = await answer.json();
    if (!answer.ok) throw Object.assign(new Error(content.problem), { status: answer.status });
    return content;
  }

  // One list is on its way at a time; of those that come meanwhile, the newest goes next.
  send() {
    this.sent ??= this.sendAll().finally(() => { this.sent = null; });
  }

  async sendAll() {
    while (this.unsaved && !this.isStale) {
      this.unsaved = false;
      const before = this.number;
      try {
        this.tell({ saving: "" }, "Saving\u2026");
        const list = { method: "PUT", body: this.work.edits.text() };
        const { saved, revision } = await this.ask(`edits?base=${this.base}`, list);
        this.base = revision;
        this.own.add(revision);
        const isDone = this.number > before && !this.learning?.now;
        const next = this.learning?.now ? "It is computed when the detector has learned." : "Computing what follows\u2026";
        this.tell({ saving: "" }, isDone ? this.state : `${count(saved, "edit")} saved. ${next}`);
      } catch (error) {
        this.isStale = error.status === 409;
        this.unsaved = !(error.status < 500); // what may go better later
        if (this.unsaved) setTimeout(() => this.send(), AGAIN);
        this.tell({ saving: `Not saved: ${error.message}` }, "");
        return;
      }
    }
  }

  async listen() {
    while (!this.isStale) {
      try {
        const state = await this.ask(`state?after=${this.number}`);
        await this.sent;
        this.hear(state);
      } catch (error) {
        const advice = "start it again. What was not saved, save as corrections.json before you close this page.";
        this.isLost = true;
        this.tell({ state: `mvseg correct does not answer (${error.message}): ${advice}` }, "");
        await new Promise((done) => setTimeout(done, AGAIN));
      }
    }
  }

  hear({ number, revision, outcomes, update, problem, isComputing, isChanged, learning, doing, making }) {
    if (isChanged || !this.own.has(revision)) {
      this.isStale = true;
      const who = isChanged ? "Another program has changed corrections.json." : "Another page has changed the edits.";
      this.tell({ state: who }, "");
      return;
    }
    if (number === this.number && !this.isLost) return; // no news: what was said stays
    this.isLost = false;
    const isFirst = this.number < 0;
    const goesOn = this.learning?.now && learning.now && !update;
    const isOld = revision !== this.base; // it was on its way while newer edits were saved
    const isStep = !isFirst && this.isComputing && doing && !update;
    Object.assign(this, { number, outcomes, learning, isComputing: isComputing || this.unsaved || isOld });
    if (isFirst && learning?.now) this.before = this.work.data.leaves.map(({ id }) => id);
    if (making && !update) return this.tell({}, `Making the whole result: ${making}`);
    if (goesOn) return this.work.panel.showProgress(); // no button changes under the pointer
    if (isStep && this.work.panel) return this.work.panel.showStep(doing);
    if (update) {
      this.work.update(update);
    }
    if (this.before && !learning.now && (update || !isComputing)) {
      if (learning.isLearned && update) this.lesson = this.compare(this.before, update);
      this.before = null;
    }
    const done = update?.told?.join(" ") || (update || !problem ? "What you see follows from all edits." : "");
    const later = learning?.now ? "Edits are saved, and computed when the detector has learned." : "";
    this.tell({ state: problem }, later || (isComputing ? `Computing${doing ? `: ${doing}` : " what follows from the edits"}\u2026` : done));
  }

  // What learning has changed, in words.
  compare(before, { leaves, agreedArea: [first, ...later] }) {
    const ids = leaves.map(({ id }) => id);
    const name = (list) => `${list.length === 1 ? "leaf" : "leaves"} ${list.join(", ")}`;
    const [gone, added] = [before.filter((id) => !ids.includes(id)), ids.filter((id) => !before.includes(id))];
    const share = Math.round(100 * (later.at(-1) / first - 1));
    const agree = !later.length || !first ? "" : share === 0 ? "The views agree about as much leaf area as before."
      : `The views agree about ${Math.abs(share)} % ${share > 0 ? "more" : "less"} leaf area than before.`;
    return [`${count(before.length, "leaf", "leaves")} before, ${ids.length} now.`, gone.length && `Gone: ${name(gone)}.`,
      added.length && `New: ${name(added)}.`, agree].filter(Boolean).join(" ");
  }

  // A rough outline becomes that of the leaf inside it.
  async fit() {
    const { draft, data, frames } = this.work;
    const { view } = draft.pane;
    this.tell({ fit: "" }, "Looking for the leaf\u2026");
    try {
      const polygon = draft.points.map((point) => frames[view].toPhoto(point));
      const body = JSON.stringify({ view: data.views[view].name, polygon });
      const found = await this.ask("outline", { method: "POST", body });
      draft.drawn ??= draft.points; // fitting can be undone alone
      draft.points = found.polygon.map((point) => frames[view].toPicture(point));
      this.tell({ fit: "" }, "");
      document.querySelector("#correct-tools button.main")?.focus(); // Enter keeps it, and does not fit it again
    } catch (error) {
      this.tell({ fit: error.message }, "");
    }
  }

  // The whole result, traits included, with the edits that are saved.
  async whole() {
    const { folder } = this.work.data.correct; // of tables
    this.tell({ whole: "" }, folder ? "Writing the tables\u2026" : "Making the whole result\u2026");
    try {
      await this.ask("whole", { method: "POST" });
      window.sessionStorage.setItem("mvseg-whole", folder ? `The tables and the page were written to ${folder}.` : "");
      if (this.work.panel) window.history.replaceState(null, "", "#look");
      window.location.reload(); // the page is the new result
    } catch (error) {
      this.tell({ whole: `The whole result was not made: ${error.message}` }, "");
    }
  }

  // What the detector knows: "learn" from these leaves, "cancel" that, or "unlearn".
  async learn(what = "learn") {
    if (!this.learning || (what === "learn" && this.learning.now)) return;
    try {
      await this.ask(what, { method: "POST" });
      this.before = what === "learn" ? this.work.data.leaves.map(({ id }) => id) : null;
      this.lesson = "";
      this.tell({ learning: "" }, this.state);
    } catch (error) {
      this.tell({ learning: error.message }, this.state);
    }
  }

  tell(messages, state) {
    Object.assign(this.messages, messages);
    this.state = state;
    this.work.changed();
  }
}
