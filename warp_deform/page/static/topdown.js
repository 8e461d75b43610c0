// The table from above on a plain canvas: the observation at rest, drawn by hand while things move.

const SCALE = 3; // canvas pixels a pixel of the picture

/** A picture from PNG bytes, or from those of another type. */
export const decode = (bytes, type = "image/png") => createImageBitmap(new Blob([bytes], {type}));

export class TopDown {
  constructor(canvas) {
    Object.assign(this, {canvas, picture: null, layers: {}, grasp: null, planned: null, pull: null, fault: null, moving: null});
    this.context = canvas.getContext("2d");
  }

  furnish(hello) {
    this.grid = hello.grid;
    this.canvas.width = this.grid.columns * SCALE;
    this.canvas.height = this.grid.rows * SCALE;
  }

  build(m) { this.m = m; }

  /** Canvas pixel of a point on the table. */
  pixel(x, y) {
    const {origin, pixel} = this.grid;
    return [((x - origin[0]) / pixel + 0.5) * SCALE, ((y - origin[1]) / pixel + 0.5) * SCALE];
  }

  /** Point of the table under the pointer. */
  at(event) {
    const box = this.canvas.getBoundingClientRect(), {origin, pixel, rows, columns} = this.grid;
    const share = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    return [origin[0] + (share[0] * columns - 0.5) * pixel, origin[1] + (share[1] * rows - 0.5) * pixel];
  }

  onKnob(event) {
    if (!this.planned) return false;
    const at = this.at(event), {pick, turn} = this.planned;
    return Math.hypot(at[0] - pick[0] - 0.05 * Math.cos(turn), at[1] - pick[1] - 0.05 * Math.sin(turn)) < 0.02;
  }

  put(state) { this.q = state.q; this.body = state.body; }

  /** Show the observation again, where there is one; `null` draws by hand. */
  still(picture) { this.moving = !picture; if (picture) this.picture = picture; }

  draw() {
    const c = this.context, {width, height} = this.canvas;
    if (!this.grid) return;
    c.imageSmoothingEnabled = false;
    if (this.moving && this.m) this.drawThings(c); else if (this.picture) c.drawImage(this.picture, 0, 0, width, height);
    for (const layer of Object.values(this.layers)) c.drawImage(layer, 0, 0, width, height);
    if (this.grasp) this.drawGrasp(c);
    if (this.planned) this.drawPlan(c);
    if (this.fault) this.drawFault(c);
    if (this.pull) line(c, this.pixel(...this.pull[0]), this.pixel(...this.pull[1]), "#ff5759");
  }

  drawThings(c) {
    const m = this.m, q = this.q, {pixel, table} = this.grid;
    const paint = (segment, share = 1) => `rgb(${Array.from(m.palette.subarray(3 * segment, 3 * segment + 3), x => Math.round(x * share))})`;
    c.fillStyle = `rgb(${table})`;
    c.fillRect(0, 0, this.canvas.width, this.canvas.height);
    const polygon = points => { c.beginPath(); points.forEach((p, k) => c[k ? "lineTo" : "moveTo"](...p)); c.closePath(); c.fill(); };
    for (let k = 0; k < m.quad_segment.length; k++) {
      c.fillStyle = paint(m.quad_segment[k]);
      polygon([0, 1, 2, 3].map(i => this.pixel(m.quad_corners[12 * k + 3 * i], m.quad_corners[12 * k + 3 * i + 1])));
    }
    const parts = []; // [height, how to draw it]: the highest last
    for (let k = 0; k < m.triangle_segment.length; k++) {
      const [a, b, d] = [0, 1, 2].map(i => 3 * m.triangle_particle[3 * k + i]);
      const u = [q[b] - q[a], q[b + 1] - q[a + 1], q[b + 2] - q[a + 2]], v = [q[d] - q[a], q[d + 1] - q[a + 1], q[d + 2] - q[a + 2]];
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      const sign = n[2] < 0 ? -1 : 1, cosine = sign * (0.3 * (n[1] - n[0]) + n[2]) / (Math.hypot(...n) || 1);
      const style = paint(m.triangle_segment[k], Math.min(0.35 + 0.65 * Math.max(cosine, 0), 1));
      parts.push([(q[a + 2] + q[b + 2] + q[d + 2]) / 3, () => { c.fillStyle = c.strokeStyle = style; c.lineWidth = 0.7; polygon([a, b, d].map(i => this.pixel(q[i], q[i + 1]))); c.stroke(); }]);
    }
    m.sphere_particle.forEach((p, k) => parts.push([q[3 * p + 2] + m.sphere_radius[k], () => {
      c.fillStyle = paint(m.sphere_segment[k]);
      c.beginPath();
      c.arc(...this.pixel(q[3 * p], q[3 * p + 1]), m.sphere_radius[k] / pixel * SCALE, 0, 7);
      c.fill();
    }]));
    m.box_segment.forEach((segment, k) => {
      const [corners, top] = boxCorners(m, this.body, k);
      parts.push([top, () => { c.fillStyle = paint(segment); polygon(hull(corners).map(p => this.pixel(...p))); }]);
    });
    parts.sort((a, b) => a[0] - b[0]).forEach(part => part[1]());
  }

