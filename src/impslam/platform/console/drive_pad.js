// Joystick and keys. Commands are sent while something is pressed, and one stop on release. Everything is
// released when the page is left, hidden, covered, or its link is lost, and must then be pressed again.
const PERIOD = 100; // ms between commands; the robot stops after 300
const DEAD = 0.08; // of the pad's radius: a resting thumb is not a command
const NOT_HERE = "input:is([type=text], :not([type])), textarea, select, [contenteditable=true], .q-dialog";
const KEYS = {
  ArrowUp: [1, 0], KeyW: [1, 0], ArrowDown: [-1, 0], KeyS: [-1, 0],
  ArrowLeft: [0, 1], KeyA: [0, 1], ArrowRight: [0, -1], KeyD: [0, -1],
};

export default {
  template: `
    <div class="drive-pad" :class="{ enabled: driving, held: held }">
      <div class="pad" ref="pad" data-testid="pad" role="application" tabindex="-1"
           aria-label="Joystick: drag to drive, let go to stop"
           @pointerdown="down" @pointermove="move" @pointerup="up" @pointercancel="up"
           @lostpointercapture="up" @contextmenu.prevent>
        <i class="q-icon material-icons n" aria-hidden="true">expand_less</i>
        <i class="q-icon material-icons s" aria-hidden="true">expand_more</i>
        <i class="q-icon material-icons w" aria-hidden="true">chevron_left</i>
        <i class="q-icon material-icons e" aria-hidden="true">chevron_right</i>
        <div class="knob" :style="{ transform: knob }"></div>
      </div>
      <div class="drive-side">
        <div class="command" data-testid="command">
          <div><b>{{ fixed(command[0] * limits[0], 2) }}</b> m/s</div>
          <div><b>{{ fixed(command[1] * limits[1] * 180 / Math.PI, 0) }}</b> °/s</div>
        </div>
        <label class="speed">
          <span>Speed up to <b>{{ (share * limits[0]).toFixed(2) }} m/s</b></span>
          <input type="range" min="0.1" max="1" step="0.05" v-model.number="share" data-testid="speed"
                 aria-label="Speed limit" @change="$event.target.blur()" />
        </label>
        <div class="hint"><kbd>W</kbd><kbd>A</kbd><kbd>S</kbd><kbd>D</kbd> or arrows<br><kbd>Space</kbd> stops</div>
      </div>
    </div>`,
  props: { driving: Boolean, limits: Array },
  data: () => ({ share: 0.5, stick: null, pressed: [], held: false, command: [0, 0] }),
  computed: {
    knob() {
      const [forward, left] = this.wanted(1);
      return `translate(calc(-50% + ${-left * 36}cqw), calc(-50% + ${-forward * 36}cqw))`;
    },
  },
  watch: {
    driving(yes) {
      if (!yes) this.release();
    },
  },
  mounted() {
    this.pointer = null;
    this.timer = null;
    this.listeners = [
      [window, "keydown", this.keydown],
      [window, "keyup", this.keyup],
      [window, "blur", this.release],
      [window, "pagehide", this.release],
      [window, "imp-halt", this.release],
      [document, "visibilitychange", this.release],
      [document, "freeze", this.release],
    ];
    for (const [target, name, handler] of this.listeners) target.addEventListener(name, handler);
  },
  unmounted() {
    this.release();
    for (const [target, name, handler] of this.listeners) target.removeEventListener(name, handler);
  },
  methods: {
    // No sign for what rounds to zero.
    fixed: (value, digits) => (Number(value.toFixed(digits)) || 0).toFixed(digits),
    down(event) {
      if (!this.driving || this.pointer !== null || event.button !== 0) return;
      event.preventDefault();
      this.pointer = event.pointerId;
      this.$refs.pad.setPointerCapture(event.pointerId);
      document.activeElement?.blur?.();
      this.box = this.$refs.pad.getBoundingClientRect(); // at each press, as an alarm may move the page
      this.point(event);
    },
    move(event) {
      if (event.pointerId === this.pointer) this.point(event);
    },
    up(event) {
      if (event.pointerId !== this.pointer) return;
      this.pointer = null;
      this.stick = null;
      this.update();
    },
    point(event) {
      const box = this.box;
      const radius = 0.36 * box.width;
      const x = (event.clientX - box.left - box.width / 2) / radius;
      const y = (event.clientY - box.top - box.height / 2) / radius;
      const far = Math.hypot(x, y);
      const cut = far < DEAD ? 0 : 1 / Math.max(far, 1);
      this.stick = [-y * cut, -x * cut];
      this.update();
    },
    keydown(event) {
      if (!(event.code in KEYS) || event.ctrlKey || event.altKey || event.metaKey) return;
      if (event.target.closest?.(NOT_HERE)) return;
      if (!this.driving) return;
      event.preventDefault(); // arrows would scroll the page
      if (event.repeat || this.pressed.includes(event.code)) return; // released keys must be pressed again
      this.pressed = [...this.pressed, event.code];
      this.update();
    },
    keyup(event) {
      if (!this.pressed.includes(event.code)) return;
      this.pressed = this.pressed.filter((code) => code !== event.code);
      this.update();
    },
    release() {
      if (this.pointer !== null) {
        const pointer = this.pointer;
        this.pointer = null;
        if (this.$refs.pad?.hasPointerCapture(pointer)) this.$refs.pad.releasePointerCapture(pointer);
      }
      this.stick = null;
      this.pressed = [];
      this.update();
    },
    wanted(share) {
      if (this.stick) return this.stick.map((value) => share * value);
      const sum = (axis) => this.pressed.reduce((total, code) => total + KEYS[code][axis], 0);
      return [0, 1].map((axis) => share * Math.max(-1, Math.min(1, sum(axis))));
    },
    update() {
      const held = this.stick !== null || this.pressed.length > 0;
      const was = this.held;
      this.held = held;
      if (held && this.timer === null) this.timer = setInterval(this.send, PERIOD);
      if (!held && this.timer !== null) {
        clearInterval(this.timer);
        this.timer = null;
      }
      if (held !== was) this.send();
    },
    send() {
      const link = window.impLink;
      if (this.held && !link?.alive()) return this.release();
      this.command = this.wanted(this.share);
      // Without a link, the socket would queue messages, and deliver them when it is back.
      if (link?.alive()) this.$emit("command", [...this.command.map((v) => +v.toFixed(3)), link.clock()]);
    },
  },
};
