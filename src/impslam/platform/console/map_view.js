// The map: a canvas that is redrawn after changes, and overlays above it.
import { paint, decode16, decode32, recolour, bounds, distance, fixed } from "impslam-map";

const LAYERS = [
  ["grid", "Grid map", true], ["path", "Path", true], ["scan", "Scan", true], ["marks", "Landmarks", true],
  ["labels", "Labels", true], ["dead", "Odometry alone", false], ["truth", "Truth", true],
];

export default {
  template: `
    <div class="map" role="region" aria-label="Map" data-testid="map" v-bind="data">
      <canvas ref="canvas" :class="{ asks: asks && sought }" aria-label="Map of landmarks, walls, scan, path and robot" role="img"
        @pointerdown="down" @pointermove="move" @pointerup="up" @pointercancel="up" @pointerleave="tip = null"
        @wheel.prevent="wheel" @dblclick="fit"></canvas>
      <div class="hud" data-testid="pose">
        <span v-if="notice" class="sought" data-testid="notice" role="status">{{ notice }}</span>
        <template v-else-if="pose">
          <span><i>x</i> <b data-testid="pose-x">{{ fixed(pose[0], 3) }}</b> m</span>
          <span><i>y</i> <b data-testid="pose-y">{{ fixed(pose[1], 3) }}</b> m</span>
          <span><i>heading</i> <b data-testid="pose-heading">{{ fixed(pose[2] * 180 / Math.PI, 1) }}</b>°</span>
          <span class="soft" data-testid="pose-sigma" title="One standard deviation">σ {{ sigma }}</span>
        </template>
        <span v-else-if="sought" class="sought" data-testid="sought" role="status">
          {{ state === "LOST" ? "" : "Where the robot is in the map is not known yet. " }}Drive on for some 10 m{{
          asks ? ", or click where it is" : "" }}.</span>
        <span v-else-if="state !== 'LOST'" class="soft">No map yet</span>
        <div v-if="!notice && (pose || state === 'LOST' || (sought && state !== 'TRACKING'))" :class="'pose-state ' + state" data-testid="pose-state" role="status">
          <b>{{ state }}</b><span v-if="why">{{ why }}</span></div>
      </div>
      <div class="layers" :class="{ open }">
        <button type="button" class="tool" data-testid="layers" :aria-expanded="open" title="Layers"
          aria-label="Layers" @click="unfold"><i class="q-icon material-icons" aria-hidden="true">layers</i></button>
        <div v-show="open" class="legend" data-testid="legend">
          <label v-for="[name, label] in offered" :key="name" :class="'layer ' + name"
            :title="name === 'dead' ? 'Dead reckoning, since this page was opened' : undefined">
            <input type="checkbox" v-model="shown[name]" :data-testid="'layer-' + name" @change="redraw" />
            <span class="swatch"></span>{{ label }}</label>
        </div>
      </div>
      <div class="tools">
        <button type="button" class="tool" :class="{ on: mode === 'follow' }" data-testid="follow" title="Follow the robot"
          :aria-pressed="mode === 'follow'" aria-label="Follow the robot" @click="follow">
          <i class="q-icon material-icons" aria-hidden="true">my_location</i></button>
        <button type="button" class="tool" :class="{ on: mode === 'fit' }" data-testid="fit" title="Show all"
          :aria-pressed="mode === 'fit'" aria-label="Show all" @click="fit">
          <i class="q-icon material-icons" aria-hidden="true">fit_screen</i></button>
        <button type="button" class="tool" title="Closer" aria-label="Closer" data-testid="closer" @click="zoom(1.4)">
          <i class="q-icon material-icons" aria-hidden="true">add</i></button>
        <button type="button" class="tool" title="Farther" aria-label="Farther" data-testid="farther" @click="zoom(1 / 1.4)">
          <i class="q-icon material-icons" aria-hidden="true">remove</i></button>
      </div>
      <div v-if="tip" class="tip" :style="{ left: tip.x + 'px', top: tip.y + 'px' }">{{ tip.text }}</div>
    </div>`,
  props: { footprint: Array, asks: Boolean, notice: String },
  data: () => ({
    pose: null, sought: false, sigma: "", state: "", why: "", mode: "fit", open: window.innerWidth > 700 && window.innerHeight > 520, tip: null, data: {}, hasTruth: false,
    shown: Object.fromEntries(LAYERS.map(([name, , on]) => [name, on])),
  }),
  computed: {
    offered() {
      return LAYERS.filter(([name]) => name !== "truth" || this.hasTruth);
    },
  },
  created() {
    // Not reactive: these change ten times a second, and only the canvas uses them.
    this.map = { path: new Float32Array(0), dead: [], truth: [], marks: new Map(), points: null, grid: null };
    this.view = { x: 0, y: 0, scale: 60 };
    this.pointers = new Map();
    this.dirty = false;
    this.awaited = null;
    this.seen = true;
  },
  mounted() {
    this.sizes = new ResizeObserver(this.resize);
    this.sizes.observe(this.$el);
    this.scheme = new MutationObserver(this.recolour);
    this.scheme.observe(document.body, { attributes: true, attributeFilter: ["class"] });
    this.onHidden = () => { if (document.hidden) this.seen = false; };
    document.addEventListener("visibilitychange", this.onHidden);
    this.recolour();
    this.resize();
  },
  unmounted() {
    this.sizes.disconnect();
    this.scheme.disconnect();
    document.removeEventListener("visibilitychange", this.onHidden);
  },
  methods: {
    fixed,
    frame(frame) {
      const map = this.map;
      if (frame.run !== map.run) {
        const empty = { dead: [], truth: [], path: new Float32Array(0), grid: null, source: null, picture: null, placed: null };
        Object.assign(map, empty, { run: frame.run });
        map.marks.clear();
      }
      Object.assign(map, {
        pose: frame.scans && frame.placed ? frame.pose : null, sigma: frame.sigma, turn: frame.turn, odometry: frame.odometry,
        points: { step: frame.points.step, xy: decode16(frame.points.xy), x: frame.pose[0], y: frame.pose[1] },
      });
      this.append(frame);
      for (const mark of frame.marks?.set ?? []) map.marks.set(mark[0], mark);
      for (const id of frame.marks?.gone ?? []) map.marks.delete(id);
      if (frame.grid) this.load(frame.grid);
      this.showState(frame);
      this.seen = !document.hidden;
      this.awaited = frame.seq;
      this.redraw();
    },
    append(frame) {
      const map = this.map;
      const tail = decode32(frame.path.xy);
      const path = new Float32Array(2 * frame.path.from + tail.length);
      path.set(map.path.subarray(0, 2 * frame.path.from));
      path.set(tail, 2 * frame.path.from);
      map.path = path;
      for (const [pose, list] of [[frame.odometry, map.dead], [frame.truth, map.truth]]) {
        if (!frame.scans || !pose || pose[0] === null || pose[1] === null) continue;
        const n = list.length;
        if (n < 2 || Math.hypot(pose[0] - list[n - 2], pose[1] - list[n - 1]) > 0.03) list.push(pose[0], pose[1]);
      }
      map.true = frame.truth;
      this.hasTruth ||= frame.truth !== null;
    },
    showState(frame) {
      const moved = frame.scans > 0 && frame.placed;
      this.sought = !frame.placed && !frame.finished;
      this.pose = moved ? frame.pose : null;
      this.sigma = moved && frame.sigma[0] !== null
        ? `${(100 * frame.sigma[0]).toFixed(1)} cm, ${((frame.turn * 180) / Math.PI).toFixed(1)}°` : "";
      this.state = frame.state;
      this.why = frame.why;
      this.data = {
        "data-x": frame.pose[0], "data-y": frame.pose[1], "data-heading": frame.pose[2], "data-stamp": frame.t,
        "data-scans": frame.scans, "data-run": frame.run, "data-version": frame.seq, "data-state": frame.state, "data-why": frame.why,
        "data-landmarks": this.map.marks.size, "data-finished": frame.finished,
      };
    },
    load(grid) {
      const picture = new Image();
      picture.onload = () => {
        if (this.map.grid !== grid) return; // a newer one came meanwhile
        this.map.source = picture;
        this.map.picture = recolour(picture, this.colours);
        this.map.placed = grid;
        this.redraw();
      };
      this.map.grid = grid;
      picture.src = `${window.path_prefix ?? ""}/grid.png?v=${grid.v}`;
    },
    recolour() {
      const style = getComputedStyle(this.$el);
      const names = ["map", "rule", "ink", "soft", "path", "scan", "point", "wall", "dead", "truth", "robot", "free", "taken"];
      this.colours = Object.fromEntries(names.map((name) => [name, style.getPropertyValue("--" + name).trim()]));
      if (this.map.source) this.map.picture = recolour(this.map.source, this.colours);
      this.redraw();
    },
    resize() {
      const canvas = this.$refs.canvas;
      this.ratio = window.devicePixelRatio || 1;
      this.width = this.$el.clientWidth;
      this.height = this.$el.clientHeight;
      canvas.width = Math.round(this.width * this.ratio);
      canvas.height = Math.round(this.height * this.ratio);
      this.redraw();
    },
    redraw() {
      if (this.dirty) return;
      this.dirty = true;
      requestAnimationFrame(() => {
        this.dirty = false;
        if (this.width > 0 && this.height > 0) this.draw();
        if (this.awaited === null) return;
        this.$emit("drawn", this.awaited, this.seen);
        this.awaited = null;
      });
    },
    draw() {
      if (this.mode === "follow" && this.map.pose) [this.view.x, this.view.y] = this.map.pose;
      if (this.mode === "fit") this.frameAll();
      const context = this.$refs.canvas.getContext("2d");
      context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
      paint(context, this);
    },
    frameAll() {
      const [left, low, right, high] = bounds(this.map, this.shown);
      // px, for overlays and labels
      const [west, north, east, south] = [36, 56, this.open && this.width > 700 ? 190 : 84, 44];
      const across = (this.width - west - east) / (right - left);
      const up = (this.height - north - south) / (high - low);
      const scale = Math.min(Math.max(Math.min(across, up), 2), 200);
      this.view = { x: (left + right) / 2 + (east - west) / 2 / scale, y: (low + high) / 2 + (north - south) / 2 / scale, scale };
    },
    unfold() {
      this.open = !this.open;
      this.redraw();
    },
    fit() {
      this.mode = "fit";
      this.redraw();
    },
    follow() {
      this.mode = this.mode === "follow" ? "free" : "follow";
      this.redraw();
    },
    zoom(factor, x = this.width / 2, y = this.height / 2) {
      const view = this.view;
      const scale = Math.min(Math.max(view.scale * factor, 1), 2000);
      if (this.mode === "fit") this.mode = "free";
      if (this.mode === "free") {
        // Keep the position under the pointer.
        view.x += (x - this.width / 2) * (1 / view.scale - 1 / scale);
        view.y -= (y - this.height / 2) * (1 / view.scale - 1 / scale);
      }
      view.scale = scale;
      this.redraw();
    },
    at(event) {
      const box = this.$refs.canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    },
    wheel(event) {
      const lines = event.deltaMode === 1 ? 16 * event.deltaY : event.deltaY;
      this.zoom(Math.exp(-0.0015 * lines), ...this.at(event));
    },
    down(event) {
      this.$refs.canvas.setPointerCapture(event.pointerId);
      this.pressed = this.at(event);
      this.pointers.set(event.pointerId, this.pressed);
      this.tip = null;
    },
    up(event) {
      const [x, y] = this.at(event);
      const { view, width, height, pressed } = this;
      const click = event.type === "pointerup" && this.pointers.size === 1 && Math.hypot(x - pressed[0], y - pressed[1]) < 6;
      if (click && this.asks && this.sought)
        this.$emit("hint", view.x + (x - width / 2) / view.scale, view.y - (y - height / 2) / view.scale);
      this.pointers.delete(event.pointerId);
    },
    move(event) {
      const place = this.at(event);
      const before = this.pointers.get(event.pointerId);
      if (!before) return this.hover(place);
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
      this.pointers.set(event.pointerId, place);
      const share = other ? 0.5 : 1;
      if (!other && Math.hypot(place[0] - before[0], place[1] - before[1]) > 0) this.mode = "free";
      this.view.x -= (share * (place[0] - before[0])) / this.view.scale;
      this.view.y += (share * (place[1] - before[1])) / this.view.scale;
      if (other) {
        const apart = (p) => Math.max(Math.hypot(p[0] - other[0], p[1] - other[1]), 1);
        this.zoom(apart(place) / apart(before), (place[0] + other[0]) / 2, (place[1] + other[1]) / 2);
      }
      this.redraw();
    },
    hover([x, y]) {
      const { view, width, height } = this;
      const px = (mx, my) => [width / 2 + (mx - view.x) * view.scale, height / 2 - (my - view.y) * view.scale];
      let nearest = 14;
      let found = null;
      for (const mark of this.map.marks.values()) {
        const ends = mark[5] ?? [mark[2], mark[3], mark[2], mark[3]];
        const wall = mark[5] ? 7 : 0; // prefer points near a wall to the wall
        const far = wall + distance([x, y], px(ends[0], ends[1]), px(ends[2], ends[3]));
        if (far < nearest) [nearest, found] = [far, mark];
      }
      const text = (m) => `${m[1]} ${m[0]} · seen ${m[6]}×` + (m[4] ? ` · ±${(100 * (m[4][0] ?? 0)).toFixed(1)} cm` : "");
      this.tip = found && this.shown.marks ? { x, y, text: text(found) } : null;
    },
  },
};
