// What the server has told: values of the whole and of each vehicle, the selected vehicle's rows, texts.

/** The columns of a row: `COLUMNS` in mavsitl/view/model.py. */
export const COLUMNS = [
  "time", "north", "east", "down", "northWanted", "eastWanted", "downWanted",
  "roll", "pitch", "yaw", "rollWanted", "pitchWanted", "yawWanted",
  "rollP", "rollI", "rollD", "pitchP", "pitchI", "pitchD", "yawP", "yawI", "yawD", "latency", "loss",
];

const KEPT_S = 60;
const KEPT_TEXTS = 200;

export class Store {
  constructor() {
    this.reset();
    this.selected = null;
  }

  /** Forget everything: a connection begins anew and is told all. */
  reset() {
    this.world = {};
    this.vehicles = new Map();
    this.texts = [];
    this.textsChanged = true;
    this.clearRows();
  }

  clearRows() {
    this.rows = Object.fromEntries(COLUMNS.map((name) => [name, []]));
    this.rowsOf = null;
  }

  /** Take news in. */
  take(news) {
    if (news.world) {
      if ("chapter" in news.world && "chapter" in this.world) {
        this.vehicles.clear();
        this.clearRows();
      }
      Object.assign(this.world, news.world);
    }
    for (const [number, values] of Object.entries(news.vehicles ?? {})) {
      const known = this.vehicles.get(Number(number));
      if (known) Object.assign(known, values);
      else this.vehicles.set(Number(number), { number: Number(number), ...values });
    }
    if (news.rows) this.takeRows(news.rows);
    if (news.forget_texts) this.texts = [];
    if (news.texts) this.texts = [...this.texts, ...news.texts].slice(-KEPT_TEXTS);
    this.textsChanged ||= Boolean(news.forget_texts || news.texts);
  }

  takeRows({ vehicle, whole, rows }) {
    if (whole) {
      this.clearRows();
      this.rowsOf = vehicle;
    }
    if (this.rowsOf !== vehicle) return;
    for (const row of rows) COLUMNS.forEach((name, index) => this.rows[name].push(row[index]));
    const { time } = this.rows;
    const oldest = time.at(-1) - KEPT_S;
    // Not at each row: what is too old may stay a while.
    if (time[0] < oldest - 10) {
      const gone = time.findIndex((each) => each >= oldest);
      for (const name of COLUMNS) this.rows[name].splice(0, gone);
    }
  }

  get vehicle() {
    return this.vehicles.get(this.selected) ?? null;
  }

  /** Vehicles in the order of their numbers. */
  get sorted() {
    return [...this.vehicles.values()].sort((one, other) => one.number - other.number);
  }
}
