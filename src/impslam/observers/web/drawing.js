// Draws the map on its canvas. First, coordinates.
const right = (x) => width / 2 + (x - view.x) * view.scale;
const down = (y) => height / 2 - (y - view.y) * view.scale;
const place = (x, y) => [view.x + (x - width / 2) / view.scale, view.y - (y - height / 2) / view.scale];

/** Return the angle and half axes, m, of the ellipse of a covariance. */
function axes(xx, xy, yy) {
  const middle = (xx + yy) / 2, half = Math.hypot((xx - yy) / 2, xy);
  const reach = [middle + half, middle - half].map((value) => SIGMAS * Math.sqrt(Math.max(value, 0)));
  return [Math.atan2(2 * xy, xx - yy) / 2, ...reach];
}

function box(parts, from = [Infinity, Infinity, -Infinity, -Infinity]) {
  let [left, low, high, top] = [from[0], from[1], from[2], from[3]];
  for (const [x, y, reach = 0] of parts) {
    if (!Number.isFinite(x + y)) continue;
    left = Math.min(left, x - reach);
    high = Math.max(high, x + reach);
    low = Math.min(low, y - reach);
    top = Math.max(top, y + reach);
  }
  return [left, low, high, top];
}
function* points(xs, ys) {
  for (let k = 0; k < xs.length; k++) yield [xs[k], ys[k]];
}
function bounds() {
  const marks = landmarks.flatMap((mark) => mark.ends ?? [[mark.x, mark.y]]);
  let all = box([...points(path.x, path.y), ...(shown.walls || shown.points ? marks : [])]);
  if (shown.grid && grid.columns > 1) {
    const bottom = grid.top - grid.rows * grid.cell;
    all = box([[grid.left, grid.top], [grid.left + grid.columns * grid.cell, bottom]], all);
  }
  if (shown.truth) all = box(points(path.tx, path.ty), all);
  const side = Math.max(all[2] - all[0], all[3] - all[1], 1);
  const round = landmarks.filter((mark) => mark.spread).map((mark) => [mark.x, mark.y, axes(...mark.spread)[1]]);
  if (shown.points) all = box(round.filter(([, , reach]) => reach < side / 2), all);
  if (shown.odometry) all = box(points(path.ox, path.oy), all);
  return all.every(Number.isFinite) ? all : [-1, -1, 1, 1];
}
function fit() {
  const [left, low, high, top] = bounds();
  const across = (width - 70) / Math.max(high - left, 0.5), up = (height - 70) / Math.max(top - low, 0.5);
  Object.assign(view, { x: (left + high) / 2, y: (low + top) / 2, scale: Math.min(across, up) });
}

