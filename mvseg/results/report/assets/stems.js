// Stems and petioles (paler: guessed), and nodes.

function makeStem(part) {
  const { mesh } = makeLeaf({ id: null, color: part.color }, part);
  mesh.userData = {};
  mesh.material.opacity = part.leaf === undefined ? 1 : 0.6;
  return mesh;
}

function drawStem({ path, leaf }) {
  return drawing("path", { d: path, class: leaf === undefined ? "stem" : "petiole" });
}

function describeStem(stem, data) {
  const angle = stem.name === "spiral" ? ` of ${stem.angle}°` : "";
  const chance = stem.probability === undefined || stem.name === "unclear" ? "" : ` (probability ${stem.probability.toFixed(2)})`;
  const note = `Found by ${stem.source}; ${stem.name}${angle}${chance}. Petioles are guessed.`;
  const title = `Stem ${stem.number}: height (${data.unit}) against azimuth`;
  return [element("h3", {}, title), element("p", { class: "note" }, note), drawNodes(stem.nodes, data, title)];
}

function drawNodes(nodes, data, title) {
  const highest = Math.max(...nodes.map((node) => node.height), 1e-12);
  const at = ({ azimuth, height }) => [30 + ((azimuth ?? 0) / 360) * 260, 210 - (height / highest) * 190];
  const picture = drawing("svg", { class: "nodes", viewBox: "0 0 320 240", role: "img", "aria-label": title });
  const write = (x, y, text) => picture.append(drawing("text", { x, y }, `${text}`));
  for (const azimuth of [0, 90, 180, 270]) write(at({ azimuth, height: 0 })[0], 235, `${azimuth}°`);
  write(0, 15, Number(highest.toPrecision(3)));
  for (const node of nodes) {
    const [x, y] = at(node);
    const { color } = data.leaves.find((leaf) => leaf.id === node.leaf) ?? {};
    const dot = drawing("circle", { cx: x, cy: y, r: 6, fill: color });
    dot.addEventListener("click", () => selection.select(node.leaf));
    picture.append(dot);
    write(x + 8, y + 4, node.leaf);
  }
  return picture;
}
