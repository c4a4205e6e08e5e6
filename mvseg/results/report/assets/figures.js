// Export a picture of the page as SVG, or as PNG with three times as many pixels; dark on white.

const LARGER = 3;
const PAPER = { ink: "#1d241d", back: "#ffffff" };
const STYLES = ["fill", "fill-opacity", "stroke", "stroke-width", "stroke-dasharray", "stroke-opacity", "opacity",
  "font-size", "font-weight", "text-anchor", "dominant-baseline", "paint-order"];

// A copy of an SVG that needs no style sheet.
function copyFigure(picture) {
  const copy = picture.cloneNode(true);
  const copies = [...copy.querySelectorAll("*")];
  const ink = getComputedStyle(picture).color;
  [...picture.querySelectorAll("*")].forEach((one, n) => {
    const style = getComputedStyle(one);
    for (const name of picture.isConnected ? STYLES : []) {
      const value = style.getPropertyValue(name);
      copies[n].style.setProperty(name, value === ink || (name === "fill" && one.tagName === "text") ? PAPER.ink : value);
    }
    copies[n].removeAttribute("class");
  });
  const [x, y, width, height] = picture.getAttribute("viewBox").split(" ").map(Number);
  copy.prepend(drawing("rect", { x, y, width, height, fill: PAPER.back }));
  return fill(copy, { xmlns: SVG, width, height, "font-family": "Helvetica, Arial, sans-serif" }, []);
}

function saveFigure(name, picture, kind) {
  const copy = copyFigure(picture);
  const text = new XMLSerializer().serializeToString(copy);
  if (kind === "SVG") return saveFile(`${name}.svg`, text, "image/svg+xml");
  const [width, height] = ["width", "height"].map((side) => LARGER * copy.getAttribute(side));
  const canvas = element("canvas", { width, height });
  const image = new Image();
  image.addEventListener("load", () => {
    canvas.getContext("2d").drawImage(image, 0, 0, width, height);
    canvas.toBlob((blob) => saveFile(`${name}.png`, blob, "image/png"));
  });
  image.src = `data:image/svg+xml,${encodeURIComponent(text)}`;
  return image;
}

// Buttons that save what `draw` returns, an SVG.
function exportButtons(name, draw) {
  return ["SVG", "PNG"].map((kind) => {
    const button = element("button", { type: "button", class: "export", title: `save the figure as ${kind}` }, kind);
    button.addEventListener("click", () => saveFigure(name(), draw(), kind));
    return button;
  });
}

// A colour of the same hue that can be seen on white paper.
function inkOf(color) {
  const parts = [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16) / 255);
  const light = parts.reduce((sum, part, n) => sum + [0.2126, 0.7152, 0.0722][n] * part ** 2.2, 0);
  const share = Math.min(1, (0.3 / light) ** (1 / 2.2));
  return `rgb(${parts.map((part) => Math.round(255 * share * part)).join(" ")})`;
}
