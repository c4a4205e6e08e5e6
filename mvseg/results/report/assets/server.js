// Where `mvseg correct` serves the page: every edit is saved at once, and what changes because of it is shown.

const AGAIN = 2000; // milliseconds until a server that does not answer is asked again

class Server {
  constructor(work) {
    this.work = work;
    this.outcomes = []; // of each edit, what hinders it; "" for nothing
    this.number = 0; // of the newest state that is known
    this.isNewer = false; // the page shows another result than it was made of
    this.messages = {}; // problems, by what they are of
    this.state = "";
    this.unsaved = false;
    this.isSending = false;
    work.edits.listen(() => {
      this.unsaved = true;
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
    if (!answer.ok) throw new Error(content.problem);
    return content;
  }

  // One list is on its way at a time; of those that come meanwhile, the newest goes next.
  async send() {
    if (this.isSending) return;
    this.isSending = true;
    while (this.unsaved) {
      this.unsaved = false;
      const text = this.work.edits.text();
      try {
        this.tell({ saving: "" }, "Saving\u2026");
        const { saved } = await this.ask("edits", { method: "PUT", body: text });
        this.tell({ saving: "" }, `${count(saved, "edit")} saved.`);
      } catch (error) {
        this.tell({ saving: `Not saved: ${error.message}` }, "");
        break;
      }
    }
    this.isSending = false;
  }

  async listen() {
    for (;;) {
      try {
        const state = await this.ask(`state?after=${this.number}`);
        this.hear(state);
      } catch (error) {
        const advice = "start it again. What was not saved, save as corrections.json before you close this page.";
        this.tell({ state: `mvseg correct does not answer (${error.message}): ${advice}` }, "");
        await new Promise((done) => setTimeout(done, AGAIN));
      }
    }
  }

  hear({ number, outcomes, update, problem, isComputing }) {
    const isFirst = this.number === 0;
    Object.assign(this, { number, outcomes });
    if (update) {
      this.isNewer ||= !isFirst;
      this.work.update(update);
    }
    const done = update || !problem ? "What you see follows from all edits." : "";
    this.tell({ state: problem }, isComputing ? "Computing what follows from the edits\u2026" : done);
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
      draft.points = found.polygon.map((point) => frames[view].toPicture(point));
      this.tell({ fit: "" }, "");
    } catch (error) {
      this.tell({ fit: error.message }, "");
    }
  }

  tell(messages, state) {
    Object.assign(this.messages, messages);
    this.state = state;
    this.work.changed();
  }
}
