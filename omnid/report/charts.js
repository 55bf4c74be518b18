"use strict";
// Charts of a report: values at the pointer, one time in all of them, zoom by dragging. Without it the page is complete.
(() => {
  const shades = document.getElementById("shades");
  if (!shades) return;
  const [start, end, secondsPerUnit] = shades.dataset.clock.split(" ").map(Number);
  const [left, right, top, bottom] = shades.dataset.box.split(" ").map(Number);
  const all = [start, end];
  const TOUCH_PX = 6;  // less is a tap, not a drag
  const NEAR_PX = 9;  // from the pointer to the end of a line whose value is shown
  let span = all;  // of the charts, in the unit of their time

  const element = (parent, name, attributes) => {
    const made = document.createElementNS(shades.namespaceURI, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return parent.appendChild(made);
  };
  const points = (path) => path.getAttribute("d").slice(1).split(/[ML]/).map((pair) => pair.split(" ").map(parseFloat));
  const nearest = (sorted, value, of) => {
    let low = 0, high = sorted.length - 1;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (of(sorted[middle]) < value) low = middle + 1; else high = middle;
    }
    return low > 0 && value - of(sorted[low - 1]) < of(sorted[low]) - value ? low - 1 : low;
  };
  const roundStep = (least) => {
    const decade = 10 ** Math.floor(Math.log10(least));
    return decade * [1, 2, 5, 10].find((digit) => digit * decade >= least * (1 - 1e-9));
  };
  const at = (event, svg) => new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());

  // Views over time: the charts, which show the span, and the timeline, which always shows all.
  const views = [...document.querySelectorAll("figure.chart svg[data-y], figure.lanes > svg")].map((svg) => {
    const chart = "y" in svg.dataset, box = chart ? [left, right] : svg.dataset.x.split(" ").map(Number);
    const [y0, y1] = chart ? [top, bottom] : [8, svg.viewBox.baseVal.height - 34];
    const band = element(svg, "rect", {class: "drag", y: y0, height: y1 - y0, width: 0});
    const cursor = element(svg, "path", {class: "cursor", d: `M0 ${y0}V${y1}`, visibility: "hidden"});
    return {svg, chart, box, band, cursor, lines: null};
  });
  const shown = (view) => view.chart ? span : all;
  const px = (view, t) => view.box[0] + (t - shown(view)[0]) / (shown(view)[1] - shown(view)[0]) * (view.box[1] - view.box[0]);
  const time = (view, x) => {
    const share = Math.min(1, Math.max(0, (x - view.box[0]) / (view.box[1] - view.box[0])));
    return shown(view)[0] + share * (shown(view)[1] - shown(view)[0]);
  };

  const value = (view, y) => {
    const [low, high, log] = view.svg.dataset.y.split(" ").map(Number), share = (bottom - y) / (bottom - top);
    const found = log ? low * (high / low) ** share : low + share * (high - low);
    const smallest = log ? Math.abs(found) / 100 : (high - low) / 1000;  // what the drawn line resolves
    const digits = Math.max(0, -Math.floor(Math.log10(smallest)));
    return digits > 6 ? found.toExponential(1) : found.toFixed(digits);
  };
  const lines = (view) => view.lines ??= [...view.svg.querySelectorAll("[data-name]")].map((group) => (
    {name: group.dataset.name, pieces: [...group.querySelectorAll("path")].map(points)}));
  const between = (piece, x) => {  // the height of a line there
    const found = piece.findIndex((p) => p[0] >= x), after = Math.max(1, found < 0 ? piece.length - 1 : found);
    const [a, b] = [piece[after - 1], piece[after]];
    return b ? a[1] + Math.min(1, Math.max(0, (x - a[0]) / (b[0] - a[0] || 1))) * (b[1] - a[1]) : a[1];
  };

  function readout(view, t) {
    const scale = (right - left) / (all[1] - all[0]), x = left + (t - all[0]) * scale;  // as drawn, before the zoom
    const near = NEAR_PX * (span[1] - span[0]) / (all[1] - all[0]);
    return lines(view).flatMap((line) => {
      const piece = line.pieces.find((points) => points[0][0] - near <= x && x <= points[points.length - 1][0] + near);
      return piece ? [`${line.name} ${value(view, between(piece, x))}`.trim()] : [];
    });
  }
  const label = (t) => `${(t).toFixed(Math.max(0, 2 - Math.floor(Math.log10(span[1] - span[0]))))} ${shades.dataset.unit}`;

  // The plan: the place of the robot at a time, and the time of a place.
  const plan = document.querySelector("figure.plan > svg");
  const path = plan && plan.querySelector("[data-t]");
  const stamps = path ? path.dataset.t.split(" ").map((t) => Number(t) / secondsPerUnit) : [];
  const places = path ? points(path) : [];
  const robot = plan && element(plan, "circle", {class: "robot", r: 6, visibility: "hidden"});

  const say = (figure, words) => {
    const place = figure.querySelector("output > span");
    if (place) place.textContent = words.join(" · ");
  };
  function point(t) {
    for (const view of views) {
      const inside = t >= shown(view)[0] && t <= shown(view)[1];
      view.cursor.setAttribute("visibility", inside ? "visible" : "hidden");
      if (inside) view.cursor.setAttribute("transform", `translate(${px(view, t)} 0)`);
      say(view.svg.parentNode, inside ? [label(t), ...readout(view, t)] : []);
    }
    if (!robot) return;
    const [x, y] = places[nearest(stamps, t, (value) => value)];
    robot.setAttribute("cx", x);
    robot.setAttribute("cy", y);
    robot.setAttribute("visibility", "visible");
  }
  function leave() {
    for (const view of views) {
      view.cursor.setAttribute("visibility", "hidden");
      say(view.svg.parentNode, []);
    }
    if (robot) robot.setAttribute("visibility", "hidden");
    if (plan) say(plan.parentNode, []);
  }

  function zoom(from, to) {
    leave();
    const part = (to - from) / (end - start);
    span = part > 1e-6 && part < 1 ? [from, to] : all;
    const scale = (all[1] - all[0]) / (span[1] - span[0]);
    const move = left - scale * (left + (span[0] - all[0]) / (all[1] - all[0]) * (right - left));
    const step = roundStep((span[1] - span[0]) / 8), ticks = [];
    for (let k = Math.ceil(span[0] / step - 1e-9); k <= span[1] / step + 1e-9; k++) ticks.push(k * step);
    for (const view of views) {
      if (!view.chart) {
        const zoomed = span !== all;
        view.band.setAttribute("x", px(view, span[0]));
        view.band.setAttribute("width", zoomed ? px(view, span[1]) - px(view, span[0]) : 0);
        continue;
      }
      view.band.setAttribute("width", 0);
      view.svg.querySelector(".zoom").setAttribute("transform", `matrix(${scale} 0 0 1 ${move} 0)`);
      view.svg.querySelector(".columns").setAttribute("d", ticks.map((t) => `M${px(view, t)} ${top}V${bottom}`).join(""));
      const axis = view.svg.querySelector(".time");
      axis.replaceChildren();
      element(axis, "path", {class: "axis", d: ticks.map((t) => `M${px(view, t)} ${bottom}v4`).join("")});
      ticks.forEach((t, k) => {
        const last = k === ticks.length - 1;
        const text = element(axis, "text", {x: px(view, t), y: bottom + 17, "text-anchor": last ? "end" : "middle"});
        text.textContent = `${Number(t.toFixed(9))}${last ? ` ${shades.dataset.unit}` : ""}`;
      });
    }
    button.hidden = span === all && !plan?.dataset.zoomed;
  }

  // A drag selects: a span of time, or a part of the plan. `select` is called with both ends in the figure's px.
  function dragged(svg, hover, draw, select) {
    let first = null;
    svg.addEventListener("pointerdown", (event) => {
      if (event.isPrimary && event.button === 0) { first = at(event, svg); hover(first); }
    });
    svg.addEventListener("pointermove", (event) => {
      const now = at(event, svg);
      hover(now);
      if (!first || !event.isPrimary) return;
      if (!svg.hasPointerCapture(event.pointerId)) svg.setPointerCapture(event.pointerId);
      draw(first, now);
    });
    const finish = (event) => {
      const now = at(event, svg), from = first;
      first = null;
      draw(now, now);
      if (from && event.type === "pointerup" && Math.hypot(now.x - from.x, now.y - from.y) > TOUCH_PX) select(from, now);
    };
    svg.addEventListener("pointerup", finish);
    svg.addEventListener("pointercancel", finish);
    svg.addEventListener("pointerleave", () => { if (!first) leave(); });
    svg.addEventListener("dblclick", showAll);
  }
  const addReadout = (svg) => {
    const output = document.createElement("output");
    output.append(document.createElement("span"));
    svg.before(output);
  };
  for (const view of views) {
    if (view.chart) addReadout(view.svg);
    const inside = (p) => px(view, time(view, p.x));
    dragged(view.svg, (p) => point(time(view, p.x)), (a, b) => {
      view.band.setAttribute("x", Math.min(inside(a), inside(b)));
      view.band.setAttribute("width", Math.abs(inside(b) - inside(a)));
    }, (a, b) => zoom(...[time(view, a.x), time(view, b.x)].sort((s, t) => s - t)));
  }
  if (plan) {
    const whole = plan.getAttribute("viewBox"), frame = element(plan, "rect", {class: "drag", width: 0, height: 0});
    const corner = (a, b) => [Math.min(a.x, b.x), Math.min(a.y, b.y), Math.abs(a.x - b.x), Math.abs(a.y - b.y)];
    plan.showPart = (box) => {
      plan.setAttribute("viewBox", box || whole);
      plan.dataset.zoomed = box ? "1" : "";
      plan.style.setProperty("--px", plan.viewBox.baseVal.width / Number(whole.split(" ")[2]));
    };
    const [x0, y0, pxPerM] = plan.dataset.m.split(" ").map(Number);
    addReadout(plan);
    dragged(plan, (p) => {
      const distances = places.map(([x, y]) => Math.hypot(x - p.x, y - p.y));
      const near = stamps[distances.reduce((best, d, k) => d < distances[best] ? k : best, 0)];
      point(near);
      say(plan.parentNode, [`x ${(x0 + p.x / pxPerM).toFixed(2)} m, y ${(y0 - p.y / pxPerM).toFixed(2)} m`, label(near)]);
    }, (a, b) => ["x", "y", "width", "height"].forEach((name, k) => frame.setAttribute(name, corner(a, b)[k])), (a, b) => {
      const [x, y, width, height] = corner(a, b), shape = plan.viewBox.baseVal.height / plan.viewBox.baseVal.width;
      const wide = Math.max(width, height / shape, 8);
      plan.showPart(`${x + width / 2 - wide / 2} ${y + (height - wide * shape) / 2} ${wide} ${wide * shape}`);
      button.hidden = false;
    });
  }
  const button = document.createElement("button");
  button.textContent = "show all";
  button.className = "all";
  button.hidden = true;
  function showAll() {
    plan?.showPart(null);
    zoom(...all);
  }
  button.addEventListener("click", showAll);
  const hint = document.createElement("p");
  hint.className = "hint";
  hint.textContent = "Point at a chart: values, and the place on the plan. Drag across a chart or the plan: zoom; double-click: all.";
  (document.querySelector("figure.plan") || document.querySelector("h2")).after(hint);
  document.body.append(button);
})();
