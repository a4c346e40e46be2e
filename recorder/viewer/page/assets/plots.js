"use strict";
// Plots of series over time. A click or drag moves the replay; a chip shows or hides a series.

// Colors that people with color blindness can tell apart (Okabe and Ito), on light and dark.
const COLORS = ["#2f7fc1", "#d55e00", "#009e73", "#cc79a7", "#b58900", "#56b4e9", "#8a6fd1", "#7f8c8d"];
const FIRST_SHOWN = 6, MOST_SERIES = 64, HEIGHT_PX = 170;

class TimePlot {
  /**
   * Add a plot to an element.
   *
   * series: objects with `name` and `values`, and optionally `dash`.
   * options: `title`; `names` of the integers on the y axis; `shown`, the number of series at first.
   */
  constructor(parent, times, series, options, seek) {
    this.series = series.slice(0, MOST_SERIES);
    this.times = times;
    this.options = options;
    this.shown = this.series.map((_, k) => k < (options.shown ?? FIRST_SHOWN));
    this.box = element("div");
    this.chips = this.series.map((one, k) => this.chip(one, k));
    const left = series.length - this.series.length;
    const title = options.title + (left ? ` (first ${MOST_SERIES} of ${series.length})` : "");
    parent.append(element("div", { className: "panel" },
      element("h2", { textContent: title }), this.box,
      element("div", { className: "chips" }, ...this.chips.map(({ button }) => button))));
    this.instant = element("div", { className: "instant" });
    this.seek = seek;
    this.build();
    this.watcher = new ResizeObserver(() => this.plot.setSize(this.size()));
    this.watcher.observe(this.box);
  }

  /** Create the button that shows or hides a series. */
  chip({ name }, k) {
    const swatch = element("span", { className: "swatch" }), value = element("span");
    swatch.style.background = COLORS[k % COLORS.length];
    const button = element("button", {}, swatch, element("span", { textContent: name }), value);
    button.setAttribute("aria-pressed", this.shown[k]);
    button.onclick = () => {
      this.shown[k] = !this.shown[k];
      button.setAttribute("aria-pressed", this.shown[k]);
      this.plot.setSeries(k + 1, { show: this.shown[k] });
    };
    return { button, value };
  }

  size() {
    return { width: Math.max(this.box.clientWidth, 50), height: HEIGHT_PX };
  }

  /** Create the plot in the colors of the style sheet. */
  build() {
    this.plot?.destroy();
    const style = getComputedStyle(document.documentElement);
    const [ink, pale] = ["--ink", "--pale"].map((name) => style.getPropertyValue(name).trim());
    const axis = { stroke: ink, grid: { stroke: pale, width: 0.5 }, ticks: { stroke: pale, width: 0.5 } };
    const { names } = this.options;
    const labels = names?.map((name) => cut(name, 22));
    const vertical = labels
      ? {
        size: 16 + 6.5 * Math.max(...labels.map(({ length }) => length)),
        splits: labels.map((_, k) => k),
        values: () => labels,
      }
      : { size: 52, values: (_, splits) => splits.map((split) => (split === null ? "" : short(split))) };
    // The last value of a series with one number per step lasts until the end of the episode.
    const columns = this.series.map(({ values }) => Array.from(this.times, (_, k) => {
      const value = values[Math.min(k, values.length - 1)];
      return Number.isFinite(value) ? value : null;
    }));
    this.plot = new libraries.uPlot({
      ...this.size(),
      padding: [8, 16, 0, 0],
      scales: {
        x: { time: false, range: () => [0, this.times.at(-1)] },
        y: names ? { range: [-0.5, names.length - 0.5] } : {},
      },
      axes: [{ ...axis, size: 32 }, { ...axis, ...vertical }],
      legend: { show: false },
      cursor: { show: false },
      series: [{}, ...this.series.map(({ dash }, k) => ({
        show: this.shown[k],
        stroke: COLORS[k % COLORS.length],
        width: 1.5,
        dash,
        points: { show: this.times.length < 3 },
        paths: libraries.uPlot.paths.stepped({ align: 1 }),
      }))],
    }, [this.times, ...columns], this.box);
    const { over } = this.plot;
    over.append(this.instant);
    over.onpointerdown = over.onpointermove = (event) => {
      if (event.buttons) this.seek(this.plot.posToVal(event.clientX - over.getBoundingClientRect().left, "x"));
    };
    if (this.now) this.draw(...this.now);
  }

