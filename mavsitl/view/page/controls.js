// What the user does: buttons of a live flight, and the player of a replay.

import { clock } from "./frames.js";

const WORDS = {
  arm: "Arm", disarm: "Disarm", takeoff: "Take off", land: "Land", hold: "Hold", offboard: "Off-board", gust: "Gust",
  "link-down": "Link outage", "link-up": "Link up", "law-pid": "PID", "law-pidnn": "PIDNN",
};
const wordOf = (name) => WORDS[name] ?? name.replace(/^motor-(\d)-off$/, "Motor $1 off").replace(/^motor-(\d)-ok$/, "Motor $1 mended");

export class Buttons {
  /** `act(name)`: a button is pressed for the selected vehicle. */
  constructor(place, outcome, act) {
    Object.assign(this, { place, outcome, act, pressed: new Map(), told: new Map() });
    this.flight = this.group("Flight");
    this.armed = this.add(this.flight, () => (this.values?.armed ? "disarm" : "arm"));
    for (const name of ["takeoff", "land", "hold", "offboard"]) this.add(this.flight, () => name);
    const trouble = this.group("Trouble");
    this.gust = this.add(trouble, () => "gust");
    const motors = joined(trouble, "Motors");
    this.motors = [1, 2, 3, 4].map((motor) => {
      const button = this.add(motors, () => `motor-${motor}-${this.parameter(`SIM_FAIL_MOT${motor}`) ? "ok" : "off"}`, String(motor));
      button.className = "trouble";
      button.title = ["rear", "right", "front", "left"][motor - 1];
      button.setAttribute("aria-label", `Motor ${motor}, ${button.title}: stop it, or mend it`);
      return button;
    });
    this.link = this.add(trouble, () => (this.parameter("SIM_LINK_DOWN") ? "link-up" : "link-down"), "Link outage");
    this.link.className = "trouble";
    const laws = joined(this.group("Law"), "");
    this.laws = ["pid", "pidnn"].map((law) => this.add(laws, () => `law-${law}`));
  }

  group(name) {
    const set = document.createElement("fieldset");
    const legend = document.createElement("legend");
    legend.textContent = name;
    set.append(legend);
    this.place.append(set);
    return set;
  }

  /** `nameOf()`: what it does now. */
  add(place, nameOf, words = wordOf(nameOf())) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = words;
    button.addEventListener("click", () => {
      const name = nameOf();
      this.pressed.set(button, name);
      button.setAttribute("aria-busy", "true");
      this.tell("", `${wordOf(name)} …`);
      this.act(name);
    });
    place.append(button);
    return button;
  }

  parameter(name) {
    return this.values?.parameters?.[name];
  }

  draw(world, values) {
    this.values = values;
    const usable = world.buttons !== false && Boolean(values?.online);
    const allow = (button, able = true) => (button.disabled = !(usable && able));
    for (const button of this.place.querySelectorAll("button")) allow(button);
    this.armed.textContent = values?.armed ? "Disarm" : "Arm";
    this.gust.textContent = `Gust ${world.gust_m_s ?? ""} m/s`;
    allow(this.gust, this.parameter("SIM_GUST_TRIG") !== undefined);
    this.motors.forEach((button, index) => {
      const state = this.parameter(`SIM_FAIL_MOT${index + 1}`);
      allow(button, state !== undefined);
      button.setAttribute("aria-pressed", String(Boolean(state)));
    });
    allow(this.link, this.parameter("SIM_LINK_DOWN") !== undefined);
    this.link.setAttribute("aria-pressed", String(Boolean(this.parameter("SIM_LINK_DOWN"))));
    this.laws.forEach((button, index) => {
      const law = ["pid", "pidnn"][index];
      allow(button, values?.law === "pid" || values?.law === "pidnn");
      button.setAttribute("aria-pressed", String(values?.law === law));
    });
    this.showOutcome(values);
  }

  /** What came of the last button, once. */
  showOutcome(values) {
    const done = values?.act;
    if (!done || this.told.get(values.number) === done.number) return;
    const first = !this.told.has(values.number) && !this.pressed.size;
    this.told.set(values.number, done.number);
    for (const [button, name] of this.pressed) {
      if (name === done.name) {
        button.removeAttribute("aria-busy");
        this.pressed.delete(button);
      }
    }
    if (first) return; // somebody else's, from before this page was opened
    this.tell(done.problem ? "bad" : "good", done.problem ? `${wordOf(done.name)}: ${done.problem}` : `${wordOf(done.name)}: done`);
  }

  tell(state, words) {
    this.outcome.dataset.state = state;
    this.outcome.textContent = words;
  }
}

function joined(place, name) {
  const group = document.createElement("span");
  group.className = "joined";
  if (name) {
    const label = document.createElement("label");
    label.textContent = name;
    group.append(label);
  }
  place.append(group);
  return group;
}

export class Player {
  /** `send(type, fields)`: a wish to the server. */
  constructor(place, send) {
    this.place = place;
    this.playing = false;
    this.button = document.createElement("button");
    this.button.type = "button";
    this.button.addEventListener("click", () => send("play", { on: !this.playing }));
    this.slider = document.createElement("input");
    this.slider.type = "range";
    this.slider.min = "0";
    this.slider.step = "0.1";
    this.slider.setAttribute("aria-label", "Time of the flight");
    this.slider.addEventListener("input", () => send("seek", { at_s: Number(this.slider.value) }));
    this.clock = document.createElement("span");
    this.clock.className = "clock";
    this.speed = choice("Speed", (value) => send("speed", { speed: Number(value) }));
    this.flight = choice("Flight", (value) => send("open", { flight: value }));
    place.append(this.flight, this.button, this.slider, this.clock, this.speed);
    addEventListener("keydown", (event) => {
      const typing = event.target.closest?.("button, input, select");
      if (event.key === " " && !typing && !place.hidden) {
        event.preventDefault();
        this.button.click();
      }
    });
  }

  draw({ playing, at_s: at = 0, duration_s: duration = 0, speed = 1, speeds = [], flight, flights = [] }) {
    this.playing = Boolean(playing);
    const words = this.playing ? "❚❚ Pause" : "▶ Play";
    if (this.button.textContent !== words) this.button.textContent = words;
    this.slider.max = String(duration);
    if (!this.slider.matches(":active")) this.slider.value = String(at);
    this.slider.setAttribute("aria-valuetext", `${at.toFixed(1)} of ${duration.toFixed(1)} seconds`);
    this.clock.textContent = `${clock(at, 1)} / ${clock(duration)}`;
    fill(this.speed, speeds.map((each) => [String(each), `${each} ×`]), String(speed));
    fill(this.flight, flights.map((each) => [each, each]), flight);
    this.flight.hidden = flights.length < 2;
  }
}

function choice(name, onChange) {
  const select = document.createElement("select");
  select.setAttribute("aria-label", name);
  select.addEventListener("change", () => onChange(select.value));
  return select;
}

function fill(select, entries, value) {
  if (select.options.length !== entries.length) {
    select.replaceChildren(...entries.map(([entry, words]) => new Option(words, entry)));
  }
  if (select.value !== value && document.activeElement !== select) select.value = value;
}
