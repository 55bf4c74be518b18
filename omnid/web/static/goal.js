// Tap to go: a point on the plan, a heading by drawing from it; shown first, driven after a second press.
import { post } from "./commands.js";
import { byId, fixed } from "./elements.js";

const BUSY = ["driving", "avoiding", "blocked", "paused", "not localised"];

// Returns show(state) and showNavigation(report).
export function wireGoal(plan) {
  const [choose, go, leave] = [byId("goal"), byId("goal-go"), byId("goal-leave")];
  let choosing = false;
  let state = null;
  let busy = false; // a drive is under way
  let resets = null; // of odometry, when the goal was chosen: another odom has another origin

  const say = (text) => { byId("goal-answer").textContent = text; };

  function show(next) {
    state = next;
    const armed = state.wheels !== null && state.wheels.armed;
    if (choosing && !armed) leaveIt();
    if (plan.goal !== null && resets !== null && state.pose?.resets !== resets) leaveIt();
    choose.disabled = !armed || !state.fresh || choosing;
    choose.title = armed ? "" : "arm it first";
    if (choosing && plan.goal !== null) describe();
  }

  function describe() {
    const { x, y, yaw } = plan.goal;
    const away = state?.pose ? Math.hypot(x - state.pose.x_m, y - state.pose.y_m) : null;
    const heading = yaw === null ? "any heading" : `heading ${fixed(yaw * 180 / Math.PI, 0)}°`;
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
    leave.textContent = choosing ? "Leave it" : "Cancel";
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
    say("Tap where it is to drive; draw from there for a heading.");
  });

  go.addEventListener("click", async () => {
    const { x, y, yaw } = plan.goal;
    choosing = false;
    plan.onPick = null;
    busy = true;
    showButtons();
    say("asking the robot ...");
    const numbers = [x, y, ...(yaw === null ? [] : [yaw * 180 / Math.PI])].map((value) => fixed(value, 3));
    const answer = await post("goal", 0, () => {}, [...numbers, state.server_ms].join(" "));
    say(answer.text);
    if (!answer.done) {
      busy = false;
      plan.setGoal(null);
      showButtons();
    }
  });

  leave.addEventListener("click", async () => {
    if (choosing) return leaveIt();
    say("asking the robot ...");
    const answer = await post("navigation", 0, () => {}, "cancel");
    say(answer.text);
    return undefined;
  });

  return {
    show,
    showNavigation(report) {
      const before = busy;
      busy = BUSY.includes(report.state);
      if (before && !busy && !choosing) {
        plan.setGoal(null);
        if (!report.state) say("The robot has started again.");
        else say(report.reason ? `It has ended: ${report.state}: ${report.reason}.` : `It has ended: ${report.state}.`);
      }
      showButtons();
    },
  };
}
