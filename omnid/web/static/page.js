// Asks the server for news, and shows them. Text is only ever set as text, never as HTML.
import { showCalibration } from "./calibration.js";
import { wireCommands } from "./commands.js";
import { byId, degrees, element, fixed, tableRow } from "./elements.js";
import { Plan } from "./plan.js";
import { showMapFile, wireGoal, wireMap, wireRoutes } from "./requests.js";
import { wireStick } from "./stick.js";

const LEVELS = ["good", "warn", "bad", "warn"];
const STATES = { tracking: "good", degraded: "warn", lost: "bad" };

const RETRY_MS = [300, 1000, 2000];
const SILENT_MS = 2500; // the server answers at least every 0.5 s
const GONE_MS = 10000; // a request without an answer is given up

const plan = new Plan(byId("plan"));
const goal = wireGoal(plan);
const routes = wireRoutes();
const shownByState = [wireCommands(), wireStick(), goal, routes];
let run = null; // of the robot's daemon: another one has another odom, map and path
let nearest = null; // distance in m and direction in degrees of the nearest obstacle

// Each request names the newest news that are shown, and is answered when there are others: so old ones never queue up.
async function follow() {
  let [seen, failures] = [0, 0];
  for (;;) {
    const noAnswer = () => showConnection("No answer from the robot's page. What is shown is old. STOP may not work.");
    const timer = setTimeout(noAnswer, SILENT_MS);
    try {
      // The panorama comes while it is open and the page is seen: it takes bandwidth that the robot may need.
      const panorama = byId("panorama-box").open && !document.hidden ? 1 : 0;
      const response = await fetch(`live?seen=${seen}&panorama=${panorama}`, { signal: AbortSignal.timeout(GONE_MS) });
      if (!response.ok) throw new Error(await response.text());
      const news = await response.json();
      await show(news);
      showConnection("");
      [seen, failures] = [news.seen, 0];
    } catch (error) {
      showConnection(`No connection to the robot's page: ${error.message}. What is shown is old. STOP may not work.`);
      await new Promise((resolve) => setTimeout(resolve, RETRY_MS[Math.min(failures, RETRY_MS.length - 1)]));
      failures += 1;
    } finally {
      clearTimeout(timer);
    }
  }
}

async function show(news) {
  if (news.path) plan.setPath(news.path);
  if (news.scan) {
    nearest = news.scan.nearest;
    plan.setObstacles(news.scan.points);
  }
  if (news.parts) {
    showCalibration(news.parts.find((part) => part.name === "calibration"));
    showMapFile(news.parts.find((part) => part.name === "map file"));
  }
  if (news.navigation) {
    goal.showNavigation(news.navigation);
    routes.showNavigation(news.navigation);
  }
  if (news.panorama !== undefined) showPanorama(news.panorama);
  showState(news.state);
  if (news.map) await showMap(news.map);
}

async function showMap(map) {
  byId("map-note").textContent = ["odom", "map"].includes(map.frame) ? "" : `a map in the frame ${map.frame} is not drawn`;
  const cells = map.width ? await (await fetch(`image/map?${map.version}`)).arrayBuffer() : null;
  plan.setMap(cells === null ? null : { ...map, cells: new Uint8Array(cells) });
}

function showConnection(text) {
  byId("lost").hidden = !text;
  byId("lost").textContent = text;
  if (text) {
    setBadge("state", "no connection", "bad");
    setBadge("armed", "", "warn");
    byId("well").hidden = true;
  }
}

function showState(state) {
  if (run !== null && state.run !== null && state.run !== run) location.reload();
  run = state.run ?? run;
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
  byId("panorama-note").hidden = state.panorama_comes;
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
  line.textContent = worst ? `${worst.name}: ${worst.message}${more}` : pose ? "It reports no pose now."
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
    ...(state.pace ? [["simulated time", `${state.pace} x real time`]] : []),
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

// One that comes while the last one loads is left out.
function showPanorama(version) {
  const image = byId("panorama");
  image.hidden = false;
  if (image.complete) image.src = `image/panorama?${version}`;
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
byId("panorama-note").textContent = "No panorama yet; bus.panorama_hz = 0 turns it off.";
follow();
