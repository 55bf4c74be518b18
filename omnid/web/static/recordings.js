// The list of recordings; a report opens in a tab of its own.
import { byId, element } from "./elements.js";

export function wireRecordings() {
  byId("recordings-box").addEventListener("toggle", (event) => event.target.open && load());
}

async function load() {
  const note = byId("recordings-note");
  try {
    const answer = await (await fetch("recordings")).json();
    note.textContent = answer.recordings.length ? answer.folder
      : `none in ${answer.folder}: set record.enabled = true, or start omnid web with --recordings`;
    byId("recordings").replaceChildren(...answer.recordings.map(row));
  } catch (error) {
    note.textContent = `cannot be listed: ${error.message}`;
  }
}

function row(recording) {
  const written = recording.state === "being written";
  const button = element("button", { type: "button", disabled: written, title: written ? "after it is complete" : "" },
    "Report");
  const note = element("div", { className: "quiet" }, described(recording));
  button.addEventListener("click", () => report(recording, button, note));
  return element("li", {}, element("div", {}, element("div", {}, recording.name), note), button);
}

function described(recording) {
  const time = new Date(1000 * recording.changed_s).toLocaleString();
  return `${(recording.size_bytes / 1e6).toFixed(1)} MB, ${time}, ${recording.state}`;
}

async function report(recording, button, note) {
  const address = `recordings/${recording.key}/report`;
  button.disabled = true;
  note.textContent = "the report is being made ...";
  try {
    const answer = await (await fetch(address, { method: "POST" })).json();
    note.textContent = answer.done ? described(recording) : answer.text;
    if (answer.done) {
      const link = element("a", { href: address, target: "_blank", rel: "noopener" }, "Open");
      button.replaceWith(link);
      link.focus();
    }
  } catch (error) {
    note.textContent = `no report: ${error.message}`;
  }
  button.disabled = false;
}
