// What the page asks: of what it is told, in that order, the first ones. The others are asked where a person clicks.

const MOST_ASKED = 10;

function askAbout(doubt, { data }) {
  const view = data.views[doubt.view].name;
  const leaf = `leaf ${doubt.leaf}`;
  const other = doubt.otherView === undefined ? null : data.views[doubt.otherView].name;
  const beside = other === null ? "" : ` Photo ${other} shows that leaf.`;
  switch (doubt.kind) {
    case "place": return `Photos ${names(doubt, data)}: large places have the colour of leaves, and no mask (dashed). Outline ` +
      "one leaf there at a time, in two photos under one name: the others follow.";
    case "half": return `Leaf ${doubt.leaf}, photos ${names(doubt, data)}: half of it may have no mask (dashed), or another ` +
      `leaf was missed there. Outline the whole of leaf ${doubt.leaf} in photo ${view}, then in the photo beside it: the others follow.`;
    case "match": return other === null
      ? `Photo ${view}: no other photo shows ${leaf}. Is it a leaf?`
      : `Photo ${view}: is this ${leaf}?${beside}`;
    case "unmatched": return `Photo ${view}: this mask was found in no other photo. Is it a leaf?`;
    case "few":
      return `Leaf ${doubt.leaf} was found in ${doubt.num_found} of ${doubt.num_expected} photos that should show it. ` +
        "Is it a leaf?";
    case "surface": return `Photo ${view}: this mask does not fit the shape of ${leaf}. Is it that leaf?${beside}`;
    case "covered": return `Photo ${view}: ${leaf} should be here. Is it this mask?${beside}`;
    case "leaf": return `Photos ${names(doubt, data)} may show a leaf here (dashed) that was not taken for one. Is it a leaf?`;
    default: return `Photo ${view}: ${leaf} should be here, where no mask is. Is it inside the dashed line?${beside}`;
  }
}

// Of the first photos that a question is about.
function names(doubt, data) {
  const views = [...new Set(doubt.outlines.map((one) => one.view))].map((view) => data.views[view].name);
  return views.slice(0, 3).join(", ") + (views.length > 3 ? ` and ${views.length - 3} more` : "");
}

// The answers that make sense: [action, text on its button].
function answersTo(doubt) {
  const draw = ["outline", "Yes, but I draw it"];
  const pair = [["same", "Yes, the same leaf"], draw, ["different", "No, another leaf"]];
  const later = ["next", "I cannot tell"];
  switch (doubt.kind) {
    case "place": return [["outline", "I outline a leaf"], ["next", "No leaves, or not now"]];
    case "half": return [["outline", "I outline it"], ["next", "It is whole, or I cannot tell"]];
    case "missing": return [["confirm", "Yes, keep this outline"], draw, ["reject", "No, or not to be seen"], later];
    case "few": case "leaf": return [["confirm", "Yes"], draw, ["reject", "No leaf, nowhere"], later];
    case "covered": return [...pair, later];
    default: return doubt.otherView === undefined
      ? [["confirm", "Yes"], draw, ["reject", "No leaf"], later]
      : [...pair, ["reject", "No leaf at all"], later];
  }
}

// The doubts with what they point at, as places; without those whose masks no picture shows.
function placeDoubts(data) {
  const places = new Map();
  data.views.forEach((view, index) => view.masks.forEach((mask) => places.set(mask.region, { view: index, mask })));
  return data.correct.doubts.flatMap((doubt) => {
    const [mask, other] = [places.get(doubt.region)?.mask, places.get(doubt.other)];
    if (!mask && !doubt.outlines.length) return [];
    const at = mask ? mask.at : insidePoint(doubt.outlines[0].outline).map(Math.round);
    const name = [doubt.kind, doubt.view, ...at].join(" ");
    const otherView = other?.view ?? doubt.outlines[1]?.view;
    const otherBox = other?.mask.box ?? (doubt.outlines[1] && boxAround(doubt.outlines[1].outline));
    return [{ ...doubt, name, mask, otherView, otherBox, otherMask: other?.mask }];
  });
}

// Whether an edit says something of what a doubt points at.
function isAnswered(doubt, places) {
  return places.some(({ view, at }) => (doubt.mask
    ? view === doubt.view && isOnMask(doubt.mask, at)
    : doubt.outlines.some((one) => one.view === view && isInside(at, one.outline))));
}
