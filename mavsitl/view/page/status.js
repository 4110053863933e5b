// What is said in words: vehicles to choose from, badges, readouts, texts. Text of others is set as text, never as HTML.

import { clock, length, signed } from "./frames.js";
import { ownColourName } from "./theme.js";

/** MAV_SEVERITY: up to 3 errors, 4 a warning. */
const severityOf = (severity) => (severity <= 3 ? ["bad", "✕", "error"] : severity === 4 ? ["even", "!", "warning"] : ["", "·", ""]);

/** A vehicle's state in a word for its chip: good, alarm or gone. */
function stateOf(values) {
  if (!values.online) return "gone";
  return values.failsafe || values.terminated ? "alarm" : "good";
}

export class Chips {
  constructor(place, store, onSelect) {
    Object.assign(this, { place, store, onSelect, chips: new Map() });
  }

  draw() {
    const { vehicles, selected } = this.store;
    for (const [number, chip] of this.chips) {
      if (!vehicles.has(number)) {
        chip.remove();
        this.chips.delete(number);
      }
    }
    for (const values of this.store.sorted) {
      let chip = this.chips.get(values.number);
      if (!chip) {
        chip = document.createElement("button");
        chip.type = "button";
        chip.dataset.vehicle = values.number;
        chip.innerHTML = "<i></i><span></span>";
        chip.firstChild.style.setProperty("--own", `var(${ownColourName(values.number)})`);
        chip.addEventListener("click", () => this.onSelect(values.number));
        this.chips.set(values.number, chip);
        const after = [...this.place.children].find((other) => Number(other.dataset.vehicle) > values.number);
        this.place.insertBefore(chip, after ?? null);
      }
      const state = stateOf(values);
      const name = vehicles.size > 6 ? `${values.number}` : `Vehicle ${values.number}`;
      set(chip.lastChild, { good: name, alarm: `${name} ⚠`, gone: `${name} silent` }[state]);
      chip.dataset.state = state;
      chip.setAttribute("aria-pressed", String(values.number === selected));
    }
  }
}

export class Badges {
  constructor(place) {
    this.place = place;
    this.shown = "";
  }

  draw(values) {
    const badges = values ? badgesOf(values) : [];
    const text = JSON.stringify(badges);
    if (text === this.shown) return;
    this.shown = text;
    this.place.replaceChildren(
      ...badges.map(([kind, words]) => {
        const badge = document.createElement("span");
        badge.className = `badge ${kind}`;
        badge.textContent = words;
        return badge;
      }),
    );
  }
}

function badgesOf(values) {
  const badges = [["mode", values.mode ?? "no mode yet"]];
  if (!values.online) badges.push(["bad", "silent"]);
  if (values.terminated) badges.push(["bad", "⚠ flight terminated"]);
  else if (values.failsafe) badges.push(["bad", "⚠ fail-safe"]);
  if (values.intended && values.intended !== values.mode) badges.push(["even", `chosen: ${values.intended}`]);
  if ("armed" in values) badges.push(values.armed ? ["good", "armed"] : ["", values.ready ? "disarmed" : "not ready to arm"]);
  if (values.landed) badges.push(["", values.landed]);
  if (values.law === "pid" || values.law === "pidnn") badges.push(["", values.law.toUpperCase()]);
  if (values.ground) badges.push([values.ground === "LOST" ? "bad" : "", `ground: ${values.ground.toLowerCase()}`]);
  for (const part of values.unhealthy ?? []) badges.push(["bad", `${part} unhealthy`]);
  return badges;
}

export class Readouts {
  constructor(place) {
    this.rows = new Map();
    this.place = place;
  }

  draw(values) {
    for (const [name, text] of Object.entries(values ? readoutsOf(values) : {})) {
      let value = this.rows.get(name);
      if (!value) {
        const term = document.createElement("dt");
        term.textContent = name;
        value = document.createElement("dd");
        this.place.append(term, value);
        this.rows.set(name, value);
      }
      set(value, text);
    }
  }
}

function readoutsOf({ position, velocity, reference, wind, battery, time_s: time }) {
  const error = position && reference ? length(position.map((each, k) => each - reference[k])) : null;
  const volts = battery?.voltage_v === null || !battery ? "–" : `${battery.voltage_v.toFixed(1)} V`;
  return {
    height: position ? `${signed(-position[2], 2)} m` : "–",
    speed: velocity ? `${length(velocity).toFixed(2)} m/s` : "–",
    error: error === null ? "–" : error < 1 ? `${(100 * error).toFixed(1)} cm` : `${error.toFixed(2)} m`,
    wind: wind ? `${length(wind.velocity).toFixed(1)} m/s` : "–",
    battery: battery?.percent !== null && battery ? `${volts}  ${battery.percent} %` : volts,
    time: time === undefined ? "–" : clock(time, 1),
  };
}

export class Texts {
  constructor(list, store) {
    Object.assign(this, { list, store });
  }

  /** The newest first. */
  draw() {
    if (!this.store.textsChanged) return;
    this.store.textsChanged = false;
    const several = this.store.vehicles.size > 1;
    this.list.replaceChildren(
      ...[...this.store.texts].reverse().map(({ severity, text, time_s: time, vehicle }) => {
        const [kind, sign, word] = severityOf(severity);
        const item = document.createElement("li");
        item.className = kind;
        const parts = [["time", time === null ? "" : clock(time, 1)], ["span", sign], ["span", several ? `${vehicle}: ${text}` : text]];
        for (const [tag, words] of parts) {
          const part = document.createElement(tag);
          part.textContent = words;
          item.append(part);
        }
        if (word) item.children[1].setAttribute("aria-label", word);
        return item;
      }),
    );
  }
}

function set(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