// Drawing.
function redraw() {
  if (pending) return;
  pending = true;
  requestAnimationFrame(() => {
    pending = false;
    if (width) draw();
  });
}
function draw() {
  if (mode === "fit") fit();
  if (mode === "follow" && count) [view.x, view.y] = [path.x[row], path.y[row]];
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.fillStyle = inks.unseen;
  context.fillRect(0, 0, width, height);
  context.lineJoin = context.lineCap = "round";
  if (shown.grid && picture) {
    context.imageSmoothingEnabled = grid.cell * view.scale < 1;
    const size = [picture.width, picture.height].map((side) => side * grid.cell * view.scale);
    context.drawImage(picture, right(grid.left), down(grid.top), ...size);
  }
  drawRules();
  if (shown.odometry) line(path.ox, path.oy, 0, row, inks.odometry, 1.2);
  if (shown.walls) for (const mark of landmarks) if (mark.ends) wall(mark);
  if (shown.loops) drawLoops();
  if (shown.path) drawPath();
  if (shown.truth) {
    context.setLineDash([6, 5]);
    line(path.tx, path.ty, 0, row, inks.truth, 1.6);
    context.setLineDash([]);
  }
  if (shown.points) for (const mark of landmarks) if (mark.spread) point(mark);
  if (shown.names) names();
  if (count) drawRobot();
}
function drawRules() {
  const step = [1, 2, 5, 10].map((f) => f * 10 ** Math.floor(Math.log10(90 / view.scale))).find((s) => s * view.scale >= 60);
  const [left, top] = place(0, 0), [end, bottom] = place(width, height);
  context.font = "11px system-ui, sans-serif";
  context.lineWidth = 1;
  const label = (value) => String(Number(value.toFixed(6)));
  for (let x = Math.ceil(left / step) * step; x < end; x += step) {
    stroke([[right(x), 0], [right(x), height]], inks.rule);
    context.fillStyle = inks.soft;
    context.fillText(label(x), right(x) + 3, height - 5);
  }
  for (let y = Math.ceil(bottom / step) * step; y < top; y += step) {
    stroke([[0, down(y)], [width, down(y)]], inks.rule);
    context.fillStyle = inks.soft;
    context.fillText(`${label(y)}${y + step >= top ? " m" : ""}`, 4, down(y) - 3);
  }
}
function stroke(places, ink) {
  context.strokeStyle = ink;
  context.beginPath();
  for (const [x, y] of places) context.lineTo(x, y);
  context.stroke();
}
/** Draw rows of a line, interrupted between drives; `shade(k)` is the colour of the segment that ends at row k. */
function line(xs, ys, from, to, ink, wide, shade = () => ink) {
  context.lineWidth = wide;
  let [x, y, last, drive] = [NaN, NaN, null, -1];
  for (let k = from; k <= to; k++) {
    const [px, py] = [right(xs[k]), down(ys[k])], now = shade(k);
    const broken = drive !== path.drive[k] || Number.isNaN(px + py);
    if (!broken && now === last && k < to && Math.abs(px - x) + Math.abs(py - y) < 1) continue;
    if (broken || now !== last) {
      if (last !== null) context.stroke();
      context.beginPath();
      context.strokeStyle = now;
      if (!broken) context.moveTo(x, y);
    }
    context.lineTo(px, py);
    [x, y, last, drive] = [px, py, now, path.drive[k]];
  }
  if (last !== null) context.stroke();
}
function drawPath() {
  context.globalAlpha = 0.25;
  if (row < count - 1) line(path.x, path.y, row, count - 1, inks.path, 1.5);
  context.globalAlpha = 1;
  line(path.x, path.y, 0, row, inks.path, 2, shading());
  if (count) disc(right(path.x[0]), down(path.y[0]), 5, inks.truth);
}
function shading() {
  if (colour === "health") return (k) => inks[STATES[path.state[k]]];
  if (!COLOURINGS[colour]) return undefined;
  const values = COLOURINGS[colour][0], [low, high] = range(colour);
  return (k) => {
    const share = Math.min(Math.max((values[k] - low) / (high - low || 1), 0), 1);
    return Number.isNaN(share) ? inks.soft : scale(Math.round(share * SHADES) / SHADES);
  };
}
/** Return the minimum and the 99th percentile of a colouring, of times the maximum. */
const ranges = {};
function range(name) {
  if (!ranges[name]) {
    const sorted = COLOURINGS[name][0].filter((v) => !Number.isNaN(v)).sort();
    const least = name === "time" ? sorted[0] : 0;
    ranges[name] = [least ?? 0, sorted[Math.floor((name === "time" ? 1 : 0.99) * (sorted.length - 1))] ?? 0];
  }
  return ranges[name];
}
function scale(share) {
  const at = Math.min(share * (STOPS.length - 1), STOPS.length - 1.001), i = Math.floor(at);
  return `rgb(${STOPS[i].map((c, k) => Math.round(c + (at - i) * (STOPS[i + 1][k] - c)))})`;
}
function wall(mark) {
  context.lineWidth = Math.min(Math.max(0.06 * view.scale, 2), 8);
  context.globalAlpha = 0.7;
  stroke(mark.ends.map(([x, y]) => [right(x), down(y)]), mark === seen?.mark ? inks.ink : inks.wall);
  context.globalAlpha = 1;
}
function ellipse(x, y, spread, ink) {
  const [angle, long, short] = axes(...spread);
  context.strokeStyle = ink;
  context.beginPath();
  context.ellipse(right(x), down(y), long * view.scale, short * view.scale, -angle, 0, 2 * Math.PI);
  context.stroke();
}
function disc(x, y, radius, ink) {
  context.fillStyle = ink;
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
}
function point(mark) {
  const [x, y] = [right(mark.x), down(mark.y)], ink = mark === seen?.mark ? inks.ink : inks.point;
  context.lineWidth = 1.5;
  context.globalAlpha = 0.35;
  disc(x, y, mark.radius * view.scale, ink);
  context.globalAlpha = 1;
  stroke([[x - 4, y], [x + 4, y]], ink);
  stroke([[x, y - 4], [x, y + 4]], ink);
  ellipse(mark.x, mark.y, mark.spread, ink);
}
function names() {
  context.font = "11px system-ui, sans-serif";
  for (const mark of landmarks) {
    if (!(mark.ends ? shown.walls : shown.points)) continue;
    const [x, y] = mark.ends ? middle(mark.ends) : [mark.x, mark.y];
    context.lineWidth = 3;
    context.strokeStyle = inks.unseen;
    context.strokeText(mark.cells[1], right(x) + 7, down(y) - 5);
    context.fillStyle = inks.ink;
    context.fillText(mark.cells[1], right(x) + 7, down(y) - 5);
  }
}
const middle = ([a, b]) => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
const ends = (k) => [loops.i[k], loops.j[k]].map((i) => [right(scans.x[i]), down(scans.y[i])]);
function drawLoops() {
  for (let k = 0; k < loops.i.length; k++) {
    if (Math.max(loops.ti[k], loops.tj[k]) > clock[row]) continue;
    const ink = k === seen?.loop ? inks.ink : inks.loop;
    context.lineWidth = 2;
    stroke(ends(k), ink);
    for (const [x, y] of ends(k)) disc(x, y, 3, ink);
  }
}
function drawRobot() {
  const i = path.scan[row], [begin, end] = [scans.starts[i], scans.starts[i + 1]];
  if (shown.scan) {
    const [c, s] = [Math.cos(scans.h[i]), Math.sin(scans.h[i])];
    context.fillStyle = inks.scan;
    for (let k = 2 * begin; k < 2 * end; k += 2) {
      const [x, y] = [scans.points[k] * scans.unit, scans.points[k + 1] * scans.unit];
      context.fillRect(right(scans.x[i] + c * x - s * y) - 1.25, down(scans.y[i] + s * x + c * y) - 1.25, 2.5, 2.5);
    }
  }
  context.lineWidth = 1.5;
  ellipse(path.x[row], path.y[row], [path.xx[row], path.xy[row], path.yy[row]], inks.ink);
  context.save();
  context.translate(right(path.x[row]), down(path.y[row]));
  context.rotate(-path.h[row]);
  context.beginPath();
  for (const [x, y] of [[13, 0], [-8, 7], [-4, 0], [-8, -7]]) context.lineTo(x, y);
  context.closePath();
  context.fillStyle = inks.robot;
  context.fill();
  context.strokeStyle = inks.unseen;
  context.stroke();
  context.restore();
}

