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

// `mvseg correct` serves the page that a command would open, and may have replaced another result.
function buildCard(card, { traits, correct: { isServed } }) {
  const place = document.getElementById("card");
  const isStale = isServed && !traits.length && card?.found?.includes("area");
  const next = isServed ? card?.next_step?.replace(/: mvseg correct .*/, ": \u201cCorrect\u201d, above") : card?.next_step;
  const lines = card ? [["before", card.before], [isStale ? "found before your edits" : "found", card.found],
    ["in doubt", card.doubt], ["next", next]] : [];
  const terms = lines.filter(([, text]) => text)
    .flatMap(([name, text]) => [element("dt", {}, name), element("dd", {}, inSymbols(text))]);
  if (terms.length) place.append(element("dl", {}, ...terms));
}

function buildRun(data) {
  const { run } = data;
  const findings = run.findings ?? [];
  const warnings = findings.filter(({ level }) => level !== "note");
  document.getElementById("plant").textContent = data.plant;
  summarise(data);
  const link = document.getElementById("findings-link");
  link.textContent = count(warnings.length, "warning");
  link.hidden = warnings.length === 0;

  buildCard(run.card, data);

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
