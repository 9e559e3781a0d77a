// Pointer events.
function zoom(factor, x = width / 2, y = height / 2) {
  const next = Math.min(Math.max(view.scale * factor, 0.2), 5000);
  if (mode === "fit") mode = "free";
  if (mode === "free") {
    view.x += (x - width / 2) * (1 / view.scale - 1 / next);
    view.y -= (y - height / 2) * (1 / view.scale - 1 / next);
  }
  view.scale = next;
  redraw();
}
function at(event) {
  const frame = canvas.getBoundingClientRect();
  return [event.clientX - frame.left, event.clientY - frame.top];
}
function drag(event) {
  const now = at(event), before = pointers.get(event.pointerId);
  if (!before) return hover(now);
  const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
  pointers.set(event.pointerId, now);
  const share = other ? 0.5 : 1;
  if (other || Math.hypot(now[0] - pressed[0], now[1] - pressed[1]) > 3) mode = "free";
  if (mode !== "free") return;
  view.x -= (share * (now[0] - before[0])) / view.scale;
  view.y += (share * (now[1] - before[1])) / view.scale;
  const apart = (p) => Math.max(Math.hypot(p[0] - other[0], p[1] - other[1]), 1);
  if (other) zoom(apart(now) / apart(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
  redraw();
}
function lift(event) {
  const [x, y] = at(event), click = event.type === "pointerup" && pointers.size === 1 && pressed;
  pointers.delete(event.pointerId);
  if (!click || Math.hypot(x - pressed[0], y - pressed[1]) > 5) return;
  hover([x, y]);
  if (seen?.row !== undefined) go(seen.row);
}
/** Return the distance, px, of a point from the line segment between two others. */
function distance([x, y], [[ax, ay], [bx, by]]) {
  const [dx, dy] = [bx - ax, by - ay];
  const share = Math.min(Math.max(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1), 0), 1);
  return Math.hypot(x - ax - share * dx, y - ay - share * dy);
}
function hover(here) {
  seen = null;
  let least = PICK_RADIUS;
  const offer = (far, what) => { if (far < least) [least, seen] = [far, what()]; };
  if (shown.walls) for (const mark of landmarks) if (mark.ends)
    offer(distance(here, mark.ends.map(([x, y]) => [right(x), down(y)])) + 3, () => ({ mark }));
  if (shown.path) for (let k = 0; k < count; k++)
    offer(Math.hypot(right(path.x[k]) - here[0], down(path.y[k]) - here[1]) + 1, () => ({ row: k }));
  if (shown.loops) for (let k = 0; k < loops.i.length; k++)
    if (Math.max(loops.ti[k], loops.tj[k]) <= clock[row]) offer(distance(here, ends(k)) + 0.5, () => ({ loop: k }));
  if (shown.points) for (const mark of landmarks) if (mark.spread)
    offer(Math.hypot(right(mark.x) - here[0], down(mark.y) - here[1]), () => ({ mark }));
  show(here);
}
function show([x, y]) {
  const box = find(".tip");
  box.hidden = !seen;
  if (seen) {
    box.textContent = describe(seen).join("\n");
    box.style.left = `${Math.min(x + 14, width - box.offsetWidth - 6)}px`;
    box.style.top = `${y + 18 + box.offsetHeight > height ? y - box.offsetHeight - 12 : y + 18}px`;
  }
  canvas.style.cursor = seen?.row !== undefined ? "pointer" : "grab";
  redraw();
}
function describe({ mark, loop, row: k }) {
  if (k !== undefined) return describeRow(k);
  if (loop !== undefined) {
    const times = [loops.ti[loop], loops.tj[loop]].map((t) => `${digits(t, 1)} s`);
    return [`Loop between ${times.join(" and ")}`, `NIS ${digits(loops.nis[loop], 2)} with 3 degrees of freedom`];
  }
  const [kind, id, at, parameters, long, spread, times, life] = mark.cells;
  return [`${kind} ${id}  ${at} m`, [parameters, long].filter(Boolean).join(", "), `1σ ${spread}`, `seen ${times}, ${life}`].filter(Boolean);
}
