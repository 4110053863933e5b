// The strip charts of the selected vehicle, over its own clock.

import uPlot from "./vendor/uplot.min.js";
import { shortWay, signed } from "./frames.js";
import { colour } from "./theme.js";

const WINDOW_S = 30;
const REDRAW_MS = 66;

const DASHES = { solid: [], dashed: [6, 4], dotted: [1.5, 3.5] };

const difference = (name, by) => (rows) => rows[name].map((value, k) => minus(value, rows[by][k]));
const minus = (value, other) => (value === null || other === null ? null : value - other);
const column = (name) => (rows) => rows[name];
const turned = (rows) => rows.yaw.map((yaw, k) => (yaw === null || rows.yawWanted[k] === null ? null : shortWay(yaw - rows.yawWanted[k])));

const net = (name, dash) =>
  [["P", "--blue"], ["I", "--orange"], ["D", "--green"]].map(([output, colourName]) => ({
    label: `${name} ${output}`, colour: colourName, dash, of: column(`${name}${output}`), digits: 3,
  }));

// `of(rows)`: the column that is drawn. `span`: the axis shows at least so much. `keys`: what the legend has, where not all.
const CHARTS = [
  {
    title: "Position error, m", none: "no reference", span: 0.1, middle: 0, digits: 3,
    series: [
      { label: "north", colour: "--blue", of: difference("north", "northWanted") },
      { label: "east", colour: "--orange", of: difference("east", "eastWanted") },
      { label: "up", colour: "--green", of: difference("downWanted", "down") },
    ],
  },
  {
    title: "Attitude, °", none: "no attitude", span: 6, digits: 1, wanted: "wanted",
    series: [
      { label: "roll", colour: "--blue", of: column("roll") },
      { label: "roll wanted", colour: "--blue", of: column("rollWanted"), dash: "dashed", quiet: true },
      { label: "pitch", colour: "--orange", of: column("pitch") },
      { label: "pitch wanted", colour: "--orange", of: column("pitchWanted"), dash: "dashed", quiet: true },
      { label: "yaw off", colour: "--green", of: turned },
    ],
  },
  {
    title: "PIDNN weights ÷ first", none: "no PIDNN at work here", span: 0.04, middle: 1, digits: 3,
    series: [...net("roll", "solid"), ...net("pitch", "dashed"), ...net("yaw", "dotted")],
    keys: [ // nine lines are three colours by three dashes
      { label: "P", colour: "--blue" }, { label: "I", colour: "--orange" }, { label: "D", colour: "--green" },
      { label: "roll", colour: "--soft" }, { label: "pitch", colour: "--soft", dash: "dashed" },
      { label: "yaw", colour: "--soft", dash: "dotted" },
    ],
  },
  {
    title: "Link", none: "nothing known of the link", span: 5, least: 0, digits: 1,
    series: [
      { label: "latency, ms", colour: "--blue", of: column("latency") },
      { label: "loss, %", colour: "--orange", of: column("loss"), dash: "dashed", scale: "percent" },
    ],
  },
];

export class Charts {
  constructor(place, store) {
    this.store = store;
    this.drawnAt = 0;
    this.charts = CHARTS.map((spec) => new Chart(place, spec));
  }

  /** New rows, sizes or colours are drawn; `now` in ms. */
  draw(now) {
    if (now - this.drawnAt < REDRAW_MS) return;
    this.drawnAt = now;
    const { rows } = this.store;
    const { time } = rows;
    // The window is filled from its left, and then moves on.
    const begin = Math.max(time[0] ?? 0, (time.at(-1) ?? 0) - WINDOW_S);
    const first = Math.max(0, time.findLastIndex((each) => each < begin));
    const shown = first ? Object.fromEntries(Object.entries(rows).map(([name, values]) => [name, values.slice(first)])) : rows;
    for (const chart of this.charts) chart.draw(shown, begin);
  }

  /** Lines in the colours of now. */
  repaint() {
    for (const chart of this.charts) chart.make();
    this.drawnAt = 0;
  }

  setLinkName(name) {
    this.charts.at(-1).title.textContent = name ? `Link: ${name}` : "Link";
  }
}

