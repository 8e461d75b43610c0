// The page of `warp-deform play`: what comes from the server goes to the views, and back.
import {connect} from "./connection.js";
import {goalLayer, heatLayer, peak} from "./heat.js";
import {$, introduce, note, offerLifts, paint, rank, tell} from "./panel.js";
import {Playback} from "./playback.js";
import {Hand} from "./pointer.js";
import {openScene} from "./scene.js";
import {TopDown, decode} from "./topdown.js";

const scene = openScene($("scene")), top = new TopDown($("top"));
let hello = null, shown = null, latest = null, lift = 0, probing = false, waiting = false;
// the state that clips lead to is told when they have been seen
const playback = new Playback(showFrame, clip => settle(clip));
const send = connect(hear, changed);

const hand = new Hand({
  scene, top,
  ready: () => Boolean(hello) && !waiting && playback.finished,
  // a press while things move goes to their end, and picks nothing that the person has not seen lie
  begin: () => {
    if (!hello || waiting) return false;
    const still = playback.finished;
    if (!still) playback.finish();
    return still;
  },
  inside: ([x, y]) => { const [[x0, x1], [y0, y1]] = hello.bounds; return x >= x0 && x <= x1 && y >= y0 && y <= y1; },
  say: plan => {
    hand.plan = plan;
    top.planned = plan;
    top.grasp = null;
    if (scene) { scene.plan(plan); if (plan) scene.highlight(null); }
    refresh();
  },
  act: (pick, place) => ask({do: "act", pick, place, turn: hand.turn, lift}),
  look: xy => {
    if (!xy || !hand.inside(xy)) { light(null); return; }
    if (!probing) probing = send({do: "probe", xy, turn: hand.turn});
  },
});
hand.turned = angle => { $("turn").value = Math.round(angle * 180 / Math.PI); $("turn-says").textContent = `${$("turn").value}°`; };

function light(grasp) {
  top.grasp = grasp;
  if (scene) scene.highlight(grasp);
  refresh();
}

/** Ask for something that changes the state, as it is now. */
function ask(message) {
  if (waiting) note("one thing at a time: what was asked for before is still at work", true);
  if (waiting || !latest) return false;
  waiting = send({...message, at: latest.version});
  pressed = performance.now();
  mark();
  return waiting;
}

function hear(message) {
  ({hello: greeted, scene: staged, lead: led, clip: moved, note: noted, grasp: probed, work: worked, sight: seen, table: ranked, gradient: pulled})[message.kind](message);
  mark();
}

function greeted(message) {
  hello = message;
  lift = hello.lifts[0];
  introduce(hello);
  setLift(lift);
  top.furnish(hello);
  if (scene) scene.furnish(hello);
}

function staged(message) {
  waiting = false;
  latest = shown = message;
  playback.keep(message.seed, message.actions);
  top.build(message);
  const state = {q: message.q, body: message.body, links: message.links};
  top.put(state);
  if (scene) { scene.build(message); scene.put(state); scene.highlight(null); }
  hand.drop();
  forget();
  settle(message);
}

/** The beginning of a motion, while the server is at the rest of it. */
function led(message) { playback.add(newMotion({...message, open: true})); }

function moved(message) {
  waiting = false;
  latest = playback.complete(playback.open ? timed(message) : newMotion(message));
}

const timed = clip => Object.assign(clip, {frames: clip.q.shape[0], fps: hello.frames});

function newMotion(clip) {
  hand.drop();
  light(null);
  forget();
  clip.sight = coming;
  coming = null;
  return timed(clip);
}

/** What somebody would do, and where it looks. */
async function seen(message) {
  if (message.acts) { coming = message; return; } // shown with the motion that follows
  forget();
  waiting = false;
  const [px, py, , qx, qy, yaw] = message.action;
  const maps = await Promise.all(["pick", "place"].map(name => message[name] && decode(message[name])));
  ["pick", "place"].forEach((name, k) => { if (maps[k]) overlay(name, heatLayer(maps[k], name), 0.002 + 0.001 * k); });
  sighted = {pick: [px, py], place: [qx, qy], turn: yaw};
  top.planned = sighted;
  if (scene) scene.plan(sighted);
  $("sight").hidden = false;
  $("sight").textContent = maps[0]
    ? `${message.who}: orange is where it would pick, blue where it would place`
    : `${message.who} sees the state and no picture, so it has no heat maps`;
  document.body.dataset.peak = maps[0] ? peak(maps[0]).join(" ") : "none";
  refresh();
}

