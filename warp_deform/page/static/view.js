// The page of `warp-deform view`: a list of episodes, and one or two of them as they are played.
import {connect} from "./connection.js";
import {$, make, note} from "./panel.js";
import {Playback} from "./playback.js";
import {openScene} from "./scene.js";
import {TopDown, decode} from "./topdown.js";

const AHEAD = 2; // clips that are asked for before they are needed
let hello = null;
const pictures = new Map(), asked = new Set();
const send = connect(hear, state => {
  document.body.dataset.connection = state;
  note({open: "", lost: "not connected; trying again", gone: "this address is no longer valid: open the one that warp-deform printed anew"}[state], false, true);
});

/** One side: its view of an episode. */
class Pane {
  constructor(side) {
    this.side = side;
    this.box = $(`pane${side}`);
    this.key = null;
    this.playback = new Playback((clip, frame) => this.frame(clip, frame), clip => this.settle(clip));
    this.still = 0;
  }

  open(key) {
    this.key = key;
    this.steps = null;
    this.box.hidden = false;
    if (this.scene === undefined) {
      this.top = new TopDown(this.box.querySelector(".top"));
      this.scene = openScene(this.box.querySelector(".scene"));
    }
    this.playback.clips = [];
    Object.assign(this.playback, {at: 0, now: 0, playing: false});
    this.says("preparing the episode: the first one of a task takes some seconds");
    send({do: "open", key, side: this.side});
  }

  /** Words in the place of an episode that is not there yet; empty once it is. */
  says(text) {
    this.preparing = Boolean(text);
    this.box.querySelector(".says").textContent = text;
    this.box.querySelector(".top").hidden = this.preparing;
  }

  /** A simulated episode's start. */
  begin(message) {
    if (message.key !== this.key) return;
    this.says("");
    this.about = message;
    this.clips = 0;
    this.same = message.same;
    this.box.querySelector(".stage").classList.toggle("flat", !this.scene);
    this.box.querySelector(".scene").hidden = !this.scene;
    this.top.furnish(message);
    this.top.build(message);
    const state = {q: message.q, body: message.body, links: message.links};
    this.top.put(state);
    if (this.scene) { this.scene.furnish(message); this.scene.build(message); this.scene.put(state); }
    this.settle(message);
    this.ask();
  }

  ask() {
    if (!this.about || this.asking || this.clips >= this.about.count) return;
    const ahead = this.playback.clips.length - this.playback.at;
    if (ahead <= AHEAD) this.asking = send({do: "clip", key: this.key, side: this.side, t: this.clips});
  }

  /** The motion of the next action, or its state where nothing moved. */
  add(message, fps) {
    this.asking = false;
    if (message.key !== this.key || message.t !== this.clips + 1) return;
    this.clips = message.t;
    if (message.same === false) this.same = false;
    if (message.q) {
      this.playback.add(Object.assign(message, {fps, frames: message.q.shape[0]}));
    } else this.settle(message);
    this.ask();
  }

  frame(clip, index) {
    const part = array => { const size = array.shape.slice(1).reduce((a, b) => a * b, 1); return array.subarray(index * size, (index + 1) * size); };
    const state = {q: part(clip.q), body: part(clip.body), links: part(clip.links)};
    this.top.still(null);
    this.top.put(state);
    this.scene?.put(state);
    this.top.draw();
    const action = this.about.actions[clip.t - 1], plan = {pick: action.slice(0, 2), place: action.slice(3, 5), turn: action[5]};
    this.scene?.plan(plan);
  }

  async settle(state) {
    this.tell(state);
    this.top.fault = state.fault ? state.fault.slice(0, 2) : null;
    this.scene?.mark(state.fault);
    this.scene?.plan(null);
    if (!state.color) return;
    const picture = await decode(state.color);
    if (!this.playback.playing) { this.top.still(picture); this.top.draw(); }
  }

