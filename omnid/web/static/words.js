// Keys of the status in words: "capture_to_pose_p50_ms" is "capture to pose, median" in ms.

const UNITS = { ms: "ms", s: "s", m: "m", mm: "mm", mps: "m/s", deg: "°", hz: "/s", v: "V", mb: "MB", px: "px", ns: "ns", grey: "grey levels" };
const STATISTICS = { p50: "median", p99: "99 %", p999: "99.9 %", max: "longest" };

// Returns the name and the unit, an empty text where there is none.
export function inWords(key) {
  const words = key.split("_");
  const unit = words.length > 1 ? UNITS[words.at(-1)] ?? "" : "";
  if (unit) words.pop();
  const statistic = STATISTICS[words.at(-1)];
  if (statistic) words.pop();
  const name = words.join(" ");
  return [statistic ? `${name}, ${statistic}` : name, unit];
}
