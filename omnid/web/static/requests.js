// Requests to the robot: tap to go, routes, and the map of places. What would move the robot repeats the server's time in
// the newest state, so that a request that comes late moves nothing.
import { ask, pressTwice } from "./commands.js";
import { byId, degrees, fixed } from "./elements.js";

const DRIVES = ["driving", "avoiding", "blocked", "not localised"];
const isArmed = (state) => state.wheels !== null && state.wheels.armed;

// Tap to go: a point on the plan, a heading by drawing from it; shown first, driven after a second press.
// Returns show(state) and showNavigation(report).
export function wireGoal(plan) {
  const [choose, go, leave] = [byId("goal"), byId("goal-go"), byId("goal-leave")];
  let choosing = false;
  let state = null;
  let busy = false; // a drive is under way
  let resets = null; // of odometry, when the goal was chosen: another odom has another origin

  const say = (text) => { byId("answer").textContent = text; };

  function describe() {
    const { x, y, yaw } = plan.goal;
    const away = state?.pose ? Math.hypot(x - state.pose.x_m, y - state.pose.y_m) : null;
    const heading = yaw === null ? "any heading" : `heading ${fixed(degrees(yaw), 0)}°`;
    say(`${fixed(away, 1)} m to ${fixed(x, 2)}, ${fixed(y, 2)} m, ${heading}: Go drives there, around obstacles.`);
    go.disabled = false;
  }

  function leaveIt() {
    choosing = false;
    resets = null;
    plan.onPick = null;
    plan.setGoal(null);
    showButtons();
    say("");
  }

  function showButtons() {
    go.hidden = !choosing;
    leave.hidden = !choosing && !busy;
    choose.setAttribute("aria-pressed", String(choosing));
    byId("plan").classList.toggle("choosing", choosing);
  }

  choose.addEventListener("click", () => {
    choosing = true;
    go.disabled = true;
    choose.disabled = true;
    resets = state?.pose?.resets ?? null;
    plan.setGoal(null);
    plan.onPick = (goal) => {
      plan.setGoal(goal);
      describe();
    };
    showButtons();
    byId("plan").scrollIntoView({ block: "center" });
    say("Tap the goal; drag to set a heading.");
  });

  go.addEventListener("click", async () => {
    const { x, y, yaw } = plan.goal;
    choosing = false;
    plan.onPick = null;
    busy = true;
    showButtons();
    const numbers = [x, y, ...(yaw === null ? [] : [degrees(yaw)])].map((value) => fixed(value, 3));
    const answer = await ask("goal", [...numbers, state.server_ms].join(" "), "answer");
    if (answer.done) return;
    busy = false;
    plan.setGoal(null);
    showButtons();
  });

  leave.addEventListener("click", () => choosing ? leaveIt() : ask("navigation", "cancel", "answer"));

  return {
    show(next) {
      state = next;
      const armed = isArmed(state);
      if (choosing && !armed) leaveIt();
      if (plan.goal !== null && resets !== null && state.pose?.resets !== resets) leaveIt();
      choose.disabled = !armed || !state.fresh || choosing;
      choose.title = armed ? "" : "arm it first";
      if (choosing && plan.goal !== null) describe();
    },
    showNavigation(report) {
      const before = busy;
      busy = [...DRIVES, "paused"].includes(report.state);
      if (busy && !before && !choosing) say(""); // the end of an earlier drive
      if (before && !busy && !choosing) {
        plan.setGoal(null);
        const why = report.reason ? `: ${report.reason}` : "";
        say(`The drive has ended: ${report.state}${why}.`);
      }
      showButtons();
    },
  };
}

// Routes: teach, finish, repeat, stop, pause and resume. A repetition moves the robot, so its button asks first.
// Returns show(state) and showNavigation(report).
export function wireRoutes() {
  const name = byId("route-name");
  let state = null;
  let report = null;
  const button = (verb, press) => byId(`route-${verb}`).addEventListener("click", press);
  const route = (text) => ask("route", text, "route-answer");
  const navigation = (text) => ask("navigation", text, "route-answer");

  button("teach", () => name.reportValidity() && route(`teach ${name.value} stamp=${state.server_ms}`));
  button("finish", () => route("finish"));
  button("stop", () => route("stop"));
  button("pause", () => navigation("pause"));
  button("resume", () => navigation(`resume stamp=${state.server_ms}`));
  pressTwice(byId("route-repeat"), "It will drive: again", () => route(`repeat ${name.value} stamp=${state.server_ms}`),
    () => name.reportValidity());

  // A button can be pressed where it does something.
  function enable() {
    const [armed, doing, taught] = [state !== null && isArmed(state), report?.state ?? "", Boolean(report?.teaching)];
    const drives = DRIVES.includes(doing);
    byId("route-teach").disabled = doing === "" || drives && report.task.startsWith("route");
    byId("route-repeat").disabled = !armed || taught;
    byId("route-stop").disabled = !taught && !drives && doing !== "paused";
    byId("route-pause").disabled = !drives;
    byId("route-resume").disabled = doing !== "paused" || !armed;
  }

  enable();
  return {
    show(next) {
      state = next;
      enable();
    },
    showNavigation(newest) {
      report = newest;
      byId("navigation-box").hidden = false;
      const left = report.left_m === null ? "" : `, ${fixed(report.left_m, 1)} m left`;
      const what = report.task ? `${report.task}: ` : "";
      const why = report.reason ? `: ${report.reason}` : "";
      byId("navigation").textContent = report.teaching
        ? `teaching ${report.teaching}: ${fixed(report.taught_m, 1)} m; drive it, then Finish`
        : `${what}${report.state}${why}${left}`;
      byId("route-teach").hidden = Boolean(report.teaching);
      byId("route-finish").hidden = !report.teaching;
      enable();
    },
  };
}

// The map of places: whether the robot keeps it in a file, and a button that saves it now.
export function wireMap() {
  const button = byId("map-save");
  button.addEventListener("click", async () => {
    button.disabled = true;
    await ask("map", undefined, "map-answer");
    button.disabled = false;
  });
}

// part: the entry of the map's file in the status; undefined where the robot keeps none.
export function showMapFile(part) {
  byId("map-box").hidden = part === undefined;
  if (part === undefined) return;
  const saves = new Map(part.values).get("saves") ?? "0";
  byId("map-file").textContent = part.level ? part.message : `saves since the start: ${saves}`;
}