let sighted = null, coming = null, moving = null, pressed = 0;
function overlay(name, layer, height) {
  if (layer) top.layers[name] = layer; else delete top.layers[name];
  if (scene) scene.overlay(name, layer, hello.grid, height);
}

/** Take away what was shown of others. */
function forget() {
  overlay("pick", null);
  overlay("place", null);
  if (sighted && top.planned === sighted) { top.planned = null; if (scene) scene.plan(null); }
  sighted = null;
  pulled({});
  $("sight").hidden = true;
  delete document.body.dataset.peak;
  refresh();
}

function pulled({place, to, says}) {
  waiting = false;
  top.pull = to ? [place, to] : null;
  if (scene) scene.gradient(to ? place : null, to);
  if (says) { $("sight").hidden = false; $("sight").textContent = says; }
  document.body.dataset.pull = to ? to.join(" ") : "";
  refresh();
}

function ranked(message) {
  rank(message.rows);
  if (waiting) $("contest").scrollIntoView({block: "nearest"}); // it was asked for, and may be out of sight
  waiting = false;
}

function noted(message) {
  waiting = probing = false;
  note(message.text, message.good);
}

function probed(message) {
  probing = false;
  if (message.version === latest.version && !playback.playing) light(message);
}

function worked(message) {
  $("work").hidden = $("stop").hidden = !message.who;
  $("work").textContent = `${message.who} is choosing`;
}

/** Tell of a state whose motion has been seen. */
async function settle(state) {
  shown = state;
  tell(state, hello);
  blame(state.fault);
  if (state.sight) { forget(); moving = null; } // what somebody meant to do is done
  mark();
  $("goal-box").hidden = !state.goal;
  if (state.goal) { goal = await paint("goal", state.goal); ghost(); }
  if (state.height) paint("height", state.height);
  if (!state.color) return;
  const picture = await decode(state.color);
  if (shown === state && !playback.playing) { top.still(picture); refresh(); }
}

/** Show where a guard of the physics fired, or nothing. */
function blame(at) {
  top.fault = at ? at.slice(0, 2) : null;
  scene?.mark(at);
  document.body.dataset.fault = at ? at.join(" ") : "";
  refresh();
}

let goal = null;
function ghost() { if (scene && goal) scene.overlay("goal", $("ghost").checked ? goalLayer(goal) : null, hello.grid, 0.0012); refresh(); }

function showFrame(clip, frame) {
  if (clip !== moving) {
    moving = clip;
    if (pressed) document.body.dataset.waited = ((performance.now() - pressed) / 1000).toFixed(3);
    pressed = 0;
    if (clip.sight) seen({...clip.sight, acts: false}); else forget();
  }
  const part = (array, rest) => array.subarray(frame * rest, (frame + 1) * rest);
  const size = array => array.shape.slice(1).reduce((a, b) => a * b, 1);
  const state = {q: part(clip.q, size(clip.q)), body: part(clip.body, size(clip.body)), links: part(clip.links, size(clip.links))};
  top.still(null);
  top.put(state);
  if (scene) scene.put(state);
  if (top.fault) blame(null);
  refresh();
}

let stale = true;
function refresh() { stale = true; }

function changed(state) {
  waiting = probing = false;
  const says = {
    open: "",
    lost: "not connected; trying again",
    gone: "this address is no longer valid: open the one that warp-deform printed when it started anew",
  };
  note(says[state], false, true);
  document.body.dataset.connection = state;
}

/** What tests wait for; a strict policy forbids evaluating scripts in the page. */
function mark() {
  Object.assign(document.body.dataset, {
    actions: shown ? shown.actions : "", score: shown ? shown.score : "", seed: shown ? shown.seed : "",
    hash: shown ? shown.hash : "", over: shown ? shown.over : "", playing: playback.playing, waiting,
    clips: playback.clips.length, end: playback.length, time: playback.time.toFixed(3),
    drawn: scene ? scene.drawn : 0, share: scene ? scene.share : "", webgl: Boolean(scene), slow: Boolean(scene?.slow),
    q: top.q ? top.q.reduce((sum, x, k) => sum + x * (k % 7 + 1), 0).toFixed(6) : "",
  });
}

