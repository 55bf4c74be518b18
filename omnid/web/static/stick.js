// The stick: a motion as long as a finger holds it, or an arrow key. Letting go stops; so does a page that is hidden.
import { post } from "./commands.js";
import { byId } from "./elements.js";

const PERIOD_MS = 100; // of the requests; one is under way at a time
const REST = 5; // requests with zero after a release; then nothing, so that others may drive
const RADIUS = 70; // of the knob's way, in units of the drawing
const KEYS = { ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, 1], ArrowRight: [0, -1] };

// Returns show(state).
export function wireStick() {
  const [pad, knob] = [byId("stick"), byId("knob")];
  const page = crypto.getRandomValues(new Uint32Array(2)).join("").slice(0, 16);
  const keys = new Set();
  let finger = null; // its id
  let wish = [0, 0]; // forward, and turn counter-clockwise: -1 to 1
  let rest = 0; // requests with zero that are still to be sent
  let sending = false;
  let state = null;
  let usable = false;

  function want(forward, turn) {
    wish = [forward, turn].map((value) => Math.max(-1, Math.min(1, value)));
    if (wish[0] || wish[1]) rest = REST;
    knob.setAttribute("cx", String(-RADIUS * wish[1]));
    knob.setAttribute("cy", String(-RADIUS * wish[0]));
  }

  function release() {
    finger = null;
    keys.clear();
    want(0, 0);
    send(); // at once
  }

  function point(event) {
    const box = pad.getBoundingClientRect();
    const at = (value, low, size) => (value - low - size / 2) / (size / 2) * (100 / RADIUS);
    const [right, down] = [at(event.clientX, box.left, box.width), at(event.clientY, box.top, box.height)];
    const far = Math.max(1, Math.hypot(right, down));
    want(-down / far, -right / far);
  }

  async function send() {
    if (sending || !state || !(wish[0] || wish[1] || rest)) return;
    if (!wish[0] && !wish[1]) rest -= 1;
    sending = true;
    const body = `${wish[0].toFixed(3)} ${wish[1].toFixed(3)} ${state.server_ms} ${page}`.replaceAll("-0.000", "0.000");
    const answer = await post("drive", body);
    sending = false;
    byId("answer").textContent = answer.text;
  }

  pad.addEventListener("pointerdown", (event) => {
    if (!usable || finger !== null) return;
    finger = event.pointerId;
    pad.setPointerCapture(finger);
    point(event);
    send();
  });
  pad.addEventListener("pointermove", (event) => event.pointerId === finger && point(event));
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    pad.addEventListener(name, (event) => event.pointerId === finger && release());
  }
  document.addEventListener("keydown", (event) => {
    if (!(event.code in KEYS) || !usable || event.target.matches("input, textarea") || event.ctrlKey || event.altKey
      || event.metaKey) return;
    event.preventDefault(); // else the page would scroll
    keys.add(event.code);
    byKeys();
  });
  document.addEventListener("keyup", (event) => keys.delete(event.code) && byKeys());
  window.addEventListener("blur", () => keys.size && release());
  document.addEventListener("visibilitychange", () => document.hidden && release());
  setInterval(send, PERIOD_MS);

  function byKeys() {
    if (finger !== null) return;
    if (!keys.size) return release();
    const sum = [0, 1].map((axis) => [...keys].reduce((total, key) => total + KEYS[key][axis], 0));
    return want(sum[0], sum[1]);
  }

  return {
    show(next) {
      state = next;
      usable = state.fresh && state.wheels !== null && state.wheels.armed;
      pad.classList.toggle("off", !usable);
      pad.setAttribute("aria-disabled", String(!usable));
      if (!usable && (wish[0] || wish[1])) release();
    },
  };
}
