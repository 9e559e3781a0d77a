// The theme of the page: that of the system until another one is chosen, which this browser then keeps.
const KEY = "imp-theme";
const THEMES = new Map([["system", null], ["dark", true], ["light", false]]); // what Quasar calls dark mode

export default {
  template: `
    <button type="button" class="button quiet" data-testid="theme" aria-label="Dark or light" title="Dark or light"
      @click="next"><i class="q-icon material-icons notranslate" aria-hidden="true">contrast</i></button>`,
  created() {
    this.choose(localStorage.getItem(KEY));
  },
  methods: {
    next() {
      const names = [...THEMES.keys()];
      this.choose(names[(names.indexOf(this.chosen) + 1) % names.length]);
    },
    choose(name) {
      this.chosen = THEMES.has(name) ? name : "system";
      setDark(THEMES.get(this.chosen));
      localStorage.setItem(KEY, this.chosen);
    },
  },
};
