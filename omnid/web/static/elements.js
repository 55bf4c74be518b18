// Elements of the page, and numbers.

export function byId(id) {
  return document.getElementById(id);
}

// An element with properties and children; strings become text nodes.
export function element(name, properties, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

export function tableRow(name, value) {
  return element("tr", {}, element("td", {}, name), element("td", {}, value));
}

// A number with so many decimals; a dash where there is none.
export function fixed(value, decimals) {
  if (typeof value !== "number") return "–";
  const text = value.toFixed(decimals);
  return Number(text) === 0 ? (0).toFixed(decimals) : text; // no -0.0
}

export function degrees(radians) {
  return radians === null ? null : radians * 180 / Math.PI;
}