  /** A recording of a real robot: its pictures, a second each. */
  async show(message) {
    if (message.key !== this.key) return;
    this.says("");
    this.about = message;
    this.scene = this.scene || null;
    this.box.querySelector(".stage").classList.add("flat");
    this.box.querySelector(".scene").hidden = true;
    this.steps = await Promise.all(Array.from({length: message.count + 1}, (_, t) => decode(message[`color${t}`])));
    const clips = this.steps.slice(1).map((_, t) => ({end: 1, fps: 1, frames: 2, t: t + 1, score: message.scores[t + 1]}));
    this.playback.show = (clip, frame) => this.picture(frame ? clip.t : clip.t - 1);
    this.playback.ended = clip => this.picture(clip.t);
    this.playback.clips = clips;
    this.picture(0);
  }

  picture(t) {
    const canvas = this.box.querySelector(".top"), picture = this.steps[t];
    canvas.width = picture.width;
    canvas.height = picture.height;
    canvas.getContext("2d").drawImage(picture, 0, 0);
    this.tell({t, score: this.about.scores[t], seconds: 0});
  }

  tell(state) {
    const {entry, count, outcomes} = this.about, simulated = !this.steps;
    const says = this.box.querySelector(".says");
    const checked = !simulated ? "a recording, not a simulation"
      : this.same === false ? "differs from the recording" : this.same ? "the recorded states, bit for bit" : "played again";
    says.replaceChildren(
      make("b", `${entry.task}, seed ${entry.seed}`),
      make("span", ` · ${entry.who} · `),
      make("span", entry.success ? "solved" : entry.kind || "not solved", {className: entry.success ? "solved" : "failed"}),
      make("br", ""),
      make("span", `action ${state.t} of ${count} · score ${state.score.toFixed(3)}${state.t && outcomes.length ? ` · ${outcomes[state.t - 1]}` : ""} · `),
      make("span", checked, {className: this.same === false ? "failed" : ""}),
      ...(state.physics ? [make("br", ""), make("span", `the physics broke: ${state.physics}`, {className: "failed"})] : []),
    );
    this.told = state;
  }

  close() { this.key = this.about = null; this.playback.clips = []; this.box.hidden = true; }
}

const panes = [new Pane(0), new Pane(1)], open = () => panes.filter(pane => pane.key !== null);

function hear(message) {
  const pane = panes[message.side];
  ({
    hello: greet,
    thumbnails: draw,
    scene: () => pane.begin(message),
    clip: () => pane.add(message, hello.frames),
    still: () => pane.add(message, hello.frames),
    pictures: () => pane.show(message),
    note: () => { for (const each of panes) { each.asking = false; if (each.preparing) each.says(message.text); } fetching = false; note(message.text); },
  })[message.kind](message);
}

function greet(message) {
  hello = message;
  asked.clear(); // what was on its way is lost
  wanted.clear();
  fetching = false;
  $("title").textContent = hello.title.split("/").filter(Boolean).at(-1);
  $("title").title = hello.title;
  document.title = `${$("title").textContent} · warp-deform`;
  const choices = (id, all, name) => {
    const values = [...new Set(hello.entries.map(entry => entry[name]).filter(Boolean))].sort();
    $(id).replaceChildren(make("option", all, {value: ""}), ...values.map(value => make("option", value, {value})));
    $(id).hidden = values.length < (name === "group" ? 2 : 1);
  };
  choices("kind", "any failure", "kind");
  choices("group", "all lists", "group");
  list();
}

function list() {
  const [which, kind, group] = ["which", "kind", "group"].map(id => $(id).value);
  const fits = {"": () => true, solved: e => e.success, unsolved: e => !e.success && !e.trouble, damaged: e => e.trouble};
  const shown = hello.entries.filter(e => fits[which](e) && (!kind || e.kind === kind) && (!group || e.group === group));
  const solved = shown.filter(entry => entry.success).length;
  $("count").textContent = `${shown.length} of ${hello.entries.length} episodes, ${solved} solved`;
  $("list").replaceChildren(...shown.map(entry => {
    const item = make("li", ""), button = make("button", "", {className: "open"});
    const canvas = make("canvas", "", {width: 160, height: 320});
    button.append(canvas, make("span", `seed ${entry.seed}`), make("br", ""), make("span", entry.trouble ? "damaged" : entry.success ? `solved, ${entry.actions}` : entry.kind || "not solved", {className: entry.success ? "solved" : "failed"}));
    button.title = entry.trouble || `${entry.group ? `${entry.group}: ` : ""}${entry.who}, score ${entry.score.toFixed(3)}, ${entry.actions} actions`;
    button.onclick = event => choose(entry, event.shiftKey ? 1 : 0);
    item.dataset.key = entry.key;
    item.append(button);
    if (!entry.trouble) item.append(make("button", "⇄", {className: "beside", title: "watch it beside the other", onclick: () => choose(entry, 1)}));
    seen.observe(item);
    return item;
  }));
  document.body.dataset.listed = shown.length;
}