  drawGrasp(c) {
    if (this.grasp.particle < 0) return;
    const p = 3 * this.grasp.particle;
    c.strokeStyle = "#edc948"; c.lineWidth = 3;
    c.beginPath(); c.arc(...this.pixel(this.q[p], this.q[p + 1]), 0.009 / this.grid.pixel * SCALE, 0, 7); c.stroke();
  }

  /** Where a guard of the physics fired. */
  drawFault(c) {
    const [x, y] = this.pixel(...this.fault);
    c.strokeStyle = "#ff3030"; c.lineWidth = 5;
    c.beginPath(); c.arc(x, y, 22, 0, 7); c.moveTo(x - 34, y); c.lineTo(x + 34, y); c.moveTo(x, y - 34); c.lineTo(x, y + 34); c.stroke();
  }

  drawPlan(c) {
    const {pick, place, turn} = this.planned, at = this.pixel(...pick), reach = 0.05 / this.grid.pixel * SCALE;
    c.lineWidth = 1.5; c.strokeStyle = "#ffffff";
    c.beginPath(); c.arc(...at, reach, 0, 7); c.stroke();
    c.beginPath(); c.arc(...at, 6, 0, 7); c.stroke();
    c.fillStyle = "#edc948";
    c.beginPath(); c.arc(at[0] + reach * Math.cos(turn), at[1] + reach * Math.sin(turn), 7, 0, 7); c.fill();
    if (place) line(c, at, this.pixel(...place), "#edc948");
  }
}

function line(c, from, to, style) {
  const angle = Math.atan2(to[1] - from[1], to[0] - from[0]);
  c.strokeStyle = c.fillStyle = style; c.lineWidth = 4;
  c.beginPath(); c.moveTo(...from); c.lineTo(...to); c.stroke();
  c.beginPath(); c.moveTo(...to);
  for (const side of [2.6, -2.6]) c.lineTo(to[0] + 16 * Math.cos(angle + side), to[1] + 16 * Math.sin(angle + side));
  c.fill();
}

/** Corners of a box seen from above, and its highest point. */
function boxCorners(m, body, k) {
  const b = 7 * m.box_body[k], pose = m.box_pose.subarray(7 * k, 7 * k + 7), half = m.box_half.subarray(3 * k, 3 * k + 3);
  const turn = (quat, p) => {
    const [x, y, z, w] = quat, t = [2 * (y * p[2] - z * p[1]), 2 * (z * p[0] - x * p[2]), 2 * (x * p[1] - y * p[0])];
    return [p[0] + w * t[0] + y * t[2] - z * t[1], p[1] + w * t[1] + z * t[0] - x * t[2], p[2] + w * t[2] + x * t[1] - y * t[0]];
  };
  let top = -1;
  const corners = [];
  for (let i = 0; i < 8; i++) {
    const own = [0, 1, 2].map(a => half[a] * (i >> a & 1 ? 1 : -1));
    const inner = turn(pose.subarray(3), own).map((x, a) => x + pose[a]);
    const p = turn(body.subarray(b + 3, b + 7), inner).map((x, a) => x + body[b + a]);
    corners.push([p[0], p[1]]);
    top = Math.max(top, p[2]);
  }
  return [corners, top];
}

function hull(points) {
  const sorted = points.slice().sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const half = order => order.reduce((chain, p) => {
    while (chain.length > 1) {
      const [a, b] = chain.slice(-2);
      if ((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0) break;
      chain.pop();
    }
    return [...chain, p];
  }, []).slice(0, -1);
  return [...half(sorted), ...half(sorted.reverse())];
}
