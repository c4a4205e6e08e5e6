// Stems and petioles: tubes in the 3D view, lines in photos, and a diagram of the nodes.

const DIAGRAM = { width: 320, height: 260, margin: 34 };

// Petioles are guessed, and paler.
function makeStem(part) {
  const { mesh } = makeLeaf({ id: null, color: part.color }, part);
  mesh.userData = {};
  mesh.material.opacity = part.leaf === undefined ? 1 : 0.6;
  return mesh;
}

function drawStem({ path, leaf }) {
  return drawing("path", { d: path, class: leaf === undefined ? "stem" : "petiole" });
}

// Height against azimuth, as if the stem were unrolled.
function describeStem(stem, data) {
  const angle = stem.angle === undefined || stem.name !== "spiral" ? "" : ` of ${stem.angle}°`;
  const chance = stem.probability === undefined ? "" : `, probability ${stem.probability.toFixed(2)}`;
  const found = `Found by ${stem.source}. Phyllotaxis: ${stem.name}${angle}${chance}.`;
  return [
    element("h3", {}, `Stem ${stem.number}: ${count(stem.nodes.length, "node", "nodes")}`),
    element("p", { class: "note" }, `${found} Lines to blades are guessed.`),
    drawNodes(stem.nodes, data),
  ];
}

function drawNodes(nodes, data) {
  const { width, height, margin } = DIAGRAM;
  const highest = Math.max(...nodes.map((node) => node.height), 1e-12);
  const colors = new Map(data.leaves.map((leaf) => [leaf.id, leaf.color]));
  const x = (azimuth) => margin + (azimuth / 360) * (width - 2 * margin);
  const y = (level) => height - margin - (level / highest) * (height - 2 * margin);
  const picture = drawing("svg", {
    class: "nodes", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": "nodes, height against azimuth",
  });
  for (const azimuth of [0, 90, 180, 270, 360]) {
    picture.append(
      drawing("line", { x1: x(azimuth), x2: x(azimuth), y1: y(0), y2: y(highest), class: "grid" }),
      drawing("text", { x: x(azimuth), y: height - 12, class: "label" }, `${azimuth}°`));
  }
  picture.append(drawing("text", { x: 6, y: 20, class: "label start" }, `${highest} ${data.unit}`));
  for (const node of nodes) {
    const dot = drawing("circle", {
      cx: x(node.azimuth ?? 0), cy: y(node.height), r: 6, fill: colors.get(node.leaf) ?? "#888", "data-leaf": node.leaf,
    });
    dot.addEventListener("click", () => selection.select(node.leaf));
    picture.append(dot, drawing("text", { x: x(node.azimuth ?? 0) + 9, y: y(node.height) + 4, class: "label start" }, `${node.leaf}`));
  }
  return picture;
}