  /** Mark a time, and write the values of a step. */
  draw(time, step) {
    this.now = [time, step];
    this.instant.style.transform = `translateX(${this.plot.valToPos(time, "x")}px)`;
    if (step === this.step) return;
    this.step = step;
    this.series.forEach(({ values }, k) => {
      const { names } = this.options, value = step < values.length ? values[step] : NaN;
      this.chips[k].value.textContent = names ? names[value] ?? "" : short(value);
    });
  }

  destroy() {
    this.watcher.disconnect();
    this.plot.destroy();
  }
}

/** Shorten the middle of a text: names of bins differ in their ends. */
function cut(text, most) {
  return text.length > most ? `${text.slice(0, most / 2 - 1)}\u2026${text.slice(-most / 2)}` : text;
}

/** Create the plots of an episode. */
function plotsOf(data) {
  const { times, rewards } = data;
  const sums = [0];
  for (const reward of rewards) sums.push(sums.at(-1) + reward);
  const plot = (series, options) => {
    return new TimePlot(get("plots"), times, series, options, seek);
  };
  const rows = (values, names) => Array.from({ length: values.shape[0] }, (_, k) =>
    ({ name: names[k] ?? String(k), values: row(values, k) }));
  const named = data.is_discrete && log.actions.length && log.actions.length <= MOST_BARS;
  const index = (values) => (named ? values.map((value) => value - log.first_action) : values);
  data.sums = sums;
  return [
    plot([{ name: "reward", values: rewards }], { title: "Reward" }),
    plot([{ name: "return", values: sums }], { title: "Return so far" }),
    data.is_discrete
      ? plot([
        { name: "log", values: index(row(data.actions, 0)) },
        ...data.policies.map(({ name, policy_action: chosen }) =>
          ({ name: name || "policy", values: index(chosen), dash: [3, 3] })),
      ], { title: "Action", names: named ? log.actions : undefined })
      : undefined,
    ...(data.is_discrete ? [] : commandPlots(data, plot, rows)),
    ...data.policies.flatMap((policy) => {
      if (!policy.preference) return valuePlots(policy, plot);
      const hasValues = policy.q.some(Number.isFinite);
      const errors = [{ name: "TD error", values: policy.td_error }, { name: "advantage", values: policy.advantage }];
      return [
        plot(rows(hasValues ? policy.q : policy.preference, log.actions), {
          title: titled(hasValues ? "Q-values" : "Probabilities of the actions", policy), shown: 8,
        }),
        ...(hasValues ? [plot(errors, { title: titled("TD error and advantage", policy) })] : []),
      ];
    }),
    ...data.plots.map(({ title, names, values }) =>
      plot(rows(values, names), { title: title[0].toUpperCase() + title.slice(1) })),
  ].filter(Boolean);
}

/** Return the plots of a Box action: each element beside the policies' commands, if there are any. */
function commandPlots({ actions, policies }, plot, rows) {
  const own = policies.filter((policy) => !policy.preference);
  if (!own.length) return [plot(rows(actions, log.parts), { title: "Action" })];
  return log.parts.map((part, k) => plot([
    { name: "log", values: row(actions, k) },
    ...own.map(({ name, policy_action: command }) =>
      ({ name: name || "policy", values: row(command, k), dash: [3, 3] })),
  ], { title: `Action: ${part}` }));
}

/** Return the plots of a policy's values of the logged commands and of the policy's. */
function valuePlots(policy, plot) {
  if (!policy.q.some(Number.isFinite)) return [];
  const values = [{ name: "log", values: policy.q }, { name: "policy", values: policy.value, dash: [3, 3] }];
  const errors = [{ name: "TD error", values: policy.td_error }, { name: "advantage", values: policy.advantage }];
  return [
    plot(values, { title: titled("Q-values of both commands", policy) }),
    plot(errors, { title: titled("TD error and advantage", policy) }),
  ];
}
