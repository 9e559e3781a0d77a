// Monitors the link in the browser, independently of the server.
const ASK = 2000; // ms between questions whether the session is over, while the link is lost

export default {
  template: `
    <div class="alarms" role="alert" aria-live="assertive">
      <div v-if="silent !== null" class="alarm alarm-link" data-testid="link-lost">
        <i class="q-icon material-icons" aria-hidden="true">wifi_off</i>
        <span><b>LINK LOST</b><template v-if="robot"> – robot stops by itself</template></span>
        <span class="alarm-time">{{ silent }} s</span>
      </div>
      <div v-for="alarm in alarms" :key="alarm" class="alarm alarm-device" data-testid="alarm">
        <i class="q-icon material-icons" aria-hidden="true">warning</i><span>{{ alarm }}</span>
      </div>
    </div>`,
  props: { patience: Number, robot: Boolean, alarms: Array },
  data: () => ({ silent: null }),
  created() {
    const start = performance.now();
    this.last = start;
    window.impLink = {
      beat: null,
      picture: 0,
      // The robot's clock, ms, behind by the travel time of the newest beat.
      clock: () => window.impLink.beat + Math.round(performance.now() - this.last),
      // Checked by the drive pad before each command.
      alive: () =>
        window.socket?.connected === true &&
        performance.now() - this.last < 1000 * this.patience,
    };
  },
  mounted() {
    this.timer = setInterval(this.check, 100);
  },
  unmounted() {
    clearInterval(this.timer);
    document.body.classList.remove("link-lost");
  },
  methods: {
    beat(number, picture) {
      this.last = performance.now();
      window.impLink.beat = number;
      window.impLink.picture = picture;
      if (this.silent !== null) this.check();
    },
    check() {
      const seconds = (performance.now() - this.last) / 1000;
      const lost = seconds >= this.patience;
      if (lost && this.silent === null) {
        window.dispatchEvent(new Event("imp-halt"));
        this.next = performance.now() + ASK;
      }
      this.silent = lost ? Math.floor(seconds) : null;
      document.body.classList.toggle("link-lost", lost);
      if (lost) this.ask();
    },
    // A robot that has restarted refuses the socket, as the session is over. The socket only tries again, so
    // the page asks if the link stays lost, and loads again if it is refused: it is then led to the login.
    async ask() {
      if (performance.now() < this.next) return;
      this.next = performance.now() + ASK;
      const options = { method: "HEAD", cache: "no-store", signal: AbortSignal.timeout(ASK) };
      const answer = await fetch(`${window.path_prefix ?? ""}/grid.png`, options).catch(() => null);
      if (answer?.status === 401) window.location.reload();
    },
  },
};
