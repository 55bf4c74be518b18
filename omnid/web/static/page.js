// Connects the elements of the page with the messages of the server. Text is only ever set as text, never as HTML.
import { showCalibration } from "./calibration.js";
import { wireCommands } from "./commands.js";
import { Connection } from "./connection.js";
import { byId, degrees, element, fixed, inWords, tableRow } from "./elements.js";
import { Plan } from "./plan.js";
import { showMapFile, wireGoal, wireMap, wireRoutes } from "./requests.js";
import { wireStick } from "./stick.js";

const LEVELS = ["good", "warn", "bad", "warn"];
const LEVEL_NAMES = ["good", "warning", "error", "no news"];
const STATES = { tracking: "good", degraded: "warn", lost: "bad" };

const plan = new Plan(byId("plan"));
const goal = wireGoal(plan);
const routes = wireRoutes();
const shownByState = [wireCommands(), wireStick(), goal, routes];
let imageUrl = "";
let nearest = null; // distance in m and direction in degrees of the nearest obstacle

function onMessage(message, body) {
  switch (message.type) {
    case "state": return showState(message);
    case "path": return plan.addPath(message.from, message.points);
    case "map":
      byId("map-note").textContent = ["odom", "map"].includes(message.frame) ? "" : `a map in the frame ${message.frame} is not drawn`;
      return plan.setMap(message, body);
    case "parts":
      showCalibration(message.parts.find((part) => part.name === "calibration"));
      showMapFile(message.parts.find((part) => part.name === "map file"));
      return showParts(message.parts);
    case "navigation":
      goal.showNavigation(message);
      return routes.showNavigation(message);
    case "scan":
      nearest = message.nearest;
      return plan.setObstacles(message.points);
    case "panorama": return showPanorama(body);
  }
  return undefined;
}

function onConnection(text) {
  byId("lost").hidden = !text;
  byId("lost").textContent = text;
  if (text) {
    setBadge("state", "no connection", "bad");
    setBadge("armed", "", "warn");
    byId("well").hidden = true;
  }
}

function showState(state) {
  document.title = `${state.robot}: ${state.state}`;
  byId("robot").textContent = state.robot;
  setBadge("state", state.state, state.fresh ? STATES[state.state] ?? "warn" : "bad");
  byId("rate").textContent = state.fresh ? `${fixed(state.rate_hz, 1)} poses/s` : "";
  showWell(state);
  showWheels(state.wheels);
  for (const part of shownByState) part.show(state);
  showWarnings(state.warnings);
  showPose(state);
  byId("no-pose").hidden = state.pose !== null;
  byId("panorama-note").hidden = state.panoramas > 0;
  plan.setMapInOdom(state.map_in_odom);
  plan.setPose(state.pose, state.fresh);
}

// One line that says whether all is well.
function showWell(state) {
  const line = byId("well");
  const [worst] = state.warnings;
  const more = state.warnings.length > 1 ? ` (and ${state.warnings.length - 1} more below)` : "";
  const moves = state.wheels === null ? "It has no wheels." : state.wheels.armed ? "It obeys commands." : "Arm it to drive.";
  const pose = state.pose === null || !state.fresh;
  line.hidden = false;
  line.className = worst ? LEVELS[worst.level] : pose ? "warn" : "good";
  line.textContent = worst ? `${worst.name}: ${worst.message}${more}` : pose ? `There is no pose: ${state.state}.`
    : `All is well. ${moves}`;
}

function showWheels(wheels) {
  const armed = wheels !== null && wheels.armed;
  setBadge("armed", wheels === null ? "" : armed ? "armed" : "not armed", armed ? "warn" : "rest");
  const source = wheels !== null && wheels.source ? `, commanded by ${wheels.source}` : "";
  byId("wheels").textContent = wheels === null ? "not reported: the robot has no motor, or is not there"
    : `${wheels.message}${source}`;
}

