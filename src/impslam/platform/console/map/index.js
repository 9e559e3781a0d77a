// Drawing of maps: pure functions on a canvas and plain values.

const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
export const decode16 = (text) => new Int16Array(bytes(text));
export const decode32 = (text) => new Float32Array(bytes(text));

/** Map the greys of a grid (0 occupied, 255 free) to colours; unknown cells stay transparent.
 * Returns the picture, and the range of columns and rows that are not transparent. */
export function recolour(picture, colours) {
  const canvas = document.createElement("canvas");
  canvas.width = picture.naturalWidth;
  canvas.height = picture.naturalHeight;
  const context = canvas.getContext("2d");
  context.drawImage(picture, 0, 0);
  const image = context.getImageData(0, 0, canvas.width, canvas.height);
  const [free, taken] = [rgb(colours.free), rgb(colours.taken)];
  const seen = [canvas.width, canvas.height, 0, 0];
  for (let i = 0; i < image.data.length; i += 4) {
    if (image.data[i + 3] === 0) continue;
    const [x, y] = [(i / 4) % canvas.width, Math.floor(i / 4 / canvas.width)];
    if (x < seen[0]) seen[0] = x;
    if (y < seen[1]) seen[1] = y;
    if (x >= seen[2]) seen[2] = x + 1;
    if (y >= seen[3]) seen[3] = y + 1;
    const share = image.data[i] / 255;
    for (let k = 0; k < 3; k++) image.data[i + k] = taken[k] + share * (free[k] - taken[k]);
  }
  context.putImageData(image, 0, 0);
  return { canvas, seen };
}

function rgb(colour) {
  const digits = parseInt(colour.slice(1), 16);
  return [digits >> 16, (digits >> 8) & 255, digits & 255];
}

/** Return a number with some digits, without a sign if it rounds to zero. */
export const fixed = (value, digits) => (Number(value.toFixed(digits)) || 0).toFixed(digits);