// Colours come from the page's style sheet and change with its scheme; the grid is drawn in them.
const source = new Image();
function recolour() {
  const style = getComputedStyle(figure);
  const known = ["unseen", "free", "taken", "rule", "ink", "soft", "path", "odometry", "truth", "wall", "point", "loop", "scan", "robot", ...STATES];
  inks = Object.fromEntries(known.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  if (source.naturalWidth) paint();
  redraw();
}
function paint() {
  picture = Object.assign(document.createElement("canvas"), { width: source.naturalWidth, height: source.naturalHeight });
  const brush = picture.getContext("2d"), [free, taken] = [inks.free, inks.taken].map((code) => parseInt(code.slice(1), 16));
  brush.drawImage(source, 0, 0);
  const image = brush.getImageData(0, 0, picture.width, picture.height), bytes = image.data;
  for (let k = 0; k < bytes.length; k += 4) {
    const grey = bytes[k], code = grey > 230 ? free : taken; // of a trinary map: 254 free, 205 unseen, 0 taken
    [bytes[k], bytes[k + 1], bytes[k + 2], bytes[k + 3]] = [code >> 16, (code >> 8) & 255, code & 255, grey > 230 || grey < 100 ? 255 : 0];
  }
  brush.putImageData(image, 0, 0);
  redraw();
}
