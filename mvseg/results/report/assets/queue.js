// What the page asks, in the order of its data: the first ones. Others are asked where the user clicks.

const MOST_ASKED = 10;

function askAbout(doubt, { data }) {
  const [view, leaf, photos] = [data.views[doubt.view].name, `leaf ${doubt.instance}`, names(doubt, data)];
  const other = doubt.otherMask && data.views[doubt.otherView].name;
  const beside = other ? ` Photo ${other} shows that leaf; ${doubt.num_found} of ${doubt.num_expected} have a mask.` : "";
  if (doubt.kind === "stem") return `Photos ${photos}: a stem may run along the dashed line. Is it the stem?`;
  if (doubt.kind === "half") {
    return `Photos ${photos}: half of ${leaf} may have no mask (dashed), or another leaf was missed there. ` +
      `Outline the whole of ${leaf} in photo ${view}, then in the photo beside it: the others follow.`;
  }
  if (doubt.isOfMany) {
    return `Photos ${photos}: large places look like leaves, and have no mask (dashed). Outline one leaf at a ` +
      "time, in two photos under one name: the others follow.";
  }
  if (doubt.kind === "place") {
    return `Photo ${view}: ${leaf} should be here, where no mask is. Is it inside the dashed line?${beside}`;
  }
  if (doubt.isOffered) return `Photos ${photos} may show a leaf here (dashed) that was not accepted as one. Is it a leaf?`;
  if (other) return `Photo ${view}: is this ${leaf}?${beside}`;
  return `Photo ${view}: no other photo has a mask of this${doubt.instance > 0 ? ` (${leaf})` : ""}. Is it a leaf?`;
}

// The first photos of a question.
function names(doubt, data) {
  const views = [...new Set(doubt.outlines.map((one) => one.view))].map((view) => data.views[view].name);
  return views.slice(0, 3).join(", ") + (views.length > 3 ? ` and ${views.length - 3} more` : "");
}

// Answers: [action, text on its button].
function answersTo(doubt) {
  const [draw, later] = [["outline", "Yes, but I draw it"], ["next", "I cannot tell"]];
  if (doubt.kind === "stem") return [["confirm", "Yes"], ["reject", "No stem"], later];
  if (doubt.kind === "half") return [["outline", "I outline it"], ["next", "It is whole, or I cannot tell"]];
  if (doubt.isOfMany) return [["outline", "I outline a leaf"], ["next", "No leaves, or not now"]];
  if (doubt.kind === "place") return [["confirm", "Yes, keep this outline"], draw, ["reject", "No, or not to be seen"], later];
  if (!doubt.otherMask) return [["confirm", "Yes"], draw, ["reject", doubt.isOffered ? "No leaf, nowhere" : "No leaf"], later];
  return [["same", "Yes, the same leaf"], draw, ["different", "No, another leaf"], ["reject", "No leaf"],
    ["reject-all", "No leaf, in all photos"], later];
}

// Questions with their places; without those whose masks no picture shows.
function placeDoubts(data) {
  const places = new Map();
  data.views.forEach((view, index) => view.masks.forEach((mask) => places.set(mask.region, { view: index, mask })));
  return [...stemDoubts(data), ...data.correct.doubts].flatMap((doubt) => {
    const [mask, other] = [places.get(doubt.region)?.mask, places.get(doubt.other)];
    if (!mask && !doubt.outlines.length) return [];
    const at = mask ? mask.at : insidePoint(doubt.outlines[0].outline).map(Math.round);
    const name = [doubt.kind, doubt.view, ...at].join(" ");
    const otherView = other?.view ?? doubt.outlines[1]?.view;
    const otherBox = other?.mask.box ?? (doubt.outlines[1] && boxAround(doubt.outlines[1].outline));
    const isOfMany = doubt.kind === "place" && doubt.instance < 0;
    const isOffered = doubt.kind === "leaf" && !mask; // a candidate
    return [{ ...doubt, name, at, mask, isOfMany, isOffered, otherView, otherBox, otherMask: other?.mask }];
  });
}

// Guessed stems, each by its line in two photos.
function stemDoubts({ views }) {
  const lines = views.flatMap(({ stems }, view) => stems.filter((one) => one.isGuessed && one.leaf === undefined)
    .map(({ name, path }) => ({ name, view, outline: path.slice(1).split("L").map((at) => at.split(" ").map(Number)) })));
  return [...new Set(lines.map(({ name }) => name))].map((stem) => {
    const [first, ...others] = lines.filter(({ name }) => name === stem);
    return { kind: "stem", view: first.view, outlines: [first, ...others.slice(others.length >> 2).slice(0, 1)] };
  });
}

// Whether an edit is about the place of a question.
function isAnswered(doubt, places) {
  const [x, y] = doubt.at;
  if (doubt.kind === "stem") {
    return places.some(({ edit, view, at }) => edit.stem && view === doubt.view && Math.hypot(at[0] - x, at[1] - y) < 5);
  }
  return places.some(({ edit, view, at }) => !edit.stem && (doubt.mask
    ? view === doubt.view && isOnMask(doubt.mask, at)
    : doubt.outlines.some((one) => one.view === view && isInside(at, one.outline))));
}