function showWarnings(warnings) {
  const text = JSON.stringify(warnings);
  const box = byId("warnings");
  if (box.dataset.shown === text) return;
  box.dataset.shown = text;
  box.replaceChildren(...warnings.map((warning) => element("div", { className: `warning ${LEVELS[warning.level]}` },
    element("strong", {}, `${warning.name}: ${warning.message}`),
    element("p", {}, warning.remedy ? `Do: ${warning.remedy}` : ""))));
}

function showPose(state) {
  const pose = state.pose;
  const rows = pose === null ? [] : [
    ["x, y, z", `${fixed(pose.x_m, 3)}, ${fixed(pose.y_m, 3)}, ${fixed(pose.z_m, 3)} m`],
    ["heading", `${fixed(degrees(pose.yaw_rad), 1)}°`],
    ["speed", `${fixed(pose.speed_mps, 2)} m/s`],
    ["uncertainty, 1 sigma", `${fixed(pose.sigma_mm, 1)} mm, ${fixed(pose.sigma_deg, 2)}°`],
    ["landmarks", `${pose.inliers} of ${pose.tracked}`],
    ...(state.in_map === null ? [] : [["in the map", state.in_map]]),
    ...(nearest === null || !plan.obstacles.length ? [] : [["nearest obstacle", `${fixed(nearest[0], 2)} m, ${direction(nearest[1])}`]]),
    ["resets", `${pose.resets}`],
    ...(state.pace ? [["simulated time", `${state.pace} x real time`]]
      : [["image to here, median and 99 %", `${fixed(state.age_ms[0], 0)} and ${fixed(state.age_ms[1], 0)} ms`]]),
    ["missed poses", `${state.missed}`],
  ];
  byId("pose").replaceChildren(...rows.map(([name, value]) => tableRow(name, value)));
}

// The direction of an angle counter-clockwise from ahead.
function direction(degrees) {
  const turn = Math.round(Math.abs(degrees));
  if (turn < 10) return "ahead";
  if (turn > 170) return "behind";
  return `${turn}° to the ${degrees > 0 ? "left" : "right"}`;
}

function showParts(parts) {
  const open = new Set([...byId("parts").querySelectorAll("details[open]")].map((part) => part.dataset.part));
  byId("parts").replaceChildren(...parts.map((part) => {
    const title = `${part.name}: ${part.message || LEVEL_NAMES[part.level]}`;
    const values = part.values.map(([key, value]) => {
      const [name, unit] = inWords(key);
      return tableRow(name, unit ? `${value} ${unit}` : value, key);
    });
    const found = element("details", { open: open.has(part.name) },
      element("summary", { className: LEVELS[part.level] }, title), element("table", {}, ...values));
    found.dataset.part = part.name;
    return found;
  }));
}

// An empty body: the robot has started again, and sent none yet.
function showPanorama(body) {
  const image = byId("panorama");
  image.hidden = body.byteLength === 0;
  if (image.hidden) return;
  const before = imageUrl;
  imageUrl = URL.createObjectURL(new Blob([body], { type: "image/jpeg" }));
  image.src = imageUrl;
  if (before) URL.revokeObjectURL(before);
}

function setBadge(id, text, className) {
  const badge = byId(id);
  if (badge.textContent !== text) badge.textContent = text;
  badge.className = `badge ${className}`;
}

byId("closer").addEventListener("click", () => plan.zoom(1.5));
byId("wider").addEventListener("click", () => plan.zoom(1 / 1.5));
byId("fit").addEventListener("click", () => plan.fit());
plan.onFit = (fits) => byId("fit").setAttribute("aria-pressed", String(fits));
wireMap();
byId("panorama-note").textContent = "None comes yet: the robot publishes it unless bus.panorama_hz = 0.";
const connection = new Connection(onMessage, onConnection);

// The panorama comes while it is open and the page is seen: it takes bandwidth that the robot may need.
const panorama = byId("panorama-box");
const askForPanorama = () => connection.request("panorama", panorama.open && !document.hidden);
panorama.addEventListener("toggle", askForPanorama);
document.addEventListener("visibilitychange", askForPanorama);
askForPanorama();