/** Return the distance of a point from the line between two others, all [x, y]. */
export function distance([x, y], [x0, y0], [x1, y1]) {
  const [dx, dy] = [x1 - x0, y1 - y0];
  const share = Math.max(0, Math.min(1, ((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy || 1)));
  return Math.hypot(x0 + share * dx - x, y0 + share * dy - y);
}

/** Return the bounds left, low, right, high in m of everything shown, at least those of a small room. */
export function bounds(map, shown) {
  let [left, low, right, high] = [Infinity, Infinity, -Infinity, -Infinity];
  const add = (x, y) => {
    left = Math.min(left, x); right = Math.max(right, x);
    low = Math.min(low, y); high = Math.max(high, y);
  };
  for (let i = 0; i < map.path.length; i += 2) add(map.path[i], map.path[i + 1]);
  for (const [, , x, y, , ends] of map.marks.values()) {
    if (ends) { add(ends[0], ends[1]); add(ends[2], ends[3]); } else add(x, y);
  }
  if (map.picture && shown.grid) {
    const { o: [x, y], r, s: [, rows] } = map.placed;
    const [first, top, last, bottom] = map.picture.seen;
    if (last > first) {
      add(x + r * first, y + r * (rows - bottom));
      add(x + r * last, y + r * (rows - top));
    }
  }
  if (map.points && shown.scan) {
    const { step, xy, x, y } = map.points;
    for (let i = 0; i < xy.length; i += 16) add(x + step * xy[i], y + step * xy[i + 1]);
  }
  if (map.pose) add(map.pose[0], map.pose[1]);
  if (left > right) return [-2, -2, 2, 2];
  const grow = (least, most) => Math.max(0, 2 - (most - least)) / 2;
  const [wide, tall] = [grow(left, right), grow(low, high)];
  return [left - wide, low - tall, right + wide, high + tall];
}

export function paint(context, { map, view, width, height, shown, colours, footprint }) {
  const X = (x) => width / 2 + (x - view.x) * view.scale;
  const Y = (y) => height / 2 - (y - view.y) * view.scale;
  const c = { context, map, view, width, height, shown, colours, footprint, X, Y };
  context.fillStyle = colours.map;
  context.fillRect(0, 0, width, height);
  context.lineJoin = context.lineCap = "round";
  if (shown.grid) picture(c);
  rules(c);
  if (shown.dead) trail(c, map.dead, colours.dead, [5, 4]);
  if (shown.truth) trail(c, map.truth, colours.truth, [2, 4]);
  if (shown.path) trail(c, map.path, colours.path, []);
  if (shown.marks) marks(c);
  if (shown.scan && map.points) scan(c);
  if (map.pose) robot(c);
  if (shown.marks && shown.labels) labels(c);
  scale(c);
}

function picture({ context, map, view, X, Y }) {
  if (!map.picture) return;
  const { o: [x, y], r, s: [columns, rows] } = map.placed;
  context.imageSmoothingEnabled = r * view.scale < 3;
  context.drawImage(map.picture.canvas, X(x), Y(y + r * rows), r * columns * view.scale, r * rows * view.scale);
}

/** Return the spacing in m of lines about this many pixels apart: 1, 2 or 5 times a power of ten. */
function stride(pixels, scale) {
  const power = 10 ** Math.floor(Math.log10(pixels / scale));
  return power * ([1, 2, 5, 10].find((k) => k * power * scale >= pixels) ?? 10);
}

function rules({ context, view, width, height, colours, X, Y }) {
  const step = stride(44, view.scale);
  const [left, low] = [view.x - width / 2 / view.scale, view.y - height / 2 / view.scale];
  context.lineWidth = 1;
  context.strokeStyle = colours.rule;
  context.beginPath();
  for (let x = Math.ceil(left / step) * step; X(x) < width; x += step) {
    const at = Math.round(X(x)) + 0.5;
    context.moveTo(at, 0); context.lineTo(at, height);
  }
  for (let y = Math.ceil(low / step) * step; Y(y) > 0; y += step) {
    const at = Math.round(Y(y)) + 0.5;
    context.moveTo(0, at); context.lineTo(width, at);
  }
  context.stroke();
  const axis = (x, y, colour) => line(context, [X(0), Y(0), X(x), Y(y)], colour, 2.5);
  axis(0.5, 0, "#e5484d");
  axis(0, 0.5, "#30a46c");
}

function line(context, [x0, y0, x1, y1], colour, wide) {
  context.strokeStyle = colour;
  context.lineWidth = wide;
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
}

function trail({ context, X, Y }, xy, colour, dash) {
  if (xy.length < 4) return;
  context.setLineDash(dash);
  context.strokeStyle = colour;
  context.lineWidth = 2;
  context.beginPath();
  for (let i = 0; i < xy.length; i += 2) context.lineTo(X(xy[i]), Y(xy[i + 1]));
  context.stroke();
  context.setLineDash([]);
}

function scan({ context, map, view, colours, X, Y }) {
  const { step, xy, x, y } = map.points;
  const size = Math.min(Math.max(0.025 * view.scale, 2), 4);
  context.fillStyle = colours.scan;
  for (let i = 0; i < xy.length; i += 2)
    context.fillRect(X(x + step * xy[i]) - size / 2, Y(y + step * xy[i + 1]) - size / 2, size, size);
}

/** Draw an ellipse of k sigma around a position; [half axis, other half axis, direction] in m and rad. */
function oval({ context, view, X, Y }, x, y, [a, b, direction], k) {
  context.beginPath();
  context.ellipse(X(x), Y(y), Math.max(k * a * view.scale, 1), Math.max(k * b * view.scale, 1), -direction, 0, 2 * Math.PI);
}

function marks(c) {
  const { context, map, colours, X, Y } = c;
  for (const [, , x, y, spread, ends] of map.marks.values()) {
    if (ends) {
      line(context, [X(ends[0]), Y(ends[1]), X(ends[2]), Y(ends[3])], colours.wall, 3.5);
      continue;
    }
    context.strokeStyle = context.fillStyle = colours.point;
    context.lineWidth = 1.5;
    if (spread && spread[0] !== null) {
      oval(c, x, y, spread, 2);
      context.globalAlpha = 0.22;
      context.fill();
      context.globalAlpha = 1;
      context.stroke();
    }
    context.beginPath();
    context.arc(X(x), Y(y), 3.5, 0, 2 * Math.PI);
    context.fill();
  }
}

function labels({ context, map, view, colours, X, Y }) {
  if (view.scale < 12) return; // zoomed out, they would cover the map
  context.font = "600 11px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.lineWidth = 3.5;
  context.strokeStyle = colours.map;
  const taken = [];
  for (const [id, kind, x, y, , ends] of map.marks.values()) {
    const name = `${kind} ${id}`;
    const at = ends ? [X((ends[0] + ends[2]) / 2), Y((ends[1] + ends[3]) / 2) - 11] : [X(x), Y(y) - 14];
    const half = context.measureText(name).width / 2;
    if (taken.some(([left, top, wide]) => Math.abs(at[0] - left) < half + wide + 6 && Math.abs(at[1] - top) < 15)) continue;
    taken.push([...at, half]); // of two overlapping ones, the older is shown; the tip shows the other
    context.strokeText(name, ...at);
    context.fillStyle = ends ? colours.wall : colours.point;
    context.fillText(name, ...at);
  }
}

function robot(c) {
  const { context, map, view, colours, footprint, X, Y } = c;
  const [x, y, heading] = map.pose;
  if (map.true && map.true[2] !== null && c.shown.truth) body(c, map.true, colours.truth, false);
  // Uncertainty of the heading, 2 sigma, as a fan.
  const reach = Math.max(footprint[0] * view.scale, 26);
  context.fillStyle = colours.robot;
  context.globalAlpha = 0.25;
  context.beginPath();
  context.moveTo(X(x), Y(y));
  context.arc(X(x), Y(y), 1.5 * reach, -heading - 2 * map.turn, -heading + 2 * map.turn);
  context.fill();
  context.globalAlpha = 1;
  body(c, map.pose, colours.robot, true);
  if (map.sigma[0] === null) return;
  oval(c, x, y, map.sigma, 2);
  context.fillStyle = context.strokeStyle = colours.path;
  context.globalAlpha = 0.25;
  context.fill();
  context.globalAlpha = 1;
  context.lineWidth = 1.5;
  context.stroke();
}

function body({ context, view, colours, footprint, X, Y }, [x, y, heading], colour, filled) {
  const long = Math.max(footprint[0] * view.scale, 22);
  const wide = (long * footprint[1]) / footprint[0];
  context.save();
  context.translate(X(x), Y(y));
  context.rotate(-heading);
  context.beginPath();
  context.roundRect(-long / 2, -wide / 2, long, wide, wide / 5);
  context.strokeStyle = filled ? colours.map : colour;
  context.fillStyle = colour;
  context.lineWidth = 1.5;
  if (filled) context.fill();
  context.stroke();
  context.fillStyle = filled ? colours.map : colour;
  context.beginPath();
  context.moveTo(0.4 * long, 0);
  context.lineTo(-0.02 * long, 0.32 * wide);
  context.lineTo(-0.02 * long, -0.32 * wide);
  context.fill();
  context.restore();
}

function scale({ context, view, height, colours }) {
  const metres = stride(60, view.scale);
  const long = metres * view.scale;
  const [x, y] = [16, height - 16];
  line(context, [x, y, x + long, y], colours.ink, 2);
  line(context, [x, y - 4, x, y + 0], colours.ink, 2);
  line(context, [x + long, y - 4, x + long, y], colours.ink, 2);
  context.font = "600 12px system-ui, sans-serif";
  context.textAlign = "left";
  context.textBaseline = "alphabetic";
  context.lineWidth = 3;
  context.strokeStyle = colours.map;
  const name = metres >= 1 ? `${metres} m` : `${Math.round(100 * metres)} cm`;
  context.strokeText(name, x + 6, y - 6);
  context.fillStyle = colours.ink;
  context.fillText(name, x + 6, y - 6);
}
