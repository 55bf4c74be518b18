// The page about all robots: a card for each, those with errors first. Text is only ever set as text, never as HTML.
import { Connection } from "./connection.js";
import { wireStop } from "./commands.js";
import { byId, element, fixed } from "./elements.js";

const LEVELS = ["good", "warn", "bad"];
const cards = new Map(); // by key

function onMessage(message) {
  byId("link").textContent = message.link ? `No connection to the router: ${message.link}` : "";
  const wrong = message.robots.filter((robot) => robot.level === 2).length;
  const armed = message.robots.filter((robot) => robot.armed).length;
  badge("state", `${message.robots.length} robots, ${wrong} with errors or gone`, wrong ? "bad" : "good");
  badge("armed", armed ? `${armed} armed` : "", "warn");
  byId("note").textContent = [message.refused ? `${message.refused} more are left out` : "",
    message.dropped ? `${message.dropped} messages dropped` : ""].filter(Boolean).join("; ");
  show(message.robots);
}

// Cards stay the same elements while their order stays: the focus, and a finger on one, stay where they are.
function show(robots) {
  for (const robot of robots) {
    if (!cards.has(robot.key)) cards.set(robot.key, card(robot));
    update(cards.get(robot.key), robot);
  }
  const wanted = robots.map((robot) => cards.get(robot.key).root);
  const list = byId("robots");
  if (wanted.length !== list.children.length || wanted.some((root, at) => list.children[at] !== root)) {
    list.replaceChildren(...wanted);
  }
}

function card(robot) {
  const parts = { name: element("strong", {}), state: element("span", {}), where: element("span", {}),
    problem: element("span", {}) };
  const head = element("span", { className: "head" }, parts.name, parts.state);
  const link = element("a", { href: `robot/${robot.key}/` }, head, parts.where, parts.problem);
  return { ...parts, root: element("li", {}, link) };
}

function update(parts, robot) {
  const turn = robot.yaw_rad === null ? null : robot.yaw_rad * 180 / Math.PI;
  set(parts.name, robot.name, "");
  set(parts.state, `${robot.state}${robot.armed ? ", armed" : ""}`, `badge ${LEVELS[robot.level]}`);
  set(parts.where, robot.rate_hz > 0
    ? `${fixed(robot.x_m, 2)}, ${fixed(robot.y_m, 2)} m, ${fixed(turn, 0)}°, ${fixed(robot.rate_hz, 1)} poses/s`
    : robot.silent_s === null ? "no pose yet" : `last pose ${duration(robot.silent_s)} ago`, "quiet");
  set(parts.problem, robot.problem, LEVELS[robot.level]);
}

function set(part, text, className) {
  if (part.textContent !== text) part.textContent = text;
  if (part.className !== className) part.className = className;
}

function duration(seconds) {
  if (seconds < 120) return `${seconds} s`;
  return seconds < 7200 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`;
}

function badge(id, text, className) {
  set(byId(id), text, `badge ${className}`);
}

function onConnection(text) {
  byId("lost").hidden = !text;
  byId("lost").textContent = text;
  if (text) badge("state", "no connection", "bad");
}

wireStop();
new Connection(onMessage, onConnection).open();
