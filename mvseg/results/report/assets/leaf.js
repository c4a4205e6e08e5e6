// The panel of the selected leaf; of the whole plant while none is selected.

function buildLeafPanel(data, addresses) {
  const panel = document.getElementById("leaf");
  let shown;
  selection.listen((selected) => {
    if (selected === shown) return;
    shown = selected;
    const leaf = data.leaves.find((one) => one.id === selected);
    panel.replaceChildren(...(leaf ? describeLeaf(leaf, data, addresses) : describePlant(data)));
    panel.scrollTop = 0;
  });
}

function describePlant(data) {
  const rejected = data.leaves.filter((leaf) => leaf.isRejected).length;
  const hint = "Click a leaf: in 3D, in a photo or in the table. It lights up everywhere, and its numbers appear here.";
  const parts = [element("h2", {}, "The plant"), element("p", { class: "note" }, hint)];
  if (data.plantTraits.length) {
    parts.push(element("h3", {}, "Traits of the plant"), traitTable(data.plantTraits, data.whole));
  }
  parts.push(...data.stems.flatMap((stem) => describeStem(stem, data)));
  if (rejected) {
    parts.push(element("p", { class: "note" }, `${rejected} of ${data.leaves.length} do not count as leaves.`));
  }
  return parts;
}

function describeLeaf(leaf, data, addresses) {
  const close = element("button", { type: "button", title: "Esc" }, "show all");
  close.addEventListener("click", () => selection.select(null));
  const swatch = element("span", { class: "swatch", style: `background:${leaf.color}` });
  const parts = [element("h2", {}, swatch, `Leaf ${leaf.id}`, close)];
  if (leaf.probability !== undefined) {
    parts.push(element("p", { class: "note" }, `A leaf with a probability of ${leaf.probability.toFixed(2)}.`));
  }
  if (leaf.doubts) parts.push(describeQuality(leaf));
  const seen = data.views.flatMap((view, index) =>
    view.masks.filter((mask) => mask.leaf === leaf.id).map((mask) => ({ view, index, mask })));
  const numViews = new Set(seen.map((one) => one.index)).size;
  parts.push(element("h3", {}, `Seen in ${numViews} of ${data.views.length} photos`));
  const crops = seen.map((one) => cropButton(one, leaf, addresses));
  parts.push(element("div", { class: "crops" }, ...crops));
  if (leaf.traits) parts.push(element("h3", {}, "Traits"), traitTable(data.traits, leaf.traits));
  return parts;
}

function describeQuality(leaf) {
  const shape = `Shape: ${leaf.shape}.`;
  if (leaf.doubts.length === 0) return element("p", { class: "note" }, `${shape} No reason to doubt it.`);
  const reasons = leaf.doubts.map((doubt) => element("li", {}, doubt));
  return element("div", { class: "doubt" }, element("p", {}, `${shape} Doubts:`), element("ul", {}, ...reasons));
}

function cropButton({ view, index, mask }, leaf, addresses) {
  const match = `match ${mask.match_score.toFixed(2)}${mask.is_sure ? "" : "?"}`;
  const found = mask.detection_score === undefined ? null : `found ${mask.detection_score.toFixed(2)}`;
  const title = [view.name, "match score, detection score"].join(": ");
  const button = element("button", { type: "button", title },
    drawCrop(view, mask, addresses.pictures[index], leaf.color),
    element("span", {}, view.name),
    element("span", { class: mask.is_sure ? "note" : "doubt" }, match),
    found && element("span", { class: "note" }, found));
  button.addEventListener("click", () => shownView.show(index));
  return button;
}

// The numbers there are, and below them why others are missing.
function traitTable(traits, numbers) {
  const rows = [];
  const missing = new Map();
  for (const trait of traits) {
    const number = numbers[trait.name];
    if (number?.value !== undefined) {
      rows.push(element("tr", {}, element("th", { scope: "row", title: trait.meaning }, trait.label),
        element("td", { title: number.on }, formatTrait(number, trait.unit))));
    } else if (number) {
      missing.set(number.why, [...(missing.get(number.why) ?? []), trait.label]);
    }
  }
  const reasons = [...missing].map(([why, names]) => element("p", { class: "note" }, `${names.join(", ")}: ${why}`));
  return element("div", {}, element("table", {}, element("tbody", {}, ...rows)), ...reasons);
}
