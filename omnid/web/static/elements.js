// Elements of the page, numbers, and keys of the status in words.

const UNITS = { ms: "ms", s: "s", m: "m", mm: "mm", mps: "m/s", deg: "°", hz: "/s", v: "V", mb: "MB", px: "px", ns: "ns", grey: "grey levels" };
const STATISTICS = { p50: "median", p99: "99 %", p999: "99.9 %", max: "longest" };

export function byId(id) {
  return document.getElementById(id);
}

// An element with properties and children; strings become text nodes.
export function element(name, properties, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

export function tableRow(name, value, key = "") {
  return element("tr", {}, element("td", { title: key }, name), element("td", {}, value));
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

// "capture_to_pose_p50_ms" is "capture to pose, median" in "ms"; the unit is an empty text where there is none.
export function inWords(key) {
  const words = key.split("_");
  const unit = words.length > 1 ? UNITS[words.at(-1)] ?? "" : "";
  if (unit) words.pop();
  const statistic = STATISTICS[words.at(-1)];
  if (statistic) words.pop();
  return [statistic ? `${words.join(" ")}, ${statistic}` : words.join(" "), unit];
}
