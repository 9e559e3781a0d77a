// Time, layers, colours and keys.
function go(k) {
  row = Math.min(Math.max(k, 0), count - 1);
  slider.value = row;
  const t = path.t[row] ?? 0;
  find(".clock").textContent = `${digits(t, 1)} s`;
  find(".readout").textContent = count ? describeRow(row).join("\n") : "";
  find(".readout").className = `readout ${STATES[path.state[row] ?? 0]}`;
  for (const [plot, cursor] of cursors) {
    const [begin, end] = [plot.dataset.begin, plot.dataset.end].map((v) => v - scene.start);
    cursor.style.left = `${(100 * (t - begin)) / (end - begin || 1)}%`;
    cursor.hidden = t < begin - 1e-3 || t > end + 1e-3;
  }
  redraw();
}
/** Return the row nearest to a time. */
function nearest(t) {
  let best = 0;
  for (let k = 1; k < count; k++) if (Math.abs(path.t[k] - t) < Math.abs(path.t[best] - t)) best = k;
  return best;
}
function play(on = !playing) {
  playing = on && count > 1;
  const button = find('[data-key=" "]');
  button.textContent = playing ? "❚❚" : "▶";
  button.setAttribute("aria-label", playing ? "Pause" : "Play");
  if (!playing) return;
  if (row === count - 1) go(0);
  let [time, before] = [clock[row], performance.now()];
  const tick = (now) => {
    if (!playing) return;
    time += (Number(find(".speed").value) * (now - before)) / 1000;
    before = now;
    let k = row;
    if (clock[k] > time + 1 || clock[Math.min(k + 1, count - 1)] < time - 60) time = clock[k]; // the slider was moved
    while (k < count - 1 && clock[k + 1] <= time) k++;
    go(k);
    if (k === count - 1) return play(false);
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}
const cursors = [...document.querySelectorAll(".plot[data-begin]")].map((plot) => {
  const cursor = Object.assign(document.createElement("i"), { className: "cursor" });
  plot.append(cursor);
  const seek = (event) => {
    const frame = plot.getBoundingClientRect(), share = (event.clientX - frame.left) / frame.width;
    const [begin, end] = [plot.dataset.begin, plot.dataset.end].map((v) => v - scene.start);
    go(nearest(begin + Math.min(Math.max(share, 0), 1) * (end - begin)));
  };
  plot.addEventListener("pointerdown", seek);
  plot.addEventListener("pointermove", (event) => event.buttons & 1 && seek(event));
  return [plot, cursor];
});

// Choices and keys.
function toggle(name, on = !shown[name]) {
  shown[name] = on;
  find(`[data-layer=${name}]`).checked = on;
  redraw();
}
function choose(name) {
  colour = name;
  find(".colour").value = name;
  const legend = find(".legend"), scaled = COLOURINGS[name];
  legend.replaceChildren();
  if (name === "health") for (const state of STATES) legend.append(Object.assign(document.createElement("span"), { className: `key ${state}`, textContent: state }));
  if (scaled) {
    const bar = Object.assign(document.createElement("i"), { className: "bar" });
    bar.style.background = `linear-gradient(90deg, ${[0, 1, 2, 3].map((k) => scale(k / 3))})`;
    const [low, high] = range(name).map(scaled[1]);
    legend.append(`${low} `, bar, ` ${high}${name === "time" ? "" : " and more"}`);
  }
  redraw();
}
function press(key, event) {
  const step = event?.shiftKey ? Math.ceil(count / 50) : 1, names = Object.keys(COLOURINGS);
  const actions = {
    " ": () => play(), ArrowRight: () => go(row + step), ArrowLeft: () => go(row - step), Home: () => go(0), End: () => go(count - 1),
    "+": () => zoom(1.4), "=": () => zoom(1.4), "-": () => zoom(1 / 1.4), 0: () => { mode = "fit"; redraw(); },
    r: () => { mode = mode === "follow" ? "free" : "follow"; redraw(); },
    c: () => choose(names[(names.indexOf(colour) + 1) % names.length]),
  };
  const action = actions[key] ?? (LAYERS[key - 1] && (() => toggle(LAYERS[key - 1][0])));
  action?.();
  return action !== undefined;
}
for (const [name, label] of LAYERS) {
  const input = Object.assign(document.createElement("input"), { type: "checkbox", checked: shown[name] });
  input.dataset.layer = name;
  input.addEventListener("change", () => toggle(name, input.checked));
  const entry = document.createElement("label");
  entry.className = `layer ${name}`;
  entry.append(input, document.createElement("i"), label);
  find(".layers").append(entry);
}
find(".colour").append(...Object.keys(COLOURINGS).map((name) => new Option(name, name)));
find(".colour").addEventListener("change", (event) => choose(event.target.value));
const SPEEDS = [1, 2, 5, 10, 20, 50, 100, 200, 500], seconds = (clock[count - 1] ?? 0) - (clock[0] ?? 0);
find(".speed").append(...SPEEDS.map((speed) => new Option(`${speed}×`, speed)));
find(".speed").value = SPEEDS.find((speed) => seconds / speed <= 60) ?? 500; // all of it in a minute
for (const button of figure.querySelectorAll("[data-key]")) button.addEventListener("click", () => press(button.dataset.key));
slider.max = Math.max(count - 1, 0);
slider.addEventListener("input", () => go(Number(slider.value)));
figure.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("select")) return;
  if (event.key === " " && event.target.matches("button, input[type=checkbox]")) return;
  if (press(event.key, event)) event.preventDefault();
});
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(Math.exp(-0.0015 * (event.deltaMode === 1 ? 16 : 1) * event.deltaY), ...at(event));
}, { passive: false });
canvas.addEventListener("pointerdown", (event) => {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, (pressed = at(event)));
  figure.focus({ preventScroll: true });
});
canvas.addEventListener("pointermove", drag);
for (const type of ["pointerup", "pointercancel"]) canvas.addEventListener(type, lift);
canvas.addEventListener("pointerleave", (event) => {
  if (event.pointerType === "touch") return; // follows each tap, whose values stay until the next one
  seen = null;
  show([0, 0]);
});
canvas.addEventListener("dblclick", () => press("0"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
new ResizeObserver(() => {
  ratio = window.devicePixelRatio || 1;
  [width, height] = [canvas.clientWidth, canvas.clientHeight];
  Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  redraw();
}).observe(canvas);
source.onload = paint;
source.src = grid.png;
recolour();
choose("plain");
go(count - 1);
