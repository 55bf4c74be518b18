"use strict";
// Charts of a report: values at the pointer, one time in all of them, zoom by dragging, the robot's place on the plan.
(() => {
  const run = JSON.parse(document.querySelector("[data-run]").dataset.run);
  const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#666", "#e69f00"], DASHES = [[], [6, 3], [2, 2]];
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const FILLS = {1: `${style("--degraded")}33`, 2: `${style("--lost")}44`};  // behind the lines, while degraded and lost
  const SECONDS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14400];
  const HEIGHT_PX = 190;
  const charts = [];

  const clock = (t) => `${+t.toFixed(2)} s`;
  const number = (v) => v == null ? "" : String(+v.toPrecision(4));

  const range = (_, low, high) => {  // of linear values, with some room
    const room = (high - low) * 0.07 || Math.abs(high) * 0.1 || 1;
    return [low - (low === 0 ? 0 : room), high + room];
  };
  const shade = (u) => {
    const {left, top, width, height} = u.bbox;
    for (const [from, to, rank] of run.spans) {
      const a = Math.max(left, u.valToPos(from, "x", true)), b = Math.min(left + width, u.valToPos(to, "x", true));
      u.ctx.fillStyle = FILLS[rank];
      if (b > a) u.ctx.fillRect(a, top, Math.max(1, b - a), height);
    }
  };
  const share = (u, scale) => {  // the zoom of one chart is that of all
    const {min, max} = u.scales.x;
    if (scale === "x") for (const other of charts)
      if (other !== u && (other.scales.x.min !== min || other.scales.x.max !== max)) other.setScale("x", {min, max});
  };

  // The plan: the place of the robot at a time, and the time of a place.
  const plan = document.querySelector("[data-plan]");
  const path = plan ? JSON.parse(plan.dataset.plan) : [];  // rows of t, and x and y in shares of the image
  const robot = plan && plan.querySelector("i");
  const place = (t) => {
    if (!plan) return;
    let low = 0, high = path.length - 1;
    while (low < high) { const middle = (low + high) >> 1; if (path[middle][0] < t) low = middle + 1; else high = middle; }
    robot.hidden = t == null;
    [robot.style.left, robot.style.top] = [`${100 * path[low][1]}%`, `${100 * path[low][2]}%`];
  };
  if (plan) plan.addEventListener("pointermove", (event) => {
    const box = plan.getBoundingClientRect();
    const off = (row) => Math.hypot((event.clientX - box.left) - row[1] * box.width, (event.clientY - box.top) - row[2] * box.height);
    const [t] = path.reduce((best, row) => off(row) < off(best) ? row : best);
    place(t);
    if (charts.length) charts[0].setCursor({left: charts[0].valToPos(t, "x"), top: 0});
  });

  for (const figure of document.querySelectorAll("[data-chart]")) {
    const {lines, log, unit} = JSON.parse(figure.dataset.chart);
    const data = uPlot.join(lines.map(({points}) => [points.map((p) => p[0]), points.map((p) => p[1])]));
    const series = lines.map(({name}, k) => ({
      label: name || unit || "value", stroke: COLOURS[k % COLOURS.length], dash: DASHES[k % 3], width: 1.5, points: {show: data[0].length < 40},
      value: (_, v) => number(v),
    }));
    const chart = new uPlot({
      width: figure.clientWidth, height: HEIGHT_PX,
      scales: {x: {time: false, min: run.start, max: run.end}, y: {distr: log ? 3 : 1, ...(log ? {} : {range})}},
      axes: [{size: 32, incrs: SECONDS, values: (_, ticks) => ticks.map(clock), space: 60},
             {size: 68, values: (_, ticks) => ticks.map((v) => v == null ? "" : String(+v.toPrecision(6)))}],
      series: [{label: "time", value: (_, t) => t == null ? "" : clock(t)}, ...series],
      cursor: {sync: {key: "run"}, drag: {x: true, y: false}},
      hooks: {drawClear: [shade], setScale: [share], setCursor: [(u) => { if (u.cursor.left >= 0) place(u.posToVal(u.cursor.left, "x")); }]},
    }, data, figure);
    charts.push(chart);
    new ResizeObserver(() => chart.setSize({width: figure.clientWidth, height: HEIGHT_PX})).observe(figure);
  }
})();
