// Puts the parts of the page together.

function buildTip(data) {
  const tip = document.getElementById("tip");
  const main = data.traits.find((trait) => trait.isColumn);
  document.addEventListener("pointermove", ({ clientX, clientY }) => {
    const x = Math.min(clientX + 14, window.innerWidth - tip.offsetWidth - 6);
    tip.style.transform = `translate(${x}px, ${clientY + 16}px)`;
  });
  selection.listen((_, hovered) => {
    const leaf = data.leaves.find((one) => one.id === hovered);
    tip.hidden = leaf === undefined;
    if (leaf === undefined) return;
    const number = main && leaf.traits?.[main.name];
    const size = number?.value === undefined ? "" : `, ${main.label} ${formatTrait(number, main.unit)}`;
    tip.textContent = `Leaf ${leaf.id}${size}`;
  });
}

function buildPage(data) {
  const addresses = {
    pictures: data.views.map((view) => addressOf(view.jpeg)),
    thumbnails: data.views.map((view) => addressOf(view.thumbnail)),
  };
  buildRun(data);
  const space = buildSpace(data, addresses);
  buildPhotos(data, addresses, (view) => space?.lookThrough(view));
  buildTable(data);
  buildLeafPanel(data, addresses);
  buildTip(data);
  const modes = buildModes(data, addresses);
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && !document.querySelector("main").hidden) selection.select(null);
  });
  selection.tell();
  return { space, modes };
}

const data = JSON.parse(document.getElementById("data").textContent);
const { space: page, modes } = buildPage(data);
