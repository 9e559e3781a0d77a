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
      const at = event.target;
      if (at.closest?.("input:not([type=range]), textarea, select, [contenteditable=true]")) return;
      if (event.code === "Escape" && document.querySelector(".q-dialog__backdrop")) return;
      event.preventDefault(); // the space bar must not press a button that has the focus
      event.stopPropagation();
      if (!event.repeat) this.stop();
    };
    // Before everything else on the page, and the release of the space bar, which clicks, too.
    this.onRelease = (event) => event.code === "Space" && event.target.closest?.("button") && event.preventDefault();
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
