// The data of the page's #scene, the shown layers, and the values as text.
const figure = document.querySelector(".viewer");
const find = (selector) => figure.querySelector(selector);
const scene = JSON.parse(document.getElementById("scene").textContent);
const TYPES = { f4: Float32Array, i4: Int32Array, i2: Int16Array, u1: Uint8Array };
for (const part of [scene.path, scene.scans, scene.loops])
  for (const [name, text] of Object.entries(part))
    if (typeof text === "string") part[name] = unpack(text);
const { path, scans, loops, landmarks, spans, grid } = scene;
const count = path.t.length;

const SIGMAS = 3; // of the ellipses
const PICK_RADIUS = 10; // px within which the pointer selects an item
const STOPS = [[59, 111, 224], [20, 163, 139], [224, 150, 20], [216, 27, 60]]; // of the colour scale
const SHADES = 32; // colours of a path; each change of colour costs a stroke
const STATES = ["TRACKING", "DEGRADED", "LOST"];
const LAYERS = [ // name, label, initially shown, available
  ["grid", "Grid", true, grid.columns > 1],
  ["path", "Path", true, true],
  ["odometry", "Odometry alone", false, "ox" in path],
  ["truth", "Truth", true, "tx" in path],
  ["walls", "Walls", true, landmarks.some((mark) => mark.ends)],
  ["points", "Points", true, landmarks.some((mark) => !mark.ends)],
  ["names", "Labels", landmarks.length <= 40, landmarks.length > 0],
  ["loops", "Loops", true, loops.i.length > 0],
  ["scan", "Scan", true, scans.points.length > 0],
].filter(([, , , available]) => available);
const shown = Object.fromEntries(LAYERS.map(([name, , on]) => [name, on]));
const errors = path.tx && path.t.map((_, k) => Math.hypot(path.x[k] - path.tx[k], path.y[k] - path.ty[k]));
const sigmas = path.t.map((_, k) => Math.sqrt(Math.max(path.xx[k] + path.yy[k], 0)));
const COLOURINGS = { // of the path: values and their format; null: not by a value
  plain: null,
  time: [path.t, (v) => `${digits(v)} s`],
  health: null,
  uncertainty: [sigmas, length],
  ...(errors && { error: [errors, length] }),
};
// Stamps may run backwards; the clock of the slider does not.
let latest = -Infinity;
const clock = path.t.map((t) => (latest = Math.max(latest, t)));

const canvas = find("canvas"), context = canvas.getContext("2d"), slider = find("input[type=range]");
const view = { x: 0, y: 0, scale: 50 }; // the position at the centre, m, and px per m
const pointers = new Map();
let mode = "fit", row = count - 1, playing = false, colour = "plain", seen = null, tip = null;
let width = 0, height = 0, ratio = 1, pending = false, inks = {}, picture = null, pressed = null;

function unpack(text) {
  const bytes = Uint8Array.from(atob(text.slice(3)), (c) => c.charCodeAt(0));
  return new TYPES[text.slice(0, 2)](bytes.buffer);
}

// Values as text.
function digits(value, places = value < 100 ? 1 : 0) {
  return (Number(value.toFixed(places)) || 0).toFixed(places); // no -0
}
function length(value) {
  return value < 1 ? `${digits(100 * value, 1)} cm` : `${digits(value, 2)} m`;
}
function degrees(angle) {
  return `${digits((180 / Math.PI) * Math.atan2(Math.sin(angle), Math.cos(angle)), 1)}°`;
}
function health(t) {
  const span = spans.find(([begin, end]) => begin <= t + 1e-3 && t - 1e-3 <= end);
  return span ? `${span[2]}: ${span[3]}` : "TRACKING";
}
function describeRow(k) {
  const place = `x ${digits(path.x[k], 3)} m, y ${digits(path.y[k], 3)} m, heading ${degrees(path.h[k])}`;
  const [x, y, h] = ["xx", "yy", "hh"].map((name) => Math.sqrt(Math.max(path[name][k], 0)));
  const spread = `1σ ${length(x)}, ${length(y)}, ${degrees(h)}`;
  const error = errors && !Number.isNaN(errors[k]) ? [`${length(errors[k])} from the truth`] : [];
  const t = path.state[k] ? health(path.t[k]) : STATES[0];
  return [`${digits(path.t[k], 1)} s, ${place}`, spread, ...error, t];
}
