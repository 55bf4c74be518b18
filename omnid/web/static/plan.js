// The plan: map, path and robot in odom, x to the right and y up; dragged, zoomed, or fitted to all that is known.

const MARGIN_PX = 40;
const SMALLEST_M = 4; // width of the plan at least, when fitted
const ROBOT_PX = 11;
const NEAREST_PX = 2000; // per metre
const WIDEST_PX = 0.05;
const OBSTACLES_MS = 2000; // for which obstacles are shown
const OBSTACLE_PX = 2.5;
const STEP_M = 0.02; // between poses that are added to the path
const MOST_ADDED = 500; // of these, where the robot publishes no path for a long time
const AIM_PX = 18; // a finger that is drawn less far gives no heading
const SCALES_M = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000];

export class Plan {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    Object.assign(this, { path: [], added: [], obstacles: [], pose: null, fresh: false, map: null, mapInOdom: null, fits: true });
    this.goal = null; // {x, y, yaw}: where it is to drive; yaw null: as it comes
    this.onPick = null; // takes a goal that a finger points out, while one is looked for; null: fingers move the plan
    this.onFit = () => {};
    this.view = { x: 0, y: 0, scale: 50 }; // the centre in m, px per m
    this.pointers = new Map();
    this.picked = null; // where the finger came down that points out a goal, px on the screen
    this.drawing = false;
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.recolour());
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY / 400));
    }, { passive: false });
  }

  // The path [[x, y], ...] that the robot publishes now and then; poses are added to it until the next one.
  setPath(points) {
    [this.path, this.added] = [points, []];
    this.draw();
  }

  setPose(pose, fresh) {
    const usable = pose !== null && [pose.x_m, pose.y_m, pose.yaw_rad].every(Number.isFinite);
    this.pose = usable ? pose : null;
    const last = this.added[this.added.length - 1];
    if (usable && (!last || Math.hypot(pose.x_m - last[0], pose.y_m - last[1]) > STEP_M)) {
      this.added = [...this.added.slice(-MOST_ADDED), [pose.x_m, pose.y_m]];
    }
    this.fresh = fresh;
    this.draw();
  }

  // The nearest obstacles around the robot, m; they go when no news comes.
  setObstacles(points) {
    clearTimeout(this.forgetting);
    this.obstacles = points;
    this.forgetting = setTimeout(() => this.setObstacles([]), OBSTACLES_MS);
    this.draw();
  }

  // A map with cells of 0 unknown, 1 free, 2 occupied, row by row from low to high y; null: none.
  setMap(map) {
    this.map = map;
    this.recolour();
  }

  recolour() {
    if (this.map !== null) {
      const { width, height, cells } = this.map;
      const colours = [[0, 0, 0, 0], this.rgba("--free"), this.rgba("--wall")];
      const image = new ImageData(width, height);
      for (let row = 0; row < height; row += 1) {
        for (let column = 0; column < width; column += 1) {
          // An image begins at the top: the row of the highest y.
          const colour = colours[cells[(height - 1 - row) * width + column]] ?? colours[0];
          image.data.set(colour, 4 * (row * width + column));
        }
      }
      this.map.canvas = new OffscreenCanvas(width, height);
      this.map.canvas.getContext("2d").putImageData(image, 0, 0);
    }
    this.draw();
  }

  zoom(factor) {
    this.setFit(false);
    this.setScale(this.view.scale * factor);
    this.draw();
  }

  setScale(pxPerMetre) {
    this.view.scale = Math.min(NEAREST_PX, Math.max(WIDEST_PX, pxPerMetre));
  }

  fit() {
    this.setFit(true);
    this.draw();
  }

  setFit(fits) {
    this.fits = fits;
    this.onFit(fits);
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    if (this.onPick !== null && this.pointers.size === 0) {
      this.picked = [event.clientX, event.clientY];
      this.pick(event);
    }
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  // The goal is where the finger came down; where it is drawn from there is the heading.
  pick(event) {
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [this.picked[0] - box.left - box.width / 2, this.picked[1] - box.top - box.height / 2];
    const [dx, dy] = [event.clientX - this.picked[0], event.clientY - this.picked[1]];
    this.setFit(false);
    this.onPick({ x: this.view.x + x / this.view.scale, y: this.view.y - y / this.view.scale,
      yaw: Math.hypot(dx, dy) < AIM_PX ? null : Math.atan2(-dy, dx) });
  }

  setGoal(goal) {
    this.goal = goal;
    this.draw();
  }

  // One pointer drags; two zoom by the ratio of their distances.
  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (before === undefined) return;
    const now = [event.clientX, event.clientY];
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    if (this.onPick !== null && other === undefined) {
      this.pick(event);
    } else if (other !== undefined) {
      const [old, spread] = [before, now].map((at) => Math.hypot(at[0] - other[0], at[1] - other[1]));
      if (old > 0 && spread > 0) this.zoom(spread / old);
    } else {
      this.setFit(false);
      this.view.x -= (now[0] - before[0]) / this.view.scale;
      this.view.y += (now[1] - before[1]) / this.view.scale;
    }
    this.pointers.set(event.pointerId, now);
    this.draw();
  }

  // Draws at the next frame of the screen; several changes are drawn at once.
  draw() {
    if (this.drawing) return;
    this.drawing = true;
    requestAnimationFrame(() => {
      this.drawing = false;
      this.paint();
    });
  }

  paint() {
    const { canvas, context } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (this.fits) this.fitView(width, height);
    const toScreen = (x, y) => [width / 2 + (x - this.view.x) * this.view.scale,
      height / 2 - (y - this.view.y) * this.view.scale];
    this.paintMap(toScreen);
    this.paintPath(toScreen);
    this.paintObstacles(toScreen);
    if (this.goal !== null) this.paintGoal(toScreen);
    if (this.pose !== null) this.paintRobot(toScreen, this.pose.x_m, this.pose.y_m, this.pose.yaw_rad, this.fresh ? "--accent" : "--bad");
    this.paintScale(width, height);
  }

  // Show all points that are known: path, obstacles, robot, and the corners of the part of the map that is known.
  fitView(width, height) {
    const shown = [...this.path, ...this.added, ...this.obstacles];
    if (this.pose !== null) shown.push([this.pose.x_m, this.pose.y_m]);
    if (this.map !== null && this.map.known !== null) {
      const [x, y, yaw] = this.mapOrigin();
      const [left, low, right, high] = this.map.known;
      for (const [u, v] of [[left, low], [left, high], [right, low], [right, high]]) {
        shown.push([x + u * Math.cos(yaw) - v * Math.sin(yaw), y + u * Math.sin(yaw) + v * Math.cos(yaw)]);
      }
    }
    if (!shown.length) return;
    const range = (axis) => shown.reduce(([low, high], point) => [Math.min(low, point[axis]), Math.max(high, point[axis])],
      [Infinity, -Infinity]);
    const [[left, right], [low, high]] = [range(0), range(1)];
    this.view.x = (left + right) / 2;
    this.view.y = (low + high) / 2;
    this.setScale(Math.min((width - 2 * MARGIN_PX) / Math.max(SMALLEST_M, right - left),
      (height - 2 * MARGIN_PX) / Math.max(SMALLEST_M, high - low)));
  }

  paintMap(toScreen) {
    if (this.map === null) return;
    const [x, y, yaw] = this.mapOrigin();
    const { view: { scale }, context, map } = this;
    context.save();
    context.translate(...toScreen(x, y));
    context.rotate(-yaw);
    context.imageSmoothingEnabled = false;
    context.drawImage(map.canvas, map.x_m * scale, -(map.y_m + map.height * map.cell_m) * scale,
      map.width * map.cell_m * scale, map.height * map.cell_m * scale);
    context.restore();
  }

  // Where the origin of the map's frame lies in odom: x, y in m and yaw in rad.
  mapOrigin() {
    return this.map.frame === "map" && this.mapInOdom !== null ? this.mapInOdom : [0, 0, 0];
  }

  setMapInOdom(origin) {
    this.mapInOdom = Array.isArray(origin) && origin.every(Number.isFinite) ? origin : null;
    this.draw();
  }

  paintPath(toScreen) {
    const { context } = this;
    context.strokeStyle = this.colour("--accent");
    context.lineWidth = 2.5;
    context.lineJoin = "round";
    context.beginPath();
    for (const point of [...this.path, ...this.added]) context.lineTo(...toScreen(point[0], point[1]));
    if (this.pose !== null) context.lineTo(...toScreen(this.pose.x_m, this.pose.y_m));
    context.stroke();
  }

  paintObstacles(toScreen) {
    this.context.fillStyle = this.colour("--warn");
    this.context.beginPath();
    for (const point of this.obstacles) {
      const [x, y] = toScreen(point[0], point[1]);
      this.context.moveTo(x + OBSTACLE_PX, y);
      this.context.arc(x, y, OBSTACLE_PX, 0, 2 * Math.PI);
    }
    this.context.fill();
  }

  // The straight way to the goal, which the robot leaves only for obstacles, and the goal.
  paintGoal(toScreen) {
    const { context, goal } = this;
    const at = toScreen(goal.x, goal.y);
    context.strokeStyle = context.fillStyle = this.colour("--goal");
    context.lineWidth = 2;
    if (this.pose !== null) {
      context.setLineDash([6, 5]);
      context.beginPath();
      context.moveTo(...toScreen(this.pose.x_m, this.pose.y_m));
      context.lineTo(...at);
      context.stroke();
      context.setLineDash([]);
    }
    if (goal.yaw !== null) {
      this.paintRobot(toScreen, goal.x, goal.y, goal.yaw, "--goal");
    } else {
      context.beginPath();
      context.arc(...at, 0.7 * ROBOT_PX, 0, 2 * Math.PI);
      context.fill();
    }
  }

  paintRobot(toScreen, x_m, y_m, yaw_rad, colour) {
    const { context } = this;
    const [x, y] = toScreen(x_m, y_m);
    context.save();
    context.translate(x, y);
    context.rotate(-yaw_rad);
    context.beginPath();
    context.moveTo(1.5 * ROBOT_PX, 0);
    context.lineTo(-ROBOT_PX, ROBOT_PX);
    context.lineTo(-0.5 * ROBOT_PX, 0);
    context.lineTo(-ROBOT_PX, -ROBOT_PX);
    context.closePath();
    context.fillStyle = this.colour(colour);
    context.strokeStyle = this.colour("--back");
    context.lineWidth = 2;
    context.fill();
    context.stroke();
    context.restore();
  }

  paintScale(width, height) {
    const { context } = this;
    const length = SCALES_M.find((metres) => metres * this.view.scale >= 60) ?? SCALES_M.at(-1);
    const [left, bottom] = [14, height - 14];
    context.fillStyle = context.strokeStyle = this.colour("--quiet");
    context.lineWidth = 2;
    context.beginPath();
    context.moveTo(left, bottom - 6);
    context.lineTo(left, bottom);
    context.lineTo(left + length * this.view.scale, bottom);
    context.lineTo(left + length * this.view.scale, bottom - 6);
    context.stroke();
    context.font = "13px system-ui, sans-serif";
    context.fillText(`${length} m`, left + 6, bottom - 8);
  }

  colour(name) {
    return getComputedStyle(this.canvas).getPropertyValue(name).trim();
  }

  // A colour #rrggbb of the style as 4 bytes.
  rgba(name) {
    const text = this.colour(name);
    return [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16)).concat(255);
  }
}