class Chart {
  constructor(place, spec) {
    this.spec = spec;
    this.root = document.createElement("div");
    this.root.className = "chart";
    this.head = document.createElement("header");
    this.title = document.createElement("h2");
    this.title.textContent = spec.title;
    this.plot = document.createElement("div");
    this.plot.className = "plot";
    this.none = document.createElement("p");
    this.none.className = "none";
    this.none.textContent = spec.none;
    this.from = 0;
    this.head.append(this.title);
    this.root.append(this.head, this.plot);
    place.append(this.root);
    this.values = (spec.keys ?? spec.series.filter((each) => !each.quiet)).map((each) => this.addKey(each));
    if (spec.wanted) this.addKey({ label: spec.wanted, colour: "--soft", dash: "dashed" });
    this.make();
    new ResizeObserver(() => this.resize()).observe(this.plot);
  }

  addKey({ label, colour: name, dash = "solid", of }) {
    const key = document.createElement("span");
    key.className = "key";
    key.innerHTML = '<svg viewBox="0 0 24 10" aria-hidden="true"><path d="M0 5H24" stroke-width="3"/></svg>';
    const line = key.querySelector("path");
    line.style.stroke = `var(${name})`;
    line.setAttribute("stroke-dasharray", DASHES[dash].join(" "));
    key.append(label);
    this.head.append(key);
    if (!of) return null;
    const value = document.createElement("b");
    key.append(value);
    return { of, value };
  }

  /** The plot, with the colours and sizes of now. */
  make() {
    this.uplot?.destroy();
    const { spec } = this;
    const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
    const font = `${Math.round(0.76 * rem)}px system-ui, sans-serif`;
    const lines = { stroke: colour("--soft"), font, grid: { stroke: colour("--line"), width: 1 }, ticks: { show: false } };
    const second = spec.series.some((each) => each.scale);
    this.uplot = new uPlot(
      {
        width: 10, height: 10, legend: { show: false }, cursor: { show: false }, padding: [0.5 * rem, second ? 0 : 1.2 * rem, 0, 0],
        scales: {
          x: { time: false, range: () => [this.from, this.from + WINDOW_S] },
          y: { range: (plot, low, high) => this.range(low, high) },
          percent: { range: (plot, low, high) => [0, Math.max(10, high ?? 0)] },
        },
        axes: [
          { ...lines, size: 1.25 * rem, gap: 2, space: 4 * rem, values: (plot, at) => at.map((each) => `${each} s`) },
          { ...lines, size: 3.3 * rem, gap: 4, space: 1.7 * rem },
          ...(second ? [{ ...lines, scale: "percent", side: 1, size: 2.6 * rem, gap: 4, space: 1.7 * rem, grid: { show: false }, values: (plot, at) => at.map((each) => `${each} %`) }] : []),
        ],
        series: [
          {},
          ...spec.series.map((each) => ({
            stroke: colour(each.colour), dash: DASHES[each.dash ?? "solid"], width: each.quiet ? 1.3 : 1.8, points: { show: false },
            scale: each.scale ?? "y", spanGaps: false,
          })),
        ],
      },
      [[], ...spec.series.map(() => [])],
      this.plot,
    );
    this.plot.append(this.none);
    this.resize();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.plot;
    if (width > 20 && height > 20) this.uplot.setSize({ width, height });
  }

  /** What the axis shows: all, and at least the span of the chart, about its middle where it has one. */
  range(low, high) {
    const { span, middle, least } = this.spec;
    if (low === null || low === undefined) return [(middle ?? 0) - span / 2, (middle ?? 0) + span / 2];
    let [from, to] = [low, high];
    if (middle !== undefined) {
      const half = Math.max(span / 2, (to - middle) * 1.08, (middle - from) * 1.08);
      return [middle - half, middle + half];
    }
    const missing = Math.max(0, span - (to - from)) / 2;
    [from, to] = [from - missing, to + missing];
    const margin = 0.05 * (to - from);
    return least === undefined ? [from - margin, to + margin] : [least, Math.max(to, least + span)];
  }

  draw(rows, from) {
    this.from = from;
    const columns = this.spec.series.map((each) => each.of(rows));
    this.none.hidden = columns.some((values) => values.some((value) => value !== null));
    this.uplot.setData([rows.time, ...columns]);
    for (const key of this.values) {
      if (key) key.value.textContent = signed(key.of(rows).at(-1) ?? null, this.spec.digits);
    }
  }
}
