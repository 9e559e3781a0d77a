export default {
  template: `
    <div class="camera" data-testid="camera" :data-stamp="stamp">
      <img v-show="stamp" ref="picture" alt="What the robot's camera sees" />
      <div v-if="!stamp" class="soft empty">No picture yet</div>
      <div v-if="old" class="old">picture is {{ old }} s old</div>
    </div>`,
  props: { period: Number },
  data: () => ({ stamp: 0, old: 0 }),
  mounted() {
    this.visible = false;
    this.loading = false;
    this.since = performance.now();
    this.watcher = new IntersectionObserver(([entry]) => (this.visible = entry.isIntersecting));
    this.watcher.observe(this.$el);
    this.timer = setInterval(this.poll, 1000 * this.period);
  },
  unmounted() {
    this.watcher.disconnect();
    clearInterval(this.timer);
  },
  methods: {
    poll() {
      const newest = window.impLink?.picture ?? 0;
      this.old = this.stamp && performance.now() - this.since > 3000 ? Math.round((performance.now() - this.since) / 1000) : 0;
      if (!this.visible || document.hidden || this.loading || !newest || newest === this.stamp) return;
      this.loading = true;
      const next = new Image();
      next.onload = () => {
        this.$refs.picture.src = next.src;
        this.stamp = newest;
        this.since = performance.now();
        this.loading = false;
      };
      next.onerror = () => (this.loading = false);
      next.src = `${window.path_prefix ?? ""}/camera.jpg?t=${newest}`;
    },
  },
};