// pictures are asked for when their place comes into view
const wanted = new Set();
let fetching = false;
const seen = new IntersectionObserver(entries => {
  for (const {isIntersecting, target} of entries) {
    const key = Number(target.dataset.key);
    if (!isIntersecting) continue;
    if (pictures.has(key)) place(key); else if (!asked.has(key)) { asked.add(key); wanted.add(key); }
  }
}, {rootMargin: "200px"});

/** Ask for pictures, but not while somebody waits for a motion: some of them take a while. */
function fetchPictures() {
  if (fetching || !wanted.size || hello.at_once < 2 && open().some(pane => pane.asking || pane.playback.playing)) return;
  const keys = [...wanted].slice(0, hello.at_once);
  fetching = send({do: "thumbnails", keys});
  if (fetching) keys.forEach(key => wanted.delete(key));
}

async function draw(message) {
  for (const [name] of message.arrays) { pictures.set(Number(name), await decode(message[name])); place(Number(name)); }
  document.body.dataset.pictures = pictures.size;
  fetching = false;
}

function place(key) {
  const canvas = document.querySelector(`li[data-key='${key}'] canvas`), picture = pictures.get(key);
  if (canvas && picture) { canvas.width = picture.width; canvas.height = picture.height; canvas.getContext("2d").drawImage(picture, 0, 0); }
}

function choose(entry, side) {
  note("");
  if (entry.trouble) { note(entry.trouble); return; }
  if (side === 1 && panes[0].key === null) side = 0;
  panes[side].open(entry.key);
  $("close").hidden = panes[1].key === null;
  for (const name of ["shown0", "shown1"]) document.querySelectorAll(`.${name}`).forEach(each => each.classList.remove(name));
  panes.forEach((pane, k) => pane.key !== null && document.querySelector(`li[data-key='${pane.key}'] .open`)?.classList.add(`shown${k}`));
}

for (const id of ["which", "kind", "group"]) $(id).onchange = list;
$("close").onclick = () => { panes[1].close(); $("close").hidden = true; };
$("pause").onclick = () => {
  const running = open().some(pane => pane.playback.playing);
  for (const {playback} of open()) { if (playback.clip && (running || !playback.playing)) running ? playback.playing = false : playback.toggle(); }
};
$("time").oninput = () => { for (const {playback} of open()) if (playback.clip) playback.scrub(Number($("time").value)); };
$("time").onchange = () => { for (const pane of open()) if (pane.playback.clip && pane.playback.finished) pane.playback.ended(pane.playback.clip); $("time").blur(); };

let before = 0;
function loop(now) {
  requestAnimationFrame(loop);
  for (const pane of open()) {
    pane.playback.speed = Number($("speed").value);
    pane.playback.tick((now - before) / 1000);
    if (pane.scene) { pane.scene.pace((now - before) / 1000, pane.playback.playing); pane.scene.draw(); }
    if (!pane.steps) pane.ask();
  }
  before = now;
  fetchPictures();
  const longest = open().map(pane => pane.playback).filter(playback => playback.clip).sort((a, b) => b.length - a.length)[0];
  $("pause").disabled = $("time").disabled = !longest;
  $("pause").textContent = open().some(pane => pane.playback.playing) ? "Pause" : "Play";
  if (longest && document.activeElement !== $("time")) $("time").value = longest.time / longest.length;
  $("time-says").textContent = longest ? `${longest.time.toFixed(1)} s` : "";
  panes.forEach((pane, k) => Object.assign(document.body.dataset, {
    [`clips${k}`]: pane.key === null ? "" : pane.playback.clips.length,
    [`playing${k}`]: pane.playback.playing, [`at${k}`]: pane.told?.t ?? "", [`same${k}`]: pane.about ? pane.same : "",
    [`count${k}`]: pane.about?.count ?? "",
  }));
}
requestAnimationFrame(loop);
