// STOP, Arm, and what all buttons share. A stop is sent again until the server has taken it; the server repeats it until
// the robot confirms it.
import { byId } from "./elements.js";

const RETRY_MS = 300;
const GIVE_UP_MS = 10000;
const SILENT_MS = 2500; // without an answer, or news of the robot (page.js)
const SURE_MS = 4000;
const EMERGENCY = "STOP IS NOT SENT: use the emergency stop on the robot";
const NO_ANSWER = "NO ANSWER YET: use the emergency stop on the robot";

// Sends a command; again and again for so many ms where the server cannot be reached. Returns {done, text}.
export async function post(address, body = undefined, patience = 0, onFailure = () => {}) {
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

// Sends a request to the robot and shows its answer in an element, by its id. Returns the answer.
export async function ask(address, body, shown) {
  byId(shown).textContent = "asking the robot ...";
  const answer = await post(address, body);
  byId(shown).textContent = answer.text;
  return answer;
}

// A button that acts only when it is pressed a second time within SURE_MS. Returns a function that takes back a first
// press. isFit(): false where the first press is not taken.
export function pressTwice(button, question, act, isFit = () => true) {
  const words = button.textContent;
  let sureUntil = 0;
  const takeBack = () => {
    sureUntil = 0;
    button.textContent = words;
    button.classList.remove("sure");
  };
  button.addEventListener("click", () => {
    if (!isFit()) return;
    if (performance.now() < sureUntil) {
      takeBack();
      act();
      return;
    }
    sureUntil = performance.now() + SURE_MS;
    button.textContent = question;
    button.classList.add("sure");
    setTimeout(() => performance.now() >= sureUntil && takeBack(), SURE_MS + 1);
  });
  return takeBack;
}

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
      () => post("stop", undefined, GIVE_UP_MS, () => show(EMERGENCY, "bad")),
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
  for (const name of ["keydown", "keyup"]) {
    document.addEventListener(name, (event) => {
      if (event.code !== "Space" || event.repeat || event.target.matches("input, textarea")) return;
      event.preventDefault(); // else the focused button would be pressed
      if (name === "keydown") stop();
    }, { capture: true });
  }
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

// Returns show(state). Answers that are no longer true are taken away.
export function wireCommands() {
  const button = byId("arm");
  let wasArmed = null;
  let stamp = 0; // the server's time in the newest state: a request to arm that comes late arms nothing
  const takeBack = pressTwice(button, "The wheels may turn: press again to arm", () => {
    showStop("", "");
    ask("arm", String(stamp), "answer");
  });
  const showStop = wireStop(takeBack);

  return {
    show(state) {
      stamp = state.server_ms;
      const armed = state.wheels !== null && state.wheels.armed;
      button.hidden = armed;
      button.disabled = state.wheels === null; // the robot reports no wheels
      if (armed && wasArmed === false) {
        takeBack();
        showStop("", "");
      }
      if (!armed && wasArmed) byId("answer").textContent = "";
      wasArmed = armed;
    },
  };
}
