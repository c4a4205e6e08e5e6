// The head of the page, and what is known of the run: findings, versions, options.

function summarise(data) {
  const leaves = count(data.leaves.length, "leaf", "leaves");
  document.getElementById("summary").textContent =
    `${leaves}, ${count(data.views.length, "photo")}, ${count(data.numMasks, "mask")}; lengths in ${data.unit}`;
}

// The card is for terminals, too, which may know ASCII only.
function inSymbols(text) {
  return text.replaceAll(" +- ", " \u00b1 ").replace(/\^2\b/g, "\u00b2");
}

// The number of leaves, and all other numbers that changed, as "before \u2192 now".
function compareFound(before, now) {
  const [old, parts] = [before, now].map((text) => text.split(/(\d[\d,.]*)/));
  if (old.length !== parts.length) return `${before} \u2192 ${now}`;
  return parts.map((part, n) => (n === 1 || (n % 2 && part !== old[n]) ? `${old[n]} \u2192 ${part}` : part)).join("");
}

// `mvseg correct` serves the page that a command would open, shows the last whole result, and may have replaced another.
function buildCard({ run: { card }, correct: { isServed, edits } }, work) {
  if (!card) return;
  const since = [];
  if (isServed) {
    const [made, now] = [card.edits, work?.edits.list ?? edits].map((list) => list.map((edit) => JSON.stringify(edit)));
    const changed = [...made.filter((edit) => !now.includes(edit)), ...now.filter((edit) => !made.includes(edit))].length;
    if (changed) since.push(count(changed, "edit"));
    if (work?.server?.learning?.isLearned) since.push("learning");
  }
  const next = isServed ? card.next_step?.replace(/: mvseg correct .*/, ": \u201cCorrect\u201d, above") : card.next_step;
  const whole = `${since.join(" and ")}; \u201cMake the whole result\u201d (Correct) shows the new numbers`;
  const lines = [["since this result", since.length ? whole : ""],
    ["found", card.before ? compareFound(card.before, card.found) : card.found], ["in doubt", card.doubt], ["next", next]];
  const terms = lines.filter(([, text]) => text)
    .flatMap(([name, text]) => [element("dt", {}, name), element("dd", {}, inSymbols(text))]);
  document.getElementById("card").replaceChildren(...(terms.length ? [element("dl", {}, ...terms)] : []));
}

function buildRun(data) {
  const { run } = data;
  const findings = run.findings ?? [];
  const warnings = findings.filter(({ level }) => level !== "note");
  document.getElementById("plant").textContent = data.plant;
  const link = document.getElementById("findings-link");
  link.textContent = count(warnings.length, "warning");
  link.hidden = warnings.length === 0;

  const list = findings.length
    ? element("ul", {}, ...findings.map(({ level, topic, sentence }) => element("li", {}, `${level}, ${topic}: ${sentence}`)))
    : element("p", { class: "note" }, `There were none.${data.correct.doubts.length
      ? ` ${count(data.correct.doubts.length, "question")} about single masks and leaves can be answered (\u201cCorrect\u201d).` : ""}`);
  const facts = [
    ["mvseg", run.mvseg], ["Python", run.python], ["PyTorch", run.torch],
    ["masks", run.mask_kind ?? "found by a detector"], ["matched by", run.matched_by],
    ["residual", run.residual_px == null ? null : `${run.residual_px} px`],
    ["seconds", Object.entries(run.seconds ?? {}).map(([stage, wall]) => `${stage} ${wall}`).join(", ")],
    ...Object.entries(run.inputs ?? {}).map(([path, hash]) => [path, `SHA-256 ${hash}`]),
  ].filter(([, value]) => value !== null && value !== undefined && value !== "");
  const terms = facts.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, String(value))]);
  document.getElementById("run").append(
    element("div", { id: "findings" }, element("h2", {}, "Findings"), list),
    ...(data.walk ? [element("details", {}, element("summary", {}, "Cameras from above"),
      element("img", { src: `data:image/svg+xml,${encodeURIComponent(data.walk)}`, alt: "cameras round the plant", width: 360 }))] : []),
    element("details", {}, element("summary", {}, "Run"), element("dl", {}, ...terms)),
    element("details", {}, element("summary", {}, "Options"), element("pre", {}, run.config)),
  );
}
