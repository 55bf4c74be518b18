// Coverage of the images by boards, as `omnid calibrate live` reports it: a disc for each camera.
import { byId, element } from "./elements.js";

const HOURS = 12;
const SIZE = 100;
const MANY = 4; // views of a part, from which its colour is full

export function showCalibration(part) {
  byId("calibration-box").hidden = part === undefined;
  if (part === undefined) return;
  const values = new Map(part.values);
  byId("calibration-pairs").textContent = `${values.get("pairs")} of ${values.get("needed")} pairs: ${part.message}`;
  const missing = (values.get("missing") ?? "").split("; ").filter(Boolean);
  byId("calibration-missing").replaceChildren(...(missing.length ? missing : ["Enough. More positions do no harm."])
    .map((text) => element("li", {}, text)));
  drawDisc("calibration-lower", values.get("lower_coverage") ?? "");
  drawDisc("calibration-upper", values.get("upper_coverage") ?? "");
}

// Digits from the middle outwards, 12 a ring, clockwise from the top; each is a sector of a ring.
function drawDisc(id, digits) {
  const svg = byId(id);
  if (svg.dataset.shown === digits) return;
  svg.dataset.shown = digits;
  const rings = Math.floor(digits.length / HOURS);
  svg.replaceChildren(...[...digits].slice(0, rings * HOURS).map((digit, at) => {
    const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
    path.setAttribute("d", sector(Math.floor(at / HOURS) / rings, (Math.floor(at / HOURS) + 1) / rings, at % HOURS));
    path.setAttribute("class", digit === "0" ? "none" : "seen");
    path.setAttribute("fill-opacity", Math.min(1, 0.4 + 0.6 * Number(digit) / MANY));
    return path;
  }));
}

function sector(inner, outer, hour) {
  const [begin, end] = [hour - 0.5, hour + 0.5].map((value) => 2 * Math.PI * value / HOURS);
  const at = (radius, angle) => `${(SIZE * radius * Math.sin(angle)).toFixed(2)} ${(-SIZE * radius * Math.cos(angle)).toFixed(2)}`;
  return `M${at(inner, begin)}L${at(outer, begin)}A${SIZE * outer} ${SIZE * outer} 0 0 1 ${at(outer, end)}`
    + `L${at(inner, end)}A${SIZE * inner} ${SIZE * inner} 0 0 0 ${at(inner, begin)}Z`;
}