/** Another text: the same one would be laid out and painted anew in every frame. */
function write(id, text) { if ($(id).textContent !== text) $(id).textContent = text; }

let before = 0;
function loop(now) {
  requestAnimationFrame(loop);
  playback.speed = Number($("speed").value);
  playback.tick((now - before) / 1000);
  if (scene) { scene.pace((now - before) / 1000, playback.playing); scene.draw(); }
  before = now;
  if (stale) { stale = false; top.draw(); }
  $("time").disabled = $("pause").disabled = !playback.clip;
  write("pause", playback.playing ? "Pause" : "Play");
  if (document.activeElement !== $("time")) $("time").value = playback.length ? playback.time / playback.length : 1;
  write("time-says", playback.clip ? `${playback.time.toFixed(1)} s` : "");
  write("hint", hint());
  mark();
}

function pull() {
  const plan = hand.plan;
  if (!plan?.place) { note("click what to pick first, then hold the pointer where it would go"); return; }
  ask({do: "gradient", pick: plan.pick, place: plan.place, turn: hand.turn, lift});
}

function hint() {
  if (!hello) return "connecting";
  if (playback.clip?.open && playback.now >= playback.clip.end) return "the rest of the motion is being computed";
  if (playback.playing || waiting) return "";
  if (!playback.finished) return "paused: P plays on, a click on the table goes to the end";
  if (shown?.over) return `${shown.over}: undo, or go on to the next`;
  if (hand.pick) return "click where it goes; Q and E turn, Esc lets go";
  return scene ? "click or drag what to pick (or arrows and Enter); drag beside it to look around, scroll to come nearer" : "click what to pick, or drag it; or arrows and Enter";
}

function setLift(value) { lift = value; offerLifts(hello.lifts, lift, setLift); }

$("undo").onclick = () => ask({do: "undo"});
$("again").onclick = () => ask({do: "reset", seed: latest.seed});
$("next").onclick = () => ask({do: "next"});
$("keep").onclick = () => ask({do: "keep"});
$("seeds").onsubmit = event => { event.preventDefault(); ask({do: "reset", seed: Math.round(Number($("seed").value))}); };
$("step").onclick = () => ask({do: "demonstrate", who: $("who").value, whole: false});
$("whole").onclick = () => ask({do: "demonstrate", who: $("who").value, whole: true});
$("look").onclick = () => ask({do: "look", who: $("who").value});
$("versus").onclick = () => ask({do: "versus", who: $("who").value});
$("pull").onclick = () => pull();
$("ghost").onchange = ghost;
$("stop").onclick = () => send({do: "stop"});
$("pause").onclick = () => playback.toggle();
$("time").oninput = () => { playback.scrub(Number($("time").value)); mark(); };
$("time").onchange = () => { if (playback.finished) settle(playback.clip); $("time").blur(); };
$("turn").oninput = () => hand.setTurn($("turn").value * Math.PI / 180);
document.addEventListener("visibilitychange", () => { if (document.hidden && playback.playing) playback.finish(); });
document.addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT)$/.test(event.target.tagName) && event.target.type !== "range") return;
  const {tagName} = event.target, arrow = event.key.startsWith("Arrow"), press = event.key === "Enter" || event.key === " ";
  if (hello && !(tagName === "INPUT" && arrow) && !(/^(INPUT|BUTTON)$/.test(tagName) && press) && hand.key(event.key, event.shiftKey, hello.bounds)) {
    event.preventDefault();
    if (arrow) $("scene").focus({preventScroll: true}); // or Enter would press the button that was pressed last
    return;
  }
  const turn = event.shiftKey ? Math.PI / 36 : Math.PI / 12;
  const keys = {
    q: () => hand.setTurn(hand.turn + turn), e: () => hand.setTurn(hand.turn - turn), escape: () => hand.drop(),
    u: () => $("undo").click(), n: () => $("next").click(), k: () => $("keep").click(), p: () => playback.toggle(), l: () => $("look").click(), g: () => pull(),
  };
  const key = event.key.toLowerCase();
  if (key in keys) keys[key]();
  else if (/^[1-9]$/.test(key) && hello?.lifts[key - 1] !== undefined) setLift(hello.lifts[key - 1]);
});
requestAnimationFrame(loop);
