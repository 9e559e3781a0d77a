// The tabs of the panels. A page that is loaded again, as after a lost link, shows the same panel as before.
const KEY = "imp-tab";

export default {
  template: `
    <nav class="tabs" role="tablist">
      <button v-for="[name, icon, title] in tabs" :key="name" type="button" role="tab" :class="'tab tab-' + name"
        :data-testid="'tab-' + name" :aria-selected="String(name === chosen)" @click="choose(name)">
        <i class="q-icon material-icons notranslate" aria-hidden="true">{{ icon }}</i><span>{{ title }}</span>
      </button>
    </nav>`,
  props: { tabs: Array },
  data: () => ({ chosen: null }),
  created() {
    const last = sessionStorage.getItem(KEY);
    if (this.tabs.some(([name]) => name === last)) this.choose(last);
  },
  methods: {
    choose(name) {
      this.chosen = document.body.dataset.tab = name;
      sessionStorage.setItem(KEY, name);
    },
  },
};
