// Inputs in which the space bar writes; elsewhere, even on a checkbox, it stops the robot.
const WRITING = "input:is([type=text], :not([type])), textarea, [contenteditable=true]";

export default {
  template: `
    <button type="button" class="stop" :class="{ stopped, asked: asked && !stopped }" data-testid="stop"
            :data-stopped="stopped" title="Emergency stop (space bar or Escape)"
            :aria-label="stopped ? 'Emergency stop holds' : 'Emergency stop'" @pointerdown="stop" @click="stop">
      <i class="q-icon material-icons" aria-hidden="true">{{ stopped ? 'front_hand' : 'dangerous' }}</i>
      <span>{{ stopped ? 'STOPPED' : 'STOP' }}</span>
    </button>`,
  props: { stopped: Boolean },
  data: () => ({ asked: false }),
  mounted() {
    this.onKey = (event) => {
      if (event.code !== "Escape" && event.code !== "Space") return;
      if (event.target.closest?.(WRITING)) return;
      if (event.code === "Escape" && document.querySelector(".q-dialog__backdrop")) return;
      event.preventDefault(); // the space bar must not press a focused button
      event.stopPropagation();
      if (!event.repeat) this.stop();
    };
    // Before all other handlers; also for the release of the space bar, which would click.
    this.onRelease = (event) => {
      if (event.code === "Space" && !event.target.closest?.(WRITING)) event.preventDefault();
    };
    window.addEventListener("keydown", this.onKey, true);
    window.addEventListener("keyup", this.onRelease, true);
  },
  unmounted() {
    window.removeEventListener("keydown", this.onKey, true);
    window.removeEventListener("keyup", this.onRelease, true);
  },
  watch: {
    stopped() {
      this.asked = false;
    },
  },
  methods: {
    stop() {
      window.dispatchEvent(new Event("imp-halt"));
      this.asked = true;
      setTimeout(() => (this.asked = false), 2000);
      this.$emit("stop");
    },
  },
};
