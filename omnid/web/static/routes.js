// Routes: teach, finish, repeat, stop, pause and resume. A repetition moves the robot, so its button asks first.
import { post } from "./commands.js";
import { byId, fixed } from "./elements.js";

const SURE_MS = 4000;

const DRIVES = ["driving", "avoiding", "blocked", "not localised"];

// Returns show(state) and showNavigation(report).
export function wireRoutes() {
  const name = byId("route-name");
  let armed = false;
  let report = null;
  let sureUntil = 0;
  let stamp = 0; // the server's time in the newest state: what would move the robot and comes late moves nothing
  const ask = async (address, text) => {
    byId("route-answer").textContent = "asking the robot ...";
    const answer = await post(address, 0, () => {}, text);
    byId("route-answer").textContent = answer.text;
  };
  const named = (verb, end = "") => {
    if (name.reportValidity()) ask("route", `${verb} ${name.value}${end}`);
  };
  const repeat = byId("route-repeat");
  const unsure = () => {
    sureUntil = 0;
    repeat.textContent = "Repeat";
    repeat.classList.remove("sure");
  };
  repeat.addEventListener("click", () => {
    if (!name.reportValidity()) return;
    if (performance.now() > sureUntil) {
      sureUntil = performance.now() + SURE_MS;
      repeat.textContent = "It will drive: again";
      repeat.classList.add("sure");
      setTimeout(unsure, SURE_MS);
      return;
    }
    unsure();
    named("repeat", ` stamp=${stamp}`);
  });
  byId("route-teach").addEventListener("click", () => named("teach"));
  byId("route-finish").addEventListener("click", () => ask("route", "finish"));
  byId("route-stop").addEventListener("click", () => ask("route", "stop"));
  byId("route-pause").addEventListener("click", () => ask("navigation", "pause"));
  byId("route-resume").addEventListener("click", () => ask("navigation", `resume stamp=${stamp}`));

  // A button can be pressed where it does something.
  function enable() {
    const state = report?.state ?? "";
    const taught = Boolean(report?.teaching);
    byId("route-teach").disabled = state === "" || DRIVES.includes(state) && report.task.startsWith("route");
    repeat.disabled = !armed || taught;
    byId("route-stop").disabled = !taught && !DRIVES.includes(state) && state !== "paused";
    byId("route-pause").disabled = !DRIVES.includes(state);
    byId("route-resume").disabled = state !== "paused" || !armed;
  }

  enable();
  return {
    show(state) {
      armed = state.wheels !== null && state.wheels.armed;
      stamp = state.server_ms;
      enable();
    },
    showNavigation(newest) {
      report = newest;
      showRoutes(report);
      enable();
    },
  };
}

function showRoutes(report) {
  byId("navigation-box").hidden = !report.state; // without one the robot has started again, and reported none yet
  const left = report.left_m === null ? "" : `, ${fixed(report.left_m, 1)} m left`;
  const what = report.task ? `${report.task}: ` : "";
  const why = report.reason ? `: ${report.reason}` : "";
  byId("navigation").textContent = report.teaching
    ? `teaching ${report.teaching}: ${fixed(report.taught_m, 1)} m; drive it, then Finish`
    : `${what}${report.state}${why}${left}`;
  byId("route-teach").hidden = Boolean(report.teaching);
  byId("route-finish").hidden = !report.teaching;
}
