// The page: news come in as they come, and what has changed is drawn once a picture.

import { Charts } from "./charts.js";
import { Buttons, Player } from "./controls.js";
import { Horizon } from "./horizon.js";
import { Link } from "./link.js";
import { Scene } from "./scene.js";
import { Badges, Chips, Readouts, Texts } from "./status.js";
import { Store } from "./store.js";
import { startTheme } from "./theme.js";

const at = (id) => document.getElementById(id);

let broken = "";

const store = new Store();
const link = new Link(take, showConnection);
const scene = new Scene(at("canvas"), at("labels"), store, select);
const charts = new Charts(at("charts"), store);
const horizon = new Horizon(at("horizon"));
const chips = new Chips(at("vehicles"), store, select);
const badges = new Badges(at("badges"));
const readouts = new Readouts(at("readouts"));
const texts = new Texts(at("texts").querySelector("ol"), store);
const buttons = new Buttons(at("buttons"), at("outcome"), (name) => link.send("act", { vehicle: store.selected, name }));
const player = new Player(at("player"), (type, fields) => link.send(type, fields));
startTheme(at("theme"), () => {
  scene.repaint();
  charts.repaint();
});
addCameras();

link.onOpen = () => {
  store.reset();
  if (store.selected !== null) select(store.selected);
};

function take(news) {
  if (news.problem) buttons.tell("bad", news.problem);
  store.take(news);
  if (!store.vehicle && store.vehicles.size) select(store.sorted[0].number);
}

function select(number) {
  store.selected = number;
  store.clearRows();
  link.send("select", { vehicle: number });
}

function showConnection(state, failures) {
  document.body.dataset.link = state;
  at("connection").dataset.state = state;
  at("connection").textContent = state === "open" ? "connected" : "trying to connect";
  // The server may have a reason that a page is not told: the token.
  const hint = "\nIf its address was given with a token, the whole of it is needed.";
  broken = state === "broken" && failures > 1 ? `The server does not answer.${failures > 3 ? hint : ""}` : "";
}
function addCameras() {
  const views = { follow: "Follow", all: "All", top: "Top", free: "Free" };
  const made = Object.entries(views).map(([view, words]) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = words;
    button.addEventListener("click", () => choose(view));
    at("cameras").append(button);
    return [view, button];
  });
  const choose = (wanted) => {
    scene.setView(wanted);
    for (const [view, button] of made) button.setAttribute("aria-pressed", String(view === wanted));
  };
  choose("follow");
}

function notice() {
  if (broken) return broken;
  if (store.vehicles.size || store.world.kind !== "live") return "";
  return "No vehicle is heard yet.\nStart one: mavsitl vehicle";
}

function draw(now) {
  requestAnimationFrame(draw);
  const values = store.vehicle;
  const replay = store.world.kind === "replay";
  scene.draw(now);
  charts.draw(now);
  charts.setLinkName(values?.link?.of);
  horizon.show(values?.attitude ?? null, values?.wanted ?? null);
  chips.draw();
  badges.draw(values);
  readouts.draw(values);
  texts.draw();
  at("buttons").hidden = replay;
  at("player").hidden = !replay;
  if (replay) player.draw(store.world);
  else buttons.draw(store.world, values);
  const words = notice();
  at("notice").hidden = !words;
  if (at("notice").textContent !== words) at("notice").textContent = words;
}
requestAnimationFrame(draw);
