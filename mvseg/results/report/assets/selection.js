"use strict";

// The leaf that is selected, and the one under the pointer. All parts of the page listen.
const selection = {
  selected: null,
  hovered: null,
  listeners: [],

  listen(listener) {
    this.listeners.push(listener);
  },

  select(leaf) {
    if (leaf === this.selected) return;
    this.selected = leaf;
    this.tell();
  },

  hover(leaf) {
    if (leaf === this.hovered) return;
    this.hovered = leaf;
    this.tell();
  },

  tell() {
    for (const listener of this.listeners) listener(this.selected, this.hovered);
  },

  // Classes of an element that stands for a leaf.
  mark(element, leaf) {
    element.classList.toggle("selected", leaf === this.selected);
    element.classList.toggle("hovered", leaf === this.hovered);
  },
};

// A view that another part of the page points at, by its index.
const shownView = {
  listeners: [],
  listen(listener) {
    this.listeners.push(listener);
  },
  show(view) {
    for (const listener of this.listeners) listener(view);
  },
};

// Names of photos as far as they differ, for places where little of them fits: "frame-000123" is frame 123.
function shortNames(names) {
  if (names.every((name) => /^frame-\d+$/.test(name))) return names.map((name) => `frame ${Number(name.slice(6))}`);
  const [first] = names;
  const isStart = (start) => /[^a-z0-9]$/i.test(start) && names.every((name) => name.startsWith(start));
  let same = names.length > 1 && first.length > 10 ? first.length : 0;
  while (same && !isStart(first.slice(0, same))) same -= 1;
  return names.map((name) => (same ? `\u2026${name.slice(same)}` : name));
}

const SVG = "http://www.w3.org/2000/svg";

// An element with attributes and children. Text becomes a text node: it is never read as HTML.
function element(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}

// The browser saves text as a file of this name.
function saveFile(name, text, type) {
  const address = URL.createObjectURL(new Blob([text], { type }));
  element("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60000);
}

function drawing(name, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, name), attributes, children);
}

function fill(node, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) {
    if (value !== null && value !== undefined) node.setAttribute(key, value);
  }
  node.append(...children.filter((child) => child !== null));
  return node;
}

// The address of a JPEG in base64: the page holds each picture once.
function addressOf(base64) {
  return URL.createObjectURL(new Blob([bytesOf(base64)], { type: "image/jpeg" }));
}

function bytesOf(base64) {
  return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
}
