// The STOP and Arm buttons. A stop is sent again until the server has taken it; the server repeats it until the robot
// confirms it.
import { byId } from "./elements.js";

const RETRY_MS = 300;
const GIVE_UP_MS = 10000;
const SILENT_MS = 2500; // without an answer, or news of the robot (connection.js)
const SURE_MS = 4000;
const EMERGENCY = "STOP IS NOT SENT: use the emergency stop on the robot";
const NO_ANSWER = "NO ANSWER YET: use the emergency stop on the robot";

// The STOP button and the space key. Returns show(text, className), which writes beside it; before() is called first.
export function wireStop(before = () => {}) {
  const button = byId("stop");
  let newest = 0;

  async function stop() {
    newest += 1;
    const number = newest;
    before();
    show("sending STOP ...", "");
    button.classList.add("sent");
    const answer = await firstAnswer(
      () => post("stop", GIVE_UP_MS, () => show(EMERGENCY, "bad")),
      () => number === newest && show(NO_ANSWER, "bad"),
    );
    if (number !== newest) return; // a newer press shows its own answer
    button.classList.remove("sent");
    show(answer.text, answer.done ? "good" : "bad");
  }

  function show(text, className) {
    byId("stop-answer").textContent = text;
    byId("stop-answer").className = className;
  }

  // On pointerdown, not on click: a finger that slides off the button has pressed it all the same.
  button.addEventListener("pointerdown", stop);
  button.addEventListener("click", (event) => event.detail === 0 && stop()); // by keyboard or by a screen reader
  document.addEventListener("keydown", (event) => {
    if (event.code !== "Space" || event.repeat || event.target.matches("input, textarea")) return;
    event.preventDefault(); // else the focused button would be pressed
    stop();
  }, { capture: true });
  document.addEventListener("keyup", (event) => {
    if (event.code === "Space" && !event.target.matches("input, textarea")) event.preventDefault();
  }, { capture: true });
  return show;
}

// The first answer to a request that is sent again while none comes, for GIVE_UP_MS: on a connection that the network
// has lost a request waits for minutes, and a new one may get through.
function firstAnswer(send, onSilence) {
  return new Promise((resolve) => {
    const end = performance.now() + GIVE_UP_MS;
    const timer = setInterval(() => {
      onSilence();
      if (performance.now() > end) clearInterval(timer);
      else send().then(settle);
    }, SILENT_MS);
    function settle(answer) {
      clearInterval(timer);
      resolve(answer);
    }
    send().then(settle);
  });
}

export function wireCommands() {
  const armButton = byId("arm");
  let sureUntil = 0;
  let wasArmed = null;
  let stamp = 0; // the server's time in the newest state: a request to arm that comes late arms nothing
  const showStop = wireStop(() => { sureUntil = 0; });

  async function arm() {
    if (performance.now() > sureUntil) {
      sureUntil = performance.now() + SURE_MS;
      armButton.textContent = "The wheels may turn: press again to arm";
      armButton.classList.add("sure");
      setTimeout(unsure, SURE_MS);
      return;
    }
    unsure();
    byId("answer").textContent = "asking the robot ...";
    showStop("", "");
    const answer = await post("arm", 0, () => {}, String(stamp));
    byId("answer").textContent = answer.text;
  }

  function unsure() {
    sureUntil = 0;
    armButton.textContent = "Arm";
    armButton.classList.remove("sure");
  }

  armButton.addEventListener("click", arm);

  return {
    // reported: false where the robot reports no wheels. serverMs: the server's time in the state. Answers that are no
    // longer true are taken away.
    setArmed(armed, reported, serverMs) {
      stamp = serverMs;
      armButton.hidden = armed;
      armButton.disabled = !reported;
      if (armed && sureUntil) unsure();
      if (armed && wasArmed === false) showStop("", "");
      if (!armed && wasArmed) byId("answer").textContent = "";
      wasArmed = armed;
    },
  };
}

// Sends a command; again and again for so many ms where the server cannot be reached. Returns {done, text}.
export async function post(address, patience, onFailure, body = undefined) {
  const end = performance.now() + patience;
  for (;;) {
    try {
      const response = await fetch(address, { method: "POST", body });
      if (response.headers.get("content-type")?.startsWith("application/json")) return await response.json();
      return { done: false, text: `${EMERGENCY}: ${await response.text()}` };
    } catch (error) {
      onFailure();
      if (performance.now() > end) return { done: false, text: `no connection: ${error.message}. ${EMERGENCY}` };
    }
    await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
  }
}
