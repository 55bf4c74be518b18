// The map of places: whether the robot keeps it in a file, and a button that saves it now.
import { post } from "./commands.js";
import { byId } from "./elements.js";

export function wireMap() {
  const button = byId("map-save");
  button.addEventListener("click", async () => {
    button.disabled = true;
    byId("map-answer").textContent = "asking the robot ...";
    const answer = await post("map", 0, () => {});
    byId("map-answer").textContent = answer.text;
    button.disabled = false;
  });
}

// part: the entry of the map's file in the status; undefined where the robot keeps none.
export function showMapFile(part) {
  byId("map-box").hidden = part === undefined;
  if (part === undefined) return;
  const saves = new Map(part.values).get("saves") ?? "0";
  byId("map-file").textContent = part.level ? part.message : `saved ${saves} times since the start`;
}
